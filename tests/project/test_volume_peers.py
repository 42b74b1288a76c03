"""Integrators of Mitsuba 3.0 run after translation, and sample as the branch of Mitsuba that they were written for."""

from __future__ import annotations

import sys
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from media_scenes import cloud, constant, heterogeneous, lit_floor
from pathreplay.errors import PathreplayError
from pathreplay.testing.statistics import gap
from pathreplay.testing.verdict import Z_LIMIT
from places import ROOT

sys.path.insert(0, str(ROOT))  # the benchmarks run from the checkout and are not installed

from benchmarks import old_integrators

OLD = """
import drjit as dr
import mitsuba as mi
from util import get_single_medium

class Counting(mi.ad.integrators.common.RBIntegrator):
    def sample(self, mode, scene, sampler, ray, δL=None, state_in=None, active=None, **kwargs):
        medium = get_single_medium(scene)
        count, mean = mi.Float(0), mi.Spectrum(0)
        going = mi.Mask(True)
        loop = mi.Loop("counting", lambda: (count, going))
        while loop(going):
            count += dr.sqr(mi.Float(1))
            going &= dr.neq(count, 3)
        if self.max_depth > 1:
            mei = dr.zeros(mi.MediumInteraction3f)
            mean = medium.get_albedo(mei, going)
        return count + mean, mi.Mask(True), mean

mi.register_integrator("counting", lambda props: Counting(props))
"""


@pytest.fixture
def counting(tmp_path: Path) -> mi.Integrator:
    file = tmp_path / "counting.py"
    file.write_text(OLD)
    return old_integrators.integrator(old_integrators.load(file)["counting"], max_depth=8)


def uniform() -> dict:
    return heterogeneous(constant(1.5), 0.25)


def test_loops_and_names_of_mitsuba_3_0(counting: mi.Integrator) -> None:
    image = counting.render(mi.load_dict(cloud(uniform())), seed=0, spp=4)
    np.testing.assert_allclose(np.array(image), 3.25, rtol=1e-5)


def test_a_second_shape_is_refused(counting: mi.Integrator) -> None:
    scene = mi.load_dict(lit_floor(uniform()))
    with pytest.raises((PathreplayError, RuntimeError), match="needs a single one"):
        counting.render(scene, seed=0, spp=1)


def test_a_missing_checkout_is_named(tmp_path: Path) -> None:
    with pytest.raises(PathreplayError, match=r"no integrator at .*volpathsimple\.py"):
        old_integrators.load(tmp_path / "volpathsimple.py")


def test_points_by_transmittance_integrate_like_quadrature() -> None:
    """The mean of weight x f(t) is the integral of T(t) f(t), for a grid that is not constant."""
    z = np.linspace(0.2, 1, 6, dtype=np.float32)[:, None, None, None] * constant(1.0)
    scene = mi.load_dict(cloud(heterogeneous(z, 0.25, scale=2.0)))
    medium = old_integrators._Medium(scene.shapes()[0].interior_medium())
    n = 1 << 16
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, n)
    ray = dr.zeros(mi.Ray3f, n)
    ray.o, ray.d, ray.maxt = mi.Point3f(0.1, 0.2, -2), mi.Vector3f(0, 0, 1), 4.0
    at, weight = medium.sample_interaction_drt(ray, sampler, 0, mi.Bool(True))

    steps = 4000
    t = dr.linspace(mi.Float, 1, 3, steps)
    mei = dr.zeros(mi.MediumInteraction3f, steps)
    mei.p = mi.Point3f(0.1, 0.2, t - 2)
    σ_t = np.array(medium.get_scattering_coefficients(mei, mi.Bool(True))[2][0], np.float64)
    width = 2 / (steps - 1)
    depth = np.concatenate([[0], np.cumsum((σ_t[1:] + σ_t[:-1]) / 2 * width)])
    distance, T = np.array(t, np.float64), np.exp(-depth)
    samples = np.array(weight[0], np.float64)
    for f in (lambda x: 0 * x + 1, lambda x: x - 1, lambda x: x**3):
        values = T * f(distance)
        exact = ((values[1:] + values[:-1]) / 2 * width).sum()
        assert abs(gap(samples * f(np.array(at.t, np.float64)), np.float64(exact)).z) < Z_LIMIT
