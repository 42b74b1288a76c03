"""What a run tells while it is under way, and who listens: the terminal, the run folder."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from pathreplay.inverse.checkpoint import Entry


@dataclass(frozen=True)
class Started:
    """Iterations begin: so many are done, of so many."""

    done: int
    wanted: int


@dataclass(frozen=True)
class Refined:
    """A grid goes on in another resolution."""

    key: str
    shape: tuple[int, ...]


@dataclass(frozen=True)
class Stepped:
    """An iteration is done."""

    entry: Entry


@dataclass(frozen=True)
class Stopped:
    """No more iterations: so many are done."""

    done: int


Event = Started | Refined | Stepped | Stopped


class Observer(Protocol):
    """Hears of everything in the order in which it happens; what it raises ends the run."""

    def observe(self, event: Event) -> None:
        """Called between iterations."""
