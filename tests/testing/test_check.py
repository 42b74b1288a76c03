"""The gradient check: its verdicts on made-up samples, its differences on polynomials, and both on Mitsuba's `prb`.

`prb` is right on a diffuse wall, and wrong on `plastic` and at a reflectance of zero: a check must tell these apart.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay import cli
from pathreplay.errors import PathreplayError
from pathreplay.integrators.path_limits import Limits
from pathreplay.integrators.stateful import stateful
from pathreplay.platform import progress_bar
from pathreplay.scenes.parameters import get_array
from pathreplay.testing import check_gradient, command
from pathreplay.testing.direction import choose_line
from pathreplay.testing.objective import Objective, integrator_name, smooth_weights
from pathreplay.testing.reference import integrator_under_test, read_limits, reference_integrator
from pathreplay.testing.statistics import gap, normal
from pathreplay.testing.stencil import BACKWARD, CENTRAL, FORWARD, UPWARD, WIDE, Stencil
from pathreplay.testing.verdict import Judgement, judge

# ------------------------------------------------------------------------------
#  Verdict
# ------------------------------------------------------------------------------


def verdict_on(g: float, r: float, noise: float, n: int = 16, halving: float = 0.0, **options: float) -> Judgement:
    """Judge n samples about g against n about r; halving the step changes the reference by the share ``halving``."""
    rng = np.random.default_rng(7)
    gradient, half = g + noise * rng.standard_normal(n), r + noise * rng.standard_normal(n)
    return judge(gradient, half * (1 - halving), half, **options)


@pytest.mark.parametrize(
    ("case", "expected"),
    [
        ({"g": 1.0, "r": 1.0, "noise": 0.1}, "pass"),
        ({"g": -3e-7, "r": -3e-7, "noise": 1e-8}, "pass"),  # small is not zero: the units are the user's
        ({"g": 1.06, "r": 1.0, "noise": 0.01}, "fail"),
        ({"g": -1.0, "r": 1.0, "noise": 0.2}, "fail"),
        ({"g": 0.0, "r": 1e-3, "noise": 1e-5}, "fail"),  # a missing derivative, however small
        ({"g": 1.0, "r": 1.0, "noise": 2.0}, "inconclusive"),
        ({"g": -1.0, "r": 0.1, "noise": 0.05, "n": 2}, "inconclusive"),  # 20 σ apart, and yet below |z| = 4
        ({"g": 0.0, "r": 0.0, "noise": 1.0}, "inconclusive"),
        ({"g": 0.0, "r": 0.0, "noise": 0.0}, "zero"),
        ({"g": 0.0, "r": 0.0, "noise": 1e-6, "negligible": 1e-3}, "zero"),
        ({"g": 0.0, "r": 0.0, "noise": 1e-2, "negligible": 1e-3}, "inconclusive"),
        ({"g": 1.0, "r": 1.0, "noise": 0.01, "halving": 0.6}, "inconclusive"),  # the step decides what comes out
        ({"g": 1.001, "r": 1.0, "noise": 0.0, "rounding": 0.01}, "pass"),
        ({"g": 1.001, "r": 1.0, "noise": 0.0}, "fail"),
        ({"g": np.nan, "r": 1.0, "noise": 0.1}, "fail"),
        ({"g": 1.0, "r": np.inf, "noise": 0.1}, "inconclusive"),
    ],
)
def test_verdict(case: dict[str, float], expected: str) -> None:
    result = verdict_on(**case)
    assert result.verdict == expected, result
    assert result.reason
    assert {type(result.gradient), type(result.reference_se), type(result.z), type(result.resolution)} == {float}


def test_an_inconclusive_verdict_names_the_samples_that_are_missing() -> None:
    few = verdict_on(1.0, 1.0, noise=1.0)
    assert few.verdict == "inconclusive"
    factor = int("".join(c for c in few.reason if c.isdigit()))
    assert verdict_on(1.0, 1.0, noise=1.0, n=16 * factor).verdict == "pass"


def test_z_keeps_its_meaning_with_few_seeds() -> None:
    # 4.6 % of standard normal deviates are beyond 2. With 3 seeds the plain ratio is there 12 % of the time; what is
    # asked of 4000 trials leaves room for Welch's approximation (which is on the safe side) and for 4 standard errors.
    rng = np.random.default_rng(3)
    beyond = 0
    for _ in range(4000):
        half = 1 + 0.1 * rng.standard_normal(3)
        beyond += abs(judge(1 + 0.1 * rng.standard_normal(3), half, half).z) > 2
    assert 0.02 < beyond / 4000 < 0.0455 + 4 * 0.0033


@pytest.mark.parametrize("seeds", [3, 12])
def test_gaps_of_few_samples_are_as_rare_as_their_deviates_say(seeds: int) -> None:
    # Beyond 3: 0.27 % of normal deviates; of plain ratios with equal noise 4 % (3 seeds), 0.6 % (12).
    noise = np.random.default_rng(5).standard_normal((2, seeds, 40_000))
    found = gap(noise[0], noise[1])
    rare, plain = (np.abs(x).__gt__(3).mean() for x in (found.z, found.value / found.error))
    assert 0.0008 < rare < 0.0027 + 4 * 0.00026
    assert plain > 2 * rare
    known = gap(noise[0], np.zeros(40_000))
    assert np.abs(known.z).__gt__(3).mean() == pytest.approx(0.0027, abs=4 * 0.00026)
    assert normal(6.2416, 11) == pytest.approx(4, abs=1e-4)  # a table's quantile of Student's distribution


@pytest.mark.parametrize(("n", "noise"), [(2, 1e-3), (3, 1e-3), (200, 0.05)])
def test_the_error_that_would_have_shown_does_show(n: int, noise: float) -> None:
    deviations = np.random.default_rng(7).standard_normal((2, n))
    samples = 1 + noise * (deviations - deviations.mean(axis=1, keepdims=True))
    right = judge(samples[0], samples[1], samples[1])
    assert right.verdict == "pass"
    error = float(right.reason.split("above ")[1].split(" %")[0]) / 100
    verdicts = [judge(samples[0] - share * error, samples[1], samples[1]).verdict for share in (0.9, 1.1)]
    assert verdicts[0] == "pass" != verdicts[1]


# ------------------------------------------------------------------------------
#  Direction, stencil, weights
# ------------------------------------------------------------------------------


@pytest.mark.parametrize("stencil", [CENTRAL, FORWARD, BACKWARD], ids=lambda s: s.name)
def test_stencils_are_of_second_order_and_richardson_of_third(stencil: Stencil) -> None:
    h = 0.1
    for power, derivative in ((0, 0), (1, 1), (2, 0)):
        for each in (stencil, stencil.halved()):
            assert each(lambda t, power=power: t**power, h) == pytest.approx(derivative, abs=1e-12)
    full, half = stencil(lambda t: t**3, h), stencil.halved()(lambda t: t**3, h)
    assert abs(full) > 1e-3  # else the next line would say nothing
    assert (4 * half - full) / 3 == pytest.approx(0, abs=1e-12)
    assert len(stencil.points()) == 4


@pytest.mark.parametrize(("stencil", "order"), [(WIDE, 4), (UPWARD, 3)], ids=lambda x: getattr(x, "name", str(x)))
def test_wide_stencils_are_of_higher_order(stencil: Stencil, order: int) -> None:
    for power in range(order + 1):
        assert stencil(lambda t, power=power: t**power, 0.1) == pytest.approx(float(power == 1), abs=1e-12)
    assert abs(stencil(lambda t: t ** (order + 1), 0.1)) > 1e-6


@pytest.mark.parametrize(
    ("key", "value", "direction", "expected"),
    [
        ("a.reflectance.value", [0.5, 0.5, 0.5], None, CENTRAL),
        ("a.reflectance.value", [0.5, 0.0, 0.5], None, FORWARD),
        ("a.reflectance.value", [0.5, 0.0, 0.5], [0, -1, 0], BACKWARD),
        ("a.reflectance.value", [0.5, 0.0, 0.5], [1, 0, 1], CENTRAL),
        ("a.reflectance.value", [0.0, 0.0, 0.5], [1, -1, 1], CENTRAL),
        ("a.specular", [-0.5, 0.0, 0.5], None, CENTRAL),
        ("a.vertex_positions", [0.0, 0.0, 0.5], None, CENTRAL),
    ],
)
def test_no_step_below_zero_where_it_would_leave_the_domain(
    key: str, value: list[float], direction: Any, expected: Stencil
) -> None:
    assert choose_line(key, np.array(value), direction).stencil is expected


def test_directions() -> None:
    assert choose_line("a.eta", np.array([1.5])).direction.tolist() == [1.0]
    random = choose_line("a.data", np.ones((4, 4, 3))).direction
    assert random.max() == 1 and random.min() >= 0.5 and np.unique(random).size == random.size
    assert np.array_equal(random, choose_line("a.data", np.ones((4, 4, 3))).direction)
    assert not np.array_equal(random, choose_line("a.data", np.ones((4, 4, 3)), seed=1).direction)
    move = choose_line("a.to_world", np.eye(4)).direction
    assert move[:3, 3].all() and not move[:, :3].any() and move[3, 3] == 0
    assert choose_line("a.radiance", np.array([20.0])).step == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"direction": [1, 2]}, "shape"),
        ({"direction": [0, 0, 0]}, "zero"),
        ({"direction": [np.nan, 0, 0]}, "NaN"),
        ({"step": 0.0}, "positive"),
        ({"step": -1.0}, "positive"),
        ({"step": np.inf}, "positive"),
    ],
)
def test_bad_lines(options: dict[str, Any], message: str) -> None:
    with pytest.raises(PathreplayError, match=message):
        choose_line("a.value", np.ones(3), **options)


def test_weights_are_a_mean_that_sees_errors_cancel() -> None:
    w = smooth_weights((16, 24, 4), alpha=True)
    assert not w[..., 3].any()
    assert w.sum() == pytest.approx(0.75, rel=0.05)
    # Errors that are opposite in two halves, or two channels, leave the plain mean alone but not this one.
    for flip in (np.s_[:, ::-1], np.s_[::-1], np.s_[::-1, ::-1], (np.s_[...], [1, 0, 2, 3])):
        assert np.abs(w - w[flip]).mean() > 0.1 * w.mean()


# ------------------------------------------------------------------------------
#  Integrators
# ------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["path", "prb", "volpath", "prbvolpath"])
@pytest.mark.parametrize("limits", [(4, 3, True), (-1, 9, False)])
def test_the_reference_has_the_limits_of_the_integrator(kind: str, limits: tuple[int, int, bool]) -> None:
    max_depth, rr_depth, hide = limits
    tested = mi.load_dict({"type": kind, "max_depth": max_depth, "rr_depth": rr_depth, "hide_emitters": hide})
    scene = mi.load_dict({"type": "scene"})
    read = read_limits(tested)
    assert read is not None and vars(read) == {"max_depth": max_depth, "rr_depth": rr_depth, "hide_emitters": hide}
    reference = reference_integrator(None, scene, tested)
    assert reference.class_name() == "PathIntegrator"
    again = read_limits(reference)
    assert again is not None and (again.max_depth, again.hide_emitters) == (max_depth, hide)
    # Roulette stays only where paths have no end without it.
    assert (again.rr_depth == rr_depth) == (max_depth == -1)


@pytest.mark.parametrize("kind", ["pathreplay_particles", "pathreplay", "ptracer"])
def test_the_reference_of_light_paths_has_their_caustics(kind: str) -> None:
    options = {"caustics": "particles"} if kind == "pathreplay" else {}
    tested = mi.load_dict({"type": kind, "max_depth": 4, **options})
    reference = reference_integrator(None, mi.load_dict({"type": "scene"}), tested)
    assert integrator_name(reference) == integrator_name(tested) == kind
    assert stateful(reference).options()["caustics"] == "particles" and read_limits(reference).max_depth == 4  # type: ignore[union-attr]


def test_choice_of_integrators() -> None:
    own = {"type": "prb", "max_depth": 3}
    smoke = {"type": "cube", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous"}}
    scene = mi.load_dict({"type": "scene", "integrator": own, "smoke": smoke})
    assert integrator_under_test(None, scene) is scene.integrator()
    assert read_limits(integrator_under_test("prb_basic", scene)).max_depth == 3  # type: ignore[union-attr]
    assert read_limits(integrator_under_test("prb", scene, max_depth=7)).max_depth == 7  # type: ignore[union-attr]
    assert reference_integrator(None, scene, scene.integrator()).class_name() == "VolumetricPathIntegrator"
    with pytest.raises(PathreplayError, match="does not expose its max_depth"):
        reference_integrator(None, scene, mi.load_dict({"type": "depth"}))
    in_fog = mi.load_dict({"type": "scene", "sensor": {"type": "perspective", "medium": {"type": "homogeneous"}}})
    in_it = reference_integrator(None, in_fog, scene.integrator())
    assert in_it.class_name() == "VolumetricPathIntegrator"
    clear = reference_integrator(None, mi.load_dict({"type": "scene"}), scene.integrator())
    assert clear.class_name() == "PathIntegrator"


def test_added_channels_are_compared_with_a_reference_that_has_them() -> None:
    scene = mi.load_dict({"type": "scene"})
    aov, plain = ({"type": "aov", "aovs": "d:depth", "inner": {"type": kind}} for kind in ("pathreplay", "path"))
    tested = mi.load_dict(aov)
    with pytest.raises(PathreplayError, match=r"'aov' adds channels.*'path' lacks: pass the integrator inside"):
        reference_integrator(None, scene, tested)
    assert reference_integrator(plain, scene, tested).aov_names() == tested.aov_names()


AOV = {"type": "aov", "aovs": "d:depth"}
OURS = {"type": "pathreplay", "max_depth": 4, "attach": "none"}


@pytest.mark.parametrize(
    ("own", "attach", "told"),
    [
        ({**AOV, "inner": OURS}, "none", "'aov' adds channels to .*, which are not checked: 'pathreplay' inside of it"),
        ({"type": "moment", "inner": OURS}, "none", "'moment' adds .*: 'pathreplay' inside of it is$"),
        ({**AOV, "inner": {"type": "moment", "inner": OURS}}, "none", "'aov' adds .*: 'pathreplay' inside of it is$"),
        ({**AOV, "inner": {"type": "path", "max_depth": 4}}, "delta", "'aov' adds .*, which are not checked$"),
        ({**AOV, "a": OURS, "b": {"type": "path"}}, "delta", "'aov' adds .*, which are not checked$"),
    ],
    ids=["aov", "moment", "moment inside of aov", "aov around path", "two inside of aov"],
)
def test_channels_that_a_scenes_own_integrator_adds_are_not_checked_and_named(
    own: dict[str, Any], attach: str, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The integrator inside is named if that very object is checked, not for a new one with its limits."""
    logged: list[str] = []
    monkeypatch.setattr("pathreplay.testing.reference.mi.Log", lambda _, text: logged.append(text))
    scene = mi.load_dict({"type": "scene", "integrator": own})
    tested = integrator_under_test(None, scene)
    assert read_limits(tested) == Limits(6 if "b" in own else 4, 5, False)
    assert stateful(tested).options()["attach"] == attach
    assert len(logged) == 1 and re.search(told, logged[0])


