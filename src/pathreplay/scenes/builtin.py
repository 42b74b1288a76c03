"""Built-in scenes: small rooms for examples and tests, as functions that return Mitsuba dictionaries."""

from __future__ import annotations

from collections.abc import Callable

import mitsuba as mi
import numpy as np

from pathreplay.scenes.bodies import ball, knobs, mesh
from pathreplay.scenes.caustics import caustic_lens, caustic_mirror
from pathreplay.types import SceneDict

COSTS: dict[str, Callable[[int], int]] = {
    "texture": lambda n: 64 * n**2,  # per texel: three numbers, and their copies in double precision
    "grid": lambda n: 256 * n**3,  # per voxel: the 12 waves of the noise, which are in memory together
    "views": lambda n: 100_000 * n,  # per view: a sensor and its film
    "columns": lambda n: 1000 * n**2,  # per vertex of a square height map: its data and its faces
    "rows": lambda n: 1000 * n**2,
    "ball_splits": lambda n: 2000 * 4 ** min(n, 40),  # per face: there are eight faces, and each split gives four
}
"""Arguments that determine the size of a scene -> approximate memory in bytes that is needed to build the scene."""


def _picture(pixels: np.ndarray, **options: object) -> SceneDict:
    """Describe a bitmap texture. Its values are used without colour conversion."""
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True, **options}


def _centres(*counts: int) -> tuple[np.ndarray, ...]:
    """Return the coordinates in [0, 1] of the cell centres of a grid, one array per axis."""
    return tuple(np.meshgrid(*((np.arange(n) + 0.5) / n for n in counts), indexing="ij"))


def cornell_box(resolution: int = 256) -> SceneDict:
    """Describe Mitsuba's Cornell box: two white boxes, a red and a green wall, one area light."""
    scene: SceneDict = mi.cornell_box()
    scene["sensor"]["film"].update(width=resolution, height=resolution)
    return scene


def cornell_box_photo(resolution: int = 128, texture: int = 96) -> SceneDict:
    """Describe the Cornell box with a grey texture (``texture``² texels) on its back wall, seen by two sensors.

    ``overview`` is the classic camera. ``closeup`` is inside the box, between the back wall and the two white boxes.
    The boxes are moved to the front, so that this camera sees every texel of the wall. The key of the texture is
    ``back.bsdf.reflectance.data``.
    """
    T = mi.ScalarTransform4f
    scene = cornell_box(resolution)
    overview = scene.pop("sensor")
    # A texel is hardly wider than a pixel. A filter that is wider than a pixel would blur neighbouring texels, which
    # slows down convergence.
    overview["film"]["rfilter"] = {"type": "box"}
    # The camera is 1.3 in front of the wall, and the wall extends 1 to each side. Therefore tan(fov / 2) is 1 / 1.3,
    # plus a margin of 1 %.
    near = T().look_at(origin=[0, 0, 0.3], target=[0, 0, -1], up=[0, 1, 0])
    scene |= {"overview": overview, "closeup": {**overview, "to_world": near, "fov": 75.8}}
    scene["large-box"]["to_world"] = T().translate([-0.45, -0.65, 0.42]).rotate([0, 1, 0], 18).scale([0.26, 0.35, 0.26])
    scene["small-box"]["to_world"] = T().translate([0.45, -0.78, 0.5]).rotate([0, 1, 0], -17).scale(0.22)
    # v is flipped, so that the first row of an image is at the top of the wall.
    upright = T().translate([0, 1, 0]).scale([1, -1, 1])
    grey = _picture(np.full((texture, texture, 3), 0.5, np.float32), wrap_mode="clamp", to_uv=upright)
    scene["back"]["bsdf"] = {"type": "diffuse", "reflectance": grey}
    return scene


