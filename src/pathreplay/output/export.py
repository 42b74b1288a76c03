"""The command `pathreplay export`: writes the results of a run, and the whole scene, in standard formats."""

from __future__ import annotations

import io
import json
import math
import shlex
import shutil
from pathlib import Path

import mitsuba as mi
import numpy as np
import safetensors
import safetensors.numpy

from pathreplay.errors import PathreplayError
from pathreplay.inverse.dataset.capture import FACING, read_capture
from pathreplay.inverse.images.io import picture_size, png_bytes
from pathreplay.inverse.parameters.exposures import EXPOSURE
from pathreplay.inverse.parameters.pose import PART_NAMES
from pathreplay.inverse.parameters.response import RESPONSE
from pathreplay.inverse.parameters.values import Arrays
from pathreplay.output.scene_folder import SCENE, Exported, Source, exported, require_same
from pathreplay.platform import backend, compat
from pathreplay.platform.atomic_files import whole_folder
from pathreplay.platform.files import file_names
from pathreplay.runs.run_folder import IN_MEMORY, Job, read_job, require_writable_name, resume_command
from pathreplay.scenes.builtin import BUILTINS
from pathreplay.scenes.descriptions import load_integrator
from pathreplay.scenes.loading import as_xml_has_them, builtin_dict
from pathreplay.scenes.parameters import get_array
from pathreplay.types import Json

OPTION = "-o"


def export_run(run: Path, output: Path | None = None) -> str:
    """Export the scene of a run with its final values.

    The folder contains `scene.xml` and the files that it references (textures as EXR, grids as `.vol`, meshes as PLY).
    Recovered textures and meshes are also written as PNG and OBJ, cameras as `transforms.json`, and small values to
    `values.json`. Large parameters that are not part of the scene are written as NPY. The function activates the
    variant of the run.

    Args:
        run: run folder.
        output: new or empty folder to write to; the default is ``export`` in the run folder.

    Returns:
        Lines for the user: the command that renders the scene, the written files, and notes.

    Raises:
        PathreplayError: ``run`` is not a run folder, has no result, or cannot be exported. In these cases nothing is
            written.
    """
    folder = run / "export" if output is None else output
    job, values = opened_run(run, folder)
    source = _source(job, values)
    photographic = {key: values.pop(key) for key in (EXPOSURE, RESPONSE) if key in values}
    free = {entry.key: values.pop(entry.key) for entry in job.config.parameters if entry.shape is not None}
    export = exported(source, values, _integrator(job))
    with whole_folder(folder, OPTION) as part:
        write_files(export, part)
        for name, data in _beside(export, values | photographic, free).items():
            (part / name).parent.mkdir(exist_ok=True)
            (part / name).write_bytes(data)
        require_same(export.scene, part)
    files = sorted([*export.files, *export.copies])
    # Do not suggest the command `mitsuba`: it loads the system's newest LLVM, and some versions of LLVM crash Mitsuba.
    render = f"pathreplay render {shlex.quote(str(folder / SCENE))} -o scene.exr --variant {mi.variant()}"
    lines = [f"{folder / SCENE}: render it with `{render}`"]
    lines += [f"{folder / name}" for name in files if name != SCENE and not name.startswith("files/")]
    return "\n".join([*lines, *(f"pathreplay: {note}" for note in export.notes)])


def write_files(export: Exported, folder: Path) -> None:
    """Write the scene and its files into an existing folder. Raises PathreplayError if a file cannot be copied."""
    for name in [*export.files, *export.copies]:
        (folder / name).parent.mkdir(exist_ok=True)
    for name, data in export.files.items():
        (folder / name).write_bytes(data)
    for name, path in export.copies.items():
        try:
            shutil.copyfile(path, folder / name)
        except OSError as error:
            raise PathreplayError(f"File {path} of the scene cannot be copied ({error.strerror})") from error


def opened_run(run: Path, folder: Path) -> tuple[Job, dict[str, np.ndarray]]:
    """Read the job and the result of a run, and activate the variant of the run.

    Raises PathreplayError unless ``run`` is a run folder with a result, and the name of the new ``folder`` is valid.
    """
    require_writable_name(run, "RUN")
    require_writable_name(folder, OPTION)
    job = read_job(run)
    backend.set_variant(job.config.variant)
    return job, run_result(run, job.in_python)


def run_result(run: Path, in_python: bool) -> dict[str, np.ndarray]:
    """Return the decoded parameter values at the end of a run.

    ``in_python`` says whether the job has Python objects. Raises PathreplayError if the run has no result.
    """
    path = run / "parameters.safetensors"
    if not path.is_file():
        raise PathreplayError(
            f"Run {run} has no result yet (no {path.name}); end it with Ctrl-C, which writes the result, or resume "
            f"with: {resume_command(run, in_python)}"
        )
    try:
        values = safetensors.numpy.load_file(str(path))
    except (safetensors.SafetensorError, OSError, ValueError) as error:
        raise PathreplayError(f"Result {path} cannot be read ({error}); resume the run, which writes it") from None
    # Omit the translation and rotation of poses, whose resulting transform or vertices have a key of their own.
    return {k: v for k, v in values.items() if not k.endswith(PART_NAMES)}