@pytest.mark.parametrize(("light", "notes"), [("constant", 1), ("point", 0)])
def test_a_check_tells_that_ptracer_does_not_expose_hidden_emitters(
    light: str, notes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    logged: list[str] = []
    monkeypatch.setattr("pathreplay.testing.reference.mi.Log", lambda _, text: logged.append(text))
    own = {"type": "ptracer", "hide_emitters": True}
    integrator_under_test(None, mi.load_dict({"type": "scene", "integrator": own, "light": {"type": light}}))
    assert len(logged) == notes and all("'ptracer' does not expose its hide_emitters" in text for text in logged)


def test_unbounded_paths_of_a_scene_are_not_those_of_ours() -> None:
    """As in a job. Unbounded paths are the default of `path`, rarely intended, and cannot be recorded."""
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "path", "rr_depth": 7, "hide_emitters": True}})
    for name in (None, "pathreplay", "pathreplay_particles"):
        assert read_limits(integrator_under_test(name, scene)) == Limits(6, 7, True)
    assert read_limits(integrator_under_test("prb", scene)) == Limits(-1, 7, True)
    assert read_limits(integrator_under_test(None, scene, max_depth=-1)) == Limits(-1, 7, True)
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "pathreplay", "max_depth": -1}})
    assert read_limits(integrator_under_test("pathreplay", scene)) == Limits(-1, 5, False)


