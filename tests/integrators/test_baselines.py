"""The rivals: the tape has the gradient of the sweep; radiative backpropagation has its mean, unless it is linear."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from media_scenes import FORWARD, cloud, heterogeneous, lit_floor, smooth, sunlit
from pathreplay import PathreplayError
from pathreplay.testing.statistics import gap
from pathreplay.testing.stencil import WIDE
from pathreplay.testing.verdict import RESOLUTION, Z_LIMIT
from truth import (
    Case,
    add,
    bitmap,
    lit_room,
    noise,
    random,
    rgb,
    tilt_vertices,
    translate,
)


def textured(shape: str = "sphere") -> dict:
    return lit_room({"type": "diffuse", "reflectance": bitmap(noise(16, 3, 0.2, 0.8))}, shape)


def black_and_green() -> dict:
    return lit_room({"type": "diffuse", "reflectance": rgb(0, 0.5, 0)})


def foggy() -> dict:
    return cloud(heterogeneous(smooth(0.5, 3), 0.8))


def coloured_fog() -> dict:
    return cloud(heterogeneous(smooth(0.5, 3), smooth(0.3, 0.9)))


def fog_before_the_sun() -> dict:
    return sunlit(heterogeneous(smooth(0.4, 2), smooth(0.3, 0.9), FORWARD))


def colourful_fog_on_the_floor() -> dict:
    return lit_floor(heterogeneous(smooth(0.5, 3, 3), 0.8))


def glass_ball() -> dict:
    return lit_room({"type": "dielectric_ad"})


TEXTURE = Case("texture", textured, "object.bsdf.reflectance.data", random(), depth=5)
FLOOR = Case("floor", textured, "floor.bsdf.reflectance.value", add(), depth=5)
VERTICES = Case("vertices", lambda: textured("cube"), "object.vertex_positions", tilt_vertices())
DENSITY = Case(
    "density",
    foggy,
    "object.interior_medium.sigma_t.data",
    random(),
    depth=5,
    step=0.15,
    spp=128,
    reference="volpath",
    stencil=WIDE,
)
SLOW = [
    Case("zero reflectance", black_and_green, "object.bsdf.reflectance.value", add([0.3, -0.2, 0.5])),
    Case("camera", textured, "camera.to_world", translate(0.3, 0.2, -1)),
    Case("index of glass", glass_ball, "object.bsdf.eta", add(), depth=5),
    Case("chromatic density and lamp", colourful_fog_on_the_floor, DENSITY.key, random()),
]
CASES = [TEXTURE, DENSITY, *(pytest.param(case, marks=pytest.mark.slow) for case in (VERTICES, *SLOW))]
LISTED = [
    pytest.param(replace(DENSITY, name="listed density"), marks=pytest.mark.slow),
    pytest.param(
        replace(DENSITY, name="listed albedo", scene=coloured_fog, key="object.interior_medium.albedo.data", step=0.1),
        marks=pytest.mark.slow),
    pytest.param(
        replace(DENSITY, name="listed g", scene=fog_before_the_sun, key="object.interior_medium.phase_function.g",
                move=add(), step=0.1), marks=pytest.mark.slow),
]  # fmt: skip
# Sums of some thousand float32 terms in another order.
ROUNDING = 1e-4
OWN = {"sampling": "scene"}  # baselines use no other sampler


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_the_tape_has_the_gradient_of_the_sweep(case: Case, opened) -> None:
    """With the same seed, while roulette plays."""
    b = opened(case)
    sweep = b.backward(b.integrator(rr_depth=2, null_branching=False, **OWN), 1, 16)
    assert sweep != 0
    assert b.backward(b.integrator("naive_ad", rr_depth=2), 1, 16) == pytest.approx(sweep, rel=ROUNDING)


@pytest.mark.slow
@pytest.mark.parametrize("case", [TEXTURE, VERTICES, DENSITY, *SLOW], ids=lambda case: case.name)
def test_the_tape_has_the_tangent_of_the_forward_driver(case: Case, opened) -> None:
    b = opened(case)
    ours = b.forward(b.integrator(rr_depth=2, null_branching=False, **OWN), 1, 16)
    tape = b.forward(b.integrator("naive_ad", rr_depth=2), 1, 16)
    assert 0 < np.abs(ours).sum() and np.abs(tape - ours).sum() < ROUNDING * np.abs(ours).sum()


@pytest.mark.parametrize(
    "case", [TEXTURE, FLOOR, pytest.param(DENSITY, marks=pytest.mark.slow)], ids=lambda case: case.name
)
def test_radiative_backpropagation_is_right_and_its_linear_variant_is_not(case: Case, opened) -> None:
    """Light that comes back from other surfaces or from the fog is not one."""
    b = opened(case)
    reference = b.reference(case.seeds)
    variants = [b.integrator("radiative_backprop", rr_depth=case.rr_depth, linear=linear) for linear in (False, True)]
    right, wrong = (gap(b.backwards(variant), reference) for variant in variants)
    assert max(right.error, wrong.error) < RESOLUTION * abs(reference.mean())
    assert abs(right.z) < Z_LIMIT
    assert abs(wrong.value) > 2 * Z_LIMIT * wrong.error


@pytest.mark.parametrize("case", LISTED, ids=lambda case: case.name)
def test_delta_tracking_as_listed_is_right_where_collisions_are_drawn(case: Case, opened) -> None:
    """By the density its transmittance is another estimate; all else is that of the forward driver, path by path."""
    b = opened(case)
    reference = b.reference(case.seeds)
    listing = b.integrator("prb_volume_listing", rr_depth=case.rr_depth)
    found = gap(b.backwards(listing), reference)
    assert found.error < RESOLUTION * abs(reference.mean())
    assert abs(found.z) < Z_LIMIT
    if case.name != "listed density":
        steady = {"rr_depth": 1000}
        tangent = b.dot(b.forward(b.integrator(**steady, **OWN), 1, 16))
        again = b.backward(b.integrator("prb_volume_listing", **steady), 1, 16)
        assert again == pytest.approx(tangent, rel=ROUNDING)


@pytest.mark.parametrize("plugin", ["naive_ad", "radiative_backprop", "prb_volume_listing"])
def test_images_are_those_of_pathreplay(plugin: str, opened) -> None:
    b = opened(TEXTURE)
    assert np.array_equal(b.image(b.integrator(plugin), 1, 4), b.image(b.integrator(**OWN), 1, 4))


@pytest.mark.parametrize(
    ("plugin", "properties", "words"),
    [
        ("naive_ad", {"max_depth": -2}, ["naive_ad", "max_depth = -2", "-1"]),
        ("radiative_backprop", {"rr_depth": 0}, ["radiative_backprop", "rr_depth = 0"]),
        ("naive_ad", {"attach": "all"}, ["attach = 'all'", "'delta'"]),
    ],
)
def test_bad_properties_are_named_with_the_way_out(plugin: str, properties: dict, words: list[str]) -> None:
    with pytest.raises(Exception) as error:  # Mitsuba wraps what a plugin raises
        mi.load_dict({"type": plugin, **properties})
    assert all(word in str(error.value) for word in words), str(error.value)


def test_radiative_backpropagation_says_what_it_cannot_do(opened) -> None:
    b = opened(VERTICES)
    rb = b.integrator("radiative_backprop")
    with pytest.raises(PathreplayError, match="no forward mode"):
        b.forward(rb, 1, 1)
    with pytest.raises(PathreplayError, match="no parameter with gradients reaches"):
        b.backward(rb, 1, 1)


def test_they_are_registered_on_request(run_python) -> None:
    load = "mi.load_dict({'type': 'naive_ad'})"
    result = run_python(
        "import pathreplay, mitsuba as mi; mi.set_variant('llvm_ad_rgb')\n"
        f"try: {load}\nexcept Exception as error: print('naive_ad' in str(error))\n"
        f"pathreplay.baselines.register(); {load}; mi.set_variant('llvm_ad_mono'); {load}; print('registered')\n"
    )
    assert result.stdout.split() == ["True", "registered"], result
