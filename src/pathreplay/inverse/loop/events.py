"""What a run tells of itself while it is under way, and how that is said."""

from __future__ import annotations

from dataclasses import dataclass

from pathreplay.inverse.loop.checkpoint import Entry


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
class Finished:
    """The optimiser takes no more steps."""

    why: str


@dataclass(frozen=True)
class Entered:
    """A stage (from 1) of so many begins, or is gone on with."""

    number: int
    of: int


@dataclass(frozen=True)
class NonFinite:
    """So many entries of the gradient of a view were NaN or infinite, and count as zero."""

    key: str
    view: str
    iteration: int
    entries: int


@dataclass(frozen=True)
class LowSNR:
    """The gradient of a variable is lost in noise: signal to noise, over the last iterations."""

    key: str
    ratio: float
    iteration: int
    spp: int


@dataclass(frozen=True)
class Stepped:
    """An iteration is done."""

    entry: Entry


@dataclass(frozen=True)
class Stopped:
    """No more iterations: so many are done."""

    done: int


Event = Started | Entered | Finished | Refined | NonFinite | LowSNR | Stepped | Stopped

Told = Entered | Finished | Refined | NonFinite | LowSNR


def note_of(event: Told) -> str:
    """One line for people."""
    if isinstance(event, Entered):
        return f"stage {event.number} of {event.of}"
    if isinstance(event, Finished):
        return f"no more steps: {event.why}"
    if isinstance(event, Refined):
        return f"{event.key} goes on with the shape {event.shape}"
    if isinstance(event, NonFinite):
        return (
            f"{event.entries} gradient entries of '{event.key}' were NaN or infinite in view '{event.view}' at "
            f"iteration {event.iteration}, and count as zero; more of it is only counted"
        )
    return (
        f"the gradient of '{event.key}' is lost in noise since about iteration {event.iteration}: signal to noise "
        f"{event.ratio:.2g} with spp = {event.spp}; take more, or it has arrived"
    )


class Notes:
    """Lines for events, of which those that come again and again are told once for each parameter."""

    def __init__(self) -> None:
        self._told: set[tuple[type, str]] = set()

    def of(self, event: Event) -> str:
        """The line; "" where there is nothing to say, or it has been said."""
        if isinstance(event, (Started, Stepped, Stopped)):
            return ""
        if isinstance(event, (NonFinite, LowSNR)):
            if (type(event), event.key) in self._told:
                return ""
            self._told.add((type(event), event.key))
        return note_of(event)
