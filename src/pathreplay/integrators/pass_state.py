"""The state of a pass: its inputs from the scene and from earlier passes, and its results."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, field, replace

from pathreplay.adjoint.baseline import Baseline
from pathreplay.integrators.term import TermResult
from pathreplay.transport.facts.traits import Tables


@dataclass(frozen=True)
class PassState:
    """Passed to a pass, and returned by it with the results added.

    `PathIntegrator.begin` makes one, `PathIntegrator.keep` reports the results and learns from them. A function that is
    recorded by `dr.freeze` takes the state as an argument, since it cannot inspect the scene on the host.
    """

    tables: Tables | None = None
    """Lookup tables of the scene."""
    branches: bool | None = None
    """`Media.branches`; None: determined by the pass."""
    guess: Baseline | None = None
    """Control variate for the radiance in media."""
    passes: frozenset[Hashable] = frozenset()
    """Keys of the passes that ``guess`` was learned from."""
    found: TermResult = field(default_factory=TermResult)
    """Sum of the results of the passes since `begin`, without images."""

    @property
    def is_complete(self) -> bool:
        """Whether the scene was inspected outside of a recording."""
        return self.branches is not None

    def after(self, found: TermResult) -> PassState:
        """Return the state with the result of a pass added."""
        return replace(self, found=self.found + replace(found, image=None))

    def to_record(self) -> PassState:
        """Return the input of a recorded pass, which cannot read its own key and compare it with ``passes``."""
        return replace(self, passes=frozenset())
