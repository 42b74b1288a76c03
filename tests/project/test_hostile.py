"""Hostile input ends with an answer: a handful of cases in this process, and hundreds in processes of their own."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

import pytest

from hostile.assets import make_room
from hostile.battery import Lane, make_assets, run_cases, table
from hostile.case import RECIPES, Case
from hostile.generate import COUNT, make_case
from hostile.judge import Ended, judge
from hostile.pairs import KEYS, Cover, missing_keys
from hostile.room import Room
from hostile.snapshot import snapshot
from measured import TOLD
from pathreplay import cli
from places import DATA

DATA = DATA / "vdb.zip"

#: Far above what all cases take on two quiet cores, which is six minutes.
LIMIT_S = 2400

#: Of a job with edges, a baseline, stages and numbers of samples of its own, which compiles some dozens of kernels.
MANY_KERNELS_S = 400


# One for each way in which a mistake is found, and none that needs a run.
HANDFUL = (
    "spp = True",
    "spp = 1000000000",
    "lists 3000 deep",
    "quoted key of control characters",
    "key of 100 kB",
    "target.integrator.type = 'diffuse'",
    "the config is fifo",
    "stages.0.downscale = 5",
    "YAML: a billion laughs",
    "YAML: an object",
    "no scene but a BSDF",
    "PLY with a face of vertex 1000",
    "PLY with a head of 1 MB",
    "target: a pixel of nan",
    "target: PNG of 100000 x 100000",
    ".vol as a value: cut short",
    ".vol in a scene: 5 channels",
    "a film of zero (check)",
    "a shapegroup of nothing",
    "serialized: a face of vertex 1000, a wrong checksum",
    "serialized: 1e6 shapes",
    "value: a.jpg of 65500 x 65400",
    "loss: ends Python with 0",
    "penalty: a text",
)


@pytest.fixture(scope="module")
def assets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("assets")
    make_room(folder / "room", DATA)
    return folder


@pytest.mark.parametrize("name", HANDFUL)
def test_a_handful_is_refused(
    name: str, assets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    recipe = next(recipe for recipe in RECIPES if recipe.name == name)
    room = Room.new(tmp_path, assets)
    action = Case(0, 0, recipe).prepare(room)
    before = snapshot(tmp_path)
    monkeypatch.chdir(room.path)
    monkeypatch.setattr(sys, "argv", ["pathreplay", *action.argv])
    with pytest.raises(SystemExit) as end:
        cli.main()
    ended = Ended(int(end.value.code or 0), "", 0.0, 0, *capfd.readouterr())
    assert judge(recipe, action, ended, before, snapshot(tmp_path)).findings == (), ended.stderr
    assert ended.status == 2


@pytest.mark.slow
def test_hostile_cases_end_with_an_answer() -> None:
    """No traceback, no death by a signal, no hang, nothing written elsewhere, never more than 4 GB."""
    results = run_cases([make_case(seed=0, number=number) for number in range(COUNT)], limit_s=LIMIT_S)
    TOLD.append(table(results))
    assert len(results) >= 400
    assert not (found := [str(result) for result in results if result.verdict.findings]), "\n".join(found)


def test_no_key_of_a_job_is_left_out_of_the_pairs() -> None:
    assert missing_keys() == set()


@pytest.mark.slow
def test_every_pair_of_keys_of_a_job_runs_or_is_refused(tmp_path: Path) -> None:
    """Two iterations on a tiny scene. What is refused is told in one line, before the first of them; most pairs run."""
    assets = make_assets(tmp_path)
    lane = Lane(tmp_path / "lane", assets)
    try:
        cover = Cover(partial(lane.try_case, timeout=MANY_KERNELS_S))
        cover.run()
    finally:
        lane.close()
    TOLD.append(
        f"{len(KEYS)} keys of a job: {len(cover.ran)} pairs ran, {len(cover.refused)} were refused, in "
        f"{len(cover.results)} jobs"
    )
    assert len(cover.ran) + len(cover.refused) == len(KEYS) * (len(KEYS) - 1) // 2
    assert not [result for result in cover.results if "optimize --resume" in result.ended.stderr]
    assert len(cover.ran) > 3 * len(cover.refused)
    assert not (found := [str(result) for result in cover.results if result.verdict.findings]), "\n".join(found)
