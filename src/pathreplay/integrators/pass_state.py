"""The state of a pass: its inputs from the scene and from earlier passes, and its results."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, field, replace

from pathreplay.adjoint.baseline import Baseline
from pathreplay.integrators.term import TermResult
from pathreplay.transport.facts.traits import Tables


@dataclass(frozen=True)
class PassState:
    """State that a pass takes as input and returns with its results added.

    `PathIntegrator.begin` creates a state. `PathIntegrator.keep` logs warnings about the results, and updates what the
    integrator has learned. A function that `dr.freeze` records takes the state as an argument, since it cannot inspect
    the scene on the host.
    """

    tables: Tables | None = None
    """Lookup tables of the scene."""
    branches: bool | None = None
    """`Media.branches`; None if the pass has to determine it."""
    guess: Baseline | None = None
    """Control variate for the radiance in media."""
    passes: frozenset[Hashable] = frozenset()
    """Keys of the passes that ``guess`` was learned from."""
    result: TermResult = field(default_factory=TermResult)
    """Sum of the results of all passes since `begin`, without images."""

    @property
    def is_complete(self) -> bool:
        """Whether `begin` could inspect the scene. While `dr.freeze` records, `begin` cannot inspect the scene."""
        return self.branches is not None

    def after(self, result: TermResult) -> PassState:
        """Return the state with the result of a pass added."""
        return replace(self, result=self.result + replace(result, image=None))

    def to_record(self) -> PassState:
        """Return the state without ``passes``, as an input of a function that `dr.freeze` records.

        A recorded pass cannot read its own key. It therefore cannot check whether ``passes`` contains this key.
        """
        return replace(self, passes=frozenset())
