"""Pyramids: the levels add up to the grid, gradients are the transpose, and unseen texels follow their surroundings."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

import pathreplay
from pathreplay.errors import PathreplayError
from pathreplay.inverse.parameters.pyramid import Pyramid
from pathreplay.inverse.parameters.reparameterization import Transform
from pathreplay.jobs import make_config, optimize
from room_job import JOB, TEXTURE, interrupt_at, room, run  # noqa: F401 (room: its folder, for every test)

SHAPES = [(5, 7, 3), (8, 8, 1), (4, 3, 5, 2), (1, 1, 3), (1, 6, 1)]
STEPPED = [{"key": TEXTURE, "initial": 0.5, "lower": 0.0, "upper": 1.0, "pyramid": True}]


def random(*shape: int) -> np.ndarray:
    return np.random.default_rng(sum(shape)).uniform(0.2, 0.8, shape).astype(np.float32)


@pytest.mark.parametrize("inner", [None, Transform("logit")])
@pytest.mark.parametrize("wraps", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
def test_the_gradient_of_the_levels_is_that_of_finite_differences(
    shape: tuple[int, ...], wraps: bool, inner: Transform | None
) -> None:
    pyramid, v = Pyramid([shape], wraps, inner), random(*shape)
    u = pyramid.latent(v)
    assert pyramid.values(u) == pytest.approx(v, abs=1e-6 if inner else 0)
    by_values, δ = random(*shape) - 0.5, 0.01 * (random(u.size) - 0.5)
    slope = np.vdot(by_values, (pyramid.values(u + δ) - pyramid.values(u - δ)).astype(float)) / 2
    assert np.vdot(pyramid.gradient(v, by_values), δ) == pytest.approx(slope, rel=2e-3)


def test_a_step_of_one_coarse_level_is_smooth_and_wraps_where_it_should() -> None:
    shape = (4, 8, 1)
    for wraps in (False, True):
        pyramid = Pyramid([shape], wraps)
        u = pyramid.latent(np.zeros(shape, np.float32))
        # From the coarsest: 1 x 1, 1 x 2, 2 x 4, 4 x 8 entries.
        assert u.size == 1 + 2 + 8 + 32
        u[1 + 2 + 3] = 1  # the last column of the first row of the third level
        v = pyramid.values(u)[..., 0]
        assert v[0].tolist() == [0.25 if wraps else 0, 0, 0, 0, 0, 0.25, 0.75, 0.75 if wraps else 1]
        assert v[:, 6].tolist() == [0.75, 0.5625, 0.1875, 0]
        u[0] = 2
        assert pyramid.values(u)[..., 0] == pytest.approx(v + 2)


def wall(texels: np.ndarray) -> dict[str, object]:
    """A wall of which the camera sees the middle, under a white sky."""
    texture = {"type": "bitmap", "raw": True, "data": mi.TensorXf(texels), "filter_type": "nearest"}
    pose = mi.ScalarTransform4f().look_at(origin=[0, 0, 2], target=[0, 0, 0], up=[0, 1, 0])
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    return {
        "type": "scene",
        "camera": {"type": "perspective", "fov": 28, "to_world": pose, "film": film},
        "wall": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": texture}},
        "sky": {"type": "constant"},
        "integrator": {"type": "path", "max_depth": 2},
    }


def test_texels_that_no_path_reaches_follow_their_surroundings() -> None:
    target = np.array(mi.render(mi.load_dict(wall(np.full((8, 8, 3), 0.8, np.float32))), spp=16))
    ends = {}
    for pyramid in (False, True):
        parameter = pathreplay.Parameter(initial=0.3, bounds=(0, 1), pyramid=pyramid)
        problem = pathreplay.Problem(
            wall(np.full((8, 8, 3), 0.3, np.float32)),
            {"wall.bsdf.reflectance.data": parameter},
            views=[pathreplay.View(target=target)],
            spp=16,
            learning_rate=0.01,
        )
        ends[pyramid] = pathreplay.minimize(problem, steps=80, progress=False).values["wall.bsdf.reflectance.data"]
    assert ends[True][3:5, 3:5].mean() == pytest.approx(0.8, abs=0.01)
    assert ends[False][0, 0] == pytest.approx(0.3)  # the camera does not see the corner
    assert (ends[True][0, 0] > 0.6).all()


@pytest.mark.parametrize(
    "more",
    [
        pytest.param({}, marks=pytest.mark.slow),
        {"resolutions": [2, 4], "refine_at": [3], "parameterization": "logit"},
    ],
)
def test_a_stopped_job_resumes_to_the_bit(more: dict[str, object], monkeypatch: pytest.MonkeyPatch) -> None:
    settings = {"parameters": [STEPPED[0] | more], "iterations": 6, "deterministic": True}
    whole = run(**settings)
    with monkeypatch.context() as patch:
        interrupt_at(4, patch)
        stopped = run(**settings)
    assert len(stopped.history) == 4
    resumed = optimize(resume=stopped.folder, progress=False)
    assert np.array_equal(resumed.parameters[TEXTURE], whole.parameters[TEXTURE])


@pytest.mark.parametrize(
    "changes, message",
    [
        (
            {"parameters": [{"key": "floor.reflectance.value", "pyramid": True}]},
            r"is not a texture or volume; remove 'pyramid'",
        ),
        ({"parameters": STEPPED, "optimizer": {"type": "l-bfgs-b"}}, "does not step the levels of a pyramid"),
        ({"parameters": [{"key": "x", "pose": "rigid", "pyramid": True}]}, "'pyramid' does not apply to a pose"),
    ],
)
def test_what_has_no_levels_is_refused(changes: dict[str, object], message: str, tmp_path: Path) -> None:
    with pytest.raises(PathreplayError, match=message):
        optimize(make_config({**JOB, **changes, "output": str(tmp_path / "out")}), progress=False)