@pytest.mark.parametrize("kind", ["prb", "prb_basic", "prbvolpath"])
def test_another_depth_leaves_the_scenes_own_integrator(kind: str) -> None:
    own = {"type": kind, "max_depth": 6, "rr_depth": 9, "hide_emitters": True}
    scene = mi.load_dict({"type": "scene", "integrator": own})
    tested = integrator_under_test(None, scene, max_depth=3)
    assert type(tested) is type(scene.integrator())
    assert read_limits(tested) == Limits(3, 9, True)
    assert read_limits(scene.integrator()) == Limits(6, 9, True)


def test_another_depth_or_boundary_leaves_the_other_properties_of_an_own_pathreplay() -> None:
    own = {"type": "pathreplay", "max_depth": 6, "attach": "all", "sampling": "scene", "adjoint": "replay"}
    scene = mi.load_dict({"type": "scene", "integrator": own})
    options = stateful(scene.integrator()).options()
    deep = integrator_under_test(None, scene, max_depth=3)
    assert stateful(deep).options() == options and options["attach"] == "all" and options["sampling"] == "scene"
    assert read_limits(deep) == Limits(3, 5, False)
    scene = mi.load_dict({"type": "scene", "integrator": {**own, "attach": "delta"}})
    edges = integrator_under_test(None, scene, boundary={"boundary": "primary"})
    assert stateful(edges).options() == options | {"attach": "delta", "boundary": "primary"}


