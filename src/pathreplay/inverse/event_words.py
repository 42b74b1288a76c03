"""What is said of a run's events, in a log that a terminal or a page shows: a line each, and nothing twice."""

from __future__ import annotations

from pathreplay.inverse.loop import Entered, Event, Faint, NonFinite, Refined


class EventWords:
    """Remembers what it has said."""

    def __init__(self) -> None:
        self._said: set[tuple[type, str]] = set()

    def of(self, event: Event) -> str:
        """The line; "" for what is not worth one, or has been said of the same parameter."""
        if isinstance(event, Entered):
            return f"stage {event.number} of {event.of}"
        if isinstance(event, Refined):
            return f"{event.key} goes on with the shape {event.shape}"
        if not isinstance(event, (NonFinite, Faint)) or (type(event), event.key) in self._said:
            return ""
        self._said.add((type(event), event.key))
        if isinstance(event, NonFinite):
            return (
                f"{event.entries} gradient entries of '{event.key}' were NaN or infinite in view '{event.view}' at "
                f"iteration {event.iteration}, and count as zero; more of it is only counted"
            )
        return (
            f"the gradient of '{event.key}' is lost in noise since about iteration {event.iteration}: signal to noise "
            f"{event.ratio:.2g} with spp = {event.spp}; take more, or it has arrived"
        )
