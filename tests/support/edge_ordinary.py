"""Scenes as people have them in which something moves: files of other programs, films, cameras and lamps of all kinds.

Each is a function that writes its files into a folder and tells what moves. `measured` gives interior and edges beside
finite differences.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

import ordinary_scenes
from ordinary_files import Patch, write_obj, write_ply
from pathreplay.testing.objective import Move, Objective
from pathreplay.testing.stencil import CENTRAL, WIDE
from truth import add, bitmap, noise, rgb, rotate, translate, translate_vertices, turn_vertices

T = mi.ScalarTransform4f
SIZE = 16
NEVER = 1000
"""Roulette depends on parameters, and would make differences noisy."""


@dataclass(frozen=True)
class Moving:
    """A scene (a dictionary, or XML with its files in the folder), and what moves in it."""

    scene: Any
    key: str
    move: Move
    depth: int = 3
    step: float = 0.02
    spp: int = 256
    sensor: int = 0
    optimize: bool = False  # merge meshes while loading, as Mitsuba does unless told otherwise
    options: dict[str, Any] = field(default_factory=dict)  # of both integrators
    reference: str = "path"


Write = Callable[[Path], Moving]


@dataclass(frozen=True)
class Measured:
    """Of each seed."""

    gradients: np.ndarray
    differences: np.ndarray
    transpose: float  # |<W, J v> - <Jᵀ W, v>| / Σ |W J v| of the first seed


def weights(shape: tuple[int, ...], alpha: bool) -> np.ndarray:
    """Smooth, and another wave in each channel; zero for alpha, whose derivative is not estimated."""
    height, width, channels = shape
    y, x, c = np.mgrid[0:height, 0:width, 0:channels]
    w = 1.2 + np.sin((0.7 - 0.2 * c) * x + (0.1 + 0.2 * c) * y + c)
    if alpha:
        w[..., -1] = 0
    return (w / w.size).astype(np.float32)


def loaded(moving: Moving, folder: Path) -> Objective:
    gc.collect()  # of scenes that go while a kernel is traced, Dr.Jit loses count, and ends the process
    if isinstance(moving.scene, str):
        (folder / "scene.xml").write_text(moving.scene, encoding="utf-8")
        scene = mi.load_file(str(folder / "scene.xml"), optimize=moving.optimize)
    else:
        scene = mi.load_dict(moving.scene, optimize=moving.optimize)
    objective = Objective(scene, mi.traverse(scene), moving.key, moving.move, moving.sensor)
    image = mi.load_dict({"type": "path", "max_depth": 2}).render(scene, objective.sensor, spp=1)
    objective.weigh(weights(image.shape, bool(mi.has_flag(objective.sensor.film().flags(), mi.FilmFlags.Alpha))))
    return objective


def measured(moving: Moving, folder: Path, seeds: int = 8, **options: Any) -> Measured:
    """Interior and edges, by reverse mode, and finite differences of Mitsuba's images; ``options`` are for ours."""
    objective = loaded(moving, folder)
    common = {"max_depth": moving.depth, "rr_depth": NEVER, **moving.options}
    ours = mi.load_dict({"type": "pathreplay", "boundary": "all", **common, **options})
    plain = mi.load_dict({"type": moving.reference, **common, "rr_depth": NEVER})
    numbers = range(1, seeds + 1)
    try:
        g = np.array([objective.backward(ours, seed, moving.spp) for seed in numbers])
        tangent = objective.forward(ours, 1, moving.spp)
        differences = [objective.difference(plain, WIDE, moving.step, 1000 + n, 4 * moving.spp) for n in numbers]
    finally:
        objective.put(dr.opaque(mi.Float, 0))
    transpose = abs(objective.dot(tangent) - g[0]) / objective.dot(np.abs(tangent))
    return Measured(g, np.array([objective.dot(image) for image in differences]), transpose)