def test_a_boundary_that_follows_from_attach_is_not_copied_without_it() -> None:
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "pathreplay", "attach": "none"}})
    assert stateful(scene.integrator()).boundary == "none"
    assert stateful(integrator_under_test("pathreplay", scene)).boundary == "auto"


def test_another_depth_or_boundary_leaves_an_own_pathreplay_particles() -> None:
    own = {"type": "pathreplay_particles", "max_depth": 6, "hide_emitters": True, "attach": "none"}
    scene = mi.load_dict({"type": "scene", "integrator": own})
    options = stateful(scene.integrator()).options()
    for changes, depth in (({"max_depth": 3}, 3), ({"boundary": {"boundary": "none"}}, 6)):
        tested = integrator_under_test(None, scene, **changes)
        assert type(tested) is type(scene.integrator())
        assert read_limits(tested) == Limits(depth, 5, True)
        assert stateful(tested).options() == options | changes.get("boundary", {}) and options["attach"] == "none"
    named = integrator_under_test("pathreplay_particles", scene, boundary={"boundary": "none", "boundary_spp": 3})
    assert stateful(named).options()["boundary_spp"] == 3
    with pytest.raises(PathreplayError, match="'boundary' is a property of 'pathreplay', and the integrator is 'prb'"):
        integrator_under_test("prb", scene, boundary={"boundary": "none"})


