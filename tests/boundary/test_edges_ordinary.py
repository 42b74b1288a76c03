"""Edges in ordinary use: interior and edges together, in scenes as people have them, against finite differences."""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from edge_ordinary import SCENES, Measured, measured
from edge_truth import hold_agreement
from pathreplay.errors import PathreplayError

AGREE = ("smooth_torus", "flat_torus", "constant", "mesh_lamp", "mesh_lamp_moves")
"""Those of `SCENES` that have been seen to agree."""
SEEDS = 8
TAIL = 0.9
"""Largest share of one pass in the variance of eight; of normal deviates it is more once in some thousand tests."""


def one_film(sensor: dict) -> dict:
    """A square before a sky, seen by a sensor."""
    film = {"type": "hdrfilm", "width": 2, "height": 1, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    sky = {"type": "constant", "radiance": 0.7}
    return {"type": "scene", "camera": {"film": film, **sensor}, "square": {"type": "rectangle"}, "sky": sky}


PINHOLE = {"type": "perspective", "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])}


def hold_refusal(description: dict, edges: str, message: str) -> None:
    """To edges of this scene being refused where its square moves."""
    scene = mi.load_dict(description)
    params = mi.traverse(scene)
    dr.enable_grad(params["square.to_world"])
    params.update()
    integrator = mi.load_dict({"type": "pathreplay", "boundary": edges, "max_depth": 2})
    with pytest.raises(PathreplayError, match=message):
        integrator.render_backward(scene, params, dr.ones(mi.TensorXf, (1, 2, 3)), spp=1)


@pytest.mark.slow
def test_batch_sensors_are_refused() -> None:
    hold_refusal(one_film({"type": "batch", "one": PINHOLE, "two": PINHOLE}), "all", "of type 'batch'")


@pytest.mark.slow
def test_grids_of_distances_are_refused() -> None:
    z, y, x = np.meshgrid(*3 * [np.linspace(-0.5, 0.5, 8)], indexing="ij")
    grid = {"type": "sdfgrid", "grid": mi.TensorXf((np.sqrt(x * x + y * y + z * z) - 0.3)[..., None])}
    hold_refusal({**one_film(PINHOLE), "body": grid}, "primary", "shape 'body' of type 'sdfgrid'")


def hold(name: str, found: Measured) -> None:
    g = found.gradients
    hold_agreement(name, g, found.differences, found.transpose)
    share = np.square(g - g.mean())
    assert share.max() < TAIL * share.sum(), g


@pytest.mark.slow
@pytest.mark.parametrize("name", AGREE)
def test_gradients_agree(name: str, tmp_path: Path) -> None:
    hold(name, measured(SCENES[name](tmp_path), tmp_path, SEEDS))
