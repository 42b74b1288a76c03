"""`pathreplay doctor --gpu`: what it writes, held to account on the processor, which takes the same way."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import drjit as dr
import pytest

from pathreplay import PathreplayError, cli
from pathreplay.testing import gpu
from pathreplay.testing.gpu import TIMINGS, TRUTHS, Item, examine


def test_without_a_gpu_one_line_says_so_and_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if dr.has_backend(dr.JitBackend.CUDA):
        pytest.skip("this machine has a GPU")
    monkeypatch.setattr(sys, "argv", ["pathreplay", "doctor", "--gpu", "--output", str(tmp_path / "gpu.json")])
    with pytest.raises(SystemExit) as end:
        cli.main()
    error = capsys.readouterr().err
    assert end.value.code == 2 and error.count("\n") == 1 and "cuda_ad_rgb does not run here" in error
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_written_is_told_first(tmp_path: Path) -> None:
    with pytest.raises(PathreplayError, match=r"is a folder.*--output"):
        examine("llvm_ad_rgb", tmp_path)


def test_the_file_has_what_was_found_and_what_failed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    facts = {"time: a": {"seconds": 0.5}, "truth: b": {"verdict": "fail", "z": 9.0}}
    found = {name: Item(name, fact) for name, fact in facts.items()} | {"time: c": Item("time: c", {}, "died")}
    monkeypatch.setattr(gpu, "_in_process", lambda variant, name: found[name])
    told: list[str] = []
    line, wrong = examine("llvm_ad_rgb", tmp_path / "gpu.json", tuple(found), told.append)
    assert wrong == ["truth: b", "time: c"]
    assert line.endswith("3 items, 2 failed (truth: b; time: c)")
    assert told == ["time: a: 0.5000 s", "truth: b: fail (z = +9.0)", "time: c: died"]
    report = json.loads((tmp_path / "gpu.json").read_text())
    assert report["variant"] == "llvm_ad_rgb" and report["device"]["backend"] == "llvm"
    assert [item["name"] for item in report["items"]] == list(found) and report["items"][2]["error"] == "died"


@pytest.mark.parametrize(("error", "status"), [("", 0), ("died", 1)])
def test_the_command_says_by_its_status_whether_an_item_failed(
    error: str, status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gpu, "_in_process", lambda variant, name: Item(name, {"seconds": 0.5}, error))
    command = ["pathreplay", "doctor", "--gpu", "--variant", "llvm_ad_rgb", "--output", str(tmp_path / "gpu.json")]
    monkeypatch.setattr(sys, "argv", command)
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == status


@pytest.mark.slow
def test_items_run_in_processes_of_their_own(tmp_path: Path) -> None:
    names = ("truth: colour of a wall", "time: recorded, 128 x 128, depth 8", "time: nothing")
    line, _ = examine("llvm_ad_rgb", tmp_path / "gpu.json", names, lambda line: None)
    truth, timing, none = json.loads((tmp_path / "gpu.json").read_text())["items"]
    assert truth["facts"]["verdict"] == "pass" and abs(truth["facts"]["z"]) < 4
    assert 0 < timing["facts"]["fastest"] <= timing["facts"]["seconds"]
    assert "KeyError" in none["error"] and "1 failed (time: nothing)" in line


def test_all_kinds_of_scenes_and_all_drivers_are_there() -> None:
    assert {scene for scene, *_ in TRUTHS.values()} >= {"cornell-box", "glass-pane", "cloud"}
    assert {options.get("adjoint", options["type"]) for options, *_ in TIMINGS.values()} == {
        "prb",
        "recorded",
        "replay",
    }
