"""The scenes of the fixed set, and what is differentiated in each: small, and together they reach all of the transport.

They use nothing of ours but plugins by name, so that they mean the same whatever becomes of the code.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi
import numpy as np

SIZE = 12
"""Width and height of all films, in pixels."""
BOX, GAUSSIAN = 0, 1
"""Sensors of every scene: the same view through two filters."""


@dataclass(frozen=True)
class Case:
    """A way to differentiate a scene: a driver, properties of the integrator, and the keys (none: all of the scene).

    Of several ``passes`` with seeds of their own the last one counts; those before it teach it what media are like.
    """

    driver: str
    keys: tuple[str, ...] = ()
    passes: int = 1
    sensor: int = BOX
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Driver and properties, and what else is not as usual."""
        told = [f"{key}={value}" for key, value in self.options.items()]
        told += [f"passes={self.passes}"] if self.passes > 1 else []
        told += ["gaussian"] if self.sensor == GAUSSIAN else []
        return " ".join([self.driver, *told])


def case(driver: str, *keys: str, passes: int = 1, sensor: int = BOX, **options: Any) -> Case:
    """A `Case`; other names are properties of the integrator."""
    return Case(driver, keys, passes, sensor, options)


@dataclass(frozen=True)
class Scene:
    """A scene and the parameters that have gradients, all at once; those called ``to_world`` are moved and turned."""

    name: str
    build: Callable[[], dict]
    keys: tuple[str, ...]
    cases: tuple[Case, ...]
    depth: int = 5
    rr_depth: int = 2
    spp: int = 8
    seed: int = 1
    """Of the first pass; chosen so that no gradient hangs on a few paths for which rounding decides much."""


# ------------------------------ Parts ------------------------------


def to() -> Any:
    return mi.ScalarTransform4f()


def rgb(*value: float) -> dict:
    return {"type": "rgb", "value": list(value)}


def noise(shape: tuple[int, ...], low: float, high: float, seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).uniform(low, high, shape).astype(np.float32)


def bitmap(values: np.ndarray) -> dict:
    return {"type": "bitmap", "raw": True, "data": mi.TensorXf(np.ascontiguousarray(values, np.float32))}


def painted(seed: int = 3) -> dict:
    return {"type": "diffuse", "reflectance": bitmap(noise((4, 4, 3), 0.2, 0.9, seed))}


def plain(*value: float) -> dict:
    return {"type": "diffuse", "reflectance": rgb(*value)}


def normals(nested: dict) -> dict:
    texels = np.concatenate([noise((4, 4, 2), 0.45, 0.55), np.full((4, 4, 1), 0.95, np.float32)], -1)
    return {"type": "normalmap", "normalmap": bitmap(texels), "nested": nested}


