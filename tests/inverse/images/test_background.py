"""The image of the environment emitter."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from pathreplay.inverse.images.background import SAMPLES, background


@pytest.mark.parametrize("side", [64, 8192])
def test_samples_of_large_films_are_limited(side: int, monkeypatch: pytest.MonkeyPatch) -> None:
    film = {"type": "hdrfilm", "width": side, "height": side}
    camera = {"type": "perspective", "film": film}
    scene = mi.load_dict({"type": "scene", "sky": {"type": "constant"}, "camera": camera})
    taken = []

    def watched(scene: mi.Scene, *, spp: int, **others: object) -> np.ndarray:
        taken.append(spp)
        return np.zeros((1, 1, 3), np.float32)

    monkeypatch.setattr(mi, "render", watched)
    background(scene, 0)
    assert taken == [SAMPLES if side == 64 else 16]
    assert taken[0] * side**2 < 2**32
