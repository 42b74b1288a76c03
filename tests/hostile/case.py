"""What a hostile case is: a recipe that spoils a room, and the command, script or shell line that then meets it."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .room import Room

OPTIMIZE = ("optimize", "job.toml", "--quiet")
CHECK = ("check", "ball.xml", "--param", "paint.reflectance.data", "--seeds", "2", "--spp", "1")
RUN = f"{shlex.quote(sys.executable)} -m pathreplay.cli"
"""The command in a shell line."""


@dataclass(frozen=True)
class Action:
    """What is run in the room: arguments of the command line, or a script, or a line for the shell."""

    argv: tuple[str, ...] = ()
    script: str = ""
    shell: str = ""
    writes: tuple[str, ...] = ()
    """Files that this action may write besides its run folder, relative to the room."""
    statuses: tuple[int, ...] = (0, 1, 2)
    """How the process may end; more than these for signals only."""


Spoil = Callable[[Room, np.random.Generator], Action | None]
"""Makes something wrong in the room and returns what is to be run; None for `optimize job.toml`."""


@dataclass(frozen=True)
class Recipe:
    """One way to be hostile. ``refused`` recipes must end with status 2; others may also be made the best of."""

    kind: str
    name: str
    spoil: Spoil
    refused: bool = False
    fuzz: bool = False
    """Whether it has enough randomness in it to be tried many times."""


RECIPES: list[Recipe] = []


def add(kind: str, name: str, spoil: Spoil, *, refused: bool = False, fuzz: bool = False) -> None:
    """Put a recipe on the list."""
    RECIPES.append(Recipe(kind, name, spoil, refused, fuzz))


def recipe(kind: str, *, refused: bool = False, fuzz: bool = False) -> Callable[[Spoil], Spoil]:
    """`add` as a decorator; the function's name, with spaces, is the recipe's."""

    def put(spoil: Spoil) -> Spoil:
        add(kind, spoil.__name__.replace("_", " "), spoil, refused=refused, fuzz=fuzz)
        return spoil

    return put


@dataclass(frozen=True)
class Case:
    """Recipe ``recipe`` with the random numbers of (seed, number)."""

    seed: int
    number: int
    recipe: Recipe

    def prepare(self, room: Room) -> Action:
        """Spoil the room; returns what is to be run in it. The same for the same seed and number."""
        return self.recipe.spoil(room, np.random.default_rng([self.seed, self.number])) or Action(argv=OPTIMIZE)

    def __str__(self) -> str:
        return f"{self.number} ({self.recipe.kind}: {self.recipe.name})"
