"""Hostile run folders: tampered with, cut short, linked elsewhere, or gone while the run is under way."""

from __future__ import annotations

import hashlib
import json
import shutil
import struct
from pathlib import Path
from typing import Any

import numpy as np

from .assets import pfm
from .case import OPTIMIZE, RUN, Action, add, recipe
from .room import ODD_FILES, Room
from .values import VALUES, pick, spoiled

KIND = "run folder"
RESUME = Action(argv=("optimize", "--resume", "runs/job", "--quiet"))

READ = (
    "config.toml",
    "run.json",
    "checkpoint.safetensors",
    "images/target-eye.exr",
    "images/start-eye.exr",
    "checksums.json",
)
WRITTEN = (
    "report.html",
    "history.jsonl",
    "parameters.json",
    "parameters.safetensors",
    "checkpoint.safetensors",
    "loss.svg",
    "summary.png",
    "images/result-eye.exr",
    "images/target-eye.png",
)


def _run(name: str, change: Any, *, refused: bool = True, fuzz: bool = False) -> None:
    def spoil(room: Room, rng: np.random.Generator) -> Action:
        change(room.put_run(), room, rng)
        return RESUME

    add(KIND, name, spoil, refused=refused, fuzz=fuzz)


for _file in READ:
    _run(f"{_file} is missing", lambda run, room, rng, file=_file: (run / file).unlink())  # type: ignore[misc]
    _run(f"{_file} is text", lambda run, room, rng, file=_file: (run / file).write_text("nothing\n"))  # type: ignore[misc]
    for _odd in ODD_FILES:
        _run(
            f"{_file} is {_odd}",
            lambda run, room, rng, file=_file, odd=_odd: Room(run, room.assets).odd_file(file, odd),  # type: ignore[misc]
        )


def _spoil_file(run: Path, room: Room, rng: np.random.Generator) -> None:
    path = run / pick(rng, READ)
    path.write_bytes(spoiled(path.read_bytes(), rng))


_run("spoiled bytes", _spoil_file, refused=False, fuzz=True)

#: Files in which every bit counts: people change the others.
SUMMED = ("checkpoint.safetensors", "images/target-eye.exr", "images/start-eye.exr", "checksums.json")


