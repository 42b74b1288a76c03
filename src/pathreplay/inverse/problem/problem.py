"""The inverse problem: scene, variables with bounds, views with targets; checked before the first iteration."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.integrators.diagnostics import COST_OF_EDGES
from pathreplay.integrators.edge_notes import edges_note, moves_edges
from pathreplay.integrators.film.image import fit_film
from pathreplay.integrators.integrator import EDGES
from pathreplay.integrators.reach import reached_sensors
from pathreplay.inverse.config.schema import Config
from pathreplay.inverse.config.tables import Plugin
from pathreplay.inverse.config.user_functions import Modules
from pathreplay.inverse.dataset.capture import Shot, fingerprint, read_capture
from pathreplay.inverse.dataset.targets import (
    Targets,
    by_view,
    masked,
    read_masks,
    read_targets,
    rendered_targets,
    require_films,
    require_weights,
    target_scene,
    truth_of,
)
from pathreplay.inverse.dataset.views import View, held_out_of, named_views, sensors_of, shares_of
from pathreplay.inverse.images.background import require_known
from pathreplay.inverse.images.disk_store import Album
from pathreplay.inverse.images.io import picture_size
from pathreplay.inverse.losses.pixelwise import Loss, find_loss
from pathreplay.inverse.parameters import limits as parameter_limits
from pathreplay.inverse.parameters.derived import Derived, make_derived
from pathreplay.inverse.parameters.exposures import EXPOSURE, Factors, fixed_rows
from pathreplay.inverse.parameters.exposures import start as start_of_exposures
from pathreplay.inverse.parameters.grids import rmse
from pathreplay.inverse.parameters.pose import Pose
from pathreplay.inverse.parameters.values import Array, Arrays
from pathreplay.inverse.parameters.variables import Variable, free_of, keys_of, make_variables
from pathreplay.inverse.problem import feasibility
from pathreplay.inverse.problem.completed import completed
from pathreplay.platform.threads import one_thread
from pathreplay.platform.traversal import traversed
from pathreplay.scenes import parameters
from pathreplay.scenes.descriptions import load_integrator
from pathreplay.scenes.loading import load_scene_for


class Held:
    """The values that were asked for last, as Dr.Jit holds them: there are none beside them."""

    def __init__(self) -> None:
        self._known: dict[str, tuple[weakref.ref[Array], Any]] = {}

    def variables(self, problem: Problem, values: Arrays) -> dict[str, Any]:
        """As `variables_of`, without derivatives; the same arrays as before, where the values are."""
        keys = [v.key for v in problem.variables]
        if any(key not in self._known or self._known[key][0]() is not values[key] for key in keys):
            self._known = {}  # before there is more
            made = variables_of(problem, values)
            # Values may go when nobody else wants them, and their places in memory may be those of others.
            self._known = {key: (weakref.ref(values[key]), value) for key, value in made.items()}
        found = {key: self._known[key][1] for key in keys}
        dr.disable_grad(found)
        return found


@dataclass(frozen=True)
class Problem:
    """min over the variables of the mean over views of loss(render(scene, view), target of the view)."""

    config: Config
    """The job, with what it leaves to others: see `completed`."""
    scene: mi.Scene
    params: mi.SceneParameters
    integrator: mi.Integrator
    baseline: mi.Integrator | None
    """Solves the same problem in the same time, for comparison."""
    judge: mi.Integrator
    """Renders the pictures by which both are compared: the one that made the targets, where it is known."""
    variables: tuple[Variable, ...]
    poses: tuple[Pose, ...]
    views: tuple[View, ...]
    loss: Loss
    notes: tuple[str, ...]
    """What was done to the scene that the user should know of."""
    derived: tuple[Derived, ...] = ()
    capture: str | None = None
    """What tells its capture from others."""
    album: Album = field(default_factory=Album)
    """Where its pictures are kept, and starts and truths."""
    held: Held = field(default_factory=Held)

    def moves(self, moving: frozenset[str]) -> set[str]:
        """The keys of the scene whose values are others when these variables are."""
        made = {each.key for each in self.made() if not moving.isdisjoint(each.of)}
        return {key for key in moving if key in self.params} | made

    def reached(self, moving: frozenset[str]) -> set[int]:
        """The places of the views whose pictures, before any exposure, depend on one of these variables."""
        sensors = [self.scene.sensors()[view.sensor] for view in self.views]
        found = reached_sensors(self.scene, sensors, self.params, self.moves(moving))
        return {n for n, reached in enumerate(found) if reached}

    def made(self) -> tuple[Pose | Derived, ...]:
        """What is made of variables."""
        return *self.poses, *self.derived

    def trained(self) -> dict[int, View]:
        """The views that are learned from, by their place."""
        return {n: view for n, view in enumerate(self.views) if not view.is_test}


def variables_of(problem: Problem, values: Arrays) -> dict[str, Any]:
    """The values of the variables (what people see) as Dr.Jit holds them, in memory of its own."""
    # NumPy's memory, which Dr.Jit would take over, begins anywhere: to a frozen function that is another kind of input.
    one = dr.opaque(mi.Float, 1)
    variables = {v.key: v.held(values[v.key]) * one for v in problem.variables}
    dr.eval(variables)
    return variables


def scene_values(problem: Problem, variables: Mapping[str, Any]) -> dict[str, Any]:
    """The scene's parameters, by key and as Mitsuba stores them; derivatives flow to the variables."""
    plain = {v.key: v.form.store(variables[v.key]) for v in problem.variables if v.key in problem.params}
    made = {each.key: each.form.store(each.value(variables)) for each in problem.derived}
    return plain | made | {pose.key: pose.value(variables) for pose in problem.poses}


