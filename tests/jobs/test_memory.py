"""Memory of jobs: sums in place, pictures kept on the disk, files that are made as they are written, and budgets."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy

from pathreplay import PathreplayError
from pathreplay.inverse.config.optimizer_options import Optimizer
from pathreplay.inverse.images.disk_store import SMALL, DiskStore
from pathreplay.inverse.objective.evaluate import Evaluation, Local, Shard, total
from pathreplay.inverse.optim import adaptive as optimisers
from pathreplay.inverse.optim.adaptive import DrJitOptimiser, WhenAsked
from pathreplay.inverse.parameters.grids import LARGEST_SHOWN, rmse, shown
from pathreplay.jobs import make_config, optimize
from pathreplay.platform import memory
from pathreplay.platform.atomic_files import chunks, made
from pathreplay.platform.tensor_files import safetensors_chunks
from room_job import JOB, room  # noqa: F401 (room: its folder, for every test)

RANDOM = np.random.default_rng(7)


def array(*shape: int) -> np.ndarray:
    return RANDOM.uniform(-1, 1, shape).astype(np.float32)


def evaluation(loss: float, gradient: np.ndarray) -> Evaluation:
    return Evaluation(loss, {"a": gradient}, {"a": 1}, {"seen": np.float64([loss])})


@pytest.mark.parametrize("owned", [False, True])
@pytest.mark.parametrize("share", [1.0, 0.5])
def test_sums_are_made_in_place_and_leave_alone_what_is_not_theirs(owned: bool, share: float) -> None:
    parts = [array(5) for _ in range(3)]
    copies = [part.copy() for part in parts]
    found = total((evaluation(n, part) for n, part in enumerate(parts)), share, owned)
    wanted = ((copies[0] + copies[1]) + copies[2]) * np.float32(share)
    np.testing.assert_array_equal(found.gradients["a"], wanted)
    assert found.loss == 3 * share and found.dropped == {"a": 3} and found.learned["seen"] == 1
    for part, copy in zip(parts[1 if owned else 0 :], copies[1 if owned else 0 :], strict=True):
        np.testing.assert_array_equal(part, copy)
    assert np.shares_memory(found.gradients["a"], parts[0]) == owned
    (alone,) = total([evaluation(1, parts[2])]).gradients.values()
    assert alone is parts[2]


def test_shards_are_evaluated_as_they_are_asked_for() -> None:
    """So that a sum holds one gradient, however many there are."""
    done: list[int] = []

    def evaluate(values: Any, shard: Shard, learned: Any) -> Evaluation:
        done.append(shard.samples)
        return evaluation(shard.samples, np.zeros(1, np.float32))

    shards = [Shard((0,), n, (n,)) for n in range(3)]
    stream = Local(evaluate).run({}, shards, {})
    assert done == [] and next(stream).loss == 0 and done == [0]
    assert [each.loss for each in stream] == [1, 2] and done == [0, 1, 2]


def test_a_sum_begins_with_what_may_only_be_read() -> None:
    """As a gradient from another process."""
    parts = [array(5) for _ in range(3)]
    for part in parts:
        part.flags.writeable = False
    found = total((evaluation(n, part) for n, part in enumerate(parts)), 0.5, owned=True)
    np.testing.assert_array_equal(found.gradients["a"], ((parts[0] + parts[1]) + parts[2]) * np.float32(0.5))


@pytest.mark.parametrize("kind", ["adam", "adamw", "rmsprop", "sgd"])
def test_pieces_step_as_the_whole_does(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Large variables are stepped piece by piece: the same bits, states and files."""
    options = Optimizer(type=kind)  # type: ignore[arg-type]
    values = {"grid": array(7, 5, 3), "number": array(1), "uniform": array(40)}
    steps = [{key: array(*value.shape) for key, value in values.items()} for _ in range(3)]

    def stepped(piece: int) -> tuple[dict[str, np.ndarray], DrJitOptimiser]:
        monkeypatch.setattr(optimisers, "PIECE", piece)
        now, optimiser = values, DrJitOptimiser(values, options, ["uniform"])
        for gradients in steps:
            now = optimiser.step(now, gradients, {"grid": 0.1, "number": 0.2, "uniform": 0.3})
        return now, optimiser

    whole, one = stepped(2**22)
    parts, other = stepped(16)
    assert len(other._pieces("grid")) == 7 and len(other._pieces("number")) == 1
    for key in values:
        np.testing.assert_array_equal(parts[key], whole[key])
        assert parts[key].shape == values[key].shape
    assert dict(one.state().arrays).keys() == dict(other.state().arrays).keys()
    for name, kept in one.state().arrays.items():
        np.testing.assert_array_equal(other.state().arrays[name], kept)
    again = DrJitOptimiser(values, options, ["uniform"])
    again.restore(one.state(), whole)
    last = {key: array(*value.shape) for key, value in values.items()}
    rates = dict.fromkeys(values, 0.1)
    gone_on, wanted = again.step(whole, last, rates), other.step(whole, last, rates)
    for key, value in gone_on.items():
        np.testing.assert_array_equal(value, wanted[key])


