"""The film of the first page: it is made by a run of the demo, which also writes its caption."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import PIL.Image
import pytest

from places import ROOT

sys.path.insert(0, str(ROOT))  # the benchmarks run from the checkout and are not installed

from benchmarks.demo_film import CAPTION, make

PAGE, FILM = ROOT / "docs/index.md", ROOT / "docs/images/demo.webp"


def test_the_film_is_small_and_moves() -> None:
    with PIL.Image.open(FILM) as film:
        assert film.n_frames > 8 and film.width > 2 * film.height
    assert FILM.stat().st_size < 1_500_000
    assert CAPTION.search(PAGE.read_text(encoding="utf-8"))


@pytest.mark.slow
def test_a_run_makes_film_and_caption(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- begin demo-film -->\nold\n<!-- end demo-film -->\nafter\n", encoding="utf-8")
    small = (
        "iterations=3",
        "spp=2",
        "eval_spp=2",
        "target.spp=4",
        "scene_parameters.resolution=16",
        "preview.share=0.5",
    )
    caption = make(tmp_path, page, small)
    assert re.fullmatch(r"\*3 iterations in \d+ seconds, on \d+ processors of a machine with .+ \(`.+`\)\.\*", caption)
    assert page.read_text(encoding="utf-8").splitlines()[1:4:2] == [
        "<!-- begin demo-film -->",
        "<!-- end demo-film -->",
    ]
    assert caption in page.read_text(encoding="utf-8") and "old" not in page.read_text(encoding="utf-8")
    with PIL.Image.open(tmp_path / "demo.webp") as film:
        assert film.n_frames > 1
