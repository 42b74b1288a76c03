"""The inverse problem: scene, variables with bounds, and views with targets, checked before the first iteration."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.integrators.diagnostics import COST_OF_EDGES
from pathreplay.integrators.edge_notes import edges_note, moves_edges
from pathreplay.integrators.film.image import fit_film
from pathreplay.integrators.integrator import EDGES
from pathreplay.integrators.lifetimes import one_renderer
from pathreplay.integrators.reach import reached_sensors
from pathreplay.integrators.scene_facts import facts_of
from pathreplay.integrators.stateful import stateful
from pathreplay.inverse.config.schema import TARGET, Config
from pathreplay.inverse.config.tables import Plugin
from pathreplay.inverse.config.user_functions import Modules
from pathreplay.inverse.dataset.capture import Shot, fingerprint, put_inside, read_capture
from pathreplay.inverse.dataset.targets import (
    Reading,
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
from pathreplay.inverse.dataset.views import View, named_views, sensors_of, shares_of, test_views_of
from pathreplay.inverse.images.background import require_known
from pathreplay.inverse.images.disk_store import DiskStore
from pathreplay.inverse.images.io import colours_of, picture_size
from pathreplay.inverse.losses.pixelwise import Loss, find_loss
from pathreplay.inverse.parameters import limits as parameter_limits
from pathreplay.inverse.parameters.derived import Derived, make_derived
from pathreplay.inverse.parameters.exposures import EXPOSURE, Factors
from pathreplay.inverse.parameters.exposures import start as start_of_exposures
from pathreplay.inverse.parameters.grids import rmse
from pathreplay.inverse.parameters.pose import Pose
from pathreplay.inverse.parameters.reparameterization import Transform
from pathreplay.inverse.parameters.response import RESPONSE
from pathreplay.inverse.parameters.response import coordinates as coordinates_of_response
from pathreplay.inverse.parameters.response import start as start_of_response
from pathreplay.inverse.parameters.values import Array, Arrays
from pathreplay.inverse.parameters.variables import Variable, free_of, keys_of, make_variables
from pathreplay.inverse.problem import feasibility
from pathreplay.inverse.problem.completed import completed, with_default_target
from pathreplay.platform import memory
from pathreplay.platform.owned_arrays import owned
from pathreplay.platform.threads import one_thread
from pathreplay.platform.traversal import known_values, traversed
from pathreplay.scenes import parameters
from pathreplay.scenes.descriptions import errors_as, load_integrator
from pathreplay.scenes.loading import load_scene_for
from pathreplay.scenes.parameters import SceneValue


class VariableCache:
    """Cache of the variables that were last converted to Dr.Jit. All callers share this one copy."""

    def __init__(self) -> None:
        self._known: dict[str, tuple[weakref.ref[Array], dr.ArrayBase]] = {}

    def variables(self, problem: Problem, values: Arrays) -> dict[str, dr.ArrayBase]:
        """Convert values as `variables_of` does, without gradients.

        The arrays of the last call are reused if the values are the same objects.
        """
        keys = [v.key for v in problem.variables]
        if any(key not in self._known or self._known[key][0]() is not values[key] for key in keys):
            self._known = {}  # release the old copies first
            converted = variables_of(problem, values)
            # Weak references do not keep arrays alive. Ids are not sufficient, because ids of freed arrays are reused.
            self._known = {key: (weakref.ref(values[key]), value) for key, value in converted.items()}
        variables = {key: self._known[key][1] for key in keys}
        dr.disable_grad(variables)
        return variables


@dataclass(frozen=True)
class Problem:
    """Minimise, over the variables, the mean of loss(render(scene, view), target of the view) over the views."""

    config: Config
    """The job with its default integrators filled in (see `completed`)."""
    scene: mi.Scene
    params: mi.SceneParameters
    integrator: mi.Integrator
    baseline: mi.Integrator | None
    """Integrator of a second run, which solves the same problem in the same time for comparison, or None."""
    judge: mi.Integrator
    """Integrator that renders images for comparing the results of ``integrator`` and ``baseline`` with the targets.

    This is the integrator that rendered the targets, or ``integrator`` if the targets are image files."""
    variables: tuple[Variable, ...]
    poses: tuple[Pose, ...]
    views: tuple[View, ...]
    loss: Loss
    notes: tuple[str, ...]
    """Messages to the user about changes to the scene and missing gradients."""
    derived: tuple[Derived, ...] = ()
    capture: str | None = None
    """Hash of the capture (see `fingerprint`)."""
    disk: DiskStore = field(default_factory=DiskStore)
    """Store of images, initial values and true values."""
    cache: VariableCache = field(default_factory=VariableCache)
    """Cache of converted values."""

    @property
    def debias(self) -> bool:
        """Whether the bias of the loss due to noise is removed to first order: see `ViewLoss.debias`."""
        return self.config.debias

    @contextmanager
    def computing(self) -> Iterator[None]:
        """Return a context for renderings: it turns errors of integrators into PathreplayError, and limits the memory.

        Deterministic jobs use one thread. Raises PathreplayError if another Python thread is rendering, or if another
        variant is active than when the problem was created.
        """
        config = self.config
        feasibility.require_variant(config.variant)
        names = "' or '".join(plugin.type for plugin in (config.integrator, config.baseline) if plugin is not None)
        problem = f"Integrator '{names}' cannot do this job"
        with one_renderer(), one_thread(config.deterministic), errors_as(problem), memory.within(config.budget):
            yield

    def moves(self, moving: frozenset[str]) -> set[str]:
        """Return the keys of the scene parameters that depend on some of these variables."""
        computed = {entry.key for entry in self.made() if not moving.isdisjoint(entry.of)}
        return {key for key in moving if key in self.params} | computed

    def reached(self, moving: frozenset[str]) -> set[int]:
        """Return the indices of the views whose rendered images, before exposure, depend on some of these variables."""
        sensors = [self.scene.sensors()[view.sensor] for view in self.views]
        flags = reached_sensors(self.scene, sensors, self.params, self.moves(moving))
        return {n for n, reached in enumerate(flags) if reached}

    def scenes(self) -> tuple[Problem, ...]:
        """Return the problems of all scenes of a joint problem, or this problem alone if it has a single scene."""
        return (self,)

    def home(self, view: View) -> tuple[Problem, View]:
        """Return the single-scene problem that renders a view, and the corresponding view of that problem."""
        return self, view

    def with_targets(self, targets: Targets) -> Problem:
        """Return this problem with other target images, one for each view, and other pixel weights."""
        images = {name: self.disk.keep(image) for name, image in targets.images.items()}
        weights = {name: self.disk.keep(weight) for name, weight in targets.weights.items()}
        views = (replace(view, target=images[view.name], weight=weights.get(view.name)) for view in self.views)
        return replace(self, views=tuple(views))

    def made(self) -> tuple[Pose | Derived, ...]:
        """Return the scene parameters that are computed from variables: poses and derived parameters."""
        return *self.poses, *self.derived

    def trained(self) -> dict[int, View]:
        """Return the training views by index."""
        return {n: view for n, view in enumerate(self.views) if not view.is_test}


def variables_of(problem: Problem, values: Arrays) -> dict[str, dr.ArrayBase]:
    """Convert the decoded values of the variables to evaluated Dr.Jit arrays that own their memory."""
    variables = {v.key: owned(v.held(values[v.key])) for v in problem.variables}
    dr.eval(variables)
    return variables


def scene_values(problem: Problem, variables: Mapping[str, dr.ArrayBase]) -> dict[str, SceneValue]:
    """Compute the scene parameters in the form that Mitsuba stores. Derivatives propagate to the variables.

    Args:
        problem: the problem.
        variables: Dr.Jit values of the variables, by key.

    Returns:
        Values of scene parameters, by key.
    """
    plain: dict[str, SceneValue] = {
        v.key: v.form.store(variables[v.key]) for v in problem.variables if v.key in problem.params
    }
    derived = {entry.key: entry.form.store(entry.value(variables)) for entry in problem.derived}
    return plain | derived | {pose.key: pose.value(variables) for pose in problem.poses}


def sensor_of(problem: Problem, view: View) -> mi.Sensor:
    """Return the sensor of a view, after resizing its film to the target image."""
    sensor = problem.scene.sensors()[view.sensor]
    fit_film(sensor, view.target.shape)
    return sensor


def put_values(problem: Problem, values: Arrays) -> None:
    """Set the parameters of the scene, or of all scenes, to the values of the variables, without gradients."""
    for each in problem.scenes():
        each.params.update(scene_values(each, each.cache.variables(each, values)))
        facts_of(each.scene).enclose(each.scene)


def detach(problem: Problem) -> None:
    """Detach the parameters of the scene, or of all scenes, after a gradient pass. Their values stay as they are.

    Dr.Jit traces virtual function calls through all scenes that exist. Gradients that stay enabled in one scene would
    make forward mode fail in all others.
    """
    for each in problem.scenes():
        for key, value in known_values(each.params):
            if dr.grad_enabled(value):
                each.params[key] = dr.detach(value)
        each.params.update()


def errors_of(problem: Problem, values: Arrays) -> dict[str, float]:
    """Compute the errors of all values whose true value is known.

    Args:
        problem: the problem.
        values: values of the variables.

    Returns:
        Root mean square errors by key, and the errors of poses by name (see `PoseError.of`).

    Raises:
        PathreplayError: a derived parameter is not finite.
    """
    errors = {v.key: rmse(values[v.key], v.truth, v.form.wraps) for v in problem.variables if v.truth is not None}
    poses = [pose for pose in problem.poses if pose.truth is not None]
    variables = problem.cache.variables(problem, values) if problem.derived or poses else {}
    for entry in problem.derived:
        value = entry.require_finite(variables)
        if entry.truth is not None:
            errors[entry.key] = rmse(parameters.get_array(value), entry.truth, entry.form.wraps)
    for pose in poses:
        if error := pose.error(parameters.get_array(pose.value(variables))):
            errors |= error.of(pose.key)
    return errors


@dataclass(frozen=True)
class InMemory:
    """Objects that take the place of files and plugins that a job names."""

    scene: mi.Scene | None = None
    integrator: mi.Integrator | None = None
    functions: Mapping[str, Callable[..., object]] = field(default_factory=dict)
    """User functions (losses, regularizers, derivations), by their names in the job."""
    starts: Mapping[str, Array] = field(default_factory=dict)
    """Initial values by key of the parameter, in place of its ``initial``."""


def build_problem(
    config: Config, base: Path, targets: Targets | None = None, memory: InMemory | None = None
) -> Problem:
    """Load and check everything that a job names.

    Args:
        config: the job.
        base: folder that relative paths start from.
        targets: target images of a resumed run, or given as arrays; None to read or render the targets.
        memory: objects that take the place of files and plugins of the job.

    Raises:
        PathreplayError: a part of the job is invalid or inconsistent.
    """
    disk = DiskStore.of(config.budget)
    given = memory or InMemory()
    modules = Modules(base, given.functions)
    loss = find_loss(config.loss, modules)
    film = "rgba" if config.target.alpha == "compare" else "rgb"
    shots = {} if config.capture is None else read_capture(config.capture, base, picture_size, film)
    scene, config, notes = _loaded(config, base, shots, given)
    params = traversed(scene)
    parameters.require_finite(params)
    integrator = given.integrator
    if integrator is None:
        integrator = _gradient_integrator(config.integrator)
    else:
        _require_gradients(integrator)
    named, derivations = keys_of(params, config.parameters, config.derived, integrator)
    keys = [*named, *derivations]
    notes += notes_on_edges(params, keys, integrator)
    baseline = None if config.baseline is None else _gradient_integrator(config.baseline)
    if baseline is not None:
        keys_of(params, config.parameters, config.derived, baseline)
        notes_on_edges(params, keys, baseline)  # only suppresses the note that the baseline would log
    # Cheap checks come before the rendering of targets.
    sensors = sensors_of(scene, list(shots) or None if config.sensors is None else config.sensors)
    used = {name: shots[id] for name, index in sensors.items() if (id := scene.sensors()[index].id()) in shots}
    every = None if config.capture is None else config.capture.test_every
    test_views = test_views_of(scene, sensors, config.test_views, list(shots)[::every] if every else [])
    feasibility.require_visible(scene, params, keys)
    if config.target.alpha == "scene":
        require_known(scene, params, keys)
    require_films(scene, sensors, {"spp": config.most_spp, "eval_spp": config.eval_spp})
    entries = {
        key: config.completed_entry(entry) for key, entry in (named | free_of(params, config.parameters)).items()
    }
    bounded = config.optimizer.type != "sgd"
    unsolved, unsolved_poses = make_variables(scene, params, entries, base, modules, given.starts, bounded)
    derived = make_derived(params, derivations, unsolved, modules)
    parameter_limits.require_values({variable.key: variable.start.size for variable in unsolved})
    opened = _Opened(scene, params, keys, sensors, integrator)
    config, targets, truth, messages = _seen(config, targets, used, opened, base, disk)
    notes += messages
    judge = integrator if config.target.integrator is None else load_integrator(config.target.integrator.model_dump())
    if missing := set(sensors) - set(targets.images):
        raise PathreplayError(f"The run folder has no target image of sensor '{missing.pop()}'; start a new run")
    masked_all = config.target.masks is not None or config.target.alpha == "mask"
    weighted = {n for n in sensors if masked_all or (n in used and (used[n].mask or used[n].lens))}
    require_weights(targets, weighted if memory is None else set(targets.weights))
    shares = shares_of(scene, sensors, config.view_weights, test_views)
    views = tuple(
        View(name, index, targets.images[name], targets.weights.get(name), name in test_views, shares[name])
        for name, index in sensors.items()
    )
    unsolved += _exposures(scene, config, views) + _response(config)
    for view in views:
        feasibility.require_finite_loss(loss, view.name, view.target, view.weight)
        disk.rest()
    variables = tuple(_kept(disk, replace(variable, truth=truth.get(variable.key))) for variable in unsolved)
    poses = tuple(replace(pose, truth=truth.get(pose.key)) for pose in unsolved_poses)
    derived = tuple(replace(entry, truth=truth.get(entry.key)) for entry in derived)
    # Traverse the scene again, because `update` requires all keys that were read, and `keep_only` removes some of them.
    params = traversed(scene)
    parameters.keep_only(params, keys)
    digest = fingerprint(used.values()) if used else None
    return Problem(
        config, scene, params, integrator, baseline, judge, variables, poses, views, loss, notes, derived, digest, disk
    )


def _loaded(
    config: Config, base: Path, shots: Mapping[str, Shot], given: InMemory
) -> tuple[mi.Scene, Config, tuple[str, ...]]:
    """Load the scene and fill in default integrators. Returns scene, completed job, and notes for the user."""
    if given.scene is not None:
        if shots and not set(shots) & {sensor.id() for sensor in given.scene.sensors()}:
            raise PathreplayError(
                "scene: cameras of a capture are only added to the scene file of a job, and this scene is in memory; "
                "give the name of a file, or 'views' in place of the capture"
            )
        config, differences = completed(config, given.scene, given.integrator)
        return given.scene, config, differences
    wanted = [entry.key for entry in config.parameters if entry.shape is None]
    wanted += [entry.key for entry in config.derived]
    cameras = {name: shot.camera for name, shot in shots.items()}
    scene, notes = load_scene_for(config.scene, wanted, base, cameras, **config.scene_parameters)
    notes += parameters.notes_on_ids(traversed(scene), wanted)
    if config.capture is not None and config.capture.medium is not None:
        put_inside(scene, set(shots), config.capture.medium)
    config, differences = completed(config, scene, given.integrator)
    return scene, config, notes + differences


@dataclass(frozen=True)
class _Opened:
    """The scene of a job, the parameters that the job recovers, and the index of the sensor of each view."""

    scene: mi.Scene
    params: mi.SceneParameters
    keys: list[str]
    sensors: dict[str, int]
    integrator: mi.Integrator


def _seen(
    config: Config, targets: Targets | None, shots: Mapping[str, Shot], opened: _Opened, base: Path, disk: DiskStore
) -> tuple[Config, Targets, dict[str, Array], tuple[str, ...]]:
    """Read or render the targets if none are given.

    Returns the job with the integrator of its targets filled in, the targets, true values by key, and notes.
    """
    truth: dict[str, Array] = {}
    notes: tuple[str, ...] = ()
    first = targets is None
    if not config.brings_pictures:
        wanted = [entry.key for entry in config.parameters] + [entry.key for entry in config.derived]
        other = target_scene(*config.target_source, config.target.values, wanted, base)
        truth = truth_of(other, opened.params, opened.keys)
        config = with_default_target(config, opened.integrator, other)
        if targets is None:
            with one_thread(config.deterministic):
                seeds = {name: config.seeds(TARGET, index)[0] for name, index in opened.sensors.items()}
                targets = Targets(rendered_targets(config.target, seeds, other, opened.sensors, disk), {})
            notes = _notes_on_black(targets)
        # Dr.Jit traces virtual calls through all live instances, so a live target scene would enlarge every kernel.
        del other
        gc.collect()
    elif targets is None:
        targets, notes = _pictures(config, shots, opened, base, disk)
    if first and config.target.masks is not None:
        masks = by_view("masks", config.target.masks, opened.sensors, base)
        how = Reading(config.target.alpha)
        targets = masked(targets, read_masks(masks, how, opened.scene, opened.sensors, base))
    return config, targets, truth, notes


def _notes_on_black(targets: Targets) -> tuple[str, ...]:
    black = [name for name, image in targets.images.items() if not np.any(image[..., : colours_of(image.shape[-1])])]
    if not black:
        return ()
    more = f" (and of {len(black) - 1} more)" if len(black) > 1 else ""
    return (
        f"the target of view '{black[0]}'{more} is black: the target scene shows no light there; check its emitters "
        "and sensors, and [target] integrator",
    )


def _kept(disk: DiskStore, variable: Variable) -> Variable:
    truth = None if variable.truth is None else disk.keep(variable.truth)
    return replace(variable, start=disk.keep(variable.start), truth=truth)


def _exposures(scene: mi.Scene, config: Config, views: tuple[View, ...]) -> list[Variable]:
    """Return a list that contains the variable of the exposures, or an empty list if the job has no exposures."""
    if (options := config.exposure) is None:
        return []
    value = start_of_exposures(len(views), min(view.target.shape[2] for view in views), options.white_balance)
    fixed = [n for n, view in enumerate(views) if not view.is_test] if options.fix_scale else []
    if options.reference is not None:
        sensors = {view.name: view.sensor for view in views}
        (reference,) = named_views(scene, sensors, [options.reference], "exposure.reference")
        fixed = [list(sensors).index(reference)]
        if views[fixed[0]].is_test:
            raise PathreplayError(
                f"exposure: the reference '{reference}' is a test view; name a training view as the reference"
            )
    rate = options.learning_rate or config.learning_rate
    return [Variable(EXPOSURE, mi.TensorXf(value), (-np.inf, np.inf), rate, value, None, coordinates=Factors(fixed))]


def _response(config: Config) -> list[Variable]:
    """Return a list that contains the variable of the camera response, or an empty list if the job has none."""
    if (options := config.response) is None:
        return []
    value = start_of_response(None if options.kind == "gamma" else options.segments)
    curve = Transform("log") if options.kind == "gamma" else coordinates_of_response(value, options.fix_exponent)
    rate = options.learning_rate or config.learning_rate
    return [Variable(RESPONSE, mi.TensorXf(value), (-np.inf, np.inf), rate, value, None, coordinates=curve)]


def _pictures(
    config: Config, shots: Mapping[str, Shot], opened: _Opened, base: Path, disk: DiskStore
) -> tuple[Targets, tuple[str, ...]]:
    """Read the targets from the files of a capture or of the job. Returns targets, and notes for the user."""
    scene, sensors = opened.scene, opened.sensors
    hidden = bool(getattr(opened.integrator, "hide_emitters", False))
    how = Reading(config.target.alpha, hidden=hidden, deterministic=config.deterministic)
    if config.capture is None:
        files = by_view("target images", config.target.images or [], sensors, base)
        return read_targets(files, how, scene, sensors, base, disk)
    if other := set(sensors) - set(shots):
        raise PathreplayError(f"sensors: '{min(other)}' is not a camera of the capture and has no image; remove it")
    pictures = {name: str(shot.image.resolve()) for name, shot in shots.items()}
    masks = {name: str(shot.mask.resolve()) for name, shot in shots.items() if shot.mask is not None}
    if masks and how.alpha == "mask":
        raise PathreplayError("target: the capture has masks, which exclude alpha = 'mask'; remove one of them")
    lenses = {name: shot.lens for name, shot in shots.items() if shot.lens is not None}
    how = replace(how, resize=True, lenses=lenses)
    targets, notes = read_targets(pictures, how, scene, sensors, base, disk)
    return masked(targets, read_masks(masks, how, scene, sensors, base)), notes


def _gradient_integrator(plugin: Plugin) -> mi.Integrator:
    integrator = load_integrator(plugin.model_dump())
    _require_gradients(integrator, plugin.type)
    return integrator


def _require_gradients(integrator: mi.Integrator, name: str = "") -> None:
    if not isinstance(integrator, mi.CppADIntegrator):
        if not name:  # users may also give something else than an integrator
            name = str(integrator.class_name()) if isinstance(integrator, mi.Integrator) else type(integrator).__name__
        within = ", without 'aov' around it" if name.lower().startswith("aov") else ""
        raise PathreplayError(
            f"Integrator '{name}' computes no gradients; use 'pathreplay' or another AD integrator{within}"
        )


def notes_on_edges(params: mi.SceneParameters, keys: Iterable[str], integrator: mi.Integrator) -> tuple[str, ...]:
    """Return a note for the user if visibility boundaries move with the parameters.

    The note says that boundary terms are expensive, or that the gradient lacks them. The integrator would log a note of
    its own during rendering. That note is suppressed.
    """
    moving = [key for key in keys if moves_edges(params, key)]
    known = stateful(integrator)
    edges = known.boundary
    if not moving or edges == "all":
        return ()
    known.silence([EDGES])
    return (COST_OF_EDGES if edges == "auto" else edges_note(moving, edges),)
