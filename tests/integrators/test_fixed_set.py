"""The fixed set: no gradient of it has changed since it was saved (see `fixed_set`)."""

from __future__ import annotations

import pytest

from fixed_scenes import SCENES, Scene
from fixed_set import compared, differs, incomparable

QUICK = {"fog"}
"""Scenes of the quick tests: surfaces and a medium, by nearly every driver."""


@pytest.mark.parametrize(
    "scene",
    [pytest.param(s, id=s.name, marks=() if s.name in QUICK else pytest.mark.slow) for s in SCENES],
)
def test_gradients_are_those_that_were_saved(scene: Scene) -> None:
    if reason := incomparable():
        pytest.skip(reason)
    rows = list(compared(scene))
    print("\n".join(line for line, _ in rows))
    assert len(rows) == len(scene.cases)
    assert not [line for line, error in rows if differs(error)]