def cameras(origin: Any, target: Any = (0, 0, 0), fov: float = 40, box: dict | None = None, **more: Any) -> dict:
    """The two sensors; ``box`` is for the film of the first."""

    def one(**film: Any) -> dict:
        return {
            "type": "perspective",
            "fov": fov,
            "to_world": to().look_at(list(origin), list(target), [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "pixel_format": "rgb", **film},
            "sampler": {"type": "independent"},
            **more,
        }

    return {
        "camera": one(rfilter={"type": "box"}, **(box or {})),
        "camera_soft": one(rfilter={"type": "gaussian"}),
    }


def floor(bsdf: dict, **more: Any) -> dict:
    at = to().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale([4, 4, 1])
    return {"type": "rectangle", "to_world": at, "bsdf": bsdf, **more}


def panel(emitter: dict | None = None, shape: str = "rectangle", size: float = 1.0) -> dict:
    """An area light above, which shines down."""
    at = to().translate([0.5, 3, 1]).rotate([1, 0, 0], 90).scale([1.5 * size, size, size])
    return {"type": shape, "to_world": at, "emitter": emitter or {"type": "area", "radiance": rgb(6, 5, 4)}}


def sky(width: int = 16) -> dict:
    y, x = np.mgrid[0 : width // 2, 0:width] / width * 2 * np.pi
    waves = [1 + 0.5 * np.sin(x) * np.sin(y), 1 + 0.5 * np.cos(x + 1) * np.sin(y), 1 + 0.3 * np.sin(2 * x) * np.sin(y)]
    return {"type": "envmap", "bitmap": mi.Bitmap(np.stack(waves, -1).astype(np.float32))}


def dim() -> dict:
    return {"type": "constant", "radiance": rgb(0.3, 0.4, 0.5)}


# ------------------------------ Surfaces ------------------------------


def room() -> dict:
    wall = {"type": "rectangle", "to_world": to().translate([0, 1, -2]).scale([4, 2.5, 1])}
    side = to().translate([-2, 1, 0]).rotate([0, 1, 0], 90).scale([3, 2.5, 1])
    return {
        "type": "scene",
        **cameras((0, 1, 6), (0, 0.5, 0)),
        "floor": floor(painted()),
        "wall": {**wall, "bsdf": {"type": "twosided", "nested": plain(0.6, 0.5, 0.4)}},
        "side": {"type": "rectangle", "to_world": side, "bsdf": plain(0.7, 0.2, 0.1)},
        "object": {"type": "sphere", "center": [0.3, -0.2, 0], "radius": 0.8, "bsdf": plain(0.5, 0.5, 0.6)},
        "light": panel(),
    }


def glossy() -> dict:
    mixed = {
        "type": "blendbsdf",
        "weight": 0.4,
        "a": plain(0.4, 0.3, 0.2),
        "b": {"type": "roughplastic", "diffuse_reflectance": rgb(0.2, 0.4, 0.5), "alpha": 0.2},
    }
    shiny = {"type": "principled", "base_color": rgb(0.3, 0.4, 0.5), "roughness": 0.5, "metallic": 0.4}
    return {
        "type": "scene",
        **cameras((0, 1, 6), fov=35),
        "floor": floor({"type": "plastic", "diffuse_reflectance": rgb(0.3, 0.4, 0.5)}),
        "metal": {"type": "sphere", "center": [-1, 0, 0], "radius": 0.8,
                  "bsdf": {"type": "roughconductor", "alpha": 0.3, "eta": 1.5, "k": 2.0}},
        "mixed": {"type": "sphere", "center": [1, -0.2, 0.4], "radius": 0.7, "bsdf": mixed},
        "shiny": {"type": "sphere", "center": [0, 0.3, -1.5], "radius": 0.8, "bsdf": shiny},
        "sky": sky(),
    }  # fmt: skip


def glass() -> dict:
    tinted = {"type": "dielectric_ad", "int_ior": 1.4, "specular_transmittance": rgb(0.9, 0.8, 0.7)}
    pane = to().translate([1.2, 0, 1]).rotate([0, 1, 0], 30).scale(0.7)
    return {
        "type": "scene",
        **cameras((0, 0.5, 6), fov=35),
        "floor": floor(painted()),
        "object": {"type": "sphere", "center": [-0.4, 0, 0], "bsdf": tinted},
        "pane": {"type": "rectangle", "to_world": pane, "bsdf": {"type": "thindielectric", "int_ior": 1.3}},
        "light": panel(),
        "sky": dim(),
    }


def frosted() -> dict:
    quad = to().translate([-1, 0, -1]).rotate([1, 1, 0], 15).scale([1.5, 1.5, 1])
    bumps = {"type": "bumpmap", "texture": bitmap(noise((4, 4, 1), 0.4, 0.6)), "nested": plain(0.5, 0.6, 0.4),
             "scale": 0.2}  # fmt: skip
    return {
        "type": "scene",
        **cameras((0, 0.5, 6), fov=35),
        "floor": floor(bumps),
        "pane": {"type": "rectangle", "to_world": to().translate([0.9, 0, 0.5]).rotate([0, 1, 0], 20),
                 "bsdf": {"type": "roughdielectric", "alpha": 0.5}},
        "quad": {"type": "rectangle", "to_world": quad, "bsdf": normals({"type": "roughconductor", "alpha": 0.5})},
        "sky": sky(),
    }  # fmt: skip


def mirror() -> dict:
    block = to().rotate([1, 1, 0], 25).scale(0.9)
    tinted = {"type": "conductor", "eta": 1.5, "k": 2.0, "specular_reflectance": rgb(0.9, 0.8, 0.7)}
    return {
        "type": "scene",
        **cameras((0, 0.5, 6), fov=30),
        "floor": floor(painted()),
        "object": {"type": "cube", "to_world": block, "bsdf": tinted},
        "sky": sky(),
    }


def turning() -> dict:
    """A rough metal that turns beside a diffuse cube that bends, under a lamp."""
    return {
        "type": "scene",
        **cameras((0, 1, 6), fov=30),
        "floor": floor(painted()),
        "metal": {"type": "rectangle", "to_world": to().translate([-0.6, 0, 0]).rotate([1, 0, 0], -40),
                  "bsdf": {"type": "twosided", "nested": {"type": "roughconductor", "alpha": 0.25}}},
        "block": {"type": "cube", "to_world": to().translate([1.2, -0.4, 0]).rotate([0, 1, 0], 30).scale(0.5),
                  "bsdf": plain(0.5, 0.6, 0.7)},
        "light": panel(),
        "sky": dim(),
    }  # fmt: skip


def lens() -> dict:
    """A camera with a lens before a painted floor and a mirror."""
    wide = {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 5.0}
    return {
        "type": "scene",
        **cameras((0.4, 0.6, 6), fov=40, **wide),
        "floor": floor(painted()),
        "mirror": {"type": "sphere", "center": [0.5, 0, 0], "bsdf": {"type": "conductor"}},
        "light": panel(),
    }


def lamps() -> dict:
    """An emitting mesh that deforms, a ball and a disk of light that move, over a floor."""
    ball = {"type": "sphere", "to_world": to().translate([-1.5, 1, 0]).scale(0.4)}
    disk = {"type": "disk", "to_world": to().translate([1.5, 1.5, 1]).rotate([1, 0, 0], 90).scale(0.6)}
    return {
        "type": "scene",
        **cameras((0, 2, 6), (0, -0.5, 0), fov=35),
        "floor": floor(painted()),
        "mesh": {**panel({"type": "area", "radiance": rgb(3, 2, 1)}, "cube", 0.4)},
        "ball": {**ball, "emitter": {"type": "area", "radiance": rgb(2, 3, 4)}},
        "disk": {**disk, "emitter": {"type": "area", "radiance": bitmap(noise((4, 4, 3), 1, 4))}},
    }


def lights() -> dict:
    """Lights without extent, a lamp that may be hidden, a mask, and a surface with another back."""
    aim = to().look_at([-2, 3, 1], [0, 0, 0], [0, 0, 1])
    gauze = {"type": "mask", "opacity": 0.6, "nested": plain(0.5, 0.4, 0.3)}
    faces = {"type": "twosided", "a": plain(0.3, 0.6, 0.2), "b": {"type": "plastic",
             "diffuse_reflectance": rgb(0.3, 0.4, 0.5)}}  # fmt: skip
    return {
        "type": "scene",
        **cameras((0, 1, 6), fov=40, box={"pixel_format": "rgba"}),
        "floor": floor(painted()),
        "gauze": {"type": "rectangle", "to_world": to().translate([-0.8, 0, 0.5]), "bsdf": gauze},
        "faces": {"type": "rectangle", "to_world": to().translate([1, 0, 0]).rotate([0, 1, 0], 160), "bsdf": faces},
        "bulb": {"type": "point", "position": [0.5, 2, 1.5], "intensity": rgb(3, 4, 2)},
        "spot": {"type": "spot", "to_world": aim, "cutoff_angle": 60.0, "intensity": rgb(9, 6, 3)},
        "sun": {"type": "directional", "direction": [0.2, -1, -0.5], "irradiance": rgb(1, 1, 0.5)},
        "lamp": {"type": "sphere", "center": [-1.5, 1.5, -1], "radius": 0.4,
                 "emitter": {"type": "area", "radiance": rgb(3, 2, 1)}},
    }  # fmt: skip


def copies() -> dict:
    """A mesh in two instances, one of them in a mirror."""
    block = {"type": "cube", "to_world": to().rotate([1, 1, 0], 25).scale(0.6), "bsdf": painted(5)}
    group = {"type": "ref", "id": "group"}
    return {
        "type": "scene",
        **cameras((0, 0.5, 6), fov=35),
        "group": {"type": "shapegroup", "block": block},
        "one": {"type": "instance", "group": group, "to_world": to().translate([-1, 0, 0])},
        "two": {"type": "instance", "group": group, "to_world": to().translate([1, 0, 0.5]).rotate([0, 1, 0], 40)},
        "floor": floor({"type": "conductor", "specular_reflectance": rgb(0.8, 0.8, 0.7)}),
        "sky": dim(),
        "bulb": {"type": "point", "position": [0.5, 2, 2.5], "intensity": rgb(6, 6, 5)},
    }


# ------------------------------ Media ------------------------------

NULL = {"type": "null"}
VOXELS = 5


def grid(low: float, high: float, channels: int = 1, empty: bool = False) -> dict:
    """Waves over the cube [-1, 1]³, out of phase between axes and channels; ``empty`` is one half where x > 0."""
    z, y, x = np.mgrid[0:VOXELS, 0:VOXELS, 0:VOXELS] / (VOXELS - 1) * np.pi
    waves = [np.sin(x + k) * np.cos(0.7 * y - k) * np.sin(0.8 * z + 2 * k) for k in range(channels)]
    values = low + (high - low) * (0.5 + 0.5 * np.stack(waves, -1))
    if empty:
        values[:, :, VOXELS // 2 :] = 0
    volume = mi.VolumeGrid(np.ascontiguousarray(values, np.float32))
    return {"type": "gridvolume", "grid": volume, "to_world": to().translate([-1, -1, -1]).scale(2), "raw": True}


def fog() -> dict:
    """A homogeneous medium in a cube over a lit floor."""
    medium = {"type": "homogeneous", "sigma_t": 0.9, "albedo": 0.7, "phase": {"type": "hg", "g": 0.4}}
    return {
        "type": "scene",
        **cameras((0, 1, 6), fov=35),
        "floor": floor(plain(0.5, 0.4, 0.3)),
        "object": {"type": "cube", "to_world": to().scale(0.95), "bsdf": NULL, "interior": medium},
        "light": panel(),
        "sky": dim(),
    }


def cloud() -> dict:
    """A grid, empty in one half, that glows and scatters, around a painted ball."""
    medium = {
        "type": "gridmedium",
        "sigma_t": grid(0.4, 2.0, empty=True),
        "albedo": grid(0.3, 0.9, 3),
        "emission": grid(0.1, 0.6, 3),
        "scale": 1.2,
        "phase": {"type": "hg", "g": 0.3},
    }
    return {
        "type": "scene",
        **cameras((0.6, 0.8, 5), fov=30),
        "object": {"type": "cube", "bsdf": NULL, "interior": medium},
        "kernel": {"type": "sphere", "center": [0.2, -0.1, 0], "radius": 0.4, "bsdf": plain(0.6, 0.5, 0.4)},
        "sky": sky(),
    }


def rainbow() -> dict:
    """Three kinds of media whose extinction differs between channels, one within another and one in glass."""
    outer = {"type": "heterogeneous", "sigma_t": grid(0.3, 1.2, 3), "albedo": grid(0.3, 0.9, 3), "scale": 1.0}
    inner = {"type": "homogeneous", "sigma_t": rgb(0.7, 0.5, 0.35), "albedo": rgb(0.8, 0.6, 0.4), "scale": 2.0}
    other = {"type": "gridmedium", "sigma_t": grid(0.4, 1.5, 3), "albedo": 0.8}
    ball = {"type": "sphere", "radius": 0.5, "center": [0.2, 0.1, 0], "bsdf": NULL}
    rough = {"type": "roughdielectric", "alpha": 0.3}
    return {
        "type": "scene",
        "outer": outer,
        "inner": inner,
        **cameras((0.6, 0.8, 5), fov=38),
        "object": {"type": "cube", "bsdf": NULL, "interior": {"type": "ref", "id": "outer"}},
        "kernel": {**ball, "interior": {"type": "ref", "id": "inner"}, "exterior": {"type": "ref", "id": "outer"}},
        "beside": {"type": "sphere", "center": [0.6, 1.0, 1.2], "radius": 0.4, "bsdf": rough, "interior": other},
        "sky": sky(),
    }


def within() -> dict:
    """The camera in a cloud, before a pane of glass and a gauze that move."""
    medium = {"type": "gridmedium", "sigma_t": grid(0.3, 1.0), "albedo": 0.8}
    gauze = {"type": "mask", "opacity": 0.6, "nested": plain(0.5, 0.4, 0.3)}
    at = to().translate([-0.3, 0.1, -0.5]).rotate([0, 1, 0], 20).scale(0.3)
    scene = {
        "type": "scene",
        "fog": medium,
        **cameras((0, 0, 0.9), fov=60, medium={"type": "ref", "id": "fog"}),
        "object": {"type": "cube", "bsdf": NULL, "interior": {"type": "ref", "id": "fog"}},
        "pane": {"type": "rectangle", "to_world": to().translate([0.25, 0, -0.2]).rotate([0, 1, 0], -20).scale(0.3),
                 "bsdf": {"type": "dielectric_ad"}},
        "gauze": {"type": "rectangle", "to_world": at, "bsdf": gauze},
        "light": {**panel(), "to_world": to().translate([0, 3, 0]).rotate([1, 0, 0], 90).scale(1.5)},
        "sky": sky(),
    }  # fmt: skip
    for part in ("pane", "gauze"):
        scene[part] |= {side: {"type": "ref", "id": "fog"} for side in ("interior", "exterior")}
    return scene


# ------------------------------ The set ------------------------------

FLOOR, LIGHT = "floor.bsdf.reflectance.data", "light.emitter.radiance.value"
MEDIUM = "object.interior_medium."
FOG = tuple(MEDIUM + key for key in ("sigma_t.value.value", "albedo.value.value", "phase_function.g"))
LISTED = tuple(MEDIUM + key for key in ("sigma_t.data", "albedo.data", "scale", "phase_function.g"))
CLOUD = (*LISTED, MEDIUM + "emission.data")
# Its derivative by g cancels, so that threads alone make 8e-6 of it, and 3e-5 in a replay.
STEADY = (*(key for key in CLOUD if not key.endswith(".g")), "kernel.bsdf.reflectance.value", "sky.data")
RAINBOW = ("outer.sigma_t.data", "inner.sigma_t.value.value", "outer.albedo.data", "sky.data")
STILL = ("bulb.intensity.value", "sun.irradiance.value", "gauze.bsdf.opacity.value",
         "faces.bsdf.brdf_1.diffuse_reflectance.value", FLOOR)  # fmt: skip
TINTS = ("object.bsdf.specular_transmittance.value", "pane.bsdf.eta", FLOOR, LIGHT)
FOV, SOFT_FOV = ("camera.x_fov", FLOOR), ("camera_soft.x_fov", FLOOR)
WALLS = ("wall.bsdf.brdf_0.reflectance.value", "side.bsdf.reflectance.value")
GLOSSY = (
    "metal.bsdf.alpha.value", "metal.bsdf.k.value", "floor.bsdf.diffuse_reflectance.value", "mixed.bsdf.weight.value",
    "mixed.bsdf.bsdf_1.diffuse_reflectance.value", "shiny.bsdf.roughness.value", "sky.data",
)  # fmt: skip
FROSTED = (
    "pane.bsdf.alpha.value", "pane.bsdf.eta", "quad.bsdf.normalmap.data", "quad.bsdf.nested_bsdf.alpha.value",
    "floor.bsdf.nested_bsdf.reflectance.value", "sky.data",
)  # fmt: skip

SCENES = (
    Scene("room", room, (FLOOR, LIGHT, *WALLS), (
        case("primal"), case("primal", sensor=GAUSSIAN), case("sweep"), case("sweep", sensor=GAUSSIAN),
        case("replay"), case("replay", max_depth=-1), case("forward", sensor=GAUSSIAN), case("pixels"), case("tape"),
        case("tape-forward"), case("rb"), case("rb", linear=True),
    )),
    Scene("glossy", glossy, GLOSSY, (
        case("primal"), case("sweep"), case("replay"), case("forward"), case("sweep", attach="all"), case("pixels"),
        case("rb"),
    )),
    Scene("glass", glass, (*TINTS, "object.bsdf.eta"), (
        case("primal"), case("sweep"), case("replay"), case("forward", sensor=GAUSSIAN), case("pixels"), case("tape"),
        case("tape-forward"), case("sweep", *TINTS, attach="none"), case("rb", *TINTS),
    )),
    Scene("frosted", frosted, FROSTED, (
        case("primal"), case("sweep"), case("sweep", attach="all"), case("replay", attach="all"),
        case("forward", attach="all"),
    ), seed=8),
    Scene("mirror", mirror, ("object.vertex_positions", "object.bsdf.k.value", "sky.to_world", FLOOR), (
        case("primal"), case("sweep"), case("replay", jacobian_noise=0.1), case("forward"), case("pixels"),
        case("tape"),
    )),
    Scene("turning", turning, ("metal.to_world", "metal.bsdf.brdf_0.alpha.value", "block.vertex_positions", FLOOR), (
        case("primal"), case("sweep", attach="all"), case("sweep", sensor=GAUSSIAN), case("replay", attach="all"),
        case("forward", attach="all"), case("pixels", attach="all"),
    )),
    Scene("lens", lens, ("camera.to_world", FLOOR, LIGHT), (
        case("primal"), case("sweep"), case("sweep", *SOFT_FOV, sensor=GAUSSIAN), case("replay", *FOV),
        case("forward", "camera_soft.to_world", FLOOR, sensor=GAUSSIAN),
    ), seed=4),
    Scene("lamps", lamps, ("mesh.vertex_positions", "ball.to_world", "disk.to_world", "disk.emitter.radiance.data",
                           FLOOR), (
        case("primal"), case("sweep"), case("replay"), case("forward"), case("pixels"),
    )),
    Scene("lights", lights, (*STILL, "bulb.position", "spot.to_world"), (
        case("primal"), case("primal", hide_emitters=True), case("sweep", hide_emitters=True),
        case("replay", *STILL, attach="none", hide_emitters=True), case("forward"), case("rb", *STILL),
    )),
    Scene("copies", copies, ("group.block.vertex_positions", "group.block.bsdf.reflectance.data",
                             "floor.bsdf.specular_reflectance.value"), (
        case("primal"), case("sweep"), case("forward"), case("pixels"),
    )),
    Scene("fog", fog, (*FOG, "floor.bsdf.reflectance.value", LIGHT), (
        case("primal"), case("sweep"), case("sweep", passes=3), case("replay"), case("forward", passes=2),
        case("tape"), case("tape-forward"), case("rb"),
    )),
    Scene("cloud", cloud, (*CLOUD, "kernel.bsdf.reflectance.value", "sky.data"), (
        case("primal"), case("sweep"), case("sweep", *STEADY, passes=3), case("sweep", passes=2, null_branching=False),
        case("replay", *STEADY, null_branching=True), case("forward"), case("listing", *LISTED), case("tape"),
    )),
    Scene("rainbow", rainbow, (*RAINBOW, "beside.interior_medium.sigma_t.data"), (
        case("primal"), case("sweep", passes=2), case("replay"), case("forward"),
        case("listing", *RAINBOW),
    ), depth=6),
    Scene("within", within, ("fog.sigma_t.data", "pane.to_world", "pane.bsdf.eta", "gauze.to_world"), (
        case("primal"), case("sweep", passes=2), case("forward"), case("tape"), case("sweep", attach="all"),
    ), depth=6),
)  # fmt: skip
