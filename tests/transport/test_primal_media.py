"""Media: pictures by `pathreplay` against pictures by Mitsuba's `volpath`, as a test of statistics.

Sixteen independent pictures by each give every pixel, and every block of pixels, a difference in standard errors.
Its ratio follows Student's distribution and is turned into the normal deviate of the same probability; the squares of
these, summed over the picture, follow χ². What must hold: every channel's mean within `Z_LIMIT`, and a sum of squares
that is no less probable than a normal deviate of `Z_LIMIT`, for pixels and for blocks; the same for the alpha channel.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from measured import PRIMALS, Difference
from media_scenes import (
    FORWARD,
    ISOTROPIC,
    NULL,
    behind_glass,
    checkers,
    cloud,
    grid,
    heterogeneous,
    homogeneous,
    in_the_mirror,
    inside,
    lit_floor,
    nested,
    overlapping,
    smooth,
    sparse,
    sunlit,
)
from pathreplay.testing.statistics import normal
from pathreplay.testing.verdict import Z_LIMIT
from truth import RES, camera, environment, rgb

SEEDS = 16
SPP = 64
BLOCK = 4
# Of some 300 statistics of right pictures one exceeds Z_LIMIT in fifty runs.


def deviates(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Normal deviates of mean(a) - mean(b), over the first axis; nan where both are the same number throughout."""
    n = len(a)
    gap = a.mean(0) - b.mean(0)
    error = np.sqrt((a.var(0, ddof=1) + b.var(0, ddof=1)) / n)
    # Float32 rounding is no difference, but where nothing varies any other difference counts.
    rounding = 1e-5 * np.abs(b.mean(0)) + 1e-9
    t = np.minimum(np.abs(gap) / np.maximum(error, rounding), 1e3)
    z = np.sign(gap) * normal(t, 2 * n - 2)
    return np.where((error <= rounding) & (np.abs(gap) <= rounding), np.nan, z)


def sum_of_squares(z: np.ndarray) -> float:
    """The normal deviate that is as improbable as Σ z², for independent z; 0 where there are none."""
    z = z[np.isfinite(z)]
    return float(stats.norm.isf(max(stats.chi2.sf(float((z**2).sum()), z.size), 1e-300))) if z.size else 0.0


def largest(z: np.ndarray) -> float:
    z = np.nan_to_num(z)
    return float(z[np.abs(z).argmax()])