def _source(job: Job, values: Arrays) -> Source:
    config = job.config
    film = "rgba" if config.target.alpha == "compare" else "rgb"
    shots = {} if config.capture is None else read_capture(config.capture, job.base, picture_size, film)
    cameras = {name: shot.camera for name, shot in shots.items()}
    medium = None if config.capture is None else config.capture.medium
    plugins = {"dielectric": "dielectric_ad"} if any(key.endswith(".eta") for key in values) else {}
    if job.in_python and config.scene == IN_MEMORY:
        raise PathreplayError(
            "The run was started in Python with a scene object; set the values of a scene with result.apply(scene)"
        )
    if config.scene in BUILTINS:
        return Source(builtin_dict(config.scene, config.scene_parameters), {}, plugins, cameras, medium=medium)
    path = job.base / config.scene
    if not path.is_file():
        raise PathreplayError(f"Scene {path} of the run no longer exists; restore it")
    return Source(path, as_xml_has_them(config.scene_parameters), plugins, cameras, medium=medium)


def _integrator(job: Job) -> Json | None:
    """Return the integrator of a job, or None to use that of the scene.

    None is returned if the integrator was an object, and for folders whose `run.json` does not name the integrator.
    """
    options = job.config.integrator.model_dump()
    if "integrator" not in job.config.model_fields_set:
        return None
    if job.in_python:
        try:
            load_integrator(options)
        except PathreplayError:  # the integrator was an object, of which the config has only the name of the class
            return None
    return options


def _beside(export: Exported, values: Arrays, free: Arrays) -> dict[str, bytes]:
    """Return the content of the additional files, which the scene does not reference, by file name.

    The files are PNG, OBJ and NPY files, and JSON files of cameras and of small values.

    ``free`` are parameters outside the scene. A parameter in ``free`` with more than 16 numbers becomes an NPY file.
    """
    params, files = mi.traverse(export.scene), {"transforms.json": _json(_cameras(export.scene))}
    names = file_names([*params.keys(), *(shape.id() for shape in export.scene.shapes())])
    numbers: Json = {}
    for key, value in values.items():
        if value.ndim == 3 and value.shape[2] <= 4:
            files[f"textures/{names[key]}.png"] = png_bytes(value)
        elif value.size <= 16 or key in (EXPOSURE, RESPONSE):
            numbers[key] = value.tolist()
    for key, name in file_names(free).items():
        if free[key].size <= 16:
            numbers[key] = free[key].tolist()
        else:
            files[f"values/{name}.npy"] = _npy(free[key])
    files["values.json"] = _json(numbers)
    for shape in export.scene.shapes():
        if shape.is_mesh() and f"meshes/{names[shape.id()]}.ply" in export.files:
            files[f"meshes/{names[shape.id()]}.obj"] = obj_bytes(shape)
    return files


def _npy(value: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, value)
    return stream.getvalue()


def _json(table: object) -> bytes:
    return (json.dumps(table, indent=2) + "\n").encode()


def obj_bytes(mesh: mi.Mesh) -> bytes:
    """Encode the mesh as a Wavefront OBJ file: vertices, texture coordinates, normals, faces.

    In OBJ files, v points upwards in the image. In the data of a mesh, as in PLY files, v points downwards.
    """
    data = compat.mesh_arrays(mi.traverse(mesh))
    if data is None:
        raise PathreplayError(f"The vertices of shape '{mesh.id()}' are not accessible, so it cannot be written as OBJ")
    lines, has = [], []
    texcoords = data.texcoords * (1, -1) + (0, 1)
    for rows, tag in ((data.positions, "v"), (texcoords, "vt"), (data.normals, "vn")):
        has.append(len(rows) > 0)
        lines += [f"{tag} " + " ".join(f"{x:.9g}" for x in row) for row in rows.tolist()]
    for face in data.faces + 1:
        corners = (f"{i}/{i if has[1] else ''}/{i if has[2] else ''}".rstrip("/") for i in face)
        lines.append("f " + " ".join(corners))
    return ("\n".join(lines) + "\n").encode()


def _cameras(scene: mi.Scene) -> Json:
    """Return the pinhole cameras of a scene in the format of NeRF's `transforms.json`."""
    frames = []
    for sensor in scene.sensors():
        params = mi.traverse(sensor)
        if sensor.class_name() != "PerspectiveCamera":
            continue
        film = sensor.film()
        size, crop, offset = ([int(n) for n in pair] for pair in (film.size(), film.crop_size(), film.crop_offset()))
        focal = size[0] / (2 * math.tan(math.radians(float(params["x_fov"][0])) / 2))
        shift = [float(params[f"principal_point_offset_{axis}"][0]) for axis in "xy"]
        frames.append(
            {
                "file_path": f"{sensor.id()}.exr", "w": crop[0], "h": crop[1], "fl_x": focal, "fl_y": focal,
                "cx": (0.5 - shift[0]) * size[0] - offset[0], "cy": (0.5 - shift[1]) * size[1] - offset[1],
                "transform_matrix": (get_array(params["to_world"]).astype(np.float64) @ FACING).tolist(),
            }
        )  # fmt: skip
    return {"camera_model": "PINHOLE", "frames": frames}
