"""Target images and pixel weights from a target scene or from files, and true parameter values from a target scene."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import prod
from pathlib import Path

import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.integrators.film.image import film_size, picture_shape, require_film
from pathreplay.integrators.scene_facts import facts_of
from pathreplay.inverse.config.parameter_options import Value
from pathreplay.inverse.config.tables import Argument
from pathreplay.inverse.config.target_options import Target
from pathreplay.inverse.dataset.globbing import matching
from pathreplay.inverse.dataset.undistortion import Lens
from pathreplay.inverse.dataset.views import View
from pathreplay.inverse.images.background import background
from pathreplay.inverse.images.disk_store import ROOM, DiskStore
from pathreplay.inverse.images.io import (
    Image,
    find_image,
    notes_on_metadata,
    over,
    over_black,
    picture_size,
    read_image,
    resized,
    transparent_share,
    unpremultiplied,
)
from pathreplay.inverse.parameters.grids import comparable
from pathreplay.inverse.parameters.values import Array, adapted_image, make_value, require_finite_array, seen
from pathreplay.platform.threads import one_thread
from pathreplay.platform.traversal import traversed
from pathreplay.scenes import parameters
from pathreplay.scenes.descriptions import errors_as, load_integrator
from pathreplay.scenes.image_files import MOST_PIXELS
from pathreplay.scenes.loading import load_scene_with_floats
from pathreplay.scenes.stored import form_of

# Bytes per pixel for the three images of a view: target, initial and final image. At most `ROOM` bytes of images are in
# memory, and the rest is on disk.
_A_VIEW = 36


@dataclass(frozen=True)
class Targets:
    """Target images and pixel weights, by name of the view."""

    images: dict[str, Image]
    """Linear images, shape (height, width, channels)."""
    weights: dict[str, Image]
    """Weights of the pixels with mean 1, shape (height, width, 1). Views without an entry weight all pixels equally."""

    @staticmethod
    def of(views: Iterable[View]) -> Targets:
        """Return the target images and pixel weights that these views contain."""
        views = tuple(views)
        weights = {view.name: view.weight for view in views if view.weight is not None}
        return Targets({view.name: view.target for view in views}, weights)


def target_scene(
    spec: str, arguments: Mapping[str, Argument], given: Mapping[str, Value], wanted: Sequence[str], base: Path
) -> mi.Scene:
    """Load the target scene, and set the parameters ``given`` (globs allowed) to their values.

    8-bit textures are converted to floats if their key matches an entry of ``given`` or ``wanted``. The parameters
    ``wanted`` are the parameters that the job recovers or derives.
    """
    scene = load_scene_with_floats(spec, [*given, *wanted], base, **arguments)
    params = traversed(scene)
    parameters.require_finite(params)
    values = {}
    for pattern, value in given.items():
        for key in parameters.resolve_keys(params, pattern):
            parameters.require_settable(params, key)
            form, like = form_of(params, key), seen(params, key)
            colours = form.of_colours(key, make_value(key, like, value, base))
            values[key] = form.store(parameters.to_value(like, colours))
    params.update(values)
    return scene


def truth_of(scene: mi.Scene, own: mi.SceneParameters, keys: Iterable[str]) -> dict[str, Array]:
    """Return the values of parameters in the target scene. Parameters whose shape is not `comparable` are left out.

    Args:
        scene: the target scene.
        own: parameters of the job's scene, with which shapes are compared.
        keys: keys of the parameters.
    """
    params = traversed(scene)
    true = {key: parameters.get_array(seen(params, key)) for key in keys if key in params}
    return {k: value for k, value in true.items() if comparable(value.shape, parameters.get_array(seen(own, k)).shape)}


def rendered_targets(
    target: Target, seeds: Mapping[str, int], scene: mi.Scene, sensors: dict[str, int], disk: DiskStore
) -> dict[str, Image]:
    """Render the targets of all views, each with its own seed. Raises PathreplayError if the scene lacks a sensor."""
    plugin = target.integrator
    assert plugin is not None  # `with_default_target` has filled in a missing integrator
    integrator = load_integrator(plugin.model_dump())
    if len(scene.sensors()) <= max(sensors.values()):
        raise PathreplayError(
            f"The target scene has {len(scene.sensors())} sensors, but the job uses the index {max(sensors.values())} "
            "(from 0); add sensors to it"
        )
    require_films(scene, sensors, {"target.spp": target.spp})
    targets: dict[str, Image] = {}
    facts_of(scene).enclose(scene)
    for name, index in sensors.items():
        with errors_as(f"Integrator '{plugin.type}' cannot render the target of sensor '{name}'"):
            image = mi.render(scene, sensor=index, integrator=integrator, spp=target.spp, seed=mi.UInt32(seeds[name]))
            targets[name] = np.array(image, dtype=np.float32)
            del image
        require_finite_array(f"Target image of sensor '{name}'", targets[name])
        targets[name] = disk.keep(targets[name])
    return targets


@dataclass(frozen=True)
class Reading:
    """Options for reading the image files of targets."""

    alpha: str
    """Treatment of the alpha channel, see `Target.alpha`."""
    hidden: bool = False
    """Whether the integrator hides directly visible emitters."""
    resize: bool = False
    """Whether images are resampled to the size of the film."""
    lenses: Mapping[str, Lens] = field(default_factory=dict)
    """Lens distortions to remove, by view."""
    deterministic: bool = False
    """Whether backgrounds are rendered by a single thread, so that they are reproducible."""


def read_targets(
    files: Mapping[str, str], how: Reading, scene: mi.Scene, sensors: dict[str, int], base: Path, disk: DiskStore
) -> tuple[Targets, tuple[str, ...]]:
    """Read target images from files.

    Args:
        files: image file of each view.
        how: options for reading.
        scene: scene of the job.
        sensors: index of the sensor of each view.
        base: folder that relative paths start from.
        disk: store of the images.

    Returns:
        The targets, with weights for alpha = 'mask' and for undistorted images, and notes for the user.

    Raises:
        PathreplayError: an image cannot be read, or does not fit its sensor or ``how.alpha``.
    """
    alpha, lenses = how.alpha, how.lenses
    targets: dict[str, Image] = {}
    weights: dict[str, Image] = {}
    notes: list[str] = []
    paths: dict[str, Path] = {}
    for name, file in files.items():
        path, what = find_image(file, base), f"Target image '{file}'"
        shape = picture_shape(scene.sensors()[sensors[name]])
        image = _read(what, path, name, shape, how.resize)
        paths[file] = path
        _require_alpha(what, image, alpha, name, shape)
        # Premultiply before resampling, since the colours of transparent pixels are arbitrary.
        image = over_black(image, path)
        # Undistortion adds an empty border, which is not part of the photograph.
        fraction = transparent_share(image) if alpha == "black" and shape[2] in (1, 3) else 0.0
        if name in lenses:
            image, valid = lenses[name].undone(image)
            if not valid.any():
                raise PathreplayError(f"{what} has no pixels left after undistortion; correct k1, k2, ...")
            weights[name] = as_weight(f"the undistorted area of '{file}'", resized(valid, *shape[:2]).clip(0, 1), name)
        image = resized(image, *shape[:2])
        if alpha == "mask":
            opaque = image[:, :, -1:] * weights.get(name, np.float32(1))
            weights[name] = as_weight(f"the alpha of '{file}'", opaque, name)
            image = unpremultiplied(image)
        elif alpha == "scene" and not how.hidden:
            with one_thread(how.deterministic):
                behind = background(scene, sensors[name])
            image = over(image, behind)
        targets[name] = disk.keep(adapted_image(what, image, f"sensor '{name}' renders", shape[2]))
        if name in weights:
            weights[name] = disk.keep(weights[name])
        if fraction:
            notes.append(
                f"target image '{file}' is transparent in {fraction:.1%} of its pixels, which are compared with black; "
                "if the background of your scene is not black, use alpha = 'scene' to composite over it, or 'mask'"
            )
    if lenses:
        kinds = ", ".join(sorted({lens.describe() for lens in lenses.values()}))
        notes.append(f"images undistorted to a pinhole camera: {len(lenses)}, taken with {kinds}")
    notes += notes_on_metadata("target image", paths)
    return Targets(targets, weights), tuple(notes)


def _require_alpha(what: str, image: Image, alpha: str, name: str, shape: tuple[int, int, int]) -> None:
    """Raise PathreplayError unless the channels of image and film are suitable for the option ``alpha``."""
    if alpha != "black" and image.shape[2] not in (2, 4):
        remedy = "give 'masks'" if alpha == "mask" else "add one"
        raise PathreplayError(f"{what} has no alpha channel for alpha = '{alpha}'; {remedy}, or remove 'alpha'")
    if alpha == "compare" and shape[2] not in (2, 4):
        raise PathreplayError(
            f"target: alpha = 'compare' needs an alpha channel in the film of sensor '{name}'; set its "
            'pixel_format = "rgba"'
        )
    if alpha == "scene" and shape[2] in (2, 4):
        raise PathreplayError(
            f"target: alpha = 'scene' makes images opaque, but the film of sensor '{name}' has an alpha channel; use "
            "'compare'"
        )


def read_masks(
    files: Mapping[str, str], how: Reading, scene: mi.Scene, sensors: dict[str, int], base: Path
) -> dict[str, Image]:
    """Read mask files as weights of the pixels, by view. Black pixels get the weight 0.

    See `read_targets` for arguments and errors.
    """
    weights: dict[str, Image] = {}
    for name, file in files.items():
        shape = picture_shape(scene.sensors()[sensors[name]])
        mask = _read(f"Mask '{file}'", find_image(file, base), name, shape, how.resize, raw=True)
        if name in how.lenses:
            mask, _ = how.lenses[name].undone(mask)
        mask = resized(mask, *shape[:2])
        weights[name] = as_weight(f"mask '{file}'", adapted_image(f"Mask '{file}'", mask, "a mask has", 1), name)
    return weights


def masked(targets: Targets, masks: Mapping[str, Image]) -> Targets:
    """Multiply the weights of the targets by masks."""
    both = {
        name: as_weight("the product of mask and image weights", mask * targets.weights[name], name)
        for name, mask in masks.items()
        if name in targets.weights
    }
    return Targets(targets.images, {**targets.weights, **masks, **both})


def require_weights(targets: Targets, masked: set[str]) -> None:
    """Check the weights of views that were read from a run folder.

    Raises PathreplayError if a view in ``masked`` has no valid weights, or if another view has weights.
    """
    for name, image in targets.images.items():
        weight = targets.weights.get(name)
        shape = (*image.shape[:2], 1)
        fits = weight is not None and weight.shape == shape and bool(np.isfinite(weight).all() and weight.any())
        if not (fits if name in masked else weight is None):
            raise PathreplayError(
                f"The mask of sensor '{name}' in the run folder (images/weight-{name}.exr) is missing, damaged or "
                "superfluous; start a new run"
            )


def by_view(what: str, files: list[str] | str, sensors: dict[str, int], base: Path) -> dict[str, str]:
    """Expand patterns and assign files to views in order. Raises PathreplayError unless each view has one file."""
    paths = list(matching([files] if isinstance(files, str) else files, base))
    if len(paths) != len(sensors):
        raise PathreplayError(
            f"{len(paths)} {what} for {len(sensors)} sensors ({', '.join(sensors)}); name one per sensor, in this order"
        )
    return dict(zip(sensors, paths, strict=True))


def _read(what: str, path: Path, name: str, shape: tuple[int, int, int], resize: bool, *, raw: bool = False) -> Image:
    """Read an image. Unless ``resize`` is set, first raise PathreplayError if image and film have different sizes."""
    (width, height), film = picture_size(path), (shape[1], shape[0])
    if not resize and (width, height) != film:
        raise PathreplayError(
            f"{what} is {width} x {height}, but sensor '{name}' renders {film[0]} x {film[1]}; resize the image or the "
            "film"
        )
    return read_image(path, raw=raw, pixels=max(MOST_PIXELS, prod(film)))


def as_weight(what: str, mask: Image, name: str) -> Image:
    """Scale a non-negative mask to mean 1. Raises PathreplayError if it is black, negative or not finite."""
    require_finite_array(what, mask)
    if mask.min() < 0 or not mask.any():
        wrong = "is black" if not mask.any() else f"has the value {mask.min():g}"
        raise PathreplayError(
            f"Sensor '{name}': {what} {wrong}; paint the pixels to compare white, or remove the sensor"
        )
    return (mask / mask.mean(dtype=np.float64)).astype(np.float32)


def require_films(scene: mi.Scene, sensors: Mapping[str, int], spp: Mapping[str, int]) -> None:
    """Raise PathreplayError unless memory and kernel sizes suffice to render every sensor, and no film stores XYZ.

    Args:
        scene: the scene.
        sensors: index of each sensor, by name.
        spp: numbers of samples per pixel, indexed by keys of the job such as ``eval_spp``.
    """
    pixels = 0
    for name, index in sensors.items():
        if found := re.search("pixel_format = (xyza?)", str(scene.sensors()[index].film())):
            format = "rgba" if found[1] == "xyza" else "rgb"
            raise PathreplayError(
                f"The film of sensor '{name}' has pixel_format = '{found[1]}', but targets and results are RGB images; "
                f"use '{format}'"
            )
        pixels += prod(film_size(scene.sensors()[index]))
        require_film(scene.sensors()[index], f"sensor '{name}'", spp, min(pixels * _A_VIEW, ROOM))