def test_another_depth_of_an_integrator_with_unknown_properties_is_refused() -> None:
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "prb_projective", "sppi": 0}})
    assert integrator_under_test(None, scene) is scene.integrator()
    assert read_limits(integrator_under_test("prb_projective", scene, max_depth=3)) == Limits(3, 5, False)
    with pytest.raises(PathreplayError, match=r"own PathProjectiveIntegrator, .*; set it in the scene, or name"):
        integrator_under_test(None, scene, max_depth=3)


# ------------------------------------------------------------------------------
#  On scenes
# ------------------------------------------------------------------------------


def corner(bsdf: dict[str, Any], resolution: int = 16) -> Any:
    """A floor and a wall of one material, which see each other, under a constant sky."""
    T = mi.ScalarTransform4f
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 4},
            "sensor": {
                "type": "perspective",
                "fov": 60,
                "to_world": T().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]),
                "film": {
                    "type": "hdrfilm",
                    "width": resolution,
                    "height": resolution,
                    "rfilter": {"type": "box"},
                    "pixel_format": "rgb",
                },
            },
            "material": {**bsdf, "id": "material"},
            "floor": {"type": "rectangle", "bsdf": {"type": "ref", "id": "material"}},
            "wall": {
                "type": "rectangle",
                "to_world": T().translate([0, -1, 1]).rotate([1, 0, 0], -90),
                "bsdf": {"type": "ref", "id": "material"},
            },
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.8, 1.0, 1.2]}},
        },
        optimize=False,
    )


def rgb(*value: float) -> dict[str, Any]:
    return {"type": "rgb", "value": list(value)}


def only_key(scene: Any, end: str) -> str:
    (key,) = (key for key in mi.traverse(scene).keys() if key.endswith(end))
    return key


@pytest.fixture
def box() -> Any:
    description = mi.cornell_box()
    description["sensor"]["film"].update(width=16, height=16)
    description["integrator"]["max_depth"] = 5
    return mi.load_dict(description, optimize=False)


@pytest.mark.parametrize("mode", ["backward", "forward"])
def test_prb_passes_on_a_diffuse_wall(box: Any, mode: Any) -> None:
    result = check_gradient(box, "red.reflectance.value", integrator="prb", mode=mode, seeds=8, spp=64)
    assert result.verdict == "pass", str(result)
    assert result.integrator == "prb" and result.reference_integrator == "path" and result.stencil == "central"
    assert result.resolution < 0.02  # an error of 8 % would have shown
    assert len(result.gradient_samples) == len(result.reference_samples) == 8
    assert len(set(result.gradient_samples)) == 8


def test_prb_fails_on_plastic() -> None:
    scene = corner({"type": "plastic", "diffuse_reflectance": rgb(0.6, 0.5, 0.4)})
    result = check_gradient(scene, only_key(scene, "diffuse_reflectance.value"), integrator="prb", seeds=12, fd_spp=64)
    assert result.verdict == "fail" and not result.passed, str(result)
    assert result.gradient > 1.05 * result.reference


def test_prb_fails_on_a_black_wall() -> None:
    scene = corner({"type": "diffuse", "reflectance": rgb(0, 0, 0)})
    result = check_gradient(scene, only_key(scene, "reflectance.value"), integrator="prb", seeds=8)
    assert result.verdict == "fail", str(result)
    assert result.stencil.startswith("one-sided")
    # The truth: first-order light from a sky of radiance r, as seen through a reflectance that was not there.
    assert result.gradient < 0.5 * result.reference