def compare(a: np.ndarray, b: np.ndarray) -> Difference:
    """Two sets of pictures, of shape (seeds, height, width, 4)."""
    grey_a, grey_b = (images[..., :3].mean(-1) for images in (a, b))  # channels share their paths: one number a pixel
    shape = (len(a), RES // BLOCK, BLOCK, RES // BLOCK, BLOCK)
    blocks = deviates(grey_a.reshape(shape).mean((2, 4)), grey_b.reshape(shape).mean((2, 4)))
    alpha = np.abs(largest(deviates(a[..., 3:].mean((1, 2)), b[..., 3:].mean((1, 2)))))
    spread = np.sqrt((grey_a.mean((1, 2)).var(ddof=1) + grey_b.mean((1, 2)).var(ddof=1)) / len(a))
    return Difference(
        mean=largest(deviates(a[..., :3].mean((1, 2)), b[..., :3].mean((1, 2)))),
        blocks=sum_of_squares(blocks),
        pixels=sum_of_squares(deviates(grey_a, grey_b)),
        alpha=max(alpha, sum_of_squares(deviates(a[..., 3], b[..., 3]))),
        relative=float(grey_a.mean() / grey_b.mean() - 1),
        error=float(spread / grey_b.mean()),
    )


def pictures(scene: Any, plugin: str, first_seed: int, spp: int = SPP, **options: Any) -> np.ndarray:
    if plugin == "pathreplay":
        options["sampling"] = "scene"  # with Sobol samples the errors of pixels know of each other
    integrator = mi.load_dict({"type": plugin, **options})
    seeds = range(first_seed, first_seed + SEEDS)
    return np.array([np.array(mi.render(scene, integrator=integrator, seed=s, spp=spp), np.float64) for s in seeds])


# ------------------------------ Scenes ------------------------------


@dataclass(frozen=True)
class Picture:
    """A scene and options of the integrator. A scene with a ``plugin`` is compared with that of `heterogeneous`."""

    name: str
    scene: Callable[..., dict]
    options: dict[str, Any]

    def load(self, **props: Any) -> Any:
        scene = self.scene(**props)
        scene["camera"]["film"]["pixel_format"] = "rgba"
        return mi.load_dict(scene)

    def reference(self) -> Any:
        return self.load(plugin="heterogeneous") if self.scene.__code__.co_argcount else self.load()


def picture(name: str, scene: Callable[..., dict], **options: Any) -> Picture:
    return Picture(name, scene, {"max_depth": 8, "rr_depth": 5, **options})


def fog(**props: Any) -> dict:
    return heterogeneous(smooth(0.4, 2.0), smooth(0.3, 0.9, 3), **props)


def mist(phase: dict = ISOTROPIC, **props: Any) -> dict:
    return homogeneous(1.0, rgb(0.9, 0.8, 0.6), phase, **props)


def chromatic() -> dict:
    return homogeneous(rgb(0.7, 0.5, 0.35), rgb(0.9, 0.8, 0.6), scale=2.0)


def under(light: dict, medium: Callable[[], dict] = fog) -> dict:
    """The cloud under a light in place of the sky, above a floor."""
    floor = lit_floor(medium())
    floor["light"] = light
    return floor


def look_down() -> Any:
    return mi.ScalarTransform4f().look_at(origin=[1, 3, 1], target=[0, -0.5, 0], up=[0, 0, 1])


def sunny_sky() -> dict:
    """An environment map with a bright patch."""
    y, x = np.mgrid[0:16, 0:32]
    sun = np.exp(-((x - 20) ** 2 + (y - 4) ** 2) / 4)[..., None] * [30, 25, 20] + [0.2, 0.3, 0.5]
    return {"type": "envmap", "bitmap": mi.Bitmap(sun.astype(np.float32))}


def lamp_inside(light: dict) -> dict:
    return cloud(fog(), lamp=light, sky=dict(DUSK))


def standing_in_fog(medium: dict) -> dict:
    """Camera, ball and lamp in one unbounded medium."""
    around = {"type": "ref", "id": "fog"}
    return {
        "type": "scene",
        "fog": medium,
        "camera": {**camera(origin=(0, 0, 5), fov=30), "medium": around},
        "ball": {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": 0.6}, "exterior": around},
        "lamp": {"type": "sphere", "center": [1.5, 1.5, 1.5], "radius": 0.4, "exterior": around,
                 "emitter": {"type": "area", "radiance": rgb(9, 8, 7)}},
    }  # fmt: skip


def side_by_side(left: dict, right: dict) -> dict:
    """Two boxes of half the size that touch: one face between them is inside of one and outside of the other."""
    T = mi.ScalarTransform4f
    scene = cloud(left)
    a, b = ({"type": "ref", "id": name} for name in ("left", "right"))
    faces = {
        "front": (T().translate([0, 0, 1]), None), "back": (T().translate([0, 0, -1]).rotate([0, 1, 0], 180), None),
        "top": (T().translate([0, 1, 0]).rotate([1, 0, 0], -90), None),
        "bottom": (T().translate([0, -1, 0]).rotate([1, 0, 0], 90), None),
    }  # fmt: skip
    half = {-0.5: a, 0.5: b}
    del scene["object"]
    for name, (where, _) in faces.items():
        for x, medium in half.items():
            scene[f"{name}{int(x > 0)}"] = {
                "type": "rectangle", "bsdf": NULL, "interior": medium,
                "to_world": T().translate([x, 0, 0]) @ where @ T().scale([0.5, 1, 1]),
            }  # fmt: skip
    for name, x, turn, inner, outer in (("west", -1, -90, a, None), ("east", 1, 90, b, None), ("middle", 0, 90, a, b)):
        scene[name] = {
            "type": "rectangle", "bsdf": NULL, "interior": inner,
            "to_world": T().translate([x, 0, 0]).rotate([0, 1, 0], turn),
            **({"exterior": outer} if outer else {}),
        }  # fmt: skip
    return {"type": "scene", "left": left, "right": right, **scene}


def with_pane(bsdf: dict) -> dict:
    """A half covering pane in front of the cloud."""
    scene = behind_glass(bsdf, fog())
    scene["pane"]["to_world"] = mi.ScalarTransform4f().translate([0.8, 0, 2]).rotate([0, 1, 0], 30).scale([0.8, 2, 1])
    return scene


DIFFUSE = {"type": "diffuse", "reflectance": rgb(0.7, 0.5, 0.3)}
GLASS = {"type": "dielectric"}
ROUGH = {"type": "roughdielectric", "alpha": 0.3}
BLEND = {"type": "blendphase", "weight": 0.4, "a": {"type": "hg", "g": 0.6}, "b": {"type": "hg", "g": -0.3}}
TABLE = {"type": "tabphase", "values": "0.5, 0.2, 0.3, 0.6, 1.5"}
POINT = {"type": "point", "position": [0.5, 3, 1], "intensity": rgb(9, 6, 3)}
DUSK = {"type": "constant", "radiance": 0.05}
BULB = {"type": "sphere", "radius": 0.3, "emitter": {"type": "area", "radiance": rgb(5, 4, 3)}}

PICTURES = [
    picture("homogeneous", lambda: cloud(mist())),
    picture("homogeneous chromatic", lambda: cloud(chromatic())),
    picture("homogeneous black", lambda: cloud(homogeneous(1.0, 0.0))),
    picture("heterogeneous", lambda: cloud(fog())),
    picture("heterogeneous chromatic", lambda: cloud(heterogeneous(smooth(0.2, 2.0, 3), smooth(0.3, 0.9, 3)))),
    picture("heterogeneous, extinction not spectral", lambda: cloud(fog(has_spectral_extinction=False))),
    picture("gridmedium", lambda plugin="gridmedium": cloud(fog(plugin=plugin))),
    picture("gridmedium chromatic", lambda plugin="gridmedium": cloud(heterogeneous(smooth(0.2, 2.0, 3),
            smooth(0.3, 0.9, 3), plugin=plugin))),
    picture("gridmedium sparse", lambda plugin="gridmedium": lit_floor(heterogeneous(sparse(), 0.8, scale=8.0,
            plugin=plugin))),
    picture("heterogeneous binary", lambda: cloud(heterogeneous(checkers(), 0.8, scale=3.0))),
    picture("heterogeneous, ball", lambda: cloud(fog(), "sphere")),
    picture("phase hg", lambda: sunlit(fog(phase=FORWARD))),
    picture("phase blend", lambda: sunlit(mist(BLEND))),
    picture("phase table", lambda: sunlit(mist(TABLE))),
    picture("phase rayleigh", lambda: sunlit(mist({"type": "rayleigh"}))),
    picture("no emitter sampling", lambda: cloud(fog(sample_emitters=False))),
    picture("no emitter sampling, floor", lambda: lit_floor(mist(sample_emitters=False))),
    picture("boundary diffuse", lambda: cloud(mist(), "sphere", DIFFUSE)),
    picture("boundary glass", lambda: cloud(mist(), "sphere", GLASS)),
    picture("boundary glass, grid", lambda: cloud(fog(), "cube", GLASS)),
    picture("boundary rough glass", lambda: cloud(fog(), "sphere", ROUGH)),
    picture("boundary thin glass", lambda: cloud(fog(), "sphere", {"type": "thindielectric"})),
    picture("boundary mask", lambda: cloud(fog(), "sphere", {"type": "mask", "opacity": 0.5, "nested": DIFFUSE})),
    picture("area light", lambda: lit_floor(fog())),
    picture("point light", lambda: under(POINT)),
    picture("directional light", lambda: under({"type": "directional", "direction": [0.2, -1, -0.3]})),
    picture("spot light", lambda: under({"type": "spot", "intensity": 20.0, "cutoff_angle": 25.0,
            "to_world": look_down()})),
    picture("sunny sky", lambda: cloud(fog(), sky=sunny_sky())),
    picture("constant sky", lambda: under({"type": "constant", "radiance": rgb(0.5, 0.7, 0.9)})),
    picture("two lights", lambda: {**lit_floor(fog()), "sky": environment(64)}),
    picture("lamp inside", lambda: lamp_inside(dict(BULB))),
    picture("nested", lambda: nested(fog(), mist(scale=3.0))),
    picture("overlapping", lambda: overlapping(mist(), fog())),
    picture("side by side", lambda: side_by_side(fog(), mist(scale=2.0))),
    picture("ball in fog", lambda: cloud(fog(), kernel={"type": "sphere", "radius": 0.5, "bsdf": DIFFUSE})),
    picture("glass ball in fog", lambda: cloud(fog(), kernel={"type": "sphere", "radius": 0.5, "bsdf": GLASS})),
    picture("sensor inside", lambda: inside(fog())),
    picture("sensor inside, homogeneous", lambda: inside(mist())),
    picture("sensor in unbounded fog", lambda: standing_in_fog(homogeneous(0.3, 0.8))),
    picture("mask beside", lambda: with_pane({"type": "mask", "opacity": 0.4, "nested": DIFFUSE})),
    picture("thin glass beside", lambda: with_pane({"type": "thindielectric"})),
    picture("glass beside", lambda: behind_glass(GLASS, fog())),
    picture("mirror beside", lambda: in_the_mirror({"type": "conductor"}, fog())),
    picture("light behind fog", lambda: cloud(fog(), sky=DUSK, lamp={**BULB, "center": [0, 0, -3], "radius": 1.0})),
    picture("hidden emitters", lambda: cloud(fog()), hide_emitters=True),
    picture("hidden emitters, lamp and fog", lambda: cloud(fog(), lamp={**BULB, "center": [0, 0, -3], "radius": 1.0}),
            hide_emitters=True),
    picture("hidden emitters, glass", lambda: cloud(mist(), "sphere", GLASS), hide_emitters=True),
    picture("depth 1", lambda: {**lit_floor(fog()), "sky": environment(64)}, max_depth=1),
    picture("depth 2", lambda: {**lit_floor(fog()), "sky": environment(64)}, max_depth=2),
    picture("depth 3", lambda: {**lit_floor(fog()), "sky": environment(64)}, max_depth=3),
    picture("depth 3, glass", lambda: cloud(fog(), "sphere", GLASS), max_depth=3),
    picture("depth unbounded", lambda: {**lit_floor(fog()), "sky": environment(64)}, max_depth=-1),
    picture("early roulette", lambda: {**lit_floor(fog()), "sky": environment(64)}, max_depth=16, rr_depth=1),
    picture("early roulette, glass", lambda: cloud(mist(), "sphere", GLASS), max_depth=16, rr_depth=1),
]  # fmt: skip


QUICK = {
    "homogeneous chromatic", "heterogeneous", "boundary glass", "boundary rough glass", "two lights", "nested",
    "overlapping", "sensor inside", "mask beside", "hidden emitters, glass", "gridmedium sparse",
}  # fmt: skip


@pytest.mark.parametrize(
    "spec", [pytest.param(p, id=p.name, marks=() if p.name in QUICK else pytest.mark.slow) for p in PICTURES]
)
def test_picture_against_volpath(spec: Picture) -> None:
    gc.collect()  # of scenes that go while a kernel is traced, Dr.Jit loses count, and aborts
    scene = spec.load()
    spp = SPP // 2 if spec.name in QUICK else SPP
    theirs = pictures(spec.reference(), "volpath", 1000, spp, **spec.options)
    ours = compare(pictures(scene, "pathreplay", 1, spp, **spec.options), theirs)
    PRIMALS.append((spec.name, ours))
    assert ours.z < Z_LIMIT, ours


# ------------------------------ Boundaries: the same medium with and without ------------------------------


def walled(walls: bool, lamp: dict) -> dict:
    """Fog in the box [-1, 1]³: inside a null boundary, or as a grid that ends there, around the sensor."""
    scene = {"type": "scene", "camera": camera(fov=30), "lamp": lamp}
    scene["camera"]["film"]["pixel_format"] = "rgba"
    if walls:
        return {**scene, "box": {"type": "cube", "bsdf": NULL, "interior": homogeneous(0.5, 0.8)}}
    scene["fog"] = heterogeneous(np.full((2, 2, 2, 1), 0.5), 0.8, plugin="gridmedium")
    scene["camera"]["medium"] = {"type": "ref", "id": "fog"}
    return scene


def walls_matter(lamp: dict, plugin: str = "pathreplay", **options: Any) -> float:
    images = [
        pictures(mi.load_dict(walled(walls, lamp)), plugin, 1 + 100 * walls, max_depth=2, **options)
        for walls in (False, True)
    ]
    return compare(*images).z


def test_a_lamp_close_to_a_null_boundary() -> None:
    """A shadow ray that the boundary shifts sideways would meet the lamp before its end, as those of `volpath` do."""
    T = mi.ScalarTransform4f
    place = T().translate([0, 1.01, 0]) @ T().rotate([1, 0, 0], 90) @ T().scale(0.6)
    lamp = {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": rgb(9, 9, 9)}}
    assert walls_matter(lamp, hide_emitters=True) < Z_LIMIT
    assert walls_matter(lamp, "volpath") > 2 * Z_LIMIT


def test_the_length_of_a_ray_through_a_hidden_lamp() -> None:
    """Light from above, and fog and walls behind a hidden ball."""
    ball = {"type": "sphere", "radius": 0.6, "emitter": {"type": "area", "radiance": rgb(4, 4, 4)}}
    assert walls_matter(ball, hide_emitters=True) < Z_LIMIT


# ------------------------------ Emission: closed forms, since volpath has none ------------------------------

# A furnace: where Q = (1 - A) σ_t L and the sky is L, the radiance is L everywhere, whatever the density.
FURNACE = 0.7


def furnace(emission: float = 1.0, sky: float = FURNACE) -> dict:
    """A cloud of albedo 0.6 that emits ``emission`` times what a sky of radiance `FURNACE` gives it."""
    density = smooth(0.4, 2.0)
    glow = grid(emission * FURNACE * (1 - 0.6) * density)
    return cloud(heterogeneous(density, 0.6, plugin="gridmedium", emission=glow),
                 sky={"type": "constant", "radiance": sky})  # fmt: skip


def against(images: np.ndarray, expected: np.ndarray) -> float:
    """The largest normal deviate of the mean over colours, and of the sum of squares over pixels, from numbers."""
    grey = images[..., :3].mean(-1)
    known = np.broadcast_to(expected, grey.shape)
    # Sets without noise count as half of the degrees of freedom in `deviates`: a little too strict.
    return max(abs(largest(deviates(grey.mean((1, 2))[:, None], known.mean((1, 2))[:, None]))),
               sum_of_squares(deviates(grey, known)))  # fmt: skip


@pytest.mark.parametrize("per_extinction", [False, True])
def test_furnace(per_extinction: bool) -> None:
    description = furnace()
    if per_extinction:  # the same emission, divided by the density
        medium = description["object"]["interior"]
        del medium["emission"]
        medium["radiance"] = FURNACE * (1 - 0.6)
    scene = mi.load_dict(description)
    assert against(pictures(scene, "pathreplay", 1, max_depth=64, rr_depth=64), np.float64(FURNACE)) < Z_LIMIT


@pytest.mark.parametrize("supergrid", [True, False])
def test_glow_of_emptiness(supergrid: bool) -> None:
    """A box that emits and does nothing else: L = 2 Q + L_sky straight through it, also in cells without density."""
    glow, sky = 0.5, 0.3
    medium = heterogeneous(0 * sparse(), 0.0, plugin="gridmedium", emission=grid(np.full((6, 6, 6, 1), glow)),
                           supergrid=supergrid)  # fmt: skip
    scene = straight_through(cloud(medium, sky={"type": "constant", "radiance": sky}))
    assert against(pictures(mi.load_dict(scene), "pathreplay", 1, max_depth=8), np.float64(2 * glow + sky)) < Z_LIMIT


def straight_through(scene: dict) -> dict:
    """The same scene, seen along the axis of its box."""
    scene["camera"].update(type="orthographic", to_world=mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])
                           .scale([0.9, 0.9, 1]))  # fmt: skip
    del scene["camera"]["fov"]
    return scene


@pytest.mark.parametrize("per_extinction", [False, True])
def test_glow_of_a_slab(per_extinction: bool) -> None:
    """Without scattering, L = Q/σ (1 - exp(-2σ)) + L_sky exp(-2σ) straight through the box."""
    σ, glow, sky = 0.8, 0.5, 0.3
    medium = homogeneous(σ, 0.0)
    emitted = {"radiance": glow / σ} if per_extinction else {"emission": {"type": "constvolume", "value": glow}}
    medium.update(type="gridmedium", **emitted)
    scene = straight_through(cloud(medium, sky={"type": "constant", "radiance": sky}))
    expected = glow / σ * (1 - np.exp(-2 * σ)) + sky * np.exp(-2 * σ)
    assert against(pictures(mi.load_dict(scene), "pathreplay", 1, max_depth=8), np.float64(expected)) < Z_LIMIT