def _room(radius: float) -> SceneDict:
    """Describe an emissive sphere around the origin, with poles above and below and a smooth radiance texture.

    Because the texture is smooth, gradients point to the optimum even if the initial values are far from it. Because
    the sphere has finite size, an image also depends on the position of the camera. The radiance from direction d in
    colour channel c is 0.6 + 0.08 Σ_j cos(k_cj · d + φ_cj), with random phases φ_cj and random wave vectors k_cj
    (wavelengths 30 to 90 degrees).
    """
    v, u = _centres(64, 128)
    θ, φ = np.pi * v, 2 * np.pi * u
    d = np.stack([np.sin(θ) * np.cos(φ), np.sin(θ) * np.sin(φ), np.cos(θ)], axis=-1)
    random = np.random.default_rng(7)  # an arbitrary fixed seed
    k = random.normal(size=(3, 6, 3))
    k *= random.uniform(4.0, 12.0, (3, 6, 1)) / np.linalg.norm(k, axis=-1, keepdims=True)
    waves = np.cos(np.einsum("rcx,nwx->rcnw", d, k) + random.uniform(0, 2 * np.pi, (3, 6)))
    radiance = (0.6 + 0.08 * waves.sum(axis=-1)).astype(np.float32)
    return {
        "type": "sphere",
        "flip_normals": True,
        "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(radius),
        "bsdf": {"type": "diffuse", "reflectance": 0.0},
        "emitter": {"type": "area", "radiance": _picture(radiance)},
    }


def _camera(origin: list[float], target: list[float], fov: float, resolution: int) -> SceneDict:
    film = {"type": "hdrfilm", "width": resolution, "height": resolution, "pixel_format": "rgb"}
    place = mi.ScalarTransform4f().look_at(origin=origin, target=target, up=[0, 1, 0])
    return {"type": "perspective", "to_world": place, "fov": fov, "film": {**film, "rfilter": {"type": "box"}}}


def glass_pane(resolution: int = 40, texture: int = 12) -> SceneDict:
    """Describe a thick pane of glass (index 1.5) with an uneven front in a textured room, seen by three sensors.

    ``front`` looks straight through the pane. ``left`` and ``right`` look at the pane at an angle of 55 degrees. At
    this angle, the thickness of the pane shifts the view, and the front reflects more of the room. Together, the three
    views distinguish the effect of the index from the effect of the slope of the surface. The key of the index is
    ``glass.eta``, and the key of the normal map is ``front_face.bsdf.normalmap.data``. The normal map covers the middle
    of the pane, and contains ``texture``² normals, stored as (n + 1) / 2.
    """
    T = mi.ScalarTransform4f
    # The pane is so wide that no path sees the rim, and its corners are inside the room.
    half, thick, distance = [2.8, 2.0, 1.0], 0.6, 2.9
    angle = np.radians(55)
    side = [float(distance * np.sin(angle)), 0.0, float(distance * np.cos(angle))]
    # The normal map covers -0.8 to 0.8 in x and y. The rest of the pane is flat, like the border of the normal map.
    middle = T().translate([0.5, 0.5, 0]).scale([half[0] / 0.8, half[1] / 0.8, 1]).translate([-0.5, -0.5, 0])
    normals = _picture(_bumps(texture), wrap_mode="clamp", to_uv=middle)
    glass = {"type": "ref", "id": "glass"}
    return {
        "type": "scene",
        "front": _camera([0, 0, distance], [0, 0, 0], 44, resolution),
        "left": _camera([-side[0], 0, side[2]], [0, 0, 0], 40, resolution),
        "right": _camera(side, [0, 0, 0], 40, resolution),
        "integrator": {"type": "path", "max_depth": 5},
        "room": _room(4.0),
        "glass": {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0},
        "front_face": {
            "type": "rectangle",
            "to_world": T().translate([0, 0, thick / 2]).scale(half),
            "bsdf": {"type": "normalmap", "normalmap": normals, "bsdf": glass},
        },
        "back_face": {
            "type": "rectangle",
            "to_world": T().translate([0, 0, -thick / 2]).rotate([0, 1, 0], 180).scale(half),
            "bsdf": glass,
        },
    }


def _bumps(size: int) -> np.ndarray:
    """Return the normal map of the height 0.03 w (sin 5x cos 4y + cos(3x + 5y)), with window w = (1 - x²)²(1 - y²)²."""
    y, x = (2 * centres - 1 for centres in _centres(size, size))

    def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        window = np.square((1 - x * x) * (1 - y * y))
        return 0.03 * window * (np.sin(5 * x) * np.cos(4 * y) + np.cos(3 * x + 5 * y))

    ε = 1e-3
    rise_x, rise_y = height(x + ε, y) - height(x - ε, y), height(x, y + ε) - height(x, y - ε)
    n = np.stack([-rise_x, -rise_y, np.full_like(x, 2 * ε)], axis=-1)
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    return ((n + 1) / 2).astype(np.float32)


