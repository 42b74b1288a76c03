"""Exports an emissive density grid that a run has recovered as a scene for plain Mitsuba: a mesh that emits light."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from pathlib import Path

import mitsuba as mi
import numpy as np
import scipy.ndimage

from pathreplay.errors import PathreplayError
from pathreplay.inverse.dataset.capture import read_capture
from pathreplay.inverse.images.io import encoded, exr_bytes, picture_size, read_image, with_channels
from pathreplay.inverse.parameters.values import Arrays
from pathreplay.output.export import OPTION, opened_run
from pathreplay.output.surfaces import surface
from pathreplay.platform import compat
from pathreplay.platform.atomic_files import whole_folder
from pathreplay.platform.threads import spare_thread
from pathreplay.runs.run_folder import Job
from pathreplay.scenes.loading import load_scene
from pathreplay.types import SceneDict

DENSITY, RADIANCE, SKY = ".sigma_t.data", ".radiance.data", "sky.data"
THICKNESSES = (8.0, 4.0, 2.0, 1.0)
"""Numbers of voxels over which the density at the surface has an optical depth of 1; the first is the default."""
DEPTH = 0.75
"""Depth below the surface, in voxels, at which its colour is read."""
COMPARED, SPP = 6, 16
"""Number of views in which candidates are compared with the photos, and samples per pixel of their images."""
SMOOTH, SMOOTH_COLOUR = 1.0, 0.5
"""Standard deviations of the Gaussians with which noise of density and colours is removed, in voxels."""


def export_surface(run: Path, output: Path | None = None) -> str:
    """Export the surface of a recovered density grid, with its radiance as a colour per vertex.

    The folder contains `scene.xml`, the mesh as PLY, and the sky. Mitsuba renders the scene with `path` and without
    this package. For each thickness in `THICKNESSES`, the surface is extracted and rendered in up to `COMPARED` views.
    The surface whose images are closest to the photos, up to a factor per colour, is exported. Parts of the grid with a
    lower density than the surface are left out.

    Args:
        run: run folder of a job that recovered `sigma_t` and `radiance` of one `gridmedium`.
        output: new folder; default: ``surface`` in the run folder.

    Returns:
        Lines for the user.

    Raises:
        PathreplayError: the run has no such result, or no part of the grid is dense enough.
    """
    folder = run / "surface" if output is None else output
    job, values = opened_run(run, folder)
    density, radiance = (
        next((value for key, value in values.items() if key.endswith(ending)), None) for ending in (DENSITY, RADIANCE)
    )
    if density is None or radiance is None:
        raise PathreplayError(f"Run {run} recovered no density grid with a radiance; use pathreplay export")
    low, size = _placed(run, job)
    cameras = _cameras(job, values)
    views = _compared(run, cameras)
    tried = THICKNESSES if views else THICKNESSES[:1]
    meshes = (emitting_mesh(density[..., 0], radiance, low, size, thickness) for thickness in tried)
    with whole_folder(folder, OPTION) as part:
        if SKY in values:
            (part / "sky.exr").write_bytes(exr_bytes(values[SKY]))
        (part / "scene.xml").write_text(surface_xml([camera for camera, _ in views], SKY in values))

        def error(mesh: mi.Mesh) -> float:
            mesh.write_ply(str(part / "surface.ply"))
            return _error(part / "scene.xml", [target for _, target in views])

        mesh = min((mesh for mesh in meshes if mesh.face_count()), key=error, default=None)
        if mesh is None:
            raise PathreplayError(f"The density grid of run {run} is empty; run more iterations")
        mesh.write_ply(str(part / "surface.ply"))
        (part / "scene.xml").write_text(surface_xml(cameras, SKY in values))
    scene = folder / "scene.xml"
    return (
        f"{scene}: {mesh.face_count()} triangles that emit light; render it with "
        f"`pathreplay render {shlex.quote(str(scene))} -o scene.exr --sensor 0`, or open it in Mitsuba"
    )


def _placed(run: Path, job: Job) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower corner and the size of the box of the medium."""
    scene = load_scene(job.config.scene, job.base, **job.config.scene_parameters)
    boxes = [shape.bbox() for shape in scene.shapes() if shape.interior_medium() is not None]
    if len(boxes) != 1:
        raise PathreplayError(
            f"Scene {job.config.scene} has {len(boxes)} shapes with a medium, but a surface is made of exactly one; "
            f"write the whole scene with: pathreplay export {shlex.quote(str(run))}"
        )
    return np.array(boxes[0].min, np.float64).ravel(), np.array(boxes[0].extents(), np.float64).ravel()


