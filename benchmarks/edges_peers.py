"""Compares derivatives with moving edges, ours and those of Mitsuba's `prb_projective`, with finite differences.

    python -m benchmarks.edges_peers [SCENE ...]

The command prints a table of the scenes below. The objective is a weighted mean of an image of 16 x 16 pixels, and
every scene has one motion. References are central differences of `path` with common random numbers. `prb_projective`
runs without guiding, which does not change its mean. A derivative counts as wrong if its error exceeds both four
standard errors and 3 %.
"""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.platform.backend import set_variant
from pathreplay.testing.objective import Objective
from pathreplay.testing.statistics import gap, mean_and_error
from pathreplay.testing.stencil import CENTRAL
from pathreplay.testing.verdict import Z_LIMIT

SceneDict = dict[str, Any]

RESOLUTION = 16
SEEDS, SPP = 8, 1024
REFERENCE_SEEDS, REFERENCE_SPP = 8, 8192
TOLERANCE = 0.03
"""Relative tolerance of a derivative: finite differences have an error of second order in their step."""
METHODS = {
    "pathreplay": {"type": "pathreplay", "boundary": "all", "sampling": "scene"},
    "prb_projective": {"type": "prb_projective", "guiding": "none"},
}


@dataclass(frozen=True)
class Scene:
    """A scene, and a motion of the object at a parameter with unit speed or unit angular speed."""

    build: Callable[[], SceneDict]
    key: str
    move: Callable[[], Any]  # transform as a function of t
    cause: str = ""  # reason for the error of `prb_projective`
    depth: int = 2
    step: float = 0.02


def moving(x: float, y: float, z: float) -> Callable[[], Any]:
    return lambda: lambda t: mi.Transform4f().translate(mi.Vector3f(x, y, z) * t)


def turning(x: float, y: float, z: float) -> Callable[[], Any]:
    return lambda: lambda t: mi.Transform4f().rotate([x, y, z], dr.rad2deg(t))


# ------------------------------ Parts ------------------------------


def T() -> Any:
    return mi.ScalarTransform4f()


def camera(fov: float) -> SceneDict:
    film = {"type": "hdrfilm", "width": RESOLUTION, "height": RESOLUTION, "rfilter": {"type": "box"}}
    return {"type": "perspective", "fov": fov, "to_world": T().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]), "film": film}


def rgb(*value: float) -> SceneDict:
    return {"type": "rgb", "value": list(value)}


def spots() -> SceneDict:
    texels = np.random.default_rng(3).uniform(0.1, 1, (8, 8, 3)).astype(np.float32)
    return {"type": "bitmap", "raw": True, "data": mi.TensorXf(texels)}


def diffuse(reflectance: SceneDict) -> SceneDict:
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}


def sheet(place: Any, reflectance: SceneDict, **more: Any) -> SceneDict:
    return {"type": "rectangle", "to_world": place, "bsdf": diffuse(reflectance), **more}


def lamp(place: Any, radiance: SceneDict) -> SceneDict:
    return sheet(place, rgb(0, 0, 0), emitter={"type": "area", "radiance": radiance})


def wall(reflectance: SceneDict) -> SceneDict:
    return sheet(T().translate([0, 0, -1]).scale([6, 6, 1]), reflectance)


def ceiling(radiance: float = 10.0) -> SceneDict:
    """An area light behind the camera, to the right."""
    place = T().translate([1.6, 1.2, 2.5]).look_at([0, 0, 0], [-1.6, -1.2, -3.5], [0, 1, 0]).scale([0.5, 0.5, 1])
    return lamp(place, rgb(radiance, radiance, radiance))


def occluder() -> SceneDict:
    return sheet(T().translate([1.3, 0.9, 1.2]).scale([0.35, 0.3, 1]), rgb(0, 0, 0))


def scene(fov: float = 45, **parts: SceneDict) -> SceneDict:
    return {"type": "scene", "camera": camera(fov), **parts}


def backdrop() -> SceneDict:
    """An emissive wall with a texture."""
    return lamp(T().translate([0, 0, -1]).scale([6, 6, 1]), spots())


def box(bsdf: SceneDict) -> SceneDict:
    """A cube with 24 vertices, none of which are shared between faces."""
    place = T().translate([0.1, 0.1, 0]).rotate([1, 0.4, 0], 30).scale(0.4)
    return {"type": "cube", "to_world": place, "face_normals": True, "bsdf": bsdf}