def mirror_camera(resolution: int = 48) -> SceneDict:
    """Describe an old mirror with blotches in a textured room, seen by two cameras.

    The camera ``tripod`` is fixed, and the camera ``camera`` may move. Both cameras see the mirror and a part of the
    room around the mirror. Because of the blotches, the images also change if the mirror moves in its plane. The key of
    the camera's pose is ``camera.to_world``, and the key of the mirror's pose is ``mirror.to_world``.
    """
    place = mi.ScalarTransform4f().translate([-0.4, -0.1, -1.0])
    blotches = _picture(_blotches(32))
    return {
        "type": "scene",
        "camera": _camera([0.9, 0.4, 1.9], [-0.3, 0.0, -1.0], 75, resolution),
        "tripod": _camera([-0.9, 0.3, 0.5], [-0.4, -0.1, -1.0], 60, resolution),
        "integrator": {"type": "path", "max_depth": 3},
        "room": _room(3.0),
        "mirror": {
            "type": "rectangle",
            "to_world": place.rotate([0, 1, 0], 15).rotate([1, 0, 0], -8).scale([1.3, 1.1, 1]),
            "bsdf": {"type": "conductor", "material": "none", "specular_reflectance": blotches},
        },
    }


def _blotches(size: int) -> np.ndarray:
    """Return the reflectance 0.7 + 0.15 (cos 9x sin 7y + sin(5x - 8y)), slightly reduced in green and blue."""
    y, x = (2 * centres - 1 for centres in _centres(size, size))
    grey = 0.7 + 0.15 * (np.cos(9 * x) * np.sin(7 * y) + np.sin(5 * x - 8 * y))
    return (grey[:, :, None] * np.array([1, 0.97, 0.9])).astype(np.float32)


def cloud(resolution: int = 40, grid: int = 32, views: int = 6) -> SceneDict:
    """Describe a small cloud (``grid``³ voxels, albedo 0.95) under a sky with a sun, seen by ``views`` sensors.

    The medium fills a cube of side 2, whose surface has a null BSDF. The sensors surround the cube. The key of the
    density (extinction per unit length) is ``cloud.interior_medium.sigma_t.data``.
    """
    place = mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
    density = {"type": "gridvolume", "grid": mi.VolumeGrid(_cumulus(grid)), "to_world": place}
    droplets = {"type": "heterogeneous", "albedo": 0.95, "sigma_t": density}
    scene: SceneDict = {
        "type": "scene",
        "integrator": {"type": "volpath", "max_depth": 64},
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(_sky(32))},
        "cloud": {"type": "cube", "bsdf": {"type": "null"}, "interior": droplets},
    }
    for view in range(views):
        angle = 2 * np.pi * (view + 0.3) / views
        # Views from below, the side and above alternate, because some parts are visible only from certain heights.
        height = (-1.6, 0.3, 2.2)[view % 3]
        origin = [float(4 * np.cos(angle)), height, float(4 * np.sin(angle))]
        scene[f"view{view + 1}"] = _camera(origin, [0, -0.1, 0], 34, resolution)
    return scene


def silhouettes(resolution: int = 32, views: int = 2) -> SceneDict:
    """Describe a black body of length 1 with four knobs in front of a white sky: only its silhouette is visible.

    The key of the vertices is ``body.vertex_positions``. With ``views`` = 2, the cameras are 90 degrees apart. Three or
    more cameras are placed around the body at equal angles.
    """
    black = {"type": "diffuse", "reflectance": 0.0}
    vertices, faces = ball(4)
    scene: SceneDict = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sky": {"type": "constant", "radiance": 1.0},
        "body": mesh(knobs(vertices), faces, black),
    }
    for view in range(views):
        angle = np.pi * view / max(views, 1) if views <= 2 else 2 * np.pi * view / views
        origin = [float(4 * np.sin(angle)), 0.8 * (-1) ** view, float(4 * np.cos(angle))]
        scene[f"view{view + 1}"] = _camera(origin, [0, 0, 0], 28, resolution)
    return scene


