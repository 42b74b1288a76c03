"""The state of a pass: what it is given of its scene and of earlier passes, and what it has found."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, field, replace

from pathreplay.adjoint.baseline import Baseline
from pathreplay.integrators.term import TermResult
from pathreplay.transport.facts.traits import Tables


@dataclass(frozen=True)
class PassState:
    """A pass takes a state and returns it with what it found; see `PathIntegrator.begin` and `PathIntegrator.keep`.

    A function that `dr.freeze` records takes the state as an argument, since it cannot look at the scene on the host.
    """

    tables: Tables | None = None  # of the scene
    branches: bool | None = None  # see `Media`; None: found out by the pass
    guess: Baseline | None = None  # of the radiance in media
    passes: frozenset[Hashable] = frozenset()  # keys of those that the guess was learned from
    found: TermResult = field(default_factory=TermResult)

    @property
    def is_complete(self) -> bool:
        """Whether all of the scene was looked at that a pass may need: a recording cannot do that."""
        return self.branches is not None

    def after(self, found: TermResult) -> PassState:
        """The state after a pass that found so much; images are not kept."""
        return replace(self, found=self.found + replace(found, image=None))

    def to_record(self) -> PassState:
        """The state for passes that `dr.freeze` records: these cannot read their keys."""
        return replace(self, passes=frozenset())
