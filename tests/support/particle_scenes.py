"""Scenes of the tests of light paths: emitters, sensors, shading normals and filters, in all combinations.

In a room, all surfaces that the sensor sees are smooth, because light paths cannot be connected to the sensor from a
mirror or from glass. Films sample their border, as light paths do.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import mitsuba as mi
import numpy as np

from truth import bitmap, environment, rgb

HEIGHT, WIDTH = 12, 16
BLOCK = 4
"""Width and height of a block of pixels."""


def colours(*shape: int, seed: int = 0, low: float = 0.0, high: float = 1.0) -> np.ndarray:
    """Random colours."""
    return np.random.default_rng(seed).uniform(low, high, (*shape, 3)).astype(np.float32)


def smooth_colours(n: int = 64) -> np.ndarray:
    """Colours without visible kinks, each of another phase."""
    x, y = np.meshgrid(*[np.arange(n) / n * 2 * np.pi] * 2)
    return np.stack([0.5 + 0.4 * np.sin(2 * x + k) * np.cos(y - k) for k in range(3)], -1).astype(np.float32)


def painted(values: np.ndarray) -> dict:
    """A texture of colours, in all variants."""
    return {**bitmap(values), "raw": False, "wrap_mode": "repeat"}


# ------------------------------ Emitters ------------------------------


def panel(radiance: dict | None = None, size: float = 0.5, emitter: str = "area") -> dict:
    """A rectangle that shines down."""
    T = mi.ScalarTransform4f
    return {
        "type": "rectangle",
        "to_world": T().look_at([0.3, 2.6, 0.4], [0, 0, 0.2], [0, 0, 1]) @ T().scale(size),
        "emitter": {"type": emitter, "radiance": radiance or rgb(14, 11, 8)},
    }


def round_lamp() -> dict:
    """A ball with interpolated normals, of 80 triangles, that shines."""
    lamp = round_mesh(80, 0.3, (0.3, 2.4, 0.2), {"type": "diffuse"})
    lamp["emitter"] = {"type": "area", "radiance": rgb(16, 13, 10)}
    return lamp


def map_of_sky() -> dict:
    """An environment map with bright texels, turned about two axes."""
    T = mi.ScalarTransform4f
    turn = T().rotate([1, 0, 0], 40) @ T().rotate([0, 1, 0], 25)
    return {"type": "envmap", "bitmap": mi.Bitmap(colours(8, 16)), "to_world": turn}


def emitters() -> dict[str, Callable[[], dict]]:
    """All emitters, by name."""
    T = mi.ScalarTransform4f
    down = T().look_at([0.4, 2.6, -0.3], [0, 0.1, 0.3], [0, 0, 1])
    return {
        "area": panel,
        "painted area": lambda: panel(painted(colours(4, 4, low=2, high=30))),
        "sphere": lambda: {
            "type": "sphere", "center": [0.2, 2.2, 0.3], "radius": 0.3,
            "emitter": {"type": "area", "radiance": rgb(12, 10, 9)},
        },
        "mesh": round_lamp,
        "point": lambda: {"type": "point", "position": [0.2, 2, 0.1], "intensity": rgb(9, 7, 5)},
        "spot": lambda: {"type": "spot", "to_world": down, "cutoff_angle": 35.0, "intensity": rgb(30, 25, 20)},
        "directional": lambda: {"type": "directional", "direction": [0.2, -1, 0.3], "irradiance": rgb(3, 2, 1)},
        "directionalarea": lambda: panel(rgb(3, 2.5, 2), 4, "directionalarea"),
        # What `directionalarea` sends down, as `path` can render it.
        "its direction": lambda: {
            "type": "directional", "direction": [-0.3, -2.6, -0.2], "irradiance": rgb(3, 2.5, 2),
        },
        "envmap": map_of_sky,
        "sky": lambda: {**map_of_sky(), "bitmap": environment(256)["bitmap"]},
        "constant": lambda: {"type": "constant", "radiance": rgb(0.8, 0.6, 0.5)},
        "projector": lambda: {"type": "projector", "to_world": down, "fov": 50, "irradiance": painted(colours(4, 4))},
    }  # fmt: skip


# ------------------------------ Sensors ------------------------------


def film(rfilter: str = "gaussian", **more: Any) -> dict:
    """A film that samples its border."""
    shape = {"width": WIDTH, "height": HEIGHT}
    own = {"type": "hdrfilm", "sample_border": True, "rfilter": {"type": rfilter}, "pixel_format": "rgb"}
    return {**own, **shape, **more}


CROPPED = {
    "width": 24,
    "height": 20,
    "crop_offset_x": 3,
    "crop_offset_y": 5,
    "crop_width": WIDTH,
    "crop_height": HEIGHT,
}


def sensor(kind: str = "perspective", rfilter: str = "gaussian", look: Any = None, **more: Any) -> dict:
    """A camera: `perspective`, `cropped` (with a principal point), `thinlens` or `orthographic` (scaled)."""
    T = mi.ScalarTransform4f
    look = T().look_at([0, 2, -3.6], [0, 0.4, 0.3], [0, 1, 0]) if look is None else look
    common = {"to_world": look, "film": film(rfilter), "sampler": {"type": "independent"}}
    own = {
        "perspective": {"type": "perspective", "fov": 45},
        "cropped": {
            "type": "perspective", "fov": 60, "principal_point_offset_x": 0.15, "principal_point_offset_y": -0.1,
            "film": film(rfilter, **CROPPED),
        },
        "thinlens": {"type": "thinlens", "fov": 45, "aperture_radius": 0.15, "focus_distance": 3.5},
        "orthographic": {"type": "orthographic", "to_world": look @ T().scale([1.6, 1.3, 1])},
    }[kind]  # fmt: skip
    return {**common, **own, **more}


def meter(shape: dict | None = None) -> dict:
    """A shape that measures its irradiance; by default, a sphere."""
    T = mi.ScalarTransform4f
    pixel = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    shape = shape or {"type": "sphere", "to_world": T().translate([-0.9, 1.3, -0.4]).scale(0.25)}
    own = {"type": "irradiancemeter", "film": pixel, "sampler": {"type": "independent"}}
    return {"bsdf": {"type": "diffuse"}, **shape, "meter": own}


# ------------------------------ Surfaces ------------------------------


def round_mesh(faces: int, radius: float, center: tuple[float, float, float], bsdf: dict, uv: bool = False) -> dict:
    """A ball with interpolated normals; few faces make shading normals differ much from geometric ones."""
    from pathreplay.scenes.bodies import ball

    vertices, triangles = ball({20: 0, 80: 1, 320: 2}[faces])
    mesh = mi.Mesh("ball", len(vertices), len(triangles), has_vertex_normals=True, has_vertex_texcoords=uv)
    params = mi.traverse(mesh)
    params["vertex_positions"] = np.ravel(vertices * radius + np.array(center)).astype(np.float32)
    params["vertex_normals"] = np.ravel(vertices).astype(np.float32)
    params["faces"] = np.ravel(triangles).astype(np.uint32)
    if uv:
        angles = np.stack([np.arctan2(vertices[:, 0], vertices[:, 2]) / (2 * np.pi), vertices[:, 1] / 2], -1) + 0.5
        params["vertex_texcoords"] = np.ravel(angles).astype(np.float32)
    params.update()
    return {"type": "ply", "filename": written(mesh), "bsdf": bsdf}


_FOLDER: list[Any] = []


def written(mesh: mi.Mesh) -> str:
    """Write a mesh to a temporary file, which lives as long as the process, and return its name."""
    import tempfile
    from pathlib import Path

    if not _FOLDER:
        _FOLDER.append(tempfile.TemporaryDirectory(prefix="particle-scenes-"))
    path = Path(_FOLDER[0].name) / f"{len(list(Path(_FOLDER[0].name).iterdir()))}.ply"
    mesh.write_ply(str(path))
    return str(path)


def perturbed(kind: str, bsdf: dict, flips: bool = False) -> dict:
    """A BSDF whose normals a `bumpmap` or `normalmap` perturbs; unchanged for "plain".

    With ``flips``, as by default in Mitsuba, a normal that ``wi`` sees from behind is mirrored.
    """
    flip = {"flip_invalid_normals": flips}
    if kind == "bumpmap":
        waves = np.random.default_rng(1).random((8, 8, 1))
        return {"type": "bumpmap", "arbitrary": bitmap(waves), "scale": 0.5, "bsdf": bsdf, **flip}
    if kind == "normalmap":
        n = np.random.default_rng(2).normal(0, 0.3, (8, 8, 3)) + np.array([0, 0, 1])
        n /= np.linalg.norm(n, axis=-1, keepdims=True)
        return {"type": "normalmap", "normalmap": bitmap(n / 2 + 0.5), "bsdf": bsdf, **flip}
    return bsdf


def room(light: str = "area", eye: dict | None = None, normals: str = "plain", **more: Any) -> dict:
    """A floor, a rough metal wall behind it and two balls, of rough plastic and of rough glass."""
    T = mi.ScalarTransform4f
    paint = {"type": "diffuse", "reflectance": rgb(0.7, 0.6, 0.5)}
    metal = {"type": "twosided", "bsdf": {"type": "roughconductor", "material": "Al", "alpha": 0.3}}
    parts = {
        "type": "scene",
        "sensor": eye or sensor(),
        "light": emitters()[light](),
        "floor": {
            "type": "rectangle",
            "to_world": T().rotate([1, 0, 0], -90) @ T().scale(3),
            "bsdf": perturbed(normals, paint),
        },
        "wall": {
            "type": "rectangle",
            "to_world": T().translate([0, 1, 1.5]) @ T().rotate([0, 1, 0], 180) @ T().scale(2),
            "bsdf": metal,
        },
        "ball": round_mesh(80, 0.5, (-0.6, 0.5, 0.1), {"type": "roughplastic", "alpha": 0.3}),
        "glass": {
            "type": "sphere", "center": [0.7, 0.45, 0], "radius": 0.45,
            "bsdf": {"type": "roughdielectric", "alpha": 0.3},
        },
    }  # fmt: skip
    if (eye or {}).get("meter"):
        del parts["sensor"]
        parts["probe"] = eye
    return {**parts, **more}


MATERIALS: dict[str, dict] = {
    "diffuse": {"type": "diffuse"},
    "rough metal": {"type": "roughconductor", "alpha": 0.2},
    "rough metal, two-sided": {"type": "twosided", "bsdf": {"type": "roughconductor", "alpha": 0.2}},
    "glass": {"type": "dielectric"},
    "mirror": {"type": "conductor"},
    "mirror, two-sided": {"type": "twosided", "bsdf": {"type": "conductor"}},
    "plastic": {"type": "plastic"},
    "rough glass": {"type": "roughdielectric", "alpha": 0.2},
    "thin glass": {"type": "thindielectric"},
    "mask": {"type": "mask", "opacity": 0.4, "bsdf": {"type": "diffuse"}},
    "null": {"type": "null"},
    "blend": {
        "type": "blendbsdf", "weight": 0.4, "first": {"type": "diffuse"},
        "second": {"type": "roughconductor", "alpha": 0.2},
    },
}  # fmt: skip


def balls(*materials: str, light: str = "area", mesh: bool = False, instances: bool = False, **more: Any) -> dict:
    """A floor and balls of the given materials, in view; each between the light and a part of the floor."""
    T = mi.ScalarTransform4f
    light_of = {"area": lambda: panel(size=0.9)}.get(light) or emitters()[light]
    parts: dict[str, Any] = {
        "type": "scene",
        "sensor": sensor(),
        "light": light_of(),
        "floor": {
            "type": "rectangle",
            "to_world": T().rotate([1, 0, 0], -90) @ T().scale(3),
            "bsdf": {"type": "diffuse", "reflectance": rgb(0.7, 0.6, 0.5)},
        },
    }
    for k, material in enumerate(materials):
        center = (1.1 * (k - (len(materials) - 1) / 2) + 0.1, 0.7, 0.1 * k)
        body = {"type": "sphere", "center": list(center), "radius": 0.45, "bsdf": MATERIALS[material]}
        if mesh or instances:
            body = round_mesh(320, 0.45, (0, 0, 0) if instances else center, MATERIALS[material])
        if instances:
            parts[f"group {k}"] = {"type": "shapegroup", "body": body}
            group = {"type": "ref", "id": f"group {k}"}
            body = {"type": "instance", "group": group, "to_world": T().translate(list(center))}
        parts[f"ball {k}"] = body
    return {**parts, **more}


# ------------------------------ Media ------------------------------


def fog(kind: str = "grey") -> dict:
    """A medium: `grey`, `coloured` (scatters forwards), `grid` or `heterogeneous`, in the box of `misty`."""
    own = {"albedo": rgb(0.8, 0.6, 0.5)}
    if kind in ("grey", "coloured"):
        forward = {"phase": {"type": "hg", "g": 0.5}} if kind == "coloured" else {}
        colour = rgb(0.9, 0.6, 0.3) if forward else rgb(0.5, 0.5, 0.5)
        return {"type": "homogeneous", "sigma_t": colour, **own, **forward}
    density = np.random.default_rng(3).uniform(0, 1.5, (4, 4, 4, 1)).astype(np.float32)
    place = mi.ScalarTransform4f().translate([-1.2, 0.1, -1.2]).scale([2.4, 1.6, 2.4])
    volume = {"type": "gridvolume", "grid": mi.VolumeGrid(density), "to_world": place, "raw": True}
    return {"type": {"grid": "gridmedium"}.get(kind, kind), "sigma_t": volume, **own}


def misty(light: str = "point", kind: str = "grey", around: str = "", **more: Any) -> dict:
    """A ball in a box of fog over a floor; all emitters are outside of the box.

    ``around`` puts camera and emitter into a second fog: "endless", or in a large "box". With "bubble", the fog is
    endless, and the camera is in a bubble of denser fog.
    """
    T = mi.ScalarTransform4f
    scene = balls(light=light)
    scene["mist"] = {
        "type": "cube", "to_world": T().translate([0, 0.9, 0]) @ T().scale([1.2, 0.8, 1.2]),
        "bsdf": {"type": "null"}, "interior": fog(kind),
    }  # fmt: skip
    scene["ball"] = round_mesh(80, 0.4, (-0.5, 0.7, 0.1), {"type": "roughplastic", "alpha": 0.3})
    if around:
        thin = {"type": "ref", "id": "thin"}
        scene["thin"] = {"type": "homogeneous", "sigma_t": rgb(0.1, 0.2, 0.1), "albedo": rgb(0.5, 0.7, 0.9)}
        scene["sensor"]["medium"], scene["mist"]["exterior"] = thin, thin
        if around == "box":
            room = {"type": "cube", "to_world": T().translate([0, 3, 0]).scale(6), "bsdf": {"type": "null"}}
            scene["hall"] = {**room, "interior": thin}
        if around == "bubble":
            scene["dense"] = {"type": "homogeneous", "sigma_t": rgb(0.8, 0.6, 0.7), "albedo": rgb(0.5, 0.7, 0.9)}
            scene["sensor"]["medium"] = dense = {"type": "ref", "id": "dense"}
            bubble = {"type": "sphere", "center": [0, 2, -3.6], "radius": 0.5, "bsdf": {"type": "null"}}
            scene["bubble"] = {**bubble, "interior": dense, "exterior": thin}
    return {**scene, **more}


def milky(light: str = "area") -> dict:
    """A ball of glass full of milk, and a caustic in the fog and on the floor beside it."""
    milk = {**fog("grey"), "scale": 3.0}
    ball = {"type": "sphere", "center": [0.4, 0.75, -0.2], "radius": 0.35, "bsdf": {"type": "dielectric"}}
    lens = {**ball, "center": [-0.5, 1.2, 0.2]}
    scene, air = misty(light, lens=lens, air=fog("grey")), {"type": "ref", "id": "air"}
    scene["ball"], scene["mist"]["interior"] = {**ball, "interior": milk, "exterior": air}, air
    return scene


# ------------------------------ Images ------------------------------


def images(scene: mi.Scene, integrator: mi.Integrator, seeds: Iterable[int], spp: int) -> np.ndarray:
    """Images of the scene, one per seed (seeds x height x width x channels)."""
    return np.array([
        np.array(mi.render(scene, integrator=integrator, seed=mi.UInt32(seed), spp=spp), np.float64) for seed in seeds
    ])  # fmt: skip


def blocks(images: np.ndarray) -> np.ndarray:
    """Mean of all channels over blocks of pixels (seeds x blocks); of the one pixel of a meter, the channels."""
    n, height, width, _ = images.shape
    if height < BLOCK:
        return images.reshape(n, -1)
    grey = images.mean(-1)
    return grey.reshape(n, height // BLOCK, BLOCK, width // BLOCK, BLOCK).mean((2, 4)).reshape(n, -1)


# ------------------------------ Scenes without edges ------------------------------


def dome(light: str = "point", eye: str = "perspective", bsdf: dict | None = None, rfilter: str = "gaussian") -> dict:
    """A ball seen from inside: nothing in it has an outline or a crease that light paths meet.

    The poles of its texture, where differences do not converge, are out of view.

    Area lights are behind the camera, whose paths then have two segments at most. With the sensor `meter`, the ball
    measures its irradiance.
    """
    T = mi.ScalarTransform4f
    look = T().look_at([0.1, 0.2, -0.6], [0.2, -0.2, 1], [0, 1, 0])
    if eye == "orthographic":
        look = look @ T().scale([1 / 1.6 / 2, 1 / 1.3 / 2, 1])  # `sensor` scales it, too
    down = T().look_at([0.4, 0.3, -0.3], [0, -0.1, 1], [0, 1, 0])
    lights = {
        **emitters(),
        "point": lambda: {"type": "point", "position": [0.2, 0.3, 0.4], "intensity": rgb(3, 2, 1)},
        "white": lambda: {
            "type": "point", "position": [0.2, 0.3, 0.4], "intensity": {"type": "uniform", "value": 2.0},
        },
        "spot": lambda: {"type": "spot", "to_world": down, "cutoff_angle": 50.0, "intensity": rgb(6, 5, 4)},
        "area": lambda: {
            "type": "rectangle", "to_world": down @ T().translate([0, 0, -0.9]) @ T().scale(0.3),
            "emitter": {"type": "area", "radiance": rgb(8, 7, 6)},
        },
        "sphere": lambda: {
            "type": "sphere", "to_world": down @ T().translate([0, 0, -0.9]) @ T().scale(0.2),
            "emitter": {"type": "area", "radiance": rgb(8, 7, 6)},
        },
        "painted area": lambda: {
            "type": "rectangle", "to_world": down @ T().translate([0, 0, -0.9]) @ T().scale(0.3),
            "emitter": {"type": "area", "radiance": painted(colours(4, 4, low=2, high=30))},
        },
        "projector": lambda: {
            "type": "projector", "to_world": down, "fov": 50, "irradiance": painted(smooth_colours()),
        },
    }  # fmt: skip
    paint = {"type": "diffuse", "reflectance": painted(smooth_colours())}
    skin = {
        "type": "sphere", "to_world": T().rotate([1, 0, 0], 90) @ T().scale(1.6), "flip_normals": True,
        "bsdf": bsdf or {"type": "twosided", "bsdf": paint},
    }  # fmt: skip
    parts = {"type": "scene", "light": lights[light](), "dome": skin}
    if eye == "meter":
        return {**parts, "dome": meter(skin)}
    return {**parts, "sensor": sensor(eye, rfilter, look, **({"focus_distance": 1.4} if eye == "thinlens" else {}))}


def plane(light: str, eye: str = "perspective", bsdf: dict | None = None) -> dict:
    """A textured floor, whose outline is out of view, under a light. A `meter` above the light looks down."""
    T = mi.ScalarTransform4f
    beam = {
        "type": "rectangle", "to_world": T().look_at([0.3, 5, 0.4], [0, 0, 0.2], [0, 0, 1]) @ T().scale(0.7),
        "emitter": {"type": "directionalarea", "radiance": rgb(3, 2.5, 2)},
    }  # fmt: skip
    down = T().translate([0.2, 3.5, 0.3]) @ T().rotate([1, 0, 0], 80) @ T().scale(0.4)
    own = {"sensor": sensor(look=T().look_at([0, 3, -1], [0, 0, 0.3], [0, 1, 0]))}
    if eye == "meter":
        own = {"probe": meter({"type": "rectangle", "to_world": down})}
    return {
        "type": "scene",
        **own,
        "light": beam if light == "directionalarea" else emitters()[light](),
        "floor": {
            "type": "rectangle",
            "to_world": T().rotate([1, 0, 0], -90) @ T().scale(3),
            "bsdf": bsdf or {"type": "diffuse", "reflectance": painted(smooth_colours())},
        },
    }


ROUGH: dict = {"type": "twosided", "bsdf": {"type": "roughconductor", "alpha": 0.35, "material": "Al"}}


def wavy(n: int = 17) -> mi.Mesh:
    """A wavy square with interpolated normals."""
    x, y = np.meshgrid(*[np.linspace(-1, 1, n)] * 2)
    points = np.stack([x, y, 0.05 * np.sin(3 * x) * np.cos(2 * y) + 0.3], -1).reshape(-1, 3)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([
        np.stack([corner, corner + 1, corner + n], -1), np.stack([corner + 1, corner + n + 1, corner + n], -1),
    ])  # fmt: skip
    mesh = mi.Mesh("wavy", len(points), len(faces), has_vertex_normals=True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = points.ravel().astype(np.float32)
    params["faces"] = faces.ravel().astype(np.uint32)
    params.update()
    return mesh


def mirror() -> dict:
    """A wavy mirror that throws the light of a spot at a ceiling. The light meets no outline of it."""
    T = mi.ScalarTransform4f
    down = T().look_at([0.1, 0, 2], [0, 0, 0], [0, 1, 0])
    return {
        "type": "scene",
        "sensor": sensor(look=T().look_at([1.6, 0, 1.2], [0, 0, 2.6], [0, 0, 1])),
        "light": {"type": "spot", "to_world": down, "cutoff_angle": 18.0, "intensity": rgb(60, 50, 40)},
        "mirror": {"type": "ply", "filename": written(wavy()), "bsdf": {"type": "conductor"}},
        "ceiling": {
            "type": "rectangle", "to_world": T().translate([0, 0, 2.6]) @ T().rotate([1, 0, 0], 180) @ T().scale(4),
            "bsdf": {"type": "diffuse", "reflectance": rgb(0.8, 0.7, 0.6)},
        },
    }  # fmt: skip


def slab(light: str = "spot", eye: str = "perspective", both: bool = False) -> dict:
    """A slab of glass with a wavy top, which casts a caustic on a floor. The light meets no outline of it.

    With ``both``, the bottom is wavy, too.
    """
    T = mi.ScalarTransform4f
    glass = {"type": "dielectric_ad", "int_ior": 1.5, "ext_ior": 1.0}
    bottom = {"type": "rectangle", "to_world": T().translate([0, 0, -0.2]) @ T().rotate([1, 0, 0], 180)}
    if both:
        turned = T().translate([0, 0, -0.5]) @ T().rotate([0, 0, 1], 30)
        bottom = {"type": "ply", "filename": written(wavy()), "to_world": turned, "flip_normals": True}
    look = T().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
    lights = {
        "spot": {"type": "spot", "to_world": look, "cutoff_angle": 12.0, "intensity": rgb(60, 50, 40)},
        "beam": {
            "type": "rectangle", "to_world": look @ T().scale(0.4),
            "emitter": {"type": "directionalarea", "radiance": rgb(3, 2, 1)},
        },
    }  # fmt: skip
    return {
        "type": "scene",
        "sensor": sensor(eye, look=T().look_at([2.4, 0, -0.8], [0, 0, -2], [0, 0, 1])),
        "light": lights[light],
        "top": {"type": "ply", "filename": written(wavy()), "bsdf": glass},
        "bottom": {**bottom, "bsdf": dict(glass)},
        "floor": {
            "type": "rectangle", "to_world": T().translate([0, 0, -2]) @ T().scale(4),
            "bsdf": {"type": "diffuse", "reflectance": rgb(0.8, 0.7, 0.6)},
        },
    }  # fmt: skip