def test_an_album_keeps_what_it_is_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    disk_store = DiskStore(room=2**20)
    pictures = [array(300, 200, 3) for _ in range(4)]
    kept = [disk_store.keep(picture) for picture in pictures]
    assert kept[0] is pictures[0] and kept[2] is not pictures[2] and not kept[2].flags.writeable
    disk_store.rest()
    for picture, other in zip(pictures, kept, strict=True):
        np.testing.assert_array_equal(picture, other)
        assert other.dtype == np.float32 and other.shape == picture.shape
    assert not list(tmp_path.glob("pathreplay-*")), "the file has no name"


def test_an_album_uses_the_space_of_freed_arrays_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs of one problem share a store, and the images of an earlier run are freed."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    store, sizes = DiskStore(room=2**20), []
    for _ in range(3):
        pictures = [array(300, 200, 3) for _ in range(4)]
        kept = [store.keep(picture) for picture in pictures]
        assert [one is other for one, other in zip(kept, pictures, strict=True)] == [True, False, False, False]
        part = kept[2][10:20]  # a part keeps its map
        del kept[1:3]
        again = store.keep(pictures[1])
        np.testing.assert_array_equal(again, pictures[1])
        np.testing.assert_array_equal(part, pictures[2][10:20])
        np.testing.assert_array_equal(kept[1], pictures[3])
        assert store._file is not None and len(store._maps) == 3
        sizes.append(os.fstat(store._file.fileno()).st_size)
        del kept, again, part, pictures
    assert store.room == 2**20 and not store._maps
    assert len(set(sizes)) == 1 and sizes[0] < 3.1 * 300 * 200 * 3 * 4


