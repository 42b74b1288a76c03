"""The inverse problem: scene, variables with bounds, views with targets; checked before the first iteration."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay import parameters
from pathreplay.errors import PathreplayError
from pathreplay.inverse.config import Config, Parameter, Plugin
from pathreplay.inverse.images import Image, find_image, read_image, with_channels
from pathreplay.inverse.losses import Loss, find_loss
from pathreplay.inverse.values import Array, make_value, require_finite_array
from pathreplay.scenes import load_scene, one_line


@dataclass(frozen=True)
class Variable:
    """One scene parameter to recover: its key, bounds, learning rate, start value, and the truth where it is known."""

    key: str
    lower: float | None
    upper: float | None
    learning_rate: float
    start: Array
    truth: Array | None


@dataclass(frozen=True)
class View:
    """One sensor and the picture that it should see (linear, height x width x channels)."""

    name: str
    sensor: int
    target: Image


@dataclass(frozen=True)
class Problem:
    """min over the variables of the mean over views of loss(render(scene, view), target of the view)."""

    scene: mi.Scene
    params: mi.SceneParameters
    integrator: mi.Integrator
    variables: tuple[Variable, ...]
    views: tuple[View, ...]
    loss: Loss


# Streams of random numbers: pictures never share a seed with iterations, nor targets with renderings.
ITERATION, TARGET, PICTURE = 0, 1, 2


def seeds(seed: int, stream: int, index: int, view: int) -> tuple[int, int]:
    """Two independent 32-bit seeds (rendering, derivative) for this job's seed, stream, iteration and view."""
    first, second = np.random.SeedSequence([seed, stream, index, view]).generate_state(2)
    return int(first), int(second)


def build_problem(config: Config, base: Path, targets: dict[str, Image] | None = None) -> Problem:
    """Load and check everything that the job names; relative paths start at ``base``.

    ``targets`` (by view name) are the pictures of an earlier part of the same run; otherwise they are read or rendered.

    Raises:
        PathreplayError: whatever in the job cannot work, as one line.
    """
    loss = find_loss(config.loss)
    scene = load_scene(config.scene, base, **config.scene_parameters)
    params = mi.traverse(scene)
    parameters.require_finite(params)
    integrator = load_integrator(config.integrator)
    # Imported late: it exists once a variant is set.
    from mitsuba.ad.integrators.common import ADIntegrator

    if not isinstance(integrator, ADIntegrator):
        raise PathreplayError(
            f"Integrator '{config.integrator.type}' computes no gradients; use 'pathreplay' or another AD integrator"
        )
    keys = _keys(params, config.parameters)
    # Before any target is rendered: the cheap mistakes first.
    start = {key: _start(params, key, entry, base) for key, entry in keys.items()}
    sensors = _sensors(scene, config.sensors)

    truth: dict[str, Array] = {}
    if config.target.images is None:
        target_scene = _target_scene(config, base)
        truth = _truth(target_scene, keys, start)
        if targets is None:
            targets = _rendered_targets(config, target_scene, sensors)
    elif targets is None:
        targets = _target_files(config.target.images, scene, sensors, base)

    if missing := set(sensors) - set(targets):
        raise PathreplayError(f"The run folder has no target picture of sensor '{missing.pop()}'; start a new run")
    variables = tuple(
        Variable(key, entry.lower, entry.upper, entry.learning_rate or config.learning_rate, start[key], truth.get(key))
        for key, entry in keys.items()
    )
    # Traversed anew: an object from which values were read expects all its keys at the next update().
    params = mi.traverse(scene)
    params.keep(list(keys))
    views = tuple(View(name, index, targets[name]) for name, index in sensors.items())
    return Problem(scene, params, integrator, variables, views, loss)


def load_integrator(plugin: Plugin) -> mi.Integrator:
    """The integrator that the job names; an unknown type or option becomes one line."""
    try:
        return mi.load_dict(plugin.as_dict())
    except (RuntimeError, TypeError, ValueError) as error:
        raise PathreplayError(f"Integrator '{plugin.type}' cannot be made: {one_line(error)}") from None


def _keys(params: mi.SceneParameters, entries: list[Parameter]) -> dict[str, Parameter]:
    keys: dict[str, Parameter] = {}
    for entry in entries:
        for key in parameters.resolve_keys(params, entry.key):
            if key in keys:
                raise PathreplayError(
                    f"Parameter '{key}' is named twice, by '{keys[key].key}' and '{entry.key}'; remove one"
                )
            parameters.require_differentiable(params, key)
            keys[key] = entry
    return keys