def sensor_of(problem: Problem, view: View) -> mi.Sensor:
    """The sensor of a view, whose film has the size of its picture."""
    sensor = problem.scene.sensors()[view.sensor]
    fit_film(sensor, view.target.shape)
    return sensor


def put_values(problem: Problem, values: Arrays) -> None:
    """Give the scene these values of the variables, without derivatives."""
    problem.params.update(scene_values(problem, problem.held.variables(problem, values)))


def errors_of(problem: Problem, values: Arrays) -> dict[str, float]:
    """How far all whose truth is known are from it, by key: root mean squares; of poses by name, see `PoseError.of`.

    Raises PathreplayError where a derived parameter is no longer finite.
    """
    found = {v.key: rmse(values[v.key], v.truth) for v in problem.variables if v.truth is not None}
    poses = [pose for pose in problem.poses if pose.truth is not None]
    variables = problem.held.variables(problem, values) if problem.derived or poses else {}
    for each in problem.derived:
        value = each.require_finite(variables)
        if each.truth is not None:
            found[each.key] = rmse(parameters.get_array(value), each.truth)
    for pose in poses:
        if error := pose.error(parameters.get_array(pose.value(variables))):
            found |= error.of(pose.key)
    return found


@dataclass(frozen=True)
class InMemory:
    """What a problem is given as objects, where a job would name files."""

    scene: mi.Scene | None = None
    integrator: mi.Integrator | None = None
    functions: Mapping[str, Callable[..., Any]] = field(default_factory=dict)
    """Callables, by the names that stand for them in the config."""
    starts: Mapping[str, Array] = field(default_factory=dict)
    """Arrays by key of the parameter, in place of its ``initial``."""