#: For quick tests of noise far below the limit: few passes, and a lower limit instead.
FEW: dict[str, Any] = {"passes": 8, "most": 0.5}


def hold_quiet(moving: Moving, folder: Path, passes: int = 24, spp: int = 32, most: float = 1.0) -> None:
    """The noise of a gradient to be below that of a difference, whose pictures have as many samples each.

    The ratio of the two variances has to be below ``most``.
    """
    objective = loaded(moving, folder)
    ours = mi.load_dict({"type": "pathreplay", "max_depth": moving.depth})
    plain = mi.load_dict({"type": moving.reference, "max_depth": moving.depth, "rr_depth": NEVER})
    g = [objective.backward(ours, seed, spp) for seed in range(passes)]
    d = [objective.dot(objective.difference(plain, CENTRAL, moving.step, seed, spp)) for seed in range(passes)]
    objective.put(dr.opaque(mi.Float, 0))
    assert np.var(g) < most * np.var(d), (np.std(g), np.std(d))


# ------------------------------ Parts ------------------------------


def torus(n: int = 24, m: int = 12, thick: float = 0.35) -> Patch:
    """A ring about the z axis, with its normals and texture coordinates."""
    i, j = (axis.ravel() for axis in np.meshgrid(np.arange(n), np.arange(m), indexing="ij"))
    a, b = 2 * np.pi * i / n, 2 * np.pi * j / m
    normals = np.stack([np.cos(a) * np.cos(b), np.sin(a) * np.cos(b), np.sin(b)], 1)
    ring = np.stack([np.cos(a), np.sin(a), 0 * a], 1)
    at = lambda i, j: (i % n) * m + j % m  # noqa: E731
    p, q, r, s = at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)
    faces = np.concatenate([np.stack([p, q, r], 1), np.stack([p, r, s], 1)])
    return Patch(0.75 * ring + thick * normals, normals, np.stack([i / n, j / m], 1), faces)


def quad() -> Patch:
    """The square [-1, 1]² as two triangles, as lamps come out of modelling programs."""
    p = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    return Patch(p, np.tile([0.0, 0, 1], (4, 1)), (p[:, :2] + 1) / 2, np.array([[0, 1, 2], [0, 2, 3]]))


def painted(reflectance: dict) -> dict:
    return {"type": "twosided", "inner": {"type": "diffuse", "reflectance": reflectance}}


def grey(*value: float) -> dict:
    return painted(rgb(*value))


PAINT = grey(0.6, 0.4, 0.3)
OVERHEAD = T().look_at([1.6, 2.2, 2.0], [0, 0, -0.5], [0, 1, 0])


def film(**more: Any) -> dict:
    return {"type": "hdrfilm", "width": SIZE, "height": SIZE, "pixel_format": "rgb", "rfilter": {"type": "box"}, **more}


def sensor(kind: str = "perspective", place: Any = None, **more: Any) -> dict:
    place = place or T().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    lens = {} if kind == "orthographic" else {"fov": 40}
    return {"type": kind, "to_world": place, "film": film(), **lens, **more}


def panel(**more: Any) -> dict:
    glow = {"type": "area", "radiance": rgb(12, 10, 8)}
    return {"type": "rectangle", "to_world": OVERHEAD @ T().scale(0.4), "bsdf": grey(0, 0, 0), "emitter": glow, **more}


def box(bsdf: dict | None = None, place: Any = None) -> dict:
    place = place or T().translate([0.1, 0, 0.1]).rotate([1, 0.4, 0], 30).scale(0.45)
    return {"type": "cube", "to_world": place, "bsdf": bsdf or PAINT}


def room(camera: dict | None = None, light: dict | None = None, **parts: Any) -> dict:
    """A box before a patterned wall, and its shadow there."""
    pattern = {"type": "diffuse", "reflectance": {**bitmap(noise(8, 3, 0.2, 0.9)), "filter_type": "bilinear"}}
    wall = {"type": "rectangle", "to_world": T().translate([0, 0, -1]).scale([3, 3, 1]), "bsdf": pattern}
    light = panel() if light is None else light
    return {"type": "scene", "camera": camera or sensor(), "wall": wall, "box": box(), "lamp": light, **parts}