def shadows(resolution: int = 32, views: int = 4, ball_splits: int = 0) -> SceneDict:
    """Describe the black body of `silhouettes` above a white floor, on which an area light casts the body's shadow.

    Cameras look down on the body from all sides. If ``ball_splits`` is not zero, a sphere replaces the body, as the
    initial value of an optimisation. With ``ball_splits`` = 4, the sphere has as many vertices as the body.
    """
    T = mi.ScalarTransform4f
    vertices, faces = ball(ball_splits or 4)
    points = 0.3 * vertices if ball_splits else knobs(vertices)
    scene: SceneDict = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "body": mesh(points, faces, {"type": "diffuse", "reflectance": 0.0}),
        "floor": {
            "type": "rectangle",
            "to_world": T().translate([0, -0.8, 0]).rotate([1, 0, 0], -90).scale(8),
            "bsdf": {"type": "diffuse", "reflectance": 0.8},
        },
        "lamp": {
            "type": "rectangle",
            "to_world": T().look_at(origin=[1.5, 4, 1], target=[0, 0, 0], up=[0, 0, 1]).scale(0.3),
            "emitter": {"type": "area", "radiance": 60.0},
        },
    }
    for view in range(views):
        angle = 2 * np.pi * (view + 0.25) / views
        origin = [float(3.6 * np.sin(angle)), 2.0, float(3.6 * np.cos(angle))]
        scene[f"view{view + 1}"] = _camera(origin, [0, -0.25, 0], 32, resolution)
    return scene


def silhouette_in_mirror(resolution: int = 32) -> SceneDict:
    """Describe the body of `silhouettes` beside a mirror, seen by one camera.

    The camera sees one side of the body directly, and another side in the mirror. The width of the image is twice its
    height. The rim of the mirror is invisible, because the white sky is behind the mirror and also reflected by it.
    """
    scene = silhouettes(resolution, views=1)
    camera = _camera([0.5, 0, 4], [0.5, 0, 0], 36, resolution)
    camera["film"]["width"] *= 2
    place = mi.ScalarTransform4f().look_at(origin=[1.3, 0, -0.6], target=[0.69, 0, 0.193], up=[0, 1, 0])
    mirror = {"type": "rectangle", "to_world": place.scale([0.8, 0.8, 1]), "bsdf": {"type": "conductor"}}
    return {**scene, "integrator": {"type": "path", "max_depth": 3}, "view1": camera, "mirror": mirror}


def _panel(centre: list[float], half: list[float], colour: list[float], turn: float = 0) -> SceneDict:
    """Describe a rectangle that faces +z, is turned by ``turn`` degrees, emits one colour and reflects nothing."""
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate(centre).rotate([0, 0, 1], turn).scale([*half, 1]),
        "bsdf": {"type": "diffuse", "reflectance": 0.0},
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": colour}},
    }


def flat_colours(resolution: int = 32) -> SceneDict:
    """Describe emissive panels of one colour each, at different distances before a black background.

    Each panel has uniform radiance, so small motions change an image only at edges. The camera looks at
    the panels from a distance of 3. The key of the camera's pose is ``camera.to_world``.
    """
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 1},
        "camera": _camera([0.2, 0.1, 3], [0, 0, 0], 40, resolution),
        "red": _panel([-0.5, 0.3, 0.4], [0.3, 0.25], [0.9, 0.2, 0.1], 20),
        "green": _panel([0.5, 0.35, -0.4], [0.4, 0.3], [0.2, 0.8, 0.3], -35),
        "blue": _panel([-0.35, -0.5, -0.8], [0.4, 0.3], [0.2, 0.3, 1.0], 50),
        "white": _panel([0.35, -0.4, 0.6], [0.2, 0.25], [0.9, 0.9, 0.9], 10),
    }


