"""What can be wrong with a run folder: in use, damaged, gone, full of links, of an impossible name; one line each."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
import random
import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors
import safetensors.numpy

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.schema import load_config
from pathreplay.inverse.images.io import exr_bytes, read_image
from pathreplay.inverse.loop import checkpoint
from pathreplay.inverse.loop.checksums import SEAL, SUMS, Sums, sealed_chunks
from pathreplay.inverse.loop.loop import new_run
from pathreplay.inverse.problem.problem import build_problem
from pathreplay.jobs import RunResult, optimize
from pathreplay.report.progress import Progress
from pathreplay.report.watch.past import pasts
from pathreplay.runs import run_folder
from pathreplay.runs.folder_lock import LOCK, FolderLock
from room_job import TEXTURE
from small_job import write_job

ONE = {"iterations": 2, "spp": 1, "eval_spp": 1, "target": {"scene": "room.xml", "spp": 1}}
CHECKPOINT = "checkpoint.safetensors"


@pytest.fixture
def room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    write_job(tmp_path, **ONE)
    return tmp_path


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a job and its finished run; copies of it are damaged."""
    folder = tmp_path_factory.mktemp("finished")
    before = Path.cwd()
    os.chdir(folder)
    try:
        optimize(write_job(folder, **ONE), progress=False)
    finally:
        os.chdir(before)
    return folder


def longer(folder: Path) -> Path:
    """The copied run, with one iteration more to do."""
    config = folder / "run/config.json"
    config.write_text(json.dumps({**json.loads(config.read_text()), "iterations": 3}))
    return folder / "run"


def one_line(act: Callable[[], Any]) -> str:
    with pytest.raises(PathreplayError) as raised:
        act()
    assert "\n" not in str(raised.value)
    return str(raised.value)


def during(monkeypatch: pytest.MonkeyPatch, act: Callable[[], Any]) -> None:
    """Act once, at the end of the first iteration."""
    advance, left = Progress.advance, [act]

    def hook(self: Progress, loss: float) -> None:
        advance(self, loss)
        if left:
            left.pop()()

    monkeypatch.setattr(Progress, "advance", hook)