def mesh(folder: Path, shape: Patch, name: str = "Cube.001.ply", **more: Any) -> dict:
    """As a PLY or OBJ file, by its name; ``normals`` and ``coordinates`` say what is in the file."""
    about = {key: more.pop(key) for key in ("normals", "coordinates") if key in more}
    write = write_ply if name.endswith("ply") else write_obj
    write(folder / name, shape, **about)
    return {"type": name[-3:], "filename": str(folder / name), "bsdf": PAINT, **more}


# ------------------------------ Meshes ------------------------------

BOX = "box.vertex_positions"
TURN, ASIDE = turn_vertices(0.3, 1, 0), translate_vertices(1, 0.3, 0)
TILT = T().rotate([1, 0.2, 0], 60)


def blender(folder: Path) -> Moving:
    use = ordinary_scenes.from_blender(folder)
    return Moving(use.xml, "elm__Würfel.001.vertex_positions", TURN)


def obj_with_everything(folder: Path) -> Moving:
    return Moving(ordinary_scenes.obj_with_everything(folder).xml, "patch.vertex_positions", TURN)


def plain_obj(folder: Path) -> Moving:
    return Moving(ordinary_scenes.plain_obj(folder).xml, "patch.vertex_positions", TURN)


def principled_ply(folder: Path) -> Moving:
    return Moving(ordinary_scenes.principled_ply(folder).xml, "patch.vertex_positions", TURN)


def smooth_torus(folder: Path) -> Moving:
    """Hides parts of itself, and shades as if it were smooth."""
    ring = mesh(folder, torus(), "Torus.001.ply", normals=True, coordinates=True, to_world=TILT)
    return Moving(room(box=ring), BOX, TURN)


def smooth_torus_before_sky(folder: Path) -> Moving:
    ring = mesh(folder, torus(), "Torus.obj", normals=True, to_world=TILT)
    return Moving({"type": "scene", "camera": sensor(), "box": ring, "sky": sky()}, BOX, TURN)


def flat_torus(folder: Path) -> Moving:
    """Facets without normals."""
    ring = mesh(folder, torus(), "Torus.002.obj", face_normals=True, to_world=TILT)
    return Moving(room(box=ring), BOX, TURN)


def fine_torus(folder: Path) -> Moving:
    """Facets smaller than a pixel."""
    ring = mesh(folder, torus(96, 48), "Torus.003.ply", face_normals=True, to_world=TILT)
    return Moving(room(box=ring), BOX, TURN)


def cornell(folder: Path) -> Moving:
    """As Mitsuba has it, gaussian filter included."""
    scene = mi.cornell_box()
    scene["sensor"]["film"].update(width=SIZE, height=SIZE)
    return Moving(scene, "small-box.vertex_positions", ASIDE, depth=6)


def merged(folder: Path) -> Moving:
    """Meshes with one material become one mesh."""
    return Moving(room(box=box(PAINT), lid=box(PAINT, T().translate([-0.7, 0.6, 0]).scale(0.2))), "camera.to_world",
                  translate(1, 0.3, 0), optimize=True)  # fmt: skip


def copies(folder: Path) -> Moving:
    group = {"type": "shapegroup", "box": box(place=T().rotate([1, 0.4, 0], 30).scale(0.35))}
    one, two = (
        {"type": "instance", "to_world": T().translate([x, 0, 0]), "group": {"type": "ref", "id": "group"}}
        for x in (-0.5, 0.6)
    )
    scene = {**room(), "group": group, "one": one, "two": two}
    del scene["box"]
    return Moving(scene, "group.box.vertex_positions", TURN)


