"""Hostile surroundings, each in a process of its own: no place to write to, no locale, no home, odd terminals."""

from __future__ import annotations

import numpy as np

from .case import RUN, Action, add, recipe
from .room import Room

KIND = "process"
CHECK = f"{RUN} check ball.xml --param paint.reflectance.data --seeds 2 --spp 1"
OPTIMIZE = f"{RUN} optimize job.toml --quiet"


def _shell(name: str, line: str, *, refused: bool = False, statuses: tuple[int, ...] = (0, 1, 2)) -> None:
    add(KIND, name, lambda room, rng: Action(shell=line, statuses=statuses), refused=refused)


_shell("output to a full disk", f"{CHECK} > /dev/full", refused=True)
_shell("optimize's output to a full disk", f"{OPTIMIZE} > /dev/full")
_shell("help to a full disk", f"{RUN} --help > /dev/full")
_shell("errors to a full disk", f"{RUN} optimize no.toml 2> /dev/full")
_shell("closed output", f"{CHECK} >&-")
_shell("closed errors", f"{CHECK} 2>&-")
_shell("closed everything", f"{RUN} optimize job.toml <&- >&- 2>&-")
_shell("a pipe that nobody reads", f"{RUN} check --help | true; {CHECK} | true")
_shell("a locale that is none", f"LC_ALL=xx_YY.nothing {CHECK}")
_shell("ASCII only", f"LC_ALL=C PYTHONIOENCODING=ascii PYTHONUTF8=0 PYTHONCOERCECLOCALE=0 {CHECK}")
_shell("a terminal of one column", f"COLUMNS=1 LINES=1 TERM=dumb {CHECK}")
_shell("forced colours", f"NO_COLOR= TERM=nothing {OPTIMIZE}")
_shell("no home", f"env -u HOME {CHECK}")
_shell("a home that is no folder", f"HOME=/dev/null {CHECK}")
_shell("a folder for temporary files that is not there", f"TMPDIR=/nowhere {OPTIMIZE}")
_shell("a libLLVM that is none", f"DRJIT_LIBLLVM_PATH=$PWD/texture.png {CHECK}")
_shell("a libLLVM that is a device", f"DRJIT_LIBLLVM_PATH=/dev/zero {CHECK}")
_shell("one core", f"taskset -c 1 {OPTIMIZE}")
_shell("no descriptors to spare", f"ulimit -n 40; {OPTIMIZE}")
_shell("files of at most a block", f"ulimit -f 1; {OPTIMIZE}", refused=True)
_shell("optimisation of Python", f"PYTHONOPTIMIZE=2 {OPTIMIZE}")
_shell("warnings as errors", f"PYTHONWARNINGS=error {RUN} optimize no.toml", refused=True)
_shell("the folder is gone", f"mkdir gone && cd gone && rmdir ../gone && {RUN} optimize ../job.toml", refused=True)
_shell(
    "the folder is gone, a scene by name",
    f"mkdir gone && cd gone && rmdir ../gone && {RUN} check cornell-box --param x",
    refused=True,
)
_shell("input from a device", f"{CHECK} < /dev/zero")


@recipe(KIND)
def names_that_are_not_ascii_in_an_ascii_locale(room: Room, rng: np.random.Generator) -> Action:
    room.change("scene", "Küche 🙂.xml")
    (room / "ball.xml").rename(room / "Küche 🙂.xml")
    return Action(shell=f"LC_ALL=C PYTHONIOENCODING=ascii PYTHONUTF8=0 PYTHONCOERCECLOCALE=0 {OPTIMIZE}")