def welded_box(bsdf: SceneDict) -> mi.Mesh:
    """The same cube with 8 shared vertices."""
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    props = mi.Properties()
    props["face_normals"], props["bsdf"] = True, mi.load_dict(bsdf)
    mesh = mi.Mesh("box", 8, 12, props)
    params, place = mi.traverse(mesh), np.array(box(bsdf)["to_world"].matrix, np.float64)
    params["vertex_positions"] = np.ravel(corners @ place[:3, :3].T + place[:3, 3]).astype(np.float32)
    params["faces"] = np.ravel(faces).astype(np.uint32)
    params.update()
    return mesh


# ------------------------------ Scenes ------------------------------


def shadow(receiver: SceneDict | None = None) -> SceneDict:
    return scene(30, wall=receiver or wall(spots()), lamp=ceiling(), occluder=occluder())


def lamp_from_behind(place: Any, fov: float, other: float, radiance: float) -> SceneDict:
    moved = lamp(place, rgb(radiance, radiance, radiance))
    return scene(fov, wall=wall(spots()), lamp=moved, other=ceiling(other))


def under_sky() -> SceneDict:
    texels = np.random.default_rng(5).uniform(0.1, 2, (4, 8, 3)).astype(np.float32)
    sky = {"type": "envmap", "bitmap": mi.Bitmap(texels.repeat(4, axis=0).repeat(4, axis=1))}
    above = sheet(T().translate([0.9, 0.9, 0.2]).scale([0.8, 0.6, 1]), rgb(0, 0, 0))
    return scene(30, wall=wall(spots()), sky=sky, occluder=above)


def rough_mirror() -> SceneDict:
    """An occluder in front of a lit side wall, seen in a rough mirror."""
    mirror = {"type": "twosided", "bsdf": {"type": "roughconductor", "alpha": 0.3}}
    above = T().translate([0.6, 2.6, 0.5]).look_at([0, 0, 0], [1.6, -2.4, 0], [0, 0, 1]).scale([0.4, 0.4, 1])
    return scene(
        30,
        wall={"type": "rectangle", "to_world": T().translate([0, 0, -1]).scale([6, 6, 1]), "bsdf": mirror},
        side=sheet(T().translate([2.2, 0, 0]).rotate([0, 1, 0], -90).scale([2, 2, 1]), spots()),
        lamp=lamp(above, rgb(20, 20, 20)),
        occluder=sheet(T().translate([1.5, 0.2, 0.2]).rotate([0, 1, 0], 60).scale([0.5, 0.5, 1]), rgb(0.3, 0.3, 0.3)),
    )


def grey_box() -> SceneDict:
    return scene(wall=wall(spots()), lamp=ceiling(), box=welded_box(diffuse(rgb(0.5, 0.5, 0.2))))


def dark_sheet() -> SceneDict:
    """A black sheet in front of an emissive wall."""
    place = T().translate([0.7, 0.5, 0.9]).rotate([0, 0, 1], 20).scale([0.35, 0.3, 1])
    return scene(wall=backdrop(), sheet=sheet(place, rgb(0, 0, 0)))


ASIDE = moving(1, 0.3, 0)

