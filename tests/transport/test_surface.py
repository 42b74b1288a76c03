"""Hit points under motion: the sum of the motion with the shape and of the slide over it is the whole motion."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay.transport.surface import FIELDS, met, met_with_normal
from variant import VARIANT

FLAGS = dr.ADFlag.ClearInterior | dr.ADFlag.AllowNoGrad
KEYS = {"rectangle": "shape.to_world", "sphere": "shape.to_world", "cube": "shape.vertex_positions"}


@pytest.mark.parametrize("plugin", KEYS)
def test_slide_and_motion_with_the_shape_add_up(plugin: str) -> None:
    mi.set_variant(VARIANT)
    scene = mi.load_dict({"type": "scene", "shape": {"type": plugin}}, optimize=False)
    params, key = mi.traverse(scene), KEYS[plugin]
    t = mi.Float(0)
    dr.enable_grad(t)
    before = params[key]
    if plugin == "cube":
        p = dr.unravel(mi.Point3f, mi.Float(before))
        params[key] = dr.ravel(p + t * mi.Vector3f(p.y, 0.3 * p.z + 0.2, p.x))
    else:
        params[key] = mi.Transform4f().translate(t * mi.Vector3f(0.3, 0.2, 0.5)) @ mi.Transform4f(before)
    params.update()
    # The last ray misses.
    x = np.array([[0.3, 0.2, 5], [-0.4, 0.5, 5], [0.1, -0.6, 5], [9, 0, 5]], np.float32)
    d = dr.normalize(mi.Vector3f(0.02, -0.05, -1)) * dr.ones(mi.Float, len(x))
    ray = mi.Ray3f(mi.Point3f(x.T), d)
    hit = scene.ray_intersect_preliminary(dr.detach(ray))
    ray.o += t * mi.Vector3f(0.5, -0.3, 0.2)
    ray.d += t * mi.Vector3f(0.1, 0.2, -0.1)
    (apart, _), whole = met_with_normal(hit, ray, mi.Bool(True)), met(hit, ray, mi.Bool(True))
    pairs = {name: (getattr(apart, name), getattr(whole, name)) for name in (*FIELDS, "wi")}
    pairs |= {f"sh_frame.{axis}": (getattr(apart.sh_frame, axis), getattr(whole.sh_frame, axis)) for axis in "stn"}
    pairs["t"] = dr.select(hit.is_valid(), apart.t, 0), dr.select(hit.is_valid(), whole.t, 0)
    dr.eval([value for pair in pairs.values() for value in pair])  # in one kernel
    slopes = []
    for name, (a, b) in pairs.items():
        np.testing.assert_allclose(np.array(a), np.array(b), rtol=1e-6, err_msg=name)
        weights = np.random.default_rng(1).uniform(0.5, 1.5, np.array(a).shape).astype(np.float32)
        for value in (a, b):
            dr.set_grad(t, 0)
            dr.backward(dr.sum(type(value)(weights) * value, axis=None), FLAGS)
            slopes.append(dr.grad(t))
    dr.eval(slopes)
    found = np.array(slopes)[:, 0]
    for name, one, other in zip(pairs, found[::2], found[1::2], strict=True):
        assert one == pytest.approx(other, abs=2e-5), name
    assert np.abs(found).max() > 0.1
