"""Hostile command lines: every option of every command with texts and numbers that nobody should give it."""

from __future__ import annotations

import numpy as np

from .case import CHECK, Action, add, recipe
from .room import ODD_FILES, Room
from .values import LOCAL, NUMBERS, TEXTS, pick

KIND = "command"

CHECK_TEXTS = ("--param", "--integrator", "--mode", "--variant")
CHECK_NUMBERS = ("--seeds", "--spp", "--fd-spp", "--step", "--max-depth", "--sensor", "--seed")


@recipe(KIND, fuzz=True)
def check_with_a_hostile_text(room: Room, rng: np.random.Generator) -> Action:
    return _with(*CHECK, pick(rng, CHECK_TEXTS), pick(rng, TEXTS))


@recipe(KIND, fuzz=True)
def check_writes_to_a_hostile_name(room: Room, rng: np.random.Generator) -> Action:
    name = pick(rng, LOCAL)
    return Action(argv=(*CHECK, "--json", name), writes=(name,))


@recipe(KIND, fuzz=True)
def check_with_a_hostile_number(room: Room, rng: np.random.Generator) -> Action:
    return _with(*CHECK, pick(rng, CHECK_NUMBERS), pick(rng, NUMBERS))


@recipe(KIND, fuzz=True)
def optimize_with_a_hostile_text(room: Room, rng: np.random.Generator) -> Action:
    text = pick(rng, LOCAL)
    return _with("optimize", *pick(rng, (("job.toml", "--output", text), ("--resume", text), (text,))), "--quiet")


@recipe(KIND, fuzz=True)
def words_in_any_order(room: Room, rng: np.random.Generator) -> Action:
    words = (*CHECK, "optimize", "job.toml", "--resume", "--quiet", "--version", "--", "--help", *TEXTS[:8])
    chosen = [pick(rng, words) for _ in range(int(rng.integers(1, 7)))]
    return Action(argv=tuple(chosen))


def _with(*words: str) -> Action:
    return Action(argv=words)


def _line(*words: str, refused: bool = True, writes: tuple[str, ...] = ()) -> None:
    action = Action(argv=words, writes=writes)
    told = " ".join(word if len(word) < 30 else f"{word[:30]}…" for word in words)
    add(KIND, told.encode("ascii", "backslashreplace").decode(), lambda room, rng: action, refused=refused)


add(KIND, "nothing, which shows the help", lambda room, rng: Action())
_line("chekc", "ball.xml")
_line("")
_line("\udcff")
_line("check")
_line("check", "ball.xml")
_line("check", "no.xml", "--param", "a")
_line("check", "", "--param", "a")
_line("check", ".", "--param", "a")
_line("check", "cornell-box", "--param", "a" * 100_000)
_line("check", "x" * 5000, "--param", "a")
_line("check", "\x1b[2J.xml", "--param", "a")
_line("check", "/dev/zero", "--param", "a")
_line("check", "job.toml", "--param", "a")
_line("check", "texture.png", "--param", "a")
for _number in NUMBERS:
    _line(*CHECK, "--seeds", _number) if _number not in ("１２", "1_0") else None
    _line(*CHECK, "--spp", _number) if _number not in ("１２", "1_0") else None
for _number in ("-1", "nan", "99999999999999999999", "1.5"):
    _line(*CHECK, "--sensor", _number)
_line(*CHECK, "--seed", "-1")
_line(*CHECK, "--seed", "9" * 4000, refused=False)
for _number in ("0", "-1", "nan", "inf", "1e400", "1e300", "1e-320"):
    _line(*CHECK, "--step", _number)
for _number in ("-2", "999999999999", "99999999999999999999"):
    _line(*CHECK, "--max-depth", _number)
_line(*CHECK, "--max-depth", "0", refused=False)
_line(*CHECK, "--fd-spp", "0")
_line(*CHECK, "--fd-spp", "1000000000")
_line(*CHECK, "--seeds", "1000000000")
for _text in ("diffuse", "scene", "ball.xml", "\x1b[2J", "prb/../..", "x" * 10_000):
    _line(*CHECK, "--integrator", _text)