def build_problem(
    config: Config, base: Path, targets: Targets | None = None, memory: InMemory | None = None
) -> Problem:
    """Load and check everything that the job names; relative paths start at ``base``.

    ``targets`` are those of an earlier part of the same run, or arrays; otherwise they are read or rendered.
    ``memory`` holds what is not named but there.
    Raises PathreplayError for whatever in the job cannot work.
    """
    album = Album.of(config.budget)
    given = memory or InMemory()
    modules = Modules(base, given.functions)
    loss = find_loss(config.loss, modules)
    film = "rgba" if config.target.alpha == "compare" else "rgb"
    shots = {} if config.capture is None else read_capture(config.capture, base, picture_size, film)
    scene, config, notes = _loaded(config, base, shots, given.scene)
    params = traversed(scene)
    parameters.require_finite(params)
    integrator = given.integrator
    if integrator is None:
        integrator = _gradient_integrator(config.integrator)
    else:
        _require_gradients(integrator, type(integrator).__name__)
    named, made = keys_of(params, config, integrator)
    free = free_of(params, config)
    keys = [*named, *made]
    notes += _edges(params, keys, integrator)
    baseline = None if config.baseline is None else _gradient_integrator(config.baseline)
    if baseline is not None:
        keys_of(params, config, baseline)
        _edges(params, keys, baseline)  # for its log: one note is enough
    judge = integrator if config.target.integrator is None else load_integrator(config.target.integrator.model_dump())
    # Before any target is rendered: the cheap mistakes first.
    sensors = sensors_of(scene, list(shots) or None if config.sensors is None else config.sensors)
    taken = {name: shots[id] for name, index in sensors.items() if (id := scene.sensors()[index].id()) in shots}
    test_views = held_out_of(scene, sensors, config, list(shots))
    feasibility.require_visible(scene, params, keys)
    if config.target.alpha == "scene":
        require_known(scene, params, keys)
    require_films(scene, sensors, {"spp": config.most_spp, "eval_spp": config.eval_spp})
    unsolved, moved = make_variables(scene, params, named | free, config, base, modules, given.starts)
    derived = make_derived(params, made, unsolved, modules)
    parameter_limits.require_values({variable.key: variable.start.size for variable in unsolved})

    targets, truth, said = _seen(config, targets, taken, scene, params, sensors, keys, base, album)
    notes += said
    if missing := set(sensors) - set(targets.images):
        raise PathreplayError(f"The run folder has no target picture of sensor '{missing.pop()}'; start a new run")
    masked_all = config.target.masks is not None or config.target.alpha == "mask"
    weighted = {n for n in sensors if masked_all or (n in taken and (taken[n].mask or taken[n].lens))}
    require_weights(targets, weighted if memory is None else set(targets.weights))
    shares = shares_of(scene, sensors, config, test_views)
    views = tuple(
        View(name, index, targets.images[name], targets.weights.get(name), name in test_views, shares[name])
        for name, index in sensors.items()
    )
    unsolved += _exposures(scene, config, views)
    for view in views:
        feasibility.require_finite_loss(loss, view.name, view.target, view.weight)
        album.rest()
    variables = tuple(_kept(album, replace(variable, truth=truth.get(variable.key))) for variable in unsolved)
    poses = tuple(replace(pose, truth=truth.get(pose.key)) for pose in moved)
    derived = tuple(replace(each, truth=truth.get(each.key)) for each in derived)
    # Traversed anew: an object from which values were read expects all its keys at the next update().
    params = traversed(scene)
    parameters.keep_only(params, keys)
    known = fingerprint(taken.values()) if taken else None
    return Problem(
        config, scene, params, integrator, baseline, judge, variables, poses, views, loss, notes, derived, known, album
    )


def _loaded(
    config: Config, base: Path, shots: Mapping[str, Shot], scene: mi.Scene | None
) -> tuple[mi.Scene, Config, tuple[str, ...]]:
    """The scene, the job with what it leaves to the scene (see `completed`), and what is to be said about both."""
    if scene is not None:
        config, differences = completed(config, scene)
        return scene, config, differences
    wanted = [entry.key for entry in config.parameters if entry.shape is None]
    wanted += [entry.key for entry in config.derived]
    cameras = {name: shot.camera for name, shot in shots.items()}
    scene, notes = load_scene_for(config.scene, wanted, base, cameras, **config.scene_parameters)
    config, differences = completed(config, scene)
    return scene, config, notes + differences


def _seen(
    config: Config,
    targets: Targets | None,
    shots: Mapping[str, Shot],
    scene: mi.Scene,
    params: mi.SceneParameters,
    sensors: dict[str, int],
    keys: list[str],
    base: Path,
    album: Album,
) -> tuple[Targets, dict[str, Array], tuple[str, ...]]:
    """Targets, those that are there or new ones; true values by key, where they are known; and what is to be said."""
    truth: dict[str, Array] = {}
    notes: tuple[str, ...] = ()
    first = targets is None
    if not config.brings_pictures:
        other = target_scene(config, base)
        truth = truth_of(other, params, keys)
        if targets is None:
            with one_thread(config.deterministic):
                targets = Targets(rendered_targets(config, other, sensors, album), {})
        # Dr.Jit traces calls through every instance alive: the target scene would be in all our kernels.
        del other
        gc.collect()
    elif targets is None:
        targets, notes = _pictures(config, shots, scene, sensors, base, album)
    if first and config.target.masks is not None:
        masks = by_view("masks", config.target.masks, sensors, base)
        targets = masked(targets, read_masks(masks, scene, sensors, base))
    return targets, truth, notes


