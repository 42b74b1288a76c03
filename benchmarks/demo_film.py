"""Makes the film of the first page of the documentation, from a run of the demo, and writes its caption.

    python -m benchmarks.demo_film

The command runs the job of `make demo`, writes `docs/images/demo.webp`, and states time and machine in `docs/index.md`.
"""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Sequence
from pathlib import Path

from pathreplay import optimize
from pathreplay.platform.threads import processor_name, usable_cores
from pathreplay.report.watch.timelapse import film

from .drafts import ROOT

JOB = ROOT / "examples" / "cornell-photo" / "config.toml"
#: More time for frames than by default, and as many as keep the film small.
FRAMES = ("preview.share=0.2", "preview.views=1", "preview.frames=20")
CAPTION = re.compile(r"(<!-- begin demo-film -->\n).*?(<!-- end demo-film -->)", re.DOTALL)


def make(images: Path, page: Path, define: Sequence[str] = ()) -> str:
    """Write the film into a folder and its caption into a page.

    Args:
        images: folder of the film.
        page: page with the markers of the caption.
        define: changes to the job, each ``KEY=VALUE``.

    Returns:
        The caption.
    """
    with tempfile.TemporaryDirectory() as folder:
        result = optimize(JOB, output=Path(folder, "run"), define=(*FRAMES, *define))
        film(result.folder, images / "demo.webp")
    seconds = sum(entry.seconds for entry in result.history)
    caption = (
        f"*{result.iterations} iterations in {seconds:.0f} seconds, on {usable_cores()} processors of a machine with "
        f"{processor_name()} (`python -m benchmarks.demo_film`).*"
    )
    page.write_text(CAPTION.sub(rf"\g<1>{caption}\n\g<2>", page.read_text(encoding="utf-8")), encoding="utf-8")
    return caption


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as cache:
        os.environ["DRJIT_CACHE_DIR"] = cache  # the time is that of a first run
        print(make(ROOT / "docs" / "images", ROOT / "docs" / "index.md"))