# ------------------------------ Films and cameras ------------------------------


def seen_by(camera: dict, **more: Any) -> Write:
    return lambda folder: Moving(room(camera), BOX, ASIDE, **more)


def moved_camera(camera: dict, **more: Any) -> Write:
    return lambda folder: Moving(room(camera), "camera.to_world", translate(1, 0.3, 0), **more)


WINDOW = {"crop_offset_x": 4, "crop_offset_y": 3, "crop_width": 8, "crop_height": 10}
UPRIGHT = T().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]).scale([1.4, 1.4, 1])
LENS = {"aperture_radius": 0.15, "focus_distance": 3.0}


def second_sensor(folder: Path) -> Moving:
    other = sensor(place=T().look_at([1.5, 1, 3.5], [0, 0, 0], [0, 1, 0]))
    return Moving(room(other=other), BOX, ASIDE, sensor=1)


# ------------------------------ Lights ------------------------------


def sky() -> dict:
    return {"type": "envmap", "bitmap": mi.Bitmap(noise(16, 3, 0.1, 2.0, 5)[:8].astype(np.float32))}


def lit_by(light: dict, key: str = BOX, move: Move = ASIDE, **more: Any) -> Write:
    return lambda folder: Moving(room(light=light), key, move, **more)


def mesh_lamp(key: str) -> Write:
    def write(folder: Path) -> Moving:
        place = OVERHEAD @ T().scale(0.4)
        glow = {"type": "area", "radiance": rgb(12, 10, 8)}
        light = mesh(folder, quad(), "Area Light.ply", to_world=place, emitter=glow, bsdf=grey(0, 0, 0))
        return Moving(room(light=light), key, ASIDE)

    return write


def cube_lamp(folder: Path) -> Moving:
    glow = {"type": "area", "radiance": rgb(4, 3, 2)}
    place = T().translate([1.2, 1.5, 1.5]).rotate([1, 1, 0], 40).scale(0.3)
    return Moving(room(light={"type": "cube", "to_world": place, "emitter": glow}), BOX, ASIDE)


def two_lamps(folder: Path) -> Moving:
    other = panel(to_world=T().look_at([-2, 0.5, 1.5], [0, 0, -0.5], [0, 1, 0]).scale(0.3))
    return Moving(room(other=other), BOX, ASIDE)


def lamp_and_sky(folder: Path) -> Moving:
    return Moving(room(sky={"type": "constant", "radiance": rgb(0.4, 0.5, 0.7)}), BOX, ASIDE)


AT = {"point": {"position": [1.6, 2.2, 2.0]}, "spot": {"to_world": OVERHEAD, "cutoff_angle": 40},
      "directional": {"direction": [-1.6, -2.2, -2.5]}}  # fmt: skip


def hard(kind: str) -> Write:
    """A light without extent, whose shadows have hard edges."""
    name = "irradiance" if kind == "directional" else "intensity"
    return lit_by({"type": kind, **AT[kind], name: rgb(9, 8, 7)}, depth=2)


def moved_light(kind: str, move: Move, key: str = "lamp.to_world") -> Write:
    """A light without extent that moves, and its shadows with it."""
    name = "irradiance" if kind == "directional" else "intensity"
    return lit_by({"type": kind, **AT[kind], name: rgb(9, 8, 7)}, key, move, depth=2)


def projector(folder: Path) -> Moving:
    light = {"type": "projector", "to_world": OVERHEAD, "fov": 50, "irradiance": bitmap(noise(8, 3, 2, 9))}
    return Moving(room(light=light), BOX, ASIDE, depth=2)


def hidden(folder: Path) -> Moving:
    lamp = panel(to_world=T().translate([-0.5, 0.5, 0.8]).scale(0.3))
    back = {"type": "rectangle", "to_world": T().translate([0.3, 1.2, 2.5]).rotate([1, 0, 0], 160).scale(0.4),
            "emitter": {"type": "area", "radiance": rgb(12, 10, 8)}}  # fmt: skip
    return Moving(room(light=lamp, back=back), BOX, ASIDE, options={"hide_emitters": True})