def test_the_second_process_gets_one_line(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    during(monkeypatch, lambda: said.append(one_line(lambda: optimize(resume="run", progress=False))))
    optimize("job.json", progress=False)
    assert f"run is in use by process {os.getpid()} on " in said[0] and "stop it" in said[0]


def test_a_lock_that_nobody_holds_does_not_block(room: Path) -> None:
    (room / LOCK).write_text("1 elsewhere\n")  # as a killed process leaves it
    lock = FolderLock(room)
    with (room / LOCK).open() as file, pytest.raises(BlockingIOError):
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    lock.close()
    FolderLock(room).close()


def test_file_systems_without_locks_do_without(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def flock(file: int, operation: int) -> None:
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", flock)
    FolderLock(room).close()


def test_a_folder_that_cannot_be_written_is_gone_and_let_go_of(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, data: bytes, held: int | None) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    job = write_job(room, **ONE)
    monkeypatch.setattr(run_folder, "_write_through", full)
    closed: list[FolderLock] = []
    monkeypatch.setattr(FolderLock, "close", lambda lock: closed.append(lock))
    with pytest.raises(PathreplayError, match="No space left"):
        run_folder.create_run_folder(room / "full", run_folder.Job(load_config(room / job), room / job, room), {})
    assert len(closed) == 1 and not (room / "full").exists()


@pytest.mark.parametrize("how", ["link", "hard link", "pipe"])
def test_a_lock_file_is_never_another_file(how: str, room: Path) -> None:
    (room / "precious").write_text("x")
    if how == "link":
        (room / LOCK).symlink_to("precious")
    elif how == "hard link":
        os.link(room / "precious", room / LOCK)
    else:
        os.mkfifo(room / LOCK)
    assert LOCK in one_line(lambda: FolderLock(room))
    assert (room / "precious").read_text() == "x"


@pytest.mark.parametrize("how", ["removed", "renamed", "replaced"])
def test_a_vanished_folder_ends_the_run_and_does_not_come_back(
    how: str, room: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def vanish() -> None:
        if how == "removed":
            shutil.rmtree("run")
        else:
            Path("run").rename("elsewhere")
        if how == "replaced":
            Path("run").mkdir()

    during(monkeypatch, vanish)
    line = one_line(lambda: optimize("job.json", progress=False))
    assert "Run folder run was removed or renamed" in line and "iterations 1 to 1 are lost" in line
    assert not Path("run").exists() or not list(Path("run").iterdir())
    if how == "renamed":
        assert optimize(resume="elsewhere", progress=False).iterations == 2


@pytest.mark.parametrize("what_follows", ["nothing", "a folder", "a link"])
def test_nothing_is_written_into_what_gets_the_name_of_the_folder_meanwhile(what_follows: str, tmp_path: Path) -> None:
    """And nothing half-written stays in the folder itself."""
    (tmp_path / "run").mkdir()
    folder = run_folder.RunFolder(tmp_path / "run")
    (tmp_path / "outside").mkdir()

    def content() -> list[bytes]:
        (tmp_path / "run").rename(tmp_path / "elsewhere")
        if what_follows == "a folder":
            (tmp_path / "run").mkdir()
        elif what_follows == "a link":
            (tmp_path / "run").symlink_to("outside")
        return [b"1"]

    with pytest.raises(PathreplayError, match="run was removed or renamed during the run, so the run ends"):
        folder.write({"within/one": content, "two": b"2", "other/three": b"3"})
    folder.lock.close()
    assert [path.name for path in (tmp_path / "elsewhere").rglob("*")] == [LOCK]
    assert not list((tmp_path / "outside").iterdir())
    assert what_follows != "a folder" or not list((tmp_path / "run").iterdir())


@pytest.mark.parametrize("link", ["run", "run/within", ""])
def test_files_are_discarded_in_the_folder_only(link: str, tmp_path: Path) -> None:
    (tmp_path / "run/within").mkdir(parents=True)
    folder = run_folder.RunFolder(tmp_path / "run")
    for name in ("one", "within/two"):
        (tmp_path / "run" / name).touch()
    if link:
        (tmp_path / link).rename(tmp_path / "elsewhere")
        (tmp_path / link).symlink_to(tmp_path / "elsewhere")
        if link == "run":  # another folder that looks like it
            shutil.copytree(tmp_path / "elsewhere", tmp_path / "outside")
            (tmp_path / "run").unlink()
            (tmp_path / "run").symlink_to("outside")
    folder.discard(["one", "gone", "within/two", "nowhere/three"])
    folder.lock.close()
    left = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()}
    assert {path for path in left if not path.endswith(LOCK)} == {
        "": set(),
        "run": {"elsewhere/one", "elsewhere/within/two", "outside/one", "outside/within/two"},
        "run/within": {"elsewhere/two"},
    }[link]


def test_links_in_the_folder_are_not_followed(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    precious = room / "precious"
    precious.write_text("x")

    def link() -> None:
        for name in ("checkpoint.safetensors.part", "report.html", "report.html.part", "images/result-left.png.part"):
            (room / "run" / name).symlink_to(precious)

    during(monkeypatch, link)
    result = optimize("job.json", progress=False)
    assert precious.read_text() == "x"
    assert not result.report.is_symlink() and result.report.stat().st_size > 1000
    assert not list(result.folder.rglob("*.part"))


def test_folders_that_are_links_are_refused(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (room / "outside").mkdir()

    def link() -> None:
        (room / "run/images").rename(room / "run/old")
        (room / "run/images").symlink_to(room / "outside")

    during(monkeypatch, link)
    assert "run/images is a link" in one_line(lambda: optimize("job.json", progress=False))
    assert not list((room / "outside").iterdir())


@pytest.mark.parametrize(
    "name", ["", ".", "/", "..", "run/..", "a\udcff", "n" * 300, "a\0b", "room.xml", "room.xml/run"]
)
@pytest.mark.parametrize("where", ["argument", "config"])
def test_impossible_output_gets_one_line(name: str, where: str, room: Path) -> None:
    if where == "config":
        if "\udcff" in name:
            pytest.skip("a config is UTF-8")
        write_job(room, **{**ONE, "output": name})
    before = set(room.rglob("*"))
    line = one_line(lambda: optimize("job.json", output=name if where == "argument" else None, progress=False))
    assert "--output" in line
    assert set(room.rglob("*")) == before


def test_an_impossible_output_is_noticed_before_targets_are_rendered(
    room: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pathreplay.jobs.session.build_problem", lambda *_: pytest.fail("targets are rendered"))
    before = set(room.rglob("*"))
    for output in ("room.xml/run", "room.xml/a/run"):
        line = one_line(lambda output=output: optimize("job.json", output=output, progress=False))  # type: ignore[misc]
        assert line == f"Run folder {output} cannot be created (Not a directory); give another --output"
    assert set(room.rglob("*")) == before


@pytest.mark.parametrize("name", ["", "nowhere", "room.xml", "a\udcff", "n" * 300, "a\0b"])
def test_impossible_resume_gets_one_line(name: str, room: Path) -> None:
    assert one_line(lambda: optimize(resume=name, progress=False))


def tensors(run: Path, change: Callable[[dict[str, np.ndarray], dict[str, Any]], Any]) -> None:
    """Change the tensors of the checkpoint, and its JSON texts: the metadata and the history."""
    path = run / CHECKPOINT
    with safetensors.safe_open(str(path), framework="numpy") as file:
        metadata = {key: json.loads(value) for key, value in file.metadata().items()}
        arrays = {name: file.get_tensor(name).copy() for name in file.keys()}
    arrays.pop(SEAL)
    metadata["history"] = json.loads(arrays.pop("history").tobytes())
    change(arrays, metadata)
    if "history" in metadata:
        arrays["history"] = np.frombuffer(json.dumps(metadata.pop("history")).encode(), np.uint8)
    text = {key: json.dumps(value) for key, value in metadata.items()}
    path.write_bytes(b"".join(sealed_chunks(arrays, text)))


def entry(key: str, value: Any) -> Callable[[Path], None]:
    return lambda run: tensors(run, lambda arrays, about: about["history"][1].update({key: value}))


def tensor(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    return lambda run: tensors(run, lambda arrays, about: arrays.update({name: change(arrays[name])}))


def picture(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    def put(run: Path) -> None:
        path = run / f"images/{name}-left.exr"
        path.write_bytes(exr_bytes(change(read_image(path))))
        table = json.loads((run / SUMS).read_text())
        data = path.read_bytes()
        table[f"images/{name}-left.exr"] = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
        (run / SUMS).write_text(json.dumps(table))

    return put


def bad_pixel(image: np.ndarray) -> np.ndarray:
    image[1, 2, 0] = np.nan
    return image


VALUE, SECOND = f"value:{TEXTURE}", f"second:{TEXTURE}"
DAMAGE: dict[str, Callable[[Path], Any]] = {
    "history out of order": entry("iteration", 7),
    "negative iteration": entry("iteration", -1),
    "loss is text": entry("loss", "low"),
    "loss is NaN": entry("loss", float("nan")),
    "unknown key": entry("colour", 1),
    "history is no list": lambda run: tensors(run, lambda arrays, about: about.update(history={"a": 1})),
    "history too short": lambda run: tensors(run, lambda arrays, about: about["history"].pop()),
    "no history": lambda run: tensors(run, lambda arrays, about: about.pop("history")),
    "negative steps": lambda run: tensors(run, lambda arrays, about: about["steps"].update({TEXTURE: -1})),
    "other steps": lambda run: tensors(run, lambda arrays, about: about["steps"].update({TEXTURE: 10**12})),
    "steps of others": lambda run: tensors(run, lambda arrays, about: about["steps"].update({"other": 2})),
    "value is NaN": tensor(VALUE, lambda a: a * np.float32(np.nan)),
    "moment is infinite": tensor(SECOND, lambda a: a + np.float32(np.inf)),
    "moment is negative": tensor(SECOND, lambda a: -a - 1),
    "other shape": tensor(VALUE, lambda a: a.reshape(-1)),
    "moment of other shape": tensor(SECOND, lambda a: a.reshape(-1, 1, 1)),
    "other type": tensor(VALUE, lambda a: a.astype(np.float64)),
    "tensor missing": lambda run: tensors(run, lambda arrays, about: arrays.pop(VALUE)),
    "empty checkpoint": lambda run: (run / CHECKPOINT).write_bytes(b""),
    "learned by nobody": lambda run: tensors(run, lambda a, about: a.update({"learned:sums": np.zeros(3, np.float32)})),
    "start of another size": picture("start", lambda image: image[1:]),
    "start of other channels": picture("start", lambda image: image[:, :, :1]),
    "start is NaN": picture("start", bad_pixel),
    "target of another size": picture("target", lambda image: image[:, 1:]),
    "target and start of another size": lambda run: [
        picture(name, lambda image: image[1:])(run) for name in ("start", "target")
    ],
    "target is NaN": picture("target", bad_pixel),
    "start missing": lambda run: (run / "images/start-left.exr").unlink(),
    "target missing": lambda run: (run / "images/target-left.exr").unlink(),
    "another start": lambda run: shutil.copyfile(run / "images/start-right.exr", run / "images/start-left.exr"),
    "checksums missing": lambda run: (run / SUMS).unlink(),
    "checksums damaged": lambda run: (run / SUMS).write_text("{"),
    "start empty": lambda run: (run / "images/start-left.exr").write_bytes(b""),
    "run.json empty": lambda run: (run / "run.json").write_bytes(b""),
    "run.json is no object": lambda run: (run / "run.json").write_text("[1]"),
    "run.json without base": lambda run: (run / "run.json").write_text('{"config": null}'),
    "run.json with a number": lambda run: (run / "run.json").write_text('{"base": 1, "config": null}'),
    "run.json not UTF-8": lambda run: (run / "run.json").write_bytes(b'{"base": "\xff", "config": null}'),
    "run.json with NUL": lambda run: (run / "run.json").write_text('{"base": "a\\u0000", "config": null}'),
    "base is gone": lambda run: (run / "run.json").write_text('{"base": "/nowhere", "config": null}'),
    "config not UTF-8": lambda run: (run / "config.json").write_bytes(b"\xff"),
}


@pytest.mark.parametrize("case", DAMAGE)
def test_damage_gets_one_line(case: str, finished: Path, tmp_path: Path) -> None:
    shutil.copytree(finished, tmp_path / "copy")
    run = longer(tmp_path / "copy")
    if case != "base is gone":
        (run / "run.json").write_text(json.dumps({"base": str(tmp_path / "copy"), "config": None}))
    DAMAGE[case](run)
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file() and path.name != LOCK}
    line = one_line(lambda: optimize(resume=run, progress=False))
    if case.endswith("of another size"):
        assert f"{case.split()[0]}-left.exr has shape" in line
    assert before == {path: path.read_bytes() for path in before}


def test_the_history_is_in_no_header_but_older_checkpoints_are_read(finished: Path, tmp_path: Path) -> None:
    """Readers take headers of at most 100 MB, which a long run would exceed."""
    shutil.copytree(finished, tmp_path / "copy")
    run = longer(tmp_path / "copy")
    (run / "run.json").write_text(json.dumps({"base": str(tmp_path / "copy"), "config": None}))
    path = run / CHECKPOINT
    with safetensors.safe_open(str(path), framework="numpy") as file:
        metadata, arrays = file.metadata(), {name: file.get_tensor(name) for name in file.keys()}
    assert metadata.keys() == {"steps", "starts"}
    history = arrays.pop("history").tobytes().decode()
    arrays.pop(SEAL)
    path.write_bytes(b"".join(sealed_chunks(arrays, {**metadata, "history": history})))
    (past,) = pasts([run])
    assert [asdict(entry) for entry in past.history] == json.loads(history)
    result = optimize(resume=run, progress=False)
    assert [asdict(entry) for entry in result.history[: len(past.history)]] == json.loads(history)


def flipped(data: bytes, bit: int) -> bytes:
    return data[: bit // 8] + bytes([data[bit // 8] ^ 1 << bit % 8]) + data[bit // 8 + 1 :]


def test_every_flipped_bit_of_what_a_resume_reads_is_noticed(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All over the checkpoint, header and tensors, and all over a picture."""
    shutil.copytree(finished, tmp_path / "copy")
    monkeypatch.chdir(tmp_path / "copy")
    run = Path("run")
    problem = build_problem(load_config(run / "config.json"), Path.cwd())
    state = new_run(problem, problem.integrator, record=False)
    checks: dict[str, Callable[[Path], Any]] = {
        CHECKPOINT: lambda path: checkpoint.restore(path, state, problem.variables),
        "images/target-right.exr": Sums(run).require,
    }
    for name, check in checks.items():
        path = run / name
        check(path)
        data = path.read_bytes()
        for bit in (*range(0, 8 * len(data), 101), *range(8 * len(data) - 300, 8 * len(data), 7)):
            path.write_bytes(flipped(data, bit))
            with pytest.raises(PathreplayError):
                check(path)
        path.write_bytes(data)


def test_what_a_killed_run_has_half_written_goes_when_it_is_gone_on_with(finished: Path, tmp_path: Path) -> None:
    shutil.copytree(finished, tmp_path / "copy")
    run = longer(tmp_path / "copy")
    (run / "run.json").write_text(json.dumps({"base": str(tmp_path / "copy"), "config": None}))
    names = ["checkpoint.safetensors", "previews/000002-view-left.webp", "previews/page.json", "images/result-left.exr"]
    for name in names:
        (run / f"{name}.part").write_bytes(b"half")
    optimize(resume=run, progress=False)
    assert not list(run.rglob("*.part"))


def tampered(data: bytes, random_: random.Random) -> bytes:
    """Cut, flipped, filled or swollen somewhere."""
    if not data:
        return b"?"
    at = random_.randrange(len(data))
    match random_.randrange(4):
        case 0:
            return data[:at]
        case 1:
            return data[:at] + bytes([data[at] ^ 1 << random_.randrange(8)]) + data[at + 1 :]
        case 2:
            return data[:at] + bytes(random_.randrange(256) for _ in range(16)) + data[at + 16 :]
        case _:
            return data[:at] + data[at : at + 40] * 3 + data[at + 40 :]


def resumes_or_one_line(run: Path) -> RunResult | str:
    try:
        return optimize(resume=run, progress=False)
    except PathreplayError as error:
        assert "\n" not in str(error)
        return str(error)


FILES = ("run.json", "config.json", CHECKPOINT, "images/start-left.exr", "images/target-right.exr")


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_tampered_files_resume_or_get_one_line(name: str, finished: Path, tmp_path: Path) -> None:
    random_ = random.Random(f"run folder {name}")
    refused = 0
    for trial in range(12):
        shutil.copytree(finished, tmp_path / str(trial))
        run = longer(tmp_path / str(trial))
        (run / name).write_bytes(tampered((run / name).read_bytes(), random_))
        refused += isinstance(resumes_or_one_line(run), str)
    print(f"{name}: 12 tampered, {refused} refused")
    assert refused > 0