def glass_ball(resolution: int = 32) -> SceneDict:
    """Describe a glass sphere (index 1.5, radius 0.5) in front of panels of one colour each.

    The sphere is visible only because it refracts and reflects light. The key of the sphere's index of refraction is
    ``glass.eta``, and the key of the sphere's pose is ``ball.to_world``.
    """
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 5},
        "camera": _camera([0, 0, 3], [0, 0, 0], 24, resolution),
        "glass": {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0},
        "ball": {"type": "sphere", "radius": 0.5, "bsdf": {"type": "ref", "id": "glass"}},
        "back": _panel([0, 0, -3], [6, 6], [0.3, 0.4, 0.6]),
        "red": _panel([-0.35, 0.2, -1.6], [0.25, 0.35], [0.9, 0.2, 0.1]),
        "green": _panel([0.3, 0.3, -1.2], [0.25, 0.2], [0.2, 0.8, 0.3]),
        "white": _panel([0.15, -0.3, -1.4], [0.35, 0.2], [0.9, 0.9, 0.9]),
    }


def _cumulus(size: int) -> np.ndarray:
    """Return the extinction of a cloud at the voxel centres of [-1, 1]³, as an array of shape (z, y, x, 1).

    The extinction is max(0, 8 b(y) Σ_i exp(-|x - c_i|² / r_i²) (0.75 + n(x)) - 1.5). The sum is over six Gaussian
    blobs with centres c_i and radii r_i. The factor b cuts off the lower part of the blobs, so that the base is flat.
    The noise n is a sum of 12 plane waves with wavelengths from 0.5 to 1.2.
    """
    z, y, x = (2 * centres - 1 for centres in _centres(size, size, size))
    shape = np.zeros_like(x)
    for cx, cy, cz, radius in (
        (0.0, -0.05, 0.0, 0.46), (0.5, -0.2, 0.12, 0.36), (-0.5, -0.22, -0.1, 0.38),
        (0.12, 0.42, -0.14, 0.32), (-0.14, -0.15, 0.52, 0.34), (0.3, -0.2, -0.5, 0.3),
    ):  # fmt: skip
        shape += np.exp(-(np.square(x - cx) + np.square(y - cy) + np.square(z - cz)) / radius**2)
    shape *= 1 / (1 + np.exp(-(y + 0.45) / 0.06))  # cut off the blobs at a flat base
    random = np.random.default_rng(5)  # an arbitrary fixed seed
    k = random.normal(size=(12, 3))
    k *= (2 * np.pi / random.uniform(0.5, 1.2, (12, 1))) / np.linalg.norm(k, axis=1, keepdims=True)
    phase = random.uniform(0, 2 * np.pi, 12)
    waves = np.cos(np.einsum("azyx,na->nzyx", np.stack([x, y, z]), k) + phase[:, None, None, None])
    noise = 0.1 * waves.sum(axis=0)
    return np.maximum(0, 8 * shape * (0.75 + noise) - 1.5).astype(np.float32)[..., None]


def _sky(rows: int) -> np.ndarray:
    """Return an environment map of a sky with a sun. The sky is blue above and dim below.

    The elevation of the sun is 50 degrees. The sun is blurred over 8 degrees, so that paths hit it.
    """
    v, u = _centres(rows, 2 * rows)
    θ, φ = np.pi * v, 2 * np.pi * u
    d = np.stack([np.sin(θ) * np.sin(φ), np.cos(θ), -np.sin(θ) * np.cos(φ)], axis=-1)  # as in Mitsuba's envmap
    up = 0.5 + 0.5 * d[..., 1:2]
    sky = up * np.array([0.2, 0.3, 0.5]) + (1 - up) * np.array([0.14, 0.12, 0.11])
    # The sun is on the side of the cameras that look up from below, so that no image contains the sun.
    elevation, azimuth = np.radians(50), np.radians(108)
    sun = np.array([np.cos(elevation) * np.cos(azimuth), np.sin(elevation), np.cos(elevation) * np.sin(azimuth)])
    glow = np.exp((d @ sun - 1) / (1 - np.cos(np.radians(8))))[..., None]
    return (sky + 30 * glow * np.array([1.0, 0.9, 0.75])).astype(np.float32)


_SCENES = (
    cornell_box, cornell_box_photo, glass_pane, mirror_camera, cloud, silhouettes, silhouette_in_mirror, shadows,
    flat_colours, glass_ball, caustic_lens, caustic_mirror,
)  # fmt: skip
BUILTINS: dict[str, Callable[..., SceneDict]] = {make.__name__.replace("_", "-"): make for make in _SCENES}
"""Built-in scenes: name -> function that returns a Mitsuba scene dictionary."""