def _flip_bits(run: Path, room: Room, rng: np.random.Generator) -> None:
    path = run / pick(rng, SUMMED)
    data = bytearray(path.read_bytes())
    for bit in rng.choice(8 * len(data), int(rng.choice([1, 1, 1, 2, 8])), replace=False):
        data[int(bit) // 8] ^= 1 << int(bit) % 8
    path.write_bytes(data)


for _number in range(12):
    _run(f"flipped bits, {_number}", _flip_bits, fuzz=_number == 0)


@recipe(KIND)
def half_written_files_of_a_killed_run(room: Room, rng: np.random.Generator) -> Action:
    room.change("iterations", 4000)
    wait = "while [ ! -e runs/job/checkpoint.safetensors ]; do sleep 0.1; done"
    kill = f"{RUN} optimize job.toml --quiet & process=$!; {wait}; sleep 0.{rng.integers(1, 9)}; kill -KILL $process"
    half = "touch runs/job/previews/000007-view-eye.webp.part runs/job/images/result-eye.png.part"
    raised = "sed -i 's/iterations = 4000/iterations = 3/' runs/job/config.toml"
    resume = f"{RUN} optimize --resume runs/job --quiet; status=$?"
    left = "[ -z \"$(find runs -name '*.part')\" ] || exit 77; exit $status"
    return Action(shell=f"set -m; {kill}; wait $process; {half}; {raised}; {resume}; {left}")


# ------------------------------------------------------------------------------
#  run.json
# ------------------------------------------------------------------------------

RUN_JSON = (
    "",
    "{}",
    "[]",
    "null",
    "3",
    '{"base": 3, "config": []}',
    '{"base": "/nowhere"}',
    '{"base": null, "config": null}',
    '{"base": "\\u0000", "config": "a"}',
    "[" * 100_000,
    '{"base": "' + "x" * 10_000 + '", "config": null}',
)
for _text in RUN_JSON:
    _run(f"run.json: {_text[:40]}", lambda run, room, rng, text=_text: (run / "run.json").write_text(text))  # type: ignore[misc]


@recipe(KIND, fuzz=True)
def a_hostile_value_in_run_json(room: Room, rng: np.random.Generator) -> Action:
    path = room.put_run() / "run.json"
    value = pick(rng, tuple(value for value in VALUES if type(value) in (int, float, str, list, dict)))
    path.write_text(json.dumps(json.loads(path.read_text()) | {pick(rng, ("base", "config", "version")): value}))
    return RESUME


# ------------------------------------------------------------------------------
#  config.toml
# ------------------------------------------------------------------------------

for _old, _new in (
    ("iterations = 4", "iterations = 1"),
    ("iterations = 4", "iterations = 2"),
    ('"ball.xml"', '"sphere.xml"'),
    ('"paint.reflectance.data"', '"clay.reflectance.value"'),
    ('"paint.reflectance.data"', '"sky.radiance.value"'),
    ("spp = 2", "spp = -2"),
    ("spp = 2", "ssp = 2"),
):
    _run(
        f"config.toml: {_new}",
        lambda run, room, rng, old=_old, new=_new: Room(run, room.assets).edit("config.toml", old, new),  # type: ignore[misc]
    )
for _old, _new in (('"pathreplay"', '"prb"'), ("lower = 0.0", "lower = 0.9")):
    _run(
        f"config.toml: {_new}",
        lambda run, room, rng, old=_old, new=_new: Room(run, room.assets).edit("config.toml", old, new),  # type: ignore[misc]
        refused=False,
    )
_run("another film", lambda run, room, rng: room.edit("ball.xml", 'value="$res"', 'value="9"'))
_run("another texture", lambda run, room, rng: room.write("texture.png", _png()))


def _png() -> bytes:
    from .assets import png

    return png(7, 5)


# ------------------------------------------------------------------------------
#  Checkpoint
# ------------------------------------------------------------------------------


def _parts(path: Path) -> tuple[dict[str, Any], bytes]:
    data = path.read_bytes()
    (length,) = struct.unpack_from("<Q", data)
    return json.loads(data[8 : 8 + length]), data[8 + length : -hashlib.sha256().digest_size]


def _put(path: Path, head: dict[str, Any], body: bytes) -> None:
    """With the right checksum at its end, as somebody would do it who knows it."""
    text = json.dumps(head).encode()
    data = struct.pack("<Q", len(text)) + text + body
    path.write_bytes(data + hashlib.sha256(data).digest())


def _metadata(name: str, value: str, *, refused: bool = True) -> None:
    def change(run: Path, room: Room, rng: np.random.Generator) -> None:
        head, body = _parts(run / "checkpoint.safetensors")
        head["__metadata__"][name] = value
        _put(run / "checkpoint.safetensors", head, body)

    _run(f"checkpoint: {name} = {value[:60]}", change, refused=refused)


def _replaced(name: str, value: str, *, refused: bool = True) -> None:
    """The text in a tensor of bytes: another, of any length."""

    def change(run: Path, room: Room, rng: np.random.Generator) -> None:
        head, body = _parts(run / "checkpoint.safetensors")
        text = value.encode()
        begin, end = head[name]["data_offsets"]
        for tensor in head.values():
            if tensor.get("data_offsets", [0])[0] >= end:
                tensor["data_offsets"] = [at - end + begin + len(text) for at in tensor["data_offsets"]]
        head[name] |= {"shape": [len(text)], "data_offsets": [begin, begin + len(text)]}
        _put(run / "checkpoint.safetensors", head, body[:begin] + text + body[end:])

    _run(f"checkpoint: {name} = {value[:60]}", change, refused=refused)


KEY = "paint.reflectance.data"
ENTRY = {"iteration": 0, "loss": 0.1, "seconds": 0.1, "gradient_norms": {KEY: 0.1}, "dropped": 0, "errors": {}}
for _steps in ("[]", "{}", "null", "x", json.dumps({KEY: -5}), json.dumps({KEY: "two"}), json.dumps({KEY: 1e30}),
               json.dumps({KEY: None}), json.dumps({KEY: 1, "other": 1}), json.dumps({KEY: 10**30})):  # fmt: skip
    _metadata("steps", _steps)
for _history in (
    "{}",
    "null",
    "[1, 2]",
    "[{}]",
    "[" * 100_000,
    json.dumps([{**ENTRY, "loss": "much"}]),
    json.dumps([{**ENTRY, "loss": None}]),
    json.dumps([{**ENTRY, "iteration": -1}]),
    json.dumps([{**ENTRY, "iteration": 7}]),
    json.dumps([{**ENTRY, "wings": 2}]),
    json.dumps([{**ENTRY, "gradient_norms": []}]),
    json.dumps([{**ENTRY, "errors": {KEY: "x"}}]),
    json.dumps([{**ENTRY, "seconds": -1e300}]),
):
    _replaced("history", _history)
_replaced("history", json.dumps([{**ENTRY, "iteration": i} for i in range(100)]))


@recipe(KIND, refused=True, fuzz=True)
def a_number_in_the_checkpoint_that_is_none(room: Room, rng: np.random.Generator) -> Action:
    path = room.put_run() / "checkpoint.safetensors"
    head, body = _parts(path)
    numbers = np.frombuffer(body, "<f4").copy()
    numbers[int(rng.integers(len(numbers)))] = pick(rng, (np.nan, np.inf, -np.inf))
    _put(path, head, numbers.tobytes())
    return RESUME


@recipe(KIND, refused=True)
def moments_below_zero(room: Room, rng: np.random.Generator) -> Action:
    path = room.put_run() / "checkpoint.safetensors"
    head, body = _parts(path)
    begin, end = head[f"second:{KEY}"]["data_offsets"]
    _put(path, head, body[:begin] + np.full((end - begin) // 4, -1, "<f4").tobytes() + body[end:])
    return RESUME


@recipe(KIND, refused=True)
def a_tensor_of_another_shape(room: Room, rng: np.random.Generator) -> Action:
    path = room.put_run() / "checkpoint.safetensors"
    head, body = _parts(path)
    head[pick(rng, (f"value:{KEY}", f"first:{KEY}", f"second:{KEY}"))]["shape"] = [48, 1, 1]
    _put(path, head, body)
    return RESUME


@recipe(KIND, refused=True)
def a_tensor_is_missing(room: Room, rng: np.random.Generator) -> Action:
    path = room.put_run() / "checkpoint.safetensors"
    head, body = _parts(path)
    head.pop(f"{pick(rng, ('value', 'first', 'second'))}:{KEY}")
    _put(path, head, body)
    return RESUME


@recipe(KIND, refused=True)
def a_tensor_of_integers(room: Room, rng: np.random.Generator) -> Action:
    path = room.put_run() / "checkpoint.safetensors"
    head, body = _parts(path)
    head[f"value:{KEY}"]["dtype"] = "I32"
    _put(path, head, body)
    return RESUME


@recipe(KIND, refused=True)
def a_checkpoint_that_tells_of_terabytes(room: Room, rng: np.random.Generator) -> Action:
    path = room.put_run() / "checkpoint.safetensors"
    path.write_bytes(struct.pack("<Q", 2**62) + path.read_bytes()[8:])
    return RESUME


# ------------------------------------------------------------------------------
#  Pictures
# ------------------------------------------------------------------------------


def _put_picture(run: Path, name: str, data: bytes) -> None:
    """With the right checksum."""
    name = f"images/{name}-eye.exr"
    (run / name).write_bytes(data)
    sums = json.loads((run / "checksums.json").read_text())
    sums[name] = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    (run / "checksums.json").write_text(json.dumps(sums))


for _picture in ("target", "start"):
    for _pixel in (float("nan"), float("inf")):

        def _odd_pixel(
            run: Path, room: Room, rng: np.random.Generator, name: str = _picture, value: float = _pixel
        ) -> None:
            _put_picture(run, name, pfm(np.full((6, 8, 3), value, np.float32)))

        _run(f"a {_picture} picture of {_pixel}", _odd_pixel)

    def _small(run: Path, room: Room, rng: np.random.Generator, name: str = _picture) -> None:
        _put_picture(run, name, pfm(np.full((3, 4, 3), 0.5, np.float32)))

    _run(f"a {_picture} picture of another size", _small)


# ------------------------------------------------------------------------------
#  Links, and folders that are no longer there
# ------------------------------------------------------------------------------

for _file in WRITTEN:
    for _suffix in (".part", ""):

        def _link(room: Room, rng: np.random.Generator, name: str = _file + _suffix) -> Action:
            path = room.put_run() / name
            original = path.read_bytes() if path.exists() else b"precious"
            path.unlink(missing_ok=True)
            target = room.outside / "linked"
            target.write_bytes(original)
            path.symlink_to(target)
            return RESUME

        add(KIND, f"{_file}{_suffix} is a link to outside", _link)


@recipe(KIND)
def a_part_file_is_a_folder(room: Room, rng: np.random.Generator) -> Action:
    (room.put_run() / (pick(rng, WRITTEN) + ".part")).mkdir()
    return RESUME


@recipe(KIND)
def a_file_to_write_is_a_folder(room: Room, rng: np.random.Generator) -> Action:
    path = room.put_run() / pick(rng, tuple(name for name in WRITTEN if name not in READ))
    path.unlink(missing_ok=True)
    path.mkdir()
    return RESUME


@recipe(KIND)
def a_part_file_is_a_fifo(room: Room, rng: np.random.Generator) -> Action:
    run = room.put_run()
    Room(run, room.assets).odd_file(pick(rng, WRITTEN) + ".part", "fifo")
    return RESUME


@recipe(KIND)
def the_folder_of_pictures_is_a_link_to_outside(room: Room, rng: np.random.Generator) -> Action:
    run = room.put_run()
    shutil.move(run / "images", room.outside / "images")
    (run / "images").symlink_to(room.outside / "images")
    return RESUME


@recipe(KIND, refused=True)
def the_folder_of_pictures_is_a_file(room: Room, rng: np.random.Generator) -> Action:
    run = room.put_run()
    shutil.rmtree(run / "images")
    (run / "images").write_text("no folder")
    return RESUME


@recipe(KIND)
def the_run_folder_is_a_link(room: Room, rng: np.random.Generator) -> Action:
    room.put_run("real")
    (room / "runs").mkdir()
    (room / "runs/job").symlink_to("../real")
    return RESUME


@recipe(KIND)
def hundred_runs_of_this_name(room: Room, rng: np.random.Generator) -> Action:
    for number in range(100):
        (room / f"runs/job-{number}").mkdir(parents=True)
    (room / "runs/job").mkdir()
    return Action(argv=OPTIMIZE)


WHILE = """
import os, shutil, sys, threading, time
from pathlib import Path
run = Path("runs/job")
def meanwhile():
    while not (run / "checkpoint.safetensors").exists():
        time.sleep(0.002)
    {act}
threading.Thread(target=meanwhile, daemon=True).start()
sys.argv = ["pathreplay", "optimize", "job.toml", "--quiet"]
from pathreplay.cli import main
main()
"""

for _name, _act in {
    "removed": "shutil.rmtree(run, ignore_errors=True)",
    "renamed": "run.rename('runs/other')",
    "replaced by a file": "run.rename('runs/other'); run.write_text('x')",
    "replaced by a link to outside": "run.rename('runs/other'); run.symlink_to('../../outside')",
    "robbed of its pictures": "shutil.rmtree(run / 'images', ignore_errors=True)",
}.items():

    def _while(room: Room, rng: np.random.Generator, act: str = _act) -> Action:
        room.change("iterations", 40)
        return Action(script=WHILE.format(act=act), writes=("runs/job", "runs/other"))

    add(KIND, f"{_name} during the run", _while)


@recipe(KIND)
def two_resumes_at_once(room: Room, rng: np.random.Generator) -> Action:
    room.put_run(iterations=30)
    line = f"{RUN} optimize --resume runs/job --quiet"
    return Action(
        shell=f"{line} 2> ../outside/first & {line}; status=$?; wait; exit $status", writes=("../outside/first",)
    )


for _signals, _statuses in (
    ("INT", (0, 130)),
    ("TERM", (0, 143, -15)),
    ("INT INT", (0, 2, 130, -2)),
    ("HUP", (0, 129, -1)),
):

    def _signalled(
        room: Room, rng: np.random.Generator, signals: str = _signals, statuses: tuple[int, ...] = _statuses
    ) -> Action:
        room.change("iterations", 300)
        sends = "; sleep 0.02; ".join(f"kill -{name} $process" for name in signals.split())
        wait = "while [ ! -e runs/job/checkpoint.safetensors ]; do sleep 0.1; done"
        return Action(
            shell=f"set -m; {RUN} optimize job.toml --quiet & process=$!; {wait}; {sends}; wait $process",
            statuses=statuses,
        )

    add(KIND, f"signals: {_signals}", _signalled)
