"""The command `pathreplay render`: checks its arguments, renders with a bar on stderr, and writes one file."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

from pathreplay.errors import PathreplayError, shown
from pathreplay.inverse.config.definitions import defined
from pathreplay.output.picture import file_bytes, find_sensor, render, set_size
from pathreplay.platform.atomic_files import require_writable, write_whole
from pathreplay.platform.progress_bar import progress_bar
from pathreplay.scenes.descriptions import load_integrator
from pathreplay.scenes.loading import load_scene
from pathreplay.types import Json

_OPTION = "-o"
# A larger number is probably a typing error: the noise of the image would be below single precision.
_MOST_SPP = 10**6


@dataclass(frozen=True)
class RenderOptions:
    """Options of a rendering. None selects the scene's own setting."""

    integrator: str | None = None  # plugin name; default: the scene's integrator, or `path` if the scene has none
    options: Sequence[str] = ()  # integrator properties, each NAME=VALUE
    sensor: str | None = None  # id or index
    size: str | None = None  # WIDTHxHEIGHT or WIDTH
    spp: int | None = None
    seed: int = 0
    define: Sequence[str] = ()  # scene parameters, each NAME=VALUE


def render_to_file(scene: str, output: Path, asked: RenderOptions, progress: bool = True) -> str:
    """Render a scene to a file in the active variant.

    Args:
        scene: path of an XML file, or name of a built-in scene.
        output: .exr or .png file.
        asked: integrator, sensor, film size and samples.
        progress: show a bar on stderr.

    Returns:
        A line for the user: file, size, samples per pixel and time.

    Raises:
        PathreplayError: an argument is invalid, or the scene cannot be rendered. An existing file stays unchanged.
    """
    integrator, options, spp, seed = asked.integrator, asked.options, asked.spp, asked.seed
    ending = output.suffix.lower()
    if ending not in (".exr", ".png"):
        raise PathreplayError(f"{output} ends in {shown(ending)}; give {_OPTION} a name that ends in .exr or .png")
    require_writable(output, _OPTION)
    if spp is not None and not 1 <= spp <= _MOST_SPP:
        raise PathreplayError(f"--spp {spp} is out of range; give a number of samples from 1 to {_MOST_SPP}")
    if not 0 <= seed < 2**32:
        raise PathreplayError(f"--seed {seed} is out of range; give a seed from 0 to {2**32 - 1}")
    given = {} if integrator is None else {"type": integrator}
    described = _flat("-I", given, options)
    if integrator is None and options:
        raise PathreplayError(f"-I {shown(options[0])} is an option of an integrator; name it with --integrator")
    loaded = load_scene(scene, **_flat("-D", {}, asked.define))
    renderer = load_integrator(described) if given else loaded.integrator() or load_integrator({"type": "path"})
    camera = find_sensor(loaded, asked.sensor)
    if asked.size is not None:
        set_size(camera, asked.size)
    samples = camera.sampler().sample_count() if spp is None else spp
    begin = time.perf_counter()
    bar = progress_bar("rendering, pass", lambda done, total: f"pass {done} of {total}") if progress else nullcontext()
    with bar as tell:
        rendering = render(loaded, camera, renderer, samples, seed, tell)
    height, width, _ = rendering.image.shape
    write_whole(output, file_bytes(rendering, ending), _OPTION)
    seconds = time.perf_counter() - begin
    return f"{output}: {width} x {height}, {rendering.spp} samples per pixel, {seconds:.3g} s"


def _flat(option: str, table: Json, changes: Sequence[str]) -> Json:
    """Return the table with the given NAME=VALUE entries added. Raises PathreplayError if a value is nested."""
    result = defined(table, changes, option)
    for name, value in result.items():
        if isinstance(value, (dict, list)):
            raise PathreplayError(f"{option} {name} is {shown(value)}; give a number, a string, true or false")
    return result