def _start(params: mi.SceneParameters, key: str, entry: Parameter, base: Path) -> Array:
    like = params[key]
    if not dr.is_array_v(like):
        raise PathreplayError(
            f"Parameter '{key}' is a {type(like).__name__}; numbers, colours, textures and flat arrays can be optimised"
        )
    start = parameters.get_array(like) if entry.initial is None else make_value(key, like, entry.initial, base)
    for bound, name, wrong in ((entry.lower, "lower", np.less), (entry.upper, "upper", np.greater)):
        if bound is not None and wrong(start, np.float32(bound)).any():
            extreme = start.min() if name == "lower" else start.max()
            raise PathreplayError(
                f"Parameter '{key}' starts at {extreme:g}, beyond its {name} bound {bound:g}; change one of them"
            )
    return start


def _sensors(scene: mi.Scene, wanted: list[int | str] | None) -> dict[str, int]:
    """The wanted sensors of the scene: readable unique name -> index."""
    available = scene.sensors()
    if not available:
        raise PathreplayError("The scene has no sensor; add one")
    names = [
        s.id() if re.fullmatch(r"[A-Za-z0-9][\w-]*", s.id() or "") else f"view-{i}" for i, s in enumerate(available)
    ]
    if len(set(names)) < len(names):
        names = [f"view-{i}" for i in range(len(available))]
    if wanted is None:
        return {name: i for i, name in enumerate(names)}
    chosen: dict[str, int] = {}
    for item in wanted:
        index = names.index(item) if item in names else item
        if not isinstance(index, int) or not 0 <= index < len(names):
            raise PathreplayError(f"No sensor {item!r} in the scene; it has {', '.join(names)} (0 to {len(names) - 1})")
        chosen[names[index]] = index
    if not chosen:
        raise PathreplayError("'sensors' is empty; name one, or leave the key out for all of them")
    return chosen


def _target_scene(config: Config, base: Path) -> mi.Scene:
    target = config.target
    spec = config.scene if target.scene is None else target.scene
    arguments = config.scene_parameters if target.scene_parameters is None else target.scene_parameters
    scene = load_scene(spec, base, **arguments)
    params = mi.traverse(scene)
    parameters.require_finite(params)
    parameters.set_arrays(
        params,
        {
            key: make_value(key, params[key], value, base)
            for pattern, value in target.values.items()
            for key in parameters.resolve_keys(params, pattern)
        },
    )
    return scene


def _truth(scene: mi.Scene, keys: dict[str, Parameter], start: dict[str, Array]) -> dict[str, Array]:
    """Values of the wanted parameters in the target scene, where it has them in the same shape."""
    params = mi.traverse(scene)
    found = {key: parameters.get_array(params[key]) for key in keys if key in params}
    return {key: value for key, value in found.items() if value.shape == start[key].shape}


def _rendered_targets(config: Config, scene: mi.Scene, sensors: dict[str, int]) -> dict[str, Image]:
    integrator = load_integrator(config.target.integrator)
    if len(scene.sensors()) <= max(sensors.values()):
        raise PathreplayError(
            f"The target scene has {len(scene.sensors())} sensors, the job uses number {max(sensors.values())} (from 0)"
        )
    targets: dict[str, Image] = {}
    for name, index in sensors.items():
        seed, _ = seeds(config.seed, TARGET, 0, index)
        image = mi.render(scene, sensor=index, integrator=integrator, spp=config.target.spp, seed=mi.UInt32(seed))
        targets[name] = np.array(image, dtype=np.float32)
        require_finite_array(f"Target picture of sensor '{name}'", targets[name])
    return targets


def _target_files(files: list[str], scene: mi.Scene, sensors: dict[str, int], base: Path) -> dict[str, Image]:
    if len(files) != len(sensors):
        raise PathreplayError(
            f"{len(files)} target images for {len(sensors)} sensors ({', '.join(sensors)}); "
            "name one per sensor, in this order"
        )
    targets: dict[str, Image] = {}
    for (name, index), file in zip(sensors.items(), files, strict=True):
        image = read_image(find_image(file, base))
        film = scene.sensors()[index].film()
        width, height = (int(n) for n in film.crop_size())
        if image.shape[:2] != (height, width):
            raise PathreplayError(
                f"Target image '{file}' is {image.shape[1]} x {image.shape[0]}, "
                f"sensor '{name}' renders {width} x {height}; resize the image or the film"
            )
        film.prepare([])  # without storage a film does not tell its channels
        channels = film.bitmap().channel_count()
        adapted = with_channels(image, channels)
        if adapted is None:
            raise PathreplayError(
                f"Target image '{file}' has {image.shape[2]} channels, sensor '{name}' renders {channels}; convert it"
            )
        require_finite_array(f"Target image '{file}'", adapted)
        targets[name] = adapted
    return targets