def test_an_album_keeps_arrays_of_all_sizes_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    store, random = DiskStore(room=0), np.random.default_rng(3)
    held: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    most = 0
    for n in range(200):
        picture = array(int(random.integers(SMALL // 4 + 1, 2**17)))
        held[n % int(random.integers(1, 9))] = picture, store.keep(picture)
        most = max(most, sum(len(picture) for picture, _ in held.values()) * 4)
        for picture, kept in held.values():
            np.testing.assert_array_equal(kept, picture)
    assert store._file is not None and os.fstat(store._file.fileno()).st_size < 3 * most


@pytest.mark.parametrize(
    ("number", "message"),
    [
        (errno.ENOSPC, r"No space left in .* set TMPDIR to a folder on another disk"),
        (errno.EROFS, r"cannot be kept on disk \(Read-only.*\); set TMPDIR to a folder"),
    ],
)
def test_an_album_tells_why_it_cannot_write(number: int, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*arguments: Any, **options: Any) -> Any:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("tempfile.TemporaryFile", fails)
    with pytest.raises(PathreplayError, match=message):
        DiskStore(room=0).keep(array(300, 200, 3))


def test_a_disk_store_needs_no_tmpdir(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TMPDIR", "/nowhere")
    picture = array(300, 200, 3)
    np.testing.assert_array_equal(DiskStore(room=0).keep(picture), picture)


def test_tensor_files_are_those_of_the_library() -> None:
    arrays = {"b:x": array(3, 4), "a": array(1)[0:0], "n": np.float64([1, 2]), "i": np.arange(3, dtype=np.uint32)}
    asked: list[str] = []

    def make(name: str) -> np.ndarray:
        asked.append(name)
        return arrays[name]

    lazy = WhenAsked({name: (lambda name=name: make(name)) for name in arrays})  # type: ignore[misc]
    data = b"".join(safetensors_chunks(lazy, {"steps": "{}"}))
    assert sorted(asked) == sorted([*arrays, *arrays])
    found = safetensors.numpy.load(data)
    assert found.keys() == arrays.keys()
    for name, value in arrays.items():
        np.testing.assert_array_equal(found[name], value)
        assert found[name].dtype == value.dtype
    with pytest.raises(PathreplayError, match="complex"):
        list(safetensors_chunks({"z": np.zeros(1, complex)}, {}))


def test_contents_are_made_when_they_are_written() -> None:
    called: list[int] = []

    def make(n: int) -> bytes:
        called.append(n)
        return bytes(n)

    content = made(make, 3)
    assert not called and b"".join(chunks(content)) == bytes(3) and called == [3]
    assert list(chunks(b"ab")) == [b"ab"]


def test_errors_in_pieces_are_those_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    a, b = array(31, 17), array(31, 17)
    wanted = np.sqrt(np.mean(np.square(a.astype(np.float64) - b)))
    monkeypatch.setattr("pathreplay.inverse.parameters.grids._PIECE", 10)
    assert rmse(a, b) == pytest.approx(wanted, rel=1e-12)


def test_large_textures_are_shown_smaller() -> None:
    small = array(8, LARGEST_SHOWN, 3)
    assert shown(small) is small
    image = array(8, 6, 3)
    np.testing.assert_allclose(shown(image, 4), image.reshape(4, 2, 3, 2, 3).mean(axis=(1, 3)), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize(
    ("text", "size"), [("8 GiB", 8 * 2**30), ("800MB", 800 * 10**6), (" 1.5 GB ", 15 * 10**8), ("1TiB", 2**40)]
)
def test_budgets_are_read(text: str, size: int) -> None:
    assert make_config({**JOB, "memory_limit": text}).budget == size
    assert make_config(JOB).budget is None


@pytest.mark.parametrize(
    ("given", "said"),
    [("8", "number and a unit"), ("8 Gib", "number and a unit"), ("-1 GB", "number and a unit"),
     ("10 MB", "512 MiB' or more"), (8, "memory_limit"), ("9" * 400 + " GB", "number and a unit")],
)  # fmt: skip
def test_other_budgets_are_refused(given: Any, said: str) -> None:
    with pytest.raises(PathreplayError, match=said) as error:
        make_config({**JOB, "memory_limit": given})
    assert "\n" not in str(error.value) and len(str(error.value)) < 300


def test_a_budget_holds_within_its_block(monkeypatch: pytest.MonkeyPatch) -> None:
    free = memory.available()
    monkeypatch.setattr(memory, "taken", lambda: 3 * 10**9)
    with memory.within(4 * 10**9):
        assert memory.available() == min(free, 10**9) and memory.is_crowded()
        memory.require_kept()
        monkeypatch.setattr(memory, "taken", lambda: 5 * 10**9)
        assert memory.available() == 0
        with pytest.raises(PathreplayError, match=r"uses 5 GB of memory, and its 'memory_limit' is 4 GB; use smaller"):
            memory.require_kept()
    memory.require_kept()
    assert not memory.is_crowded()


def test_budgets_end_in_any_order(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "taken", lambda: 0)
    first, second, third = memory.within(1000), memory.within(None), memory.within(2000)
    left = []
    for block in (first, second, third):
        block.__enter__()
    for block in (first, third, second):
        left.append(memory.available())
        block.__exit__(None, None, None)
    assert left[:2] == [1000, 2000] and min(left[2], memory.available()) > 2000


def test_a_run_beyond_its_budget_ends_with_a_line_and_a_checkpoint(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing half-written: what was done is there, and the run goes on from it with more memory."""
    sizes = iter([10**8] * 60)
    monkeypatch.setattr(memory, "taken", lambda: next(sizes, 2 * 10**9))
    with pytest.raises(PathreplayError, match=r"'memory_limit' is 1 GB; .*resume with: pathreplay optimize --resume"):
        optimize(make_config({**JOB, "memory_limit": "1 GB", "iterations": 40}), output="run", progress=False)
    assert (Path("run") / "checkpoint.safetensors").exists() and not list(Path("run").rglob("*.part"))


PEAK = """
import sys
sys.path.insert(0, {tests!r})
import pathreplay.platform.backend
pathreplay.platform.backend.set_variant("llvm_ad_rgb")
from pathreplay.jobs import make_config, optimize
result = optimize(make_config({job!r}), output={output!r}, progress=False)
print(int(open("/proc/self/status").read().split("VmHWM:")[1].split()[0]) // 1024)
"""


def peak_mib(job: dict[str, Any], output: str) -> int:
    """Largest resident size of a run in a process of its own."""
    code = PEAK.format(tests=str(Path(__file__).parent), job=job, output=output)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-2000:]
    return int(done.stdout.split()[-1])


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs Linux' account of memory")
def test_memory_grows_with_some_times_the_values_and_what_adam_remembers_of_them() -> None:
    """One texture of 9 million values beside a small one. At this size pictures of a texture take more than its values:
    what grows with those shows from some ten million on, in docs/memory.md."""

    def job(side: int) -> dict[str, Any]:
        key = JOB["parameters"][0]["key"]
        return {
            **JOB, "iterations": 3, "checkpoint_every": 1, "integrator": {"type": "pathreplay", "max_depth": 2},
            "parameters": [{"key": key, "lower": 0.0, "upper": 1.0, "resolutions": [side]}],
        }  # fmt: skip

    small, large = peak_mib(job(16), "small"), peak_mib(job(1732), "large")
    values = 1732 * 1732 * 3 * 4 / 2**20
    print(f"{small} MiB, and {(large - small) / (3 * values):.2f} x (values + Adam's state) more")
    assert large - small < 7 * 3 * values