def _compared(run: Path, cameras: list[SceneDict]) -> list[tuple[SceneDict, np.ndarray]]:
    """Return pairs of a camera and its photo, for at most `COMPARED` cameras whose photos the run has saved.

    The cameras are evenly spaced in the order of the capture.
    """
    found = [(camera, path) for camera in cameras if (path := run / "images" / f"target-{camera['id']}.exr").is_file()]
    views = []
    for camera, path in found[:: -(-len(found) // COMPARED) or 1]:
        target = with_channels(read_image(path), 3)
        if target is None:
            continue
        film = {**camera["film"], "width": target.shape[1], "height": target.shape[0]}
        views.append(({**camera, "film": film}, target))
    return views


def _error(scene: Path, targets: list[np.ndarray]) -> float:
    """Return the L1 error of the images of a scene, summed over its sensors, in sRGB-encoded values.

    Each image is first multiplied by one factor per colour, so that its mean colour is that of its target.
    """
    with spare_thread():
        loaded, error = mi.load_file(str(scene)), 0.0
    for k, target in enumerate(targets):
        image = np.array(mi.render(loaded, sensor=k, spp=SPP))
        gain = target.mean((0, 1)) / np.maximum(image.mean((0, 1)), 1e-6)
        error += float(np.abs(encoded(gain * image) - encoded(target)).mean())
    return error


def emitting_mesh(
    density: np.ndarray,
    radiance: np.ndarray,
    low: np.ndarray,
    size: np.ndarray,
    thickness: float = THICKNESSES[0],
) -> mi.Mesh:
    """Make the mesh of a grid, with the vertex attribute ``vertex_color``.

    Args:
        density: extinction per length, shape (z, y, x).
        radiance: radiance of an optically thick medium, shape (z, y, x, 3).
        low: lower corner of the grid in world space.
        size: size of the grid in world space.
        thickness: number of voxels over which the density at the surface has an optical depth of 1.
    """
    voxel = size / density.shape[::-1]
    level = 1 / (thickness * float(voxel.mean()))
    smooth = scipy.ndimage.gaussian_filter(density, SMOOTH)
    thick = scipy.ndimage.gaussian_filter(density, SMOOTH_COLOUR)
    emitted = scipy.ndimage.gaussian_filter(density[..., None] * radiance, (*3 * (SMOOTH_COLOUR,), 0))
    points, triangles = surface(smooth, level)
    slopes = np.stack([_at(component, points) for component in np.gradient(smooth)][::-1], axis=1)
    lengths = np.linalg.norm(slopes, axis=1, keepdims=True)
    inner = points + DEPTH * np.divide(slopes, lengths, out=np.zeros_like(slopes), where=lengths > 0)
    weight = np.maximum(_at(thick, inner), 1e-6 * level)  # the colour is a mean that is weighted by density
    colours = np.stack([_at(emitted[..., k], inner) / weight for k in range(3)], axis=1)
    mesh = compat.new_mesh(low + (points + 0.5) * voxel, triangles, mi.Properties(), flat=True)
    mesh.add_attribute("vertex_color", 3, np.maximum(colours, 0).astype(np.float32).ravel())
    return mesh


def _at(values: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Interpolate a grid (z, y, x) at points (x, y, z)."""
    return scipy.ndimage.map_coordinates(values.astype(np.float64), points[:, ::-1].T, order=1, mode="nearest")


def _cameras(job: Job, values: Arrays) -> list[SceneDict]:
    """Return the cameras of the capture, with the poses that the run has recovered."""
    if job.config.capture is None:
        return []
    shots = read_capture(job.config.capture, job.base, picture_size)
    poses = {name: values[key] for name in shots if (key := f"{name}.to_world") in values}
    places = {name: {"to_world": mi.ScalarTransform4f(pose.astype(np.float64))} for name, pose in poses.items()}
    return [{**shot.camera, **places.get(name, {})} for name, shot in shots.items()]


def surface_xml(cameras: Iterable[SceneDict], has_sky: bool) -> str:
    """Return the scene of `surface.ply`, which emits its vertex colours, with cameras and possibly `sky.exr`."""
    sky = (
        '  <emitter type="envmap" id="sky">\n    <string name="filename" value="sky.exr"/>\n  </emitter>\n'
        if has_sky
        else ""
    )
    return (
        '<scene version="3.0.0">\n'
        '  <integrator type="path">\n    <integer name="max_depth" value="1"/>\n  </integrator>\n'
        + "".join(map(_sensor, cameras))
        + '  <shape type="ply" id="surface">\n'
        '    <string name="filename" value="surface.ply"/>\n'
        '    <bsdf type="diffuse">\n      <rgb name="reflectance" value="0"/>\n    </bsdf>\n'
        '    <emitter type="area">\n'
        '      <texture type="mesh_attribute" name="radiance">\n'
        '        <string name="name" value="vertex_color"/>\n'
        "      </texture>\n"
        "    </emitter>\n"
        "  </shape>\n" + sky + "</scene>\n"
    )


def _sensor(camera: SceneDict) -> str:
    film = camera["film"]
    matrix = " ".join(f"{x:.9g}" for x in np.array(camera["to_world"].matrix).ravel())
    numbers = "".join(
        f'    <float name="{name}" value="{camera[name]:.9g}"/>\n'
        for name in ("fov", "near_clip", "far_clip", "principal_point_offset_x", "principal_point_offset_y")
    )
    return (
        f'  <sensor type="perspective" id="{camera["id"]}">\n    <string name="fov_axis" value="x"/>\n{numbers}'
        f'    <transform name="to_world">\n      <matrix value="{matrix}"/>\n    </transform>\n'
        '    <film type="hdrfilm">\n'
        f'      <integer name="width" value="{film["width"]}"/>\n'
        f'      <integer name="height" value="{film["height"]}"/>\n'
        '      <string name="pixel_format" value="rgb"/>\n      <rfilter type="box"/>\n    </film>\n'
        "  </sensor>\n"
    )