def test_the_reference_is_right_at_a_black_wall() -> None:
    # Beside a white furnace's emitter nothing else is there: dI/dρ = radiance wherever the wall is seen, else 0.
    T = mi.ScalarTransform4f
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "prb", "max_depth": 2},
            "sensor": {
                "type": "orthographic",
                "to_world": T().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
            },
            "wall": {
                "type": "rectangle",
                "to_world": T().scale(2),
                "bsdf": {"type": "diffuse", "reflectance": rgb(0, 0, 0)},
            },
            "sky": {"type": "constant", "radiance": rgb(0.5, 0.5, 0.5)},
        },
        optimize=False,
    )
    key = only_key(scene, "reflectance.value")
    result = check_gradient(scene, key, seeds=8, spp=64, direction=[1, 1, 1])
    truth = 0.5 * float(smooth_weights((8, 8, 3), alpha=False).sum())
    assert abs(result.reference - truth) < 4 * np.hypot(result.reference_se, result.step_error), str(result)
    assert result.reference_se < 0.02 * truth


def test_a_light_that_is_only_looked_at_has_a_known_gradient() -> None:
    scene = corner({"type": "diffuse", "reflectance": rgb(0.5, 0.5, 0.5)})
    key = only_key(scene, "radiance.value")
    # One bounce of length 1 sees the sky alone; no noise but that of pixels at the silhouette.
    result = check_gradient(scene, key, integrator="prb", max_depth=1, seeds=4, direction=[1, 1, 1])
    assert result.verdict == "pass", str(result)
    alone = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "prb", "max_depth": 2},
            "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}},
            "sky": {"type": "constant", "radiance": rgb(2, 2, 2)},
        }
    )
    key = only_key(alone, "radiance.value")
    exact = check_gradient(alone, key, seeds=3, spp=4, direction=[1, 1, 1])
    truth = float(smooth_weights((8, 8, 3), alpha=False).sum())
    assert exact.verdict == "pass", str(exact)
    assert exact.gradient == pytest.approx(truth, rel=1e-4) and exact.reference == pytest.approx(truth, rel=1e-3)


def test_what_nobody_sees_has_gradient_zero(box: Any) -> None:
    params = mi.traverse(box)
    # The sensor sees no wall with max_depth 1, only the lamp.
    result = check_gradient(box, "red.reflectance.value", integrator="prb", max_depth=1, seeds=3, spp=4)
    assert result.verdict == "zero" and result.passed and result.gradient == 0, str(result)
    assert "red.reflectance.value" in params


def test_too_few_samples_are_inconclusive(box: Any) -> None:
    result = check_gradient(box, "small-box.vertex_positions", integrator="prb", seeds=3, spp=2)
    assert result.verdict == "inconclusive" and not result.passed, str(result)


@pytest.mark.parametrize("mode", ["backward", "forward"])
@pytest.mark.parametrize(("shape", "parameter"), [("sphere", "to_world"), ("cube", "vertex_positions")])
def test_moving_a_lit_thing_that_fills_the_view(shape: str, parameter: str, mode: Any) -> None:
    T = mi.ScalarTransform4f
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "prb", "max_depth": 2},
            "sensor": {
                "type": "orthographic",
                "to_world": T().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
            },
            "thing": {"type": shape, "to_world": T().scale(3).translate([0, 0, -1])},
            "lamp": {"type": "point", "position": [0.3, 0.4, 2.5], "intensity": rgb(5, 5, 5)},
        },
        optimize=False,
    )
    towards = np.zeros((4, 4)) if parameter == "to_world" else np.tile([0.0, 0.0, 1.0], 24)
    if parameter == "to_world":
        towards[2, 3] = 1
    result = check_gradient(scene, f"thing.{parameter}", mode=mode, seeds=6, direction=towards)
    assert result.verdict == "pass" and result.resolution < 0.01 and result.gradient > 0.01, str(result)


def test_a_loss_is_linearised(box: Any) -> None:
    target = mi.TensorXf(np.full((16, 16, 3), 0.2, np.float32))

    def loss(image: Any) -> Any:
        return dr.mean(dr.square(image - target), axis=None)

    result = check_gradient(box, "white.reflectance.value", integrator="prb", loss=loss, seeds=8, spp=64)
    assert result.verdict == "pass", str(result)
    with pytest.raises(PathreplayError, match="loss does not depend on its image"):
        check_gradient(box, "white.reflectance.value", integrator="prb", loss=lambda image: mi.Float(1), seeds=2, spp=1)


def test_attached_parameters_of_another_scene_do_not_matter(box: Any) -> None:
    other = mi.traverse(mi.load_dict(mi.cornell_box(), optimize=False))
    dr.enable_grad(other["red.reflectance.value"])
    other.update()
    result = check_gradient(
        box, "red.reflectance.value", integrator="prb", loss=lambda image: dr.mean(image, axis=None), seeds=8, spp=64
    )
    assert result.verdict == "pass", str(result)


# ------------------------------------------------------------------------------
#  Manners
# ------------------------------------------------------------------------------