def hidden_sky(folder: Path) -> Moving:
    scene = {"type": "scene", "camera": sensor(), "box": box(), "sky": sky()}
    return Moving(scene, BOX, ASIDE, options={"hide_emitters": True})


# ------------------------------ Materials ------------------------------


def normal_map(folder: Path) -> Moving:
    texels = np.concatenate([noise(8, 2, 0.4, 0.6), np.full((8, 8, 1), 0.95)], -1)
    bumpy = {"type": "normalmap", "normalmap": bitmap(texels), "nested": {"type": "diffuse"}}
    return Moving(room(box=box(bumpy)), BOX, TURN)


def made_of(name: str, depth: int = 3, **more: Any) -> Write:
    return lambda folder: Moving(room(box=box({"type": name, **more})), BOX, TURN, depth)


def painted_lamp(folder: Path) -> Moving:
    """A lamp with a texture, in the view, that turns."""
    glow = {"type": "area", "radiance": bitmap(noise(8, 3, 1, 20))}
    lamp = panel(to_world=T().translate([-0.7, 0.6, 0.5]).rotate([0, 1, 0], 25).scale(0.4), emitter=glow)
    return Moving(room(light=lamp), "lamp.to_world", rotate(0.3, 1, 0))


def seen_through(opacity: Any) -> Write:
    """A sheet that lets a part of the light through, without an outline of its own inside."""

    def write(folder: Path) -> Moving:
        veil = {"type": "mask", "opacity": opacity(), "bsdf": PAINT}
        sheet = {"type": "rectangle", "to_world": T().translate([0.2, 0.1, 0.4]).rotate([0, 1, 0], 20).scale(0.6)}
        return Moving(room(box={**sheet, "bsdf": veil}), "box.to_world", translate(1, 0.3, 0))

    return write


def shaped(**shape: Any) -> Write:
    """Another shape than a mesh in place of the box."""
    return lambda folder: Moving(room(box={"bsdf": PAINT, **shape}), "box.to_world", translate(1, 0.3, 0))


def curve(folder: Path) -> Moving:
    """A bent tube, before which the camera moves."""
    points = np.array([[-0.9, -0.6, 0.1], [-0.5, 0.3, 0.3], [0, -0.2, 0.5], [0.5, 0.5, 0.2], [0.9, -0.4, 0]])
    (folder / "tube.txt").write_text("\n".join(f"{x} {y} {z} 0.15" for x, y, z in points))
    tube = {"type": "bsplinecurve", "filename": str(folder / "tube.txt"), "bsdf": PAINT}
    return Moving(room(box=tube), "camera.to_world", translate(1, 0.3, 0))


def deep(folder: Path) -> Moving:
    return Moving(room(), BOX, TURN, depth=6)


def by_roulette(folder: Path) -> Moving:
    return Moving(room(), BOX, TURN, depth=6, options={"rr_depth": 2})


def mono(folder: Path) -> Moving:
    """A grey world, written into a film of one channel."""
    return Moving(room(sensor(film=film(pixel_format="luminance"))), BOX, ASIDE)


def spectral(folder: Path) -> Moving:
    """Spectra by wavelength; the film has three colours."""
    glow = {"type": "area", "radiance": {"type": "spectrum", "value": [(400, 4), (550, 12), (700, 8)]}}
    return Moving(room(light=panel(emitter=glow)), BOX, ASIDE)