SCENES = {
    "sheet before a glow": Scene(dark_sheet, "sheet.to_world", ASIDE),
    "glowing rectangle, unequal sides": Scene(
        lambda: scene(lamp=lamp(T().translate([0.1, 0.05, 0]).scale([0.4, 0.3, 1]), rgb(1, 1, 1))),
        "lamp.to_world",
        moving(1, 0, 0),
        "the sampling density of its sides differs from the reported one",
    ),
    "cube with split vertices turns": Scene(
        lambda: scene(wall=backdrop(), box=box(diffuse(rgb(0, 0, 0)))),
        "box.vertex_positions",
        turning(0, 1, 0),
        "every copy of an edge is counted",
    ),
    "lit cube turns": Scene(
        grey_box, "box.vertex_positions", turning(0, 1, 0), "creases are missing, and hidden faces shade outlines"
    ),
    "occluder of a shadow": Scene(shadow, "occluder.to_world", ASIDE, step=0.03),
    "emitter of a shadow": Scene(shadow, "lamp.to_world", ASIDE, step=0.03),
    "receiver of a shadow, along its normal": Scene(
        lambda: shadow(wall(rgb(0.7, 0.6, 0.5))),
        "wall.to_world",
        moving(0, 0, 1),
        "motion of the receiver is missing",
        step=0.03,
    ),
    "shadow under a sky": Scene(under_sky, "occluder.to_world", ASIDE, "same cause as glowing rectangle", step=0.01),
    "emitter, seen from its back, lights a wall": Scene(
        lambda: lamp_from_behind(T().translate([0.9, 0.8, 0.6]).rotate([0, 1, 0], 160).scale([0.4, 0.3, 1]), 30, 10, 5),
        "lamp.to_world",
        ASIDE,
        "the back of an emitter glows at its rim",
        step=0.03,
    ),
    "emitter, seen from its back, turned": Scene(
        lambda: lamp_from_behind(T().translate([0.2, 0.1, 0.3]).rotate([0, 1, 0], 200).scale([0.5, 0.4, 1]), 45, 6, 3),
        "lamp.to_world",
        ASIDE,
        "the rims of turned rectangles are not sampled",
    ),
    "occluder, seen in a rough mirror": Scene(rough_mirror, "occluder.to_world", moving(1, 0.3, 0.4), "", 3, 0.03),
    "camera": Scene(dark_sheet, "camera.to_world", ASIDE, "moving cameras are not supported"),
}


# ------------------------------ Measurement ------------------------------


class Estimate(NamedTuple):
    mean: float
    error: float
    z: float  # relative to the reference

    def wrong(self, reference: float) -> bool:
        return abs(self.z) > Z_LIMIT and abs(self.mean - reference) > TOLERANCE * abs(reference)


def measure(cell: Scene) -> tuple[Estimate, dict[str, Estimate | str]]:
    """The reference, and each method's estimate or error message."""
    gc.collect()
    loaded = mi.load_dict(cell.build(), optimize=False)
    by = cell.move()

    def move(value: Any, t: Any) -> Any:
        if cell.key.endswith("vertex_positions"):
            return dr.ravel(by(t) @ dr.unravel(mi.Point3f, value))
        return by(t) @ mi.Transform4f(value)

    objective = Objective(loaded, mi.traverse(loaded), cell.key, move)
    limits = {"max_depth": cell.depth, "rr_depth": 100}
    plain = mi.load_dict({"type": "path"} | limits)
    objective.weigh(weights())
    images = (objective.difference(plain, CENTRAL, cell.step, 1000 + k, REFERENCE_SPP) for k in range(REFERENCE_SEEDS))
    differences = np.array([objective.dot(image) for image in images])
    estimates: dict[str, Estimate | str] = {}
    for name, plugin in METHODS.items():
        integrator = mi.load_dict(plugin | limits)
        try:
            samples = np.array([objective.backward(integrator, 1 + k, SPP) for k in range(SEEDS)])
        except Exception as error:
            estimates[name] = str(error).splitlines()[0]
            continue
        estimates[name] = Estimate(*mean_and_error(samples), gap(samples, differences).z)
    objective.put(mi.Float(0))
    return Estimate(*mean_and_error(differences), 0.0), estimates


def weights() -> np.ndarray:
    """Smooth asymmetric pixel weights, equal for all channels so that grey contributions do not cancel."""
    y, x, _ = np.mgrid[0:RESOLUTION, 0:RESOLUTION, 0:3] / RESOLUTION
    w = 1 + np.cos(2 * np.pi * (1.4 * x + 0.4 * y) + 1)
    return w / w.size


def estimate_cell(estimate: Estimate | str, reference: float) -> str:
    if isinstance(estimate, str):
        return "raises"
    text = f"{estimate.mean:+.5f} ± {estimate.error:.5f} (z {estimate.z:+.1f})"
    return f"{text} **wrong**" if estimate.wrong(reference) else text


def main(names: list[str]) -> None:
    """Print the table, row by row."""
    set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    print(f"| what moves | finite differences | {' | '.join(METHODS)} | why |\n|{' --- |' * (3 + len(METHODS))}")
    for name in names or SCENES:
        reference, estimates = measure(SCENES[name])
        cells = [f"{reference.mean:+.5f} ± {reference.error:.5f}"]
        cells += [estimate_cell(estimate, reference.mean) for estimate in estimates.values()]
        print(f"| {' | '.join([name, *cells, SCENES[name].cause])} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