def _kept(album: Album, variable: Variable) -> Variable:
    truth = None if variable.truth is None else album.keep(variable.truth)
    return replace(variable, start=album.keep(variable.start), truth=truth)


def _exposures(scene: mi.Scene, config: Config, views: tuple[View, ...]) -> list[Variable]:
    """The factors on the pictures, where the job asks for them."""
    if (asked := config.exposure) is None:
        return []
    value = start_of_exposures(len(views), min(view.target.shape[2] for view in views), asked.white_balance)
    trained = [n for n, view in enumerate(views) if not view.is_test]
    reference = None
    if asked.reference is not None:
        places = named_views(scene, {view.name: view.sensor for view in views}, [asked.reference], "exposure.reference")
        reference = places[0]
        if views[[view.name for view in views].index(reference)].is_test:
            raise PathreplayError(
                f"exposure: the reference '{reference}' is held out; name a view that is learned from"
            )
    fixed = fixed_rows([view.name for view in views], trained, reference, not asked.fix_scale)
    rate = asked.learning_rate or config.learning_rate
    return [Variable(EXPOSURE, mi.TensorXf(value), (-np.inf, np.inf), rate, value, None, coordinates=Factors(fixed))]


def _pictures(
    config: Config, shots: Mapping[str, Shot], scene: mi.Scene, sensors: dict[str, int], base: Path, album: Album
) -> tuple[Targets, tuple[str, ...]]:
    """Targets from the files of a capture, or from those that the job names, and what is to be said about them."""
    alpha, hidden = config.target.alpha, bool((config.integrator.model_extra or {}).get("hide_emitters"))
    if config.capture is None:
        files = by_view("target images", config.target.images or [], sensors, base)
        return read_targets(files, alpha, scene, sensors, base, hidden=hidden, album=album)
    if other := set(sensors) - set(shots):
        raise PathreplayError(f"sensors: '{min(other)}' is no camera of the capture, and has no picture; leave it out")
    pictures = {name: str(shot.image.resolve()) for name, shot in shots.items()}
    masks = {name: str(shot.mask.resolve()) for name, shot in shots.items() if shot.mask is not None}
    if masks and alpha == "mask":
        raise PathreplayError("target: the capture has masks, and alpha = 'mask' is another; leave alpha out")
    lenses = {name: shot.lens for name, shot in shots.items() if shot.lens is not None}
    targets, notes = read_targets(
        pictures, alpha, scene, sensors, base, resize=True, lenses=lenses, hidden=hidden, album=album
    )
    return masked(targets, read_masks(masks, scene, sensors, base, resize=True, lenses=lenses)), notes


def _gradient_integrator(plugin: Plugin) -> mi.Integrator:
    integrator = load_integrator(plugin.model_dump())
    _require_gradients(integrator, plugin.type)
    return integrator


def _require_gradients(integrator: mi.Integrator, name: str) -> None:
    if not isinstance(integrator, mi.CppADIntegrator):
        raise PathreplayError(f"Integrator '{name}' computes no gradients; use 'pathreplay' or another AD integrator")


def _edges(params: mi.SceneParameters, keys: Iterable[str], integrator: mi.Integrator) -> tuple[str, ...]:
    """What is to be said of edges that move. An integrator of ours need not say it once more."""
    moving = [key for key in keys if moves_edges(params, key)]
    edges = getattr(integrator, "boundary", "none")
    # By name: Mitsuba's projective integrators sample edges. Ours tells itself what it leaves out.
    if not moving or "Projective" in type(integrator).__name__ or edges == "all":
        return ()
    if hasattr(integrator, "told"):
        integrator.told.add(EDGES)
    return (COST_OF_EDGES if edges == "auto" else edges_note(moving, edges),)