def test_the_scene_is_left_as_it_was(box: Any) -> None:
    params = mi.traverse(box)
    keys = ("red.reflectance.value", "white.reflectance.value", "light.to_world")
    for key in keys[:2]:
        dr.enable_grad(params[key])
        dr.set_grad(params[key], 0.25)
    before = {key: get_array(params[key]) for key in keys}
    image = np.array(mi.render(box, spp=4, seed=5))

    def interrupt(done: int, total: int) -> None:
        if done == total - 1:
            raise KeyboardInterrupt

    check_gradient(box, keys[0], integrator="prb", seeds=2, spp=2)
    check_gradient(box, keys[2], integrator="prb", seeds=2, spp=2)
    with pytest.raises(KeyboardInterrupt):
        check_gradient(box, keys[0], integrator="prb", seeds=2, spp=2, progress=interrupt)
    after = mi.traverse(box)
    for key in keys:
        assert np.array_equal(get_array(after[key]), before[key])
    for key in keys[:2]:
        assert dr.grad_enabled(after[key]) and np.array_equal(get_array(dr.grad(after[key])), [0.25] * 3)
    assert not dr.grad_enabled(after[keys[2]])
    assert np.allclose(np.array(mi.render(box, spp=4, seed=5)), image, rtol=1e-5)


def test_same_seed_same_numbers_other_seed_others(box: Any) -> None:
    first, again, other = (
        check_gradient(box, "red.reflectance.value", integrator="prb", seeds=2, spp=2, direction=[1, 1, 1], seed=seed)
        for seed in (1, 1, 2)
    )
    assert first.gradient_samples == pytest.approx(again.gradient_samples, rel=1e-4)
    assert first.reference_samples == pytest.approx(again.reference_samples, rel=1e-3)
    assert first.gradient_samples != pytest.approx(other.gradient_samples, rel=1e-3)


def test_progress_counts_every_rendering(box: Any) -> None:
    calls: list[tuple[int, int]] = []
    check_gradient(
        box, "red.reflectance.value", integrator="prb", seeds=2, spp=1, progress=lambda *call: calls.append(call)
    )
    assert calls == [(i, 11) for i in range(12)]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seeds": 1}, "seeds is 1"),
        ({"spp": 0}, "spp is 0"),
        ({"fd_spp": -4}, "fd_spp is -4"),
        ({"step": 0.0}, "Step 0.0"),
        ({"key": None}, "key is None"),
        ({"key": ["red.reflectance.value"]}, "give the name of one parameter"),
        ({"sensor": "eye"}, "sensor is 'eye'; give a whole number"),
        ({"spp": True}, "spp is True"),
        ({"loss": 3}, "loss is 3"),
        ({"loss": lambda image: 3.0}, "loss does not depend on its image"),
        ({"loss": lambda image: dr.sum(image, axis=None) * float("nan")}, "loss has a derivative that is NaN"),
        ({"mode": "sideways"}, "mode is 'sideways'"),
        ({"sensor": 1}, "Sensor 1 does not exist"),
        ({"max_depth": 0}, "max_depth is 0"),
        ({"integrator": "prx"}, "'prx' cannot be created"),
        ({"integrator": {"type": "diffuse"}}, "not an integrator"),
        ({"key": "red.reflectanse.value"}, "nearest: red.reflectance.value"),
        ({"key": "small-box.faces"}, "carries no derivative"),
    ],
)
def test_bad_input_is_named(box: Any, options: dict[str, Any], message: str) -> None:
    arguments = {"key": "red.reflectance.value", "integrator": "prb", "seeds": 2, "spp": 1, **options}
    with pytest.raises(PathreplayError, match=message) as error:
        check_gradient(box, **arguments)
    assert "\n" not in str(error.value)


def test_a_scene_with_nan_is_refused(box: Any) -> None:
    params = mi.traverse(box)
    params["green.reflectance.value"] = mi.Color3f(0.1, np.nan, 0.1)
    params.update()
    with pytest.raises(PathreplayError, match=r"green\.reflectance\.value.*NaN"):
        check_gradient(box, "red.reflectance.value", integrator="prb", seeds=2, spp=1)


def test_half_precision_is_refused() -> None:
    picture = mi.Bitmap(np.full((4, 4, 3), 0.5, np.float16))
    scene = corner({"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": picture, "raw": True}})
    with pytest.raises(PathreplayError, match=r"half precision.*format='variant'"):
        check_gradient(scene, only_key(scene, "reflectance.data"), integrator="prb", seeds=2, spp=1)


# ------------------------------------------------------------------------------
#  Command
# ------------------------------------------------------------------------------