for _text in ("", "both", "Backward", "\x1b[2J"):
    _line(*CHECK, "--mode", _text)
for _text in ("", "llvm", "scalar_rgb", "llvm_ad_rgb_polarized", "\udcff", "x" * 10_000, "\x1b[2J"):
    _line(*CHECK, "--variant", _text)
for _text in ("", "*", "[", "[[[[", "paint.reflectance", "ball.to_world.0", "\udcff", "x" * 100_000):
    _line("check", "ball.xml", "--param", _text, "--seeds", "2", "--spp", "1", refused=_text != "*")
for _text in ("", ".", "no/such.json", "job.toml/a.json", "/dev/full", "/proc/none", "n" * 300, "\udcff/"):
    _line(*CHECK, "--json", _text)
_line(*CHECK, "--json", "\udcff.json", refused=False, writes=("\udcff.json",))
_line(*CHECK, "--json")
for _text in (
    "",
    ".",
    "..",
    "/",
    "/dev/full/run",
    "/proc/none/run",
    "job.toml/run",
    "n" * 300,
    "/sys/run",
):
    _line("optimize", "job.toml", "--quiet", "--output", _text)
for _text in ("", ".", "/", "job.toml", "/dev/zero", "/proc", "no", "\udcff", "\x1b[2J"):
    _line("optimize", "--quiet", "--resume", _text)
for _text in ("\udcff", "a b", "na\u0308ıve 🙂", "-run", "$(touch hacked)", "\x1b[2J", "two\nlines"):
    _line("optimize", "job.toml", "--quiet", "--output", _text, refused=False)
_line("optimize", "job.toml", "--quiet", "--output", "a/b/c/d", refused=False)
_line("optimize", "job.toml", "job.toml")
_line("optimize", "job.toml", "--resume", "runs/job")
_line("optimize", "--output", "a")
_line("optimize", ".")
_line("optimize", "")
_line("optimize", "\udcff.toml")
_line("optimize", "x" * 5000)
_line("optimize", "job.toml", "--iterations", "3")
_line("doctor", "now")
_line("doctor", "--fast")
_line("bench", "no-such-task")
_line("bench", "--compare", "no.json")
_line("bench", "--compare", "job.toml")
_line("bench", "--compare", "/dev/zero")
_line("bench", "\x1b[2J")
_line("bench", "surface", "--quick", "--save")
_line("--help", "extra", refused=False)
_line("--version", "extra", refused=False)


for _odd in ODD_FILES:
    if _odd not in ("empty", "/dev/null", "dangling", "20 GB"):

        def _json(room: Room, rng: np.random.Generator, odd: str = _odd) -> Action:
            room.odd_file("out.json", odd)
            return Action(argv=(*CHECK, "--json", "out.json"))

        add(KIND, f"--json is {_odd}", _json, refused=_odd not in ("/dev/zero", "/dev/tty"))


@recipe(KIND, refused=True)
def a_scene_that_is_a_fifo(room: Room, rng: np.random.Generator) -> Action:
    room.odd_file("ball.xml", "fifo")
    return Action(argv=CHECK)


@recipe(KIND)
def output_is_a_link_to_outside(room: Room, rng: np.random.Generator) -> Action:
    (room / "link").symlink_to(room.outside)
    return Action(argv=("optimize", "job.toml", "--quiet", "--output", "link"))


@recipe(KIND)
def output_is_a_link_to_nowhere(room: Room, rng: np.random.Generator) -> Action:
    (room / "link").symlink_to(room.outside / "new")
    return Action(argv=("optimize", "job.toml", "--quiet", "--output", "link"))


@recipe(KIND)
def output_is_a_file(room: Room, rng: np.random.Generator) -> Action:
    return Action(argv=("optimize", "job.toml", "--quiet", "--output", "texture.png"))


@recipe(KIND, refused=True)
def bench_compares_with_nonsense(room: Room, rng: np.random.Generator) -> Action:
    room.write("old.json", pick(rng, ("{}", "[]", "null", "[" * 5000, '{"task": "surface"}', "")))
    return Action(argv=("bench", "--compare", "old.json", "old.json"))
