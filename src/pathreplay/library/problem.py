"""An inverse problem in memory: a scene, what of it is sought, the images to match, and a loss."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from pathreplay.errors import PathreplayError, shown
from pathreplay.integrators.film.image import picture_shape
from pathreplay.inverse.config.schema import Config, make_config
from pathreplay.inverse.dataset.targets import Targets, as_weight
from pathreplay.inverse.dataset.views import sensors_of
from pathreplay.inverse.images.io import Image, find_image, read_image
from pathreplay.inverse.loop.loop import picture_of
from pathreplay.inverse.losses.pixelwise import LOSSES
from pathreplay.inverse.objective.evaluate import computing
from pathreplay.inverse.objective.reached import require_reached
from pathreplay.inverse.parameters.values import Array, Arrays, adapted_image
from pathreplay.inverse.problem import problem as inner
from pathreplay.platform import backend
from pathreplay.platform.device import require_order
from pathreplay.platform.traversal import traversed
from pathreplay.scenes.loading import load_scene_for

MOST_ITERATIONS = 10**6
"""Iterations of a problem that nobody minimises: above all at which a grid is refined."""
_HERE = Path()


@dataclass(frozen=True)
class Parameter:
    """What is sought of one scene parameter, or of several by a glob; every field has a key of that name in jobs.

    Values are decoded ones: reflectances and radiances as arrays of numbers, in the shape that `mi.traverse` shows.

    Args:
        initial: a number, a colour, an array in the parameter's shape, or an image or volume file; for a pose a
            displacement ``{"translation": [x, y, z], "rotation": [rx, ry, rz]}`` (scene units, degrees). None: the
            value in the scene.
        bounds: lowest and highest value, held by projection after each step; None: none.
        learning_rate: about the length of a step of Adam. None: that of the problem.
        parameterization: ``"log"``, ``"softplus"`` or ``"logit"``: steps are taken in that function of the value.
        resolutions, refine_at: sizes of a grid, coarse to fine, and the iterations at which it is refined.
        pose: ``"translation"``, ``"rotation"`` or ``"rigid"``, of a ``to_world`` or of ``vertex_positions``; with
            ``pivot``, ``rotation_learning_rate`` (degrees) and ``error_scale``.
        large_steps_lambda: λ of Large Steps (Nicolet et al. 2021), for ``vertex_positions``.
        total_variation, l2_to_initial, laplacian_weight: weights of regularizers.
        regularizer: a function of the values (a tensor) that gives one number, which is added to the loss.
        shape: of numbers that are no part of the scene, from which others are `Derived`.
    """

    initial: Any = None
    bounds: tuple[float | None, float | None] = (None, None)
    learning_rate: float | None = None
    parameterization: str | None = None
    resolutions: Sequence[int] | None = None
    refine_at: Sequence[int] | None = None
    pose: str | None = None
    pivot: Sequence[float] | None = None
    rotation_learning_rate: float | None = None
    error_scale: float | None = None
    large_steps_lambda: float | None = None
    total_variation: float | None = None
    l2_to_initial: float | None = None
    laplacian_weight: float | None = None
    regularizer: Callable[[Any], Any] | str | None = None
    shape: Sequence[int] | None = None


@dataclass(frozen=True)
class Derived:
    """A scene parameter that a function makes of others: ``function(value in the scene, *values of those in of)``."""

    function: Callable[..., Any] | str
    of: Sequence[str]


@dataclass(frozen=True)
class View:
    """A sensor and the image that it should see.

    Args:
        sensor: its place in the scene, or its id.
        target: linear pixels (height, width, channels): a NumPy or Dr.Jit array, a `mi.Bitmap`, or an image file.
        weight: how much pixels count (height, width), none negative; scaled to the mean 1. None: all the same.
        share: how much the view counts beside the others.
        test: never learned from.
    """

    sensor: int | str = 0
    target: Any = None
    weight: Any = None
    share: float = 1.0
    test: bool = False


class Problem:
    """min over the parameters of the mean over views of loss(render(scene, view), target of the view).

    The scene is used, not copied: it holds the values of the last evaluation. Occlusion is differentiated by the
    integrator's boundary terms; the choice of paths, roulette and targets are not differentiated.

    Args:
        scene: a scene, a dictionary for `mi.load_dict`, an XML file, or the name of a built-in scene. Of the last three
            a ``dielectric`` whose index is sought, and 8-bit textures that are sought, are exchanged for plugins that
            can be differentiated.
        parameters: by key of ``mi.traverse(scene)`` or by glob; keys alone take each as it is.
        views: what should be seen.
        loss: a name (``"l2"``, ``"relative-l2"``, ...; see `pathreplay.losses`) or ``loss(image, target)`` on tensors
            of shape (height, width, channels) that gives such a tensor, or one number.
        integrator: a dictionary of Mitsuba's, or an integrator. None: `pathreplay`, with the depth of the scene's own.
        derived: scene parameters by key, or glob, that functions make of ``parameters``.
        spp: samples per pixel, of the image and of its derivative.
        learning_rate: of parameters that have none of their own.
        seed: decides all random numbers.
        deterministic: the same bits every time, on one thread of an LLVM variant.

    Raises:
        PathreplayError: for whatever cannot work, before anything is rendered.
    """

    def __init__(  # noqa: PLR0913 (of which most are keywords)
        self,
        scene: mi.Scene | Mapping[str, Any] | str | Path,
        parameters: Mapping[str, Parameter | None] | Sequence[str] | str,
        views: View | Sequence[View],
        *,
        loss: str | Callable[[Any, Any], Any] = "l2",
        integrator: Mapping[str, Any] | mi.Integrator | None = None,
        derived: Mapping[str, Derived] | None = None,
        spp: int = 16,
        learning_rate: float = 0.02,
        seed: int = 0,
        deterministic: bool = False,
    ) -> None:
        if mi.variant() is None:
            backend.set_variant(None)
        wanted, made = _wanted(parameters), derived or {}
        looked_at = [views] if isinstance(views, View) else list(views)
        _require_kinds(wanted, looked_at, made)
        own = [key for key, entry in wanted.items() if entry is None or entry.shape is None]
        scene, self.notes = _loaded(scene, [*own, *made])
        functions: dict[str, Callable[..., Any]] = {}
        starts: dict[str, Array] = {}

        def named(what: str, function: Callable[..., Any] | str) -> str:
            if isinstance(function, str):
                return function
            name = f"memory:{what}-{len(functions)}"
            functions[name] = function
            return name

        tables = [_table(key, entry or Parameter(), named, starts) for key, entry in wanted.items()]
        by_name = _by_name(scene, looked_at)
        known = next((name for name, function in LOSSES.items() if function is loss), None)
        self.job: dict[str, Any] = {
            "scene": "memory",
            "parameters": tables,
            "derived": [
                {"key": key, "function": named("derived", each.function), "of": list(each.of)}
                for key, each in made.items()
            ],
            "sensors": list(by_name),
            "test_views": [name for name, view in by_name.items() if view.test],
            "view_weights": {name: view.share for name, view in by_name.items() if view.share != 1},
            "target": {"images": list(by_name)},
            "loss": known or named("loss", loss),
            "spp": spp,
            "learning_rate": learning_rate,
            "seed": seed,
            "deterministic": deterministic,
        }
        if isinstance(integrator, Mapping):
            self.job["integrator"] = dict(integrator)
        own_integrator = None if isinstance(integrator, Mapping) else integrator
        if deterministic:
            require_order(mi.variant())
        memory = inner.InMemory(scene, own_integrator, functions, starts)
        config = make_config({**self.job, "iterations": MOST_ITERATIONS}, "problem")
        self.built = inner.build_problem(config, _HERE, _targets(scene, by_name), memory)
        with computing(self.built.config):
            require_reached(self.built, self.built.config)

    def __repr__(self) -> str:
        """Short: for notebooks."""
        return f"<Problem: {', '.join(self.initial)}; {len(self.built.views)} views, loss {self.job['loss']}>"

    @property
    def scene(self) -> mi.Scene:
        """The scene, with the values of the last evaluation."""
        return self.built.scene

    @property
    def initial(self) -> dict[str, Array]:
        """The values at which the parameters start, by name; a pose has names ``KEY:translation``, ``KEY:rotation``."""
        return {v.key: np.array(v.start, np.float32) for v in self.built.variables}

    def render(self, values: Mapping[str, ArrayLike] | None = None, view: int = 0, spp: int | None = None) -> Image:
        """The image (height, width, channels; linear) of a view at these values, the initial ones if left out."""
        about = self.built.views[view]
        with computing(self.built.config):
            return picture_of(self.built, self.built.config, self.complete(values), about, spp)

    def complete(self, values: Mapping[str, ArrayLike] | None) -> dict[str, Array]:
        """Values of all parameters: those given, else initial ones. Raises PathreplayError for what does not fit."""
        given, starts = values or {}, {v.key: v.start for v in self.built.variables}
        if unknown := set(given) - set(starts):
            raise PathreplayError(f"No parameter '{min(unknown)}' in the problem; it has {', '.join(starts)}")
        return {
            key: _fitted(key, given[key], start.shape) if key in given else np.array(start, np.float32)
            for key, start in starts.items()
        }

    def configured(self, changes: Mapping[str, Any]) -> tuple[inner.Problem, Config]:
        """The problem and its settings with some of them changed, checked as those of a job."""
        checked = make_config({**self.job, **changes}, "minimize")
        config = self.built.config.model_copy(update={key: getattr(checked, key) for key in {*changes, "iterations"}})
        config.model_fields_set.update(changes)
        config.__dict__["learning_rate_schedule"] = checked.learning_rate_schedule
        return replace(self.built, config=config), config

    def assign(self, values: Arrays, scene: mi.Scene) -> None:
        """Give a scene with the same parameters these values."""
        params = traversed(scene)
        stored = inner.scene_values(self.built, inner.variables_of(self.built, values))
        for key, value in stored.items():
            if key not in params:
                raise PathreplayError(f"The scene has no parameter '{key}'; give one that is built alike")
            params[key] = value
        params.update()


def _fitted(key: str, value: ArrayLike, wanted: tuple[int, ...]) -> Array:
    """A value of a parameter; textures and grids may have other sizes."""
    array = np.array(value, np.float32)
    resized = len(wanted) >= 3 and array.ndim == len(wanted) and array.shape[-1] == wanted[-1]
    if array.shape != wanted and not resized and not (len(wanted) == 1 and array.size == wanted[0]):
        raise PathreplayError(f"Value of '{key}' has the shape {array.shape}, the parameter {wanted}; reshape it")
    return array if resized else array.reshape(wanted)


def _require_kinds(wanted: Mapping[str, Parameter | None], views: Sequence[View], made: Mapping[str, Derived]) -> None:
    """Raise PathreplayError for a number in the place of a Parameter, and the like."""
    for what, kind, things in (
        ("parameters", Parameter, [each for each in wanted.values() if each is not None]),
        ("views", View, list(views)),
        ("derived", Derived, list(made.values())),
    ):
        if wrong := [each for each in things if not isinstance(each, kind)]:
            raise PathreplayError(f"{what}: {shown(wrong[0])} is no {kind.__name__}; write {kind.__name__}(...)")


def _loaded(scene: Any, wanted: list[str]) -> tuple[mi.Scene, tuple[str, ...]]:
    """The scene, in which these keys carry derivatives as far as exchanging plugins brings it, and notes on that."""
    if isinstance(scene, mi.Scene):
        return scene, ()
    if not isinstance(scene, (Mapping, str, Path)):
        raise PathreplayError(
            f"scene: {shown(type(scene).__name__)} is no scene of the active variant, {mi.variant()}; load it in "
            "this variant, or give a dictionary, a file or the name of a built-in scene"
        )
    return load_scene_for(dict(scene) if isinstance(scene, Mapping) else scene, wanted)


def _wanted(parameters: Mapping[str, Parameter | None] | Sequence[str] | str) -> dict[str, Parameter | None]:
    """By key or glob; a name stands for a parameter as it is."""
    if isinstance(parameters, Mapping):
        return dict(parameters)
    return dict.fromkeys([parameters] if isinstance(parameters, str) else parameters)


def _table(key: str, entry: Parameter, named: Callable[[str, Any], str], starts: dict[str, Array]) -> dict[str, Any]:
    """A parameter as a job has it."""
    lower, upper = entry.bounds
    table = {"key": key, "lower": lower, "upper": upper}
    table |= {each.name: getattr(entry, each.name) for each in fields(Parameter) if each.name != "bounds"}
    if entry.regularizer is not None:
        table["regularizer"] = named("regularizer", entry.regularizer)
    if isinstance(entry.initial, np.ndarray) or dr.is_array_v(entry.initial):
        starts[key] = np.array(entry.initial, np.float32)
        table["initial"] = None
        if entry.pose is not None:
            raise PathreplayError(
                f"Parameter '{key}': 'initial' of a pose is a displacement; write {{'translation': [...], 'rotation': "
                "[...]}}, and set the scene's own value in the scene"
            )
    return {name: _plain(value) for name, value in table.items() if value is not None}


def _plain(value: Any) -> Any:
    """Numbers and lists as a job has them."""
    if isinstance(value, (str, Mapping)):
        return value
    if isinstance(value, Iterable):
        return [_plain(each) for each in value]
    return value.item() if isinstance(value, np.generic) else value


def _by_name(scene: mi.Scene, views: Sequence[View]) -> dict[str, View]:
    found: dict[str, View] = {}
    for view in views:
        name = next(iter(sensors_of(scene, [view.sensor])))
        if name in found:
            raise PathreplayError(f"views: sensor {view.sensor!r} is named twice; give each view a sensor of its own")
        found[name] = view
    if not found:
        raise PathreplayError("views: there is none; give a View")
    return found


def _targets(scene: mi.Scene, views: Mapping[str, View]) -> Targets:
    """The arrays of all views, checked against their films."""
    images, weights = {}, {}
    sensors = sensors_of(scene, list(views))
    for name, view in views.items():
        height, width, channels = picture_shape(scene.sensors()[sensors[name]])
        what = f"Target of sensor '{name}'"
        image = _pixels(what, view.target)
        if image.shape[:2] != (height, width):
            raise PathreplayError(
                f"{what} is {image.shape[1]} x {image.shape[0]}, and its film {width} x {height}; resize the image or "
                "the film"
            )
        images[name] = adapted_image(what, image, "the film has", channels)
        if view.weight is not None:
            mask = _pixels(f"Weight of sensor '{name}'", view.weight)
            if mask.shape != (height, width, 1):
                raise PathreplayError(f"Weight of sensor '{name}' has the shape {mask.shape}; give ({height}, {width})")
            weights[name] = as_weight("the weight", mask, name)
    return Targets(images, weights)


def _pixels(what: str, value: Any) -> Image:
    """An image as linear pixels (height, width, channels)."""
    if isinstance(value, (str, Path)):
        return read_image(find_image(str(value), _HERE))
    if isinstance(value, mi.Bitmap):
        value = value.convert(component_format=mi.Struct.Type.Float32, srgb_gamma=False)
    if value is None:
        raise PathreplayError(f"{what} is missing; give an array, a mi.Bitmap or a file")
    try:
        image = np.array(value, np.float32)
    except (TypeError, ValueError) as error:
        raise PathreplayError(f"{what} is no image ({error}); give an array, a mi.Bitmap or a file") from None
    image = image[:, :, None] if image.ndim == 2 else image
    if image.ndim != 3:
        raise PathreplayError(f"{what} has the shape {image.shape}; give (height, width, channels)")
    return image