SCENES: dict[str, Write] = {
    "blender": blender,
    "obj_with_everything": obj_with_everything,
    "plain_obj": plain_obj,
    "principled_ply": principled_ply,
    "smooth_torus": smooth_torus,
    "smooth_torus_before_sky": smooth_torus_before_sky,
    "flat_torus": flat_torus,
    "fine_torus": fine_torus,
    "cornell": cornell,
    "merged": merged,
    "copies": copies,
    "gaussian": seen_by(sensor(film=film(rfilter={"type": "gaussian"}))),
    "mitchell": seen_by(sensor(film=film(rfilter={"type": "mitchell"}, sample_border=True))),
    "crop": seen_by(sensor(film=film(**WINDOW))),
    "crop_gaussian": seen_by(sensor(film=film(rfilter={"type": "gaussian"}, **WINDOW))),
    "rgba": seen_by(sensor(film=film(pixel_format="rgba"))),
    "luminance": seen_by(sensor(film=film(pixel_format="luminance"))),
    "stratified": seen_by(sensor(sampler={"type": "stratified", "sample_count": 64})),
    "thinlens": seen_by(sensor("thinlens", **LENS)),
    "thinlens_moves": moved_camera(sensor("thinlens", **LENS)),
    "orthographic": seen_by(sensor("orthographic", UPRIGHT)),
    "orthographic_moves": moved_camera(sensor("orthographic", UPRIGHT)),
    "camera_turns": lambda folder: Moving(room(), "camera.to_world", rotate(0.3, 1, 0)),
    "fov": lambda folder: Moving(room(), "camera.x_fov", add(10.0)),
    "second_sensor": second_sensor,
    "sky": lambda folder: Moving(room(light=sky()), BOX, ASIDE),
    "constant": lit_by({"type": "constant", "radiance": rgb(0.8, 0.9, 1)}),
    "lamp_and_sky": lamp_and_sky,
    "two_lamps": two_lamps,
    "mesh_lamp": mesh_lamp(BOX),
    "mesh_lamp_moves": mesh_lamp("lamp.vertex_positions"),
    "cube_lamp": cube_lamp,
    "lamp_moves": lambda folder: Moving(room(), "lamp.to_world", translate(1, 0.3, 0)),
    "point": hard("point"),
    "spot": hard("spot"),
    "directional": hard("directional"),
    "point_moves": moved_light("point", add([1.0, 0.3, 0.0]), "lamp.position"),
    "spot_moves": moved_light("spot", translate(1, 0.3, 0)),
    "directional_turns": moved_light("directional", rotate(0.3, 1, 0)),
    "sky_turns": lambda folder: Moving(room(light=sky()), "lamp.to_world", rotate(0.3, 1, 0)),
    "projector": projector,
    "painted_lamp": painted_lamp,
    "hidden": hidden,
    "hidden_sky": hidden_sky,
    "normal_map": normal_map,
    "plastic": made_of("plastic"),
    "roughplastic": made_of("roughplastic", alpha=0.2),
    "roughconductor": made_of("roughconductor", alpha=0.2),
    "principled": made_of("principled", roughness=0.3, metallic=0.5),
    "dielectric": made_of("dielectric", 6),
    "roughdielectric": made_of("roughdielectric", 6, alpha=0.3),
    "thindielectric": made_of("thindielectric", 6),
    "veil": seen_through(lambda: 0.5),
    "painted_veil": seen_through(lambda: {**bitmap(noise(8, 1, 0.2, 0.9)), "filter_type": "bilinear"}),
    "sphere": shaped(type="sphere", radius=0.5),
    "disk": shaped(type="disk", to_world=T().rotate([1, 1, 0], 40).scale(0.6)),
    "cylinder": shaped(type="cylinder", p0=[-0.5, -0.2, 0.1], p1=[0.5, 0.3, 0.3], radius=0.3),
    "curve": curve,
    "deep": deep,
    "by_roulette": by_roulette,
}

VARIANTS: dict[str, tuple[str, Write]] = {
    "mono": ("llvm_ad_mono", mono),
    "spectral": ("llvm_ad_spectral", spectral),
}
"""Those that need another variant, set before they are written."""