SCENE = """<scene version="3.0.0">
    <integrator type="path"><integer name="max_depth" value="4"/></integrator>
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0,0,3" target="0,0,0" up="0,1,0"/></transform>
        <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/></film>
    </sensor>
    <shape type="sphere" id="ball"><bsdf type="{bsdf}" id="skin"/></shape>
    <emitter type="constant" id="sky"/>
</scene>"""


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["pathreplay", "check", *arguments])
    with pytest.raises(SystemExit) as end:
        cli.main()
    return int(end.value.code or 0)


def test_command_passes(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "ball.xml").write_text(SCENE.format(bsdf="diffuse"))
    arguments = ["--param", "ball.bsdf.*", "--param", "sky.*", "--integrator", "prb", "--seeds", "8"]
    status = run(monkeypatch, str(tmp_path / "ball.xml"), *arguments, "--json", str(tmp_path / "out.json"))
    out = capsys.readouterr().out
    assert status == 0, out
    assert "prb (backward) against finite differences of path: 8 seeds" in out
    assert "ball.bsdf.reflectance.value" in out and "2 checked: 2 pass" in out
    records = json.loads((tmp_path / "out.json").read_text())
    assert [record["key"] for record in records] == ["ball.bsdf.reflectance.value", "sky.radiance.value"]
    assert all(record["passed"] and len(record["gradient_samples"]) == 8 for record in records)


def test_each_check_is_told_when_it_is_there(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Where nobody sees a bar: what is under way, how far it is, and no verdict that waits for the last one."""
    (tmp_path / "ball.xml").write_text(SCENE.format(bsdf="diffuse"))
    plain, seen = command.check_gradient, []

    def watched(*arguments: Any, **options: Any) -> Any:
        seen.append(capsys.readouterr())
        return plain(*arguments, **options)

    monkeypatch.setattr(command, "check_gradient", watched)
    monkeypatch.setattr(progress_bar, "PAUSE_S", 0.0)
    keys = ["ball.bsdf.reflectance.value", "sky.radiance.value"]
    params = [option for key in keys for option in ("--param", key)]
    run(monkeypatch, str(tmp_path / "ball.xml"), *params, "--seeds", "2", "--spp", "1")
    seen.append(capsys.readouterr())
    assert seen[0].err == seen[0].out == ""
    assert seen[1].err.startswith(f"pathreplay: checking {keys[0]} (1/2)\n")
    assert keys[0] in seen[1].out and keys[1] not in seen[1].out
    assert f"pathreplay: {keys[0]} (1/2): 11 of 11 renderings\n" in seen[1].err
    assert seen[2].err.startswith(f"pathreplay: checking {keys[1]} (2/2)\n") and keys[1] in seen[2].out


def test_the_first_gradient_is_announced_in_a_pipe(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Its kernels may take minutes to compile. Later lines are those of a pause, and a quick check has none."""
    (tmp_path / "ball.xml").write_text(SCENE.format(bsdf="diffuse"))
    plain, seen = Objective.derivative, []

    def watched(*arguments: Any) -> float:
        seen.append(capsys.readouterr().err)
        return plain(*arguments)

    monkeypatch.setattr(Objective, "derivative", watched)
    monkeypatch.setattr(progress_bar, "PAUSE_S", float("inf"))
    key = "sky.radiance.value"
    run(monkeypatch, str(tmp_path / "ball.xml"), "--param", key, "--seeds", "2", "--spp", "1")
    lines = f"pathreplay: checking {key} (1/1)", f"pathreplay: {key} (1/1): compiling and measuring the first gradient"
    assert seen == ["\n".join([*lines, ""]), ""] and not capsys.readouterr().err


def test_command_fails(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "ball.xml").write_text(SCENE.format(bsdf="plastic"))
    arguments = ["--param", "ball.bsdf.diffuse_*", "--integrator", "prb", "--fd-spp", "64"]
    assert run(monkeypatch, str(tmp_path / "ball.xml"), *arguments) == 1
    out = capsys.readouterr().out
    assert "FAIL" in out and "times the reference" in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["cornell-bax", "--param", "x"], "cornell-box"),
        (["cornell-box", "--param", "red.reflectance"], "nearest: red.reflectance.value"),
        (["cornell-box", "--param", "red.reflectance.value", "--spp", "0"], "spp is 0"),
        (["cornell-box", "--param", "red.reflectance.value", "--json", "no/such/folder.json"], "does not exist"),
        (["cornell-box", "--param", "red.reflectance.value", "--variant", "scalar_rgb"], "scalar_rgb"),
    ],
)
def test_command_names_bad_input(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert run(monkeypatch, *arguments, "--integrator", "prb") == 2
    captured = capsys.readouterr()
    assert message in captured.err and "Traceback" not in captured.err and not captured.out
