"""Events of a run, and their text for the log."""

from __future__ import annotations

from dataclasses import dataclass

from pathreplay.inverse.loop.checkpoint import Entry


@dataclass(frozen=True)
class Started:
    """Iterations begin or resume. ``done`` of the ``wanted`` iterations have already been taken."""

    done: int
    wanted: int


@dataclass(frozen=True)
class Refined:
    """A grid is resampled to its next resolution."""

    key: str
    shape: tuple[int, ...]


@dataclass(frozen=True)
class Finished:
    """The optimiser has stopped."""

    why: str


@dataclass(frozen=True)
class Entered:
    """Stage ``number`` of ``of`` stages, counted from 1, begins or is resumed."""

    number: int
    of: int


@dataclass(frozen=True)
class NonFinite:
    """Some entries of the gradient in a view were NaN or infinite and count as zero."""

    key: str
    view: str
    iteration: int
    entries: int


@dataclass(frozen=True)
class LowSNR:
    """The signal-to-noise ratio of the gradient of a variable, over the last iterations, is low."""

    key: str
    ratio: float
    iteration: int
    spp: int


@dataclass(frozen=True)
class Stepped:
    """An iteration has finished."""

    entry: Entry


@dataclass(frozen=True)
class Stopped:
    """Iterations have ended, after ``done`` iterations in total."""

    done: int


Event = Started | Entered | Finished | Refined | NonFinite | LowSNR | Stepped | Stopped


class Notes:
    """Log lines of events. Recurring events are reported once per parameter."""

    def __init__(self) -> None:
        self._told: set[tuple[type, str]] = set()

    def of(self, event: Event) -> str:
        """Return the log line of an event, or "" if the event has no line or was reported before."""
        if isinstance(event, Entered):
            return f"stage {event.number} of {event.of}"
        if isinstance(event, Finished):
            return f"the optimiser has stopped: {event.why}"
        if isinstance(event, Refined):
            return f"{event.key} is refined to the shape {event.shape}"
        if not isinstance(event, (NonFinite, LowSNR)) or (type(event), event.key) in self._told:
            return ""
        self._told.add((type(event), event.key))
        if isinstance(event, NonFinite):
            return (
                f"{event.entries} gradient entries of '{event.key}' were NaN or infinite in view '{event.view}' at "
                f"iteration {event.iteration} and count as zero; further ones are counted, but not reported"
            )
        return (
            f"the gradient of '{event.key}' is dominated by noise since about iteration {event.iteration}: its "
            f"signal-to-noise ratio is {event.ratio:.2g} with spp = {event.spp}; raise spp unless the value has "
            "converged"
        )
