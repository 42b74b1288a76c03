"""The pictures to match, rendered from a scene of their own or read from files, and the truth where it is known."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import prod
from pathlib import Path
from types import MappingProxyType

import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.integrators.film.image import film_size, picture_shape, require_film
from pathreplay.inverse.config.schema import TARGET, Config
from pathreplay.inverse.dataset.globbing import matching
from pathreplay.inverse.dataset.undistortion import Lens
from pathreplay.inverse.dataset.views import View
from pathreplay.inverse.images.background import background
from pathreplay.inverse.images.disk_store import ROOM, Album
from pathreplay.inverse.images.io import (
    Image,
    find_image,
    oddities,
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
from pathreplay.platform.traversal import traversed
from pathreplay.scenes import parameters
from pathreplay.scenes.descriptions import load_integrator, told
from pathreplay.scenes.image_files import MOST_PIXELS
from pathreplay.scenes.loading import load_scene_with_floats
from pathreplay.scenes.stored import form_of

# Bytes for each pixel of each view: its target, start and result stay, but go to the disk where they are many.
_A_VIEW = 36


@dataclass(frozen=True)
class Targets:
    """By view: what it should look like, and how much each pixel counts where that is not all the same.

    Pictures are linear, height x width x channels; weights are height x width x 1, with the mean 1.
    """

    images: dict[str, Image]
    weights: dict[str, Image]

    @staticmethod
    def of(views: Iterable[View]) -> Targets:
        """Those that views have."""
        views = tuple(views)
        weights = {view.name: view.weight for view in views if view.weight is not None}
        return Targets({view.name: view.target for view in views}, weights)


def target_scene(config: Config, base: Path) -> mi.Scene:
    """The scene from which targets are rendered, with the values that the job gives it."""
    target = config.target
    spec = config.scene if target.scene is None else target.scene
    arguments = config.scene_parameters if target.scene_parameters is None else target.scene_parameters
    wanted = [*target.values, *(entry.key for entry in config.parameters), *(made.key for made in config.derived)]
    scene = load_scene_with_floats(spec, wanted, base, **arguments)
    params = traversed(scene)
    parameters.require_finite(params)
    values = {}
    for pattern, value in target.values.items():
        for key in parameters.resolve_keys(params, pattern):
            parameters.require_settable(params, key)
            form, like = form_of(params, key), seen(params, key)
            given = form.of_colours(key, make_value(key, like, value, base))
            values[key] = form.store(parameters.to_value(like, given))
    params.update(values)
    return scene


def truth_of(scene: mi.Scene, own: mi.SceneParameters, keys: Iterable[str]) -> dict[str, Array]:
    """Values of the wanted parameters in the target scene, where it has them in the same shape or as such a grid."""
    params = traversed(scene)
    found = {key: parameters.get_array(seen(params, key)) for key in keys if key in params}
    return {k: value for k, value in found.items() if comparable(value.shape, parameters.get_array(seen(own, k)).shape)}


def rendered_targets(config: Config, scene: mi.Scene, sensors: dict[str, int], album: Album) -> dict[str, Image]:
    """Render the targets of all views. Raises PathreplayError where the target scene lacks a sensor."""
    plugin = config.target.integrator
    assert plugin is not None  # `completed`
    integrator = load_integrator(plugin.model_dump())
    if len(scene.sensors()) <= max(sensors.values()):
        raise PathreplayError(
            f"The target scene has {len(scene.sensors())} sensors, the job uses number {max(sensors.values())} (from 0)"
        )
    require_films(scene, sensors, {"target.spp": config.target.spp})
    targets: dict[str, Image] = {}
    for name, index in sensors.items():
        seed, _ = config.seeds(TARGET, index)
        with told(f"Integrator '{plugin.type}' cannot render the target of sensor '{name}'"):
            image = mi.render(scene, sensor=index, integrator=integrator, spp=config.target.spp, seed=mi.UInt32(seed))
            targets[name] = np.array(image, dtype=np.float32)
            del image
        require_finite_array(f"Target picture of sensor '{name}'", targets[name])
        targets[name] = album.keep(targets[name])
    return targets


def read_targets(
    files: Mapping[str, str],
    alpha: str,
    scene: mi.Scene,
    sensors: dict[str, int],
    base: Path,
    *,
    resize: bool = False,
    lenses: Mapping[str, Lens] = MappingProxyType({}),
    hidden: bool = False,
    album: Album,
) -> tuple[Targets, tuple[str, ...]]:
    """Pictures by view (and weights, with ``alpha`` = 'mask' or a lens) from files by view, and what is to be said.

    ``resize``: to the size of the film, if they have another. ``lenses`` are undone. ``hidden``: emitters are not seen.
    """
    targets: dict[str, Image] = {}
    weights: dict[str, Image] = {}
    notes: list[str] = []
    odd: dict[str, list[str]] = {}
    for name, file in files.items():
        path, what = find_image(file, base), f"Target image '{file}'"
        shape = picture_shape(scene.sensors()[sensors[name]])
        image = _read(what, path, name, shape, resize)
        for oddity in oddities(path):
            odd.setdefault(oddity, []).append(file)
        _require_alpha(what, image, alpha, name, shape)
        # Undone and resized as it looks over black: colours of what is transparent are anything.
        image = over_black(image, path)
        if name in lenses:
            image, there = lenses[name].undone(image)
            if not there.any():
                raise PathreplayError(
                    f"{what} has nothing of what a pinhole would see in place of its lens; correct k1, k2, ..."
                )
            weights[name] = as_weight(f"what the lens leaves of '{file}'", resized(there, *shape[:2]).clip(0, 1), name)
        image = resized(image, *shape[:2])
        if alpha == "mask":
            opaque = image[:, :, -1:] * weights.get(name, np.float32(1))
            weights[name] = as_weight(f"the alpha of '{file}'", opaque, name)
            image = unpremultiplied(image)
        elif alpha == "scene" and not hidden:
            image = over(image, background(scene, sensors[name]))
        targets[name] = album.keep(adapted_image(what, image, f"sensor '{name}' renders", shape[2]))
        if name in weights:
            weights[name] = album.keep(weights[name])
        share = transparent_share(image)
        if share and shape[2] in (1, 3) and alpha == "black":
            notes.append(
                f"target image '{file}' is transparent in {share:.1%} of its pixels: black is fitted there; if the "
                "background of your scene is not black, take alpha = 'scene', which puts it behind, or alpha = 'mask'"
            )
    if lenses:
        notes.append(f"{len(lenses)} pictures are resampled to what a pinhole sees: they come from {_kinds(lenses)}")
    notes += [
        f"target image '{files[0]}'{f' (and {len(files) - 1} others)' if len(files) > 1 else ''} {oddity}"
        for oddity, files in odd.items()
    ]
    return Targets(targets, weights), tuple(notes)


def _kinds(lenses: Mapping[str, Lens]) -> str:
    return ", ".join(sorted({lens.told() for lens in lenses.values()}))


def _require_alpha(what: str, image: Image, alpha: str, name: str, shape: tuple[int, int, int]) -> None:
    """Raise PathreplayError unless picture and film go with this ``alpha``."""
    if alpha != "black" and image.shape[2] not in (2, 4):
        use = "be its mask; give masks" if alpha == "mask" else f"go with alpha = '{alpha}'; give it one"
        raise PathreplayError(f"{what} has no alpha to {use}, or leave alpha = '{alpha}' out")
    if alpha == "compare" and shape[2] not in (2, 4):
        raise PathreplayError(
            f"target: alpha = 'compare', and the film of sensor '{name}' has none; write pixel_format = \"rgba\" there"
        )
    if alpha == "scene" and shape[2] in (2, 4):
        raise PathreplayError(
            f"target: alpha = 'scene' makes pictures opaque, and the film of sensor '{name}' has alpha; take 'compare'"
        )


def read_masks(
    files: Mapping[str, str],
    scene: mi.Scene,
    sensors: dict[str, int],
    base: Path,
    *,
    resize: bool = False,
    lenses: Mapping[str, Lens] = MappingProxyType({}),
) -> dict[str, Image]:
    """The weights that masks give, by view: white counts, black does not."""
    weights: dict[str, Image] = {}
    for name, file in files.items():
        shape = picture_shape(scene.sensors()[sensors[name]])
        mask = _read(f"Mask '{file}'", find_image(file, base), name, shape, resize, raw=True)
        if name in lenses:
            mask, _ = lenses[name].undone(mask)
        mask = resized(mask, *shape[:2])
        weights[name] = as_weight(f"mask '{file}'", adapted_image(f"Mask '{file}'", mask, "a mask has", 1), name)
    return weights


def masked(targets: Targets, masks: Mapping[str, Image]) -> Targets:
    """The targets with these weights as well: what counts counts by all of them."""
    both = {
        name: as_weight("what mask and picture leave", mask * targets.weights[name], name)
        for name, mask in masks.items()
        if name in targets.weights
    }
    return Targets(targets.images, {**targets.weights, **masks, **both})


def require_weights(targets: Targets, masked: set[str]) -> None:
    """Raise PathreplayError unless the views that are ``masked``, and no others, have fitting weights."""
    for name, image in targets.images.items():
        weight = targets.weights.get(name)
        shape = (*image.shape[:2], 1)
        fits = weight is not None and weight.shape == shape and bool(np.isfinite(weight).all() and weight.any())
        if not (fits if name in masked else weight is None):
            raise PathreplayError(
                f"The mask of sensor '{name}' in the run folder (images/weight-{name}.exr) is missing, damaged, or one "
                "too many; start a new run"
            )


def by_view(what: str, files: list[str] | str, sensors: dict[str, int], base: Path) -> dict[str, str]:
    """A file for each view; patterns are expanded. Raises PathreplayError unless there are as many."""
    found = list(matching([files] if isinstance(files, str) else files, base))
    if len(found) != len(sensors):
        raise PathreplayError(
            f"{len(found)} {what} for {len(sensors)} sensors ({', '.join(sensors)}); name one per sensor, in this order"
        )
    return dict(zip(sensors, found, strict=True))


def _read(what: str, path: Path, name: str, shape: tuple[int, int, int], resize: bool, *, raw: bool = False) -> Image:
    """The image, which must have the size of the film, unless it is to be brought to it; others are not unpacked."""
    (width, height), film = picture_size(path), (shape[1], shape[0])
    if not resize and (width, height) != film:
        raise PathreplayError(
            f"{what} is {width} x {height}, sensor '{name}' renders {film[0]} x {film[1]}; resize the image or the film"
        )
    return read_image(path, raw=raw, pixels=max(MOST_PIXELS, prod(film)))


def as_weight(what: str, mask: Image, name: str) -> Image:
    """A mask, none of it negative, as a weight with the mean 1."""
    require_finite_array(what, mask)
    if mask.min() < 0 or not mask.any():
        wrong = "is black" if not mask.any() else f"has the value {mask.min():g}"
        raise PathreplayError(f"Of sensor '{name}' {what} {wrong}; paint white what counts, or leave the sensor out")
    return (mask / mask.mean(dtype=np.float64)).astype(np.float32)


def require_films(scene: mi.Scene, sensors: Mapping[str, int], spp: Mapping[str, int]) -> None:
    """Raise PathreplayError unless memory and a kernel hold every sensor (name -> index) at each ``spp`` (by key)."""
    pixels = 0
    for name, index in sensors.items():
        pixels += prod(film_size(scene.sensors()[index]))
        require_film(scene.sensors()[index], f"sensor '{name}'", spp, min(pixels * _A_VIEW, ROOM))
