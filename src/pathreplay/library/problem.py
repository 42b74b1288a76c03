"""Inverse problems: a scene, its unknown parameters, target images and a loss, from objects or from a job."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from pathreplay.errors import PathreplayError, shown
from pathreplay.inverse.config.schema import make_config, read_table
from pathreplay.inverse.dataset.targets import Targets
from pathreplay.inverse.images.io import Image
from pathreplay.inverse.losses.pixelwise import LOSSES
from pathreplay.inverse.objective.reached import require_possible
from pathreplay.inverse.parameters.pose import PART_NAMES
from pathreplay.inverse.parameters.values import Array, Arrays, require_finite_array
from pathreplay.inverse.parameters.variables import Variable, free_of, keys_of
from pathreplay.inverse.problem import joint as inner_joint
from pathreplay.inverse.problem import problem as inner
from pathreplay.inverse.problem.feasibility import require_variant
from pathreplay.library.descriptions import Derived, Objects, Parameter, View, by_key, require_kinds
from pathreplay.library.iterations import rendered
from pathreplay.library.sharing import Part, require_alike
from pathreplay.library.views import by_name, targets_of
from pathreplay.platform import backend
from pathreplay.platform.device import require_order
from pathreplay.platform.traversal import traversed
from pathreplay.runs.run_folder import IN_MEMORY
from pathreplay.scenes.loading import load_scene_for
from pathreplay.scenes.parameters import SceneValue, get_array, require_settable
from pathreplay.types import Json

MOST_ITERATIONS = 10**6
"""Number of iterations in the config of a problem that does not define it. Every ``refine_at`` must be below it."""
OF_A_PROBLEM = frozenset(
    "scene scene_parameters sensors test_views variant integrator baseline parameters derived capture exposure "
    "response view_weights target loss learning_rate deterministic memory_limit".split()
)
"""Keys of a job that are fixed when the problem is created."""
OF_VIEWS = {
    "target": "View(target=..., weight=...)",
    "sensors": "View(sensor=...)",
    "test_views": "View(test=True)",
    "view_weights": "View(share=...)",
    "capture": "load_job, without 'views'",
}
"""Keys of a job that views replace, and what takes their place."""


class Problem:
    """An inverse problem: minimise the mean of ``loss(render(scene, view), target)`` over all views.

    The unknowns are scene parameters. The scene is not copied, and has the values of the last evaluation. The
    integrator's boundary terms differentiate visibility. Sampling decisions, Russian roulette and targets are not
    differentiated.

    Args:
        scene: a scene, a dictionary for `mi.load_dict`, an XML file, or the name of a built-in scene. A `mi.Scene` is
            used unchanged. Scenes of the other kinds are loaded such that ``parameters`` are differentiable: if an
            index of refraction is a parameter, `dielectric_ad` replaces each ``dielectric``, and 8-bit textures that
            are parameters are stored as floating-point numbers.
        parameters: options by parameter key of ``mi.traverse(scene)`` or glob, or a sequence of keys without options.
        views: sensors and their targets.
        loss: a name (see `pathreplay.losses`), or ``loss(image, target)`` on tensors of shape (height, width, channels)
            that returns such a tensor or one number.
        integrator: an integrator, its dictionary or its type. Default: `pathreplay` with the depth of the scene's
            integrator.
        derived: scene parameters that are computed from ``parameters``, by key or glob.
        spp: samples per pixel of the image and of its derivative.
        learning_rate: learning rate of parameters that have none of their own.
        seed: seed of all random numbers.
        deterministic: reproduce results bit by bit; this uses one thread and needs an LLVM variant.
        **settings: further keys of a job, such as ``eval_spp``, ``exposure``, ``memory_limit`` (docs/job-reference.md).

    Raises:
        PathreplayError: the problem is invalid. This is checked before anything is rendered.
    """

    def __init__(  # noqa: PLR0913 (most arguments are keyword-only)
        self,
        scene: mi.Scene | Mapping[str, object] | str | Path,
        parameters: Mapping[str, Parameter | None] | Sequence[str] | str,
        views: View | Sequence[View],
        *,
        loss: str | Callable[[mi.TensorXf, mi.TensorXf], mi.TensorXf] = "l2",
        integrator: Mapping[str, object] | mi.Integrator | str | None = None,
        derived: Mapping[str, Derived] | None = None,
        spp: int = 16,
        learning_rate: float = 0.02,
        seed: int = 0,
        deterministic: bool = False,
        **settings: object,
    ) -> None:
        _require_none_of_views(settings)
        _require_no_output("problem", settings)
        settings |= {"spp": spp, "learning_rate": learning_rate, "seed": seed, "deterministic": deterministic}
        self._build(settings, Path.cwd(), scene, parameters, views, loss, integrator, derived or {})

    def _build(
        self,
        job: Json,
        base: Path,
        scene: mi.Scene | Mapping[str, object] | str | Path | None = None,
        parameters: Mapping[str, Parameter | None] | Sequence[str] | str | None = None,
        views: View | Sequence[View] | None = None,
        loss: str | Callable[[mi.TensorXf, mi.TensorXf], mi.TensorXf] | None = None,
        integrator: Mapping[str, object] | mi.Integrator | str | None = None,
        derived: Mapping[str, Derived] | None = None,
    ) -> None:
        """Replace parts of the job's tables by the given objects, and build the problem."""
        self.base, self.job, objects = base, job, Objects()
        self.functions = objects.functions
        self.notes: tuple[str, ...] = ()
        if mi.variant() is None or "variant" in job:
            backend.set_variant(job.get("variant"))
        job["variant"] = mi.variant()  # for runs that are resumed or exported by the command line
        wanted = None if parameters is None else by_key(parameters)
        if wanted == {}:
            raise PathreplayError("parameters: there are none; give {KEY: Parameter(...)}, or a list of keys")
        integrator = {"type": integrator} if isinstance(integrator, str) else integrator
        looked_at = None if views is None else [views] if isinstance(views, View) else list(views)
        require_kinds(wanted or {}, looked_at or (), derived or {})
        if wanted is not None:
            job["parameters"] = objects.tables(wanted)
        if derived is not None:
            job["derived"] = objects.made(derived)
        if loss is not None:
            job["loss"] = next((name for name, each in LOSSES.items() if each is loss), None) or objects.named(loss)
        own_integrator = None if isinstance(integrator, Mapping) else integrator
        if integrator is not None:
            job["integrator"] = (
                dict(integrator) if isinstance(integrator, Mapping) else {"type": type(integrator).__name__}
            )
        if isinstance(scene, (str, Path)):
            job["scene"], scene = str(scene), None
        own_scene, targets = None, None
        if scene is not None or looked_at is not None:
            own_scene, self.notes = _loaded(job.get("scene") if scene is None else scene, job, base)
            targets = _moved(job, own_scene, looked_at)
        if job.get("deterministic"):
            require_order(mi.variant())
        memory = inner.InMemory(own_scene, own_integrator, objects.functions, objects.starts)
        self.in_memory = memory != inner.InMemory()
        """Whether the problem contains objects that a job file cannot describe."""
        known = {"iterations", "stages"} & set(job)
        names = {f"parameters.{n}": f"Parameter '{key}'" for n, key in enumerate(wanted or {})}
        config = make_config(job if known else {"iterations": MOST_ITERATIONS, **job}, "problem", names)
        self.built = inner.build_problem(config, base, targets, memory if self.in_memory else None)
        require_possible(self.built)

    @staticmethod
    def joint(problems: Sequence[Problem]) -> Problem:
        """Combine problems with different scenes into one, whose loss is the mean of their losses.

        Args:
            problems: the problems. Parameters with the same name are shared, and must have the same initial value,
                bounds, learning rate and other options in all problems that have the parameter. Settings such as
                ``spp``, ``seed`` and ``deterministic`` must be the same in all problems. Each problem keeps its
                integrator and its loss.

        Returns:
            The combined problem, which uses the problems' scenes. Its views have names such as ``0-left`` and
            ``1-left``.

        Raises:
            PathreplayError: shared parameters have different shapes, options or initial values, settings differ, two
                problems have the same scene, or a problem has exposures, a response or a baseline.
        """
        if isinstance(problems, Problem) or not problems:
            found = "this is a single one" if problems else "there are none"
            raise PathreplayError(f"problems: {found}; give a list of problems")
        for n, problem in enumerate(problems):
            problem.require_variant()
            if isinstance(problem.built, inner_joint.JointProblem):
                raise PathreplayError(f"problems: problem {n} is itself joint; list the problems that it combines")
        joint: Problem = Problem.__new__(Problem)
        first = problems[0]
        joint.base, joint.in_memory, joint.functions = first.base, True, {}
        joint.notes = tuple(dict.fromkeys(note for problem in problems for note in problem.notes))
        tables = {kind: [each for p in problems for each in p.job.get(kind, [])] for kind in ("parameters", "derived")}
        known = {kind: list({table["key"]: table for table in all_[::-1]}.values()) for kind, all_ in tables.items()}
        seen = {f"{n}-{view.name}": view for n, problem in enumerate(problems) for view in problem.built.views}
        joint.job = {
            **first.job, **known, "scene": IN_MEMORY, "sensors": list(seen), "target": {"images": list(seen)},
            "test_views": [name for name, view in seen.items() if view.is_test],
            "view_weights": {name: view.share for name, view in seen.items() if view.share != 1},
        }  # fmt: skip
        joint.job.pop("capture", None)  # its cameras and images are among the views
        config = first.built.config.model_copy(update={"parameters": make_config(joint.job).parameters})
        joint.built = inner_joint.joined([problem.built for problem in problems], config)
        require_alike([Part(problem.built, problem.job, problem.functions) for problem in problems])
        return joint

    def __repr__(self) -> str:
        return (
            f"<Problem: {', '.join(self.initial)}; {len(self.built.views)} views, loss {self.built.config.loss_name}>"
        )

    @property
    def scene(self) -> mi.Scene:
        """Return the scene, with the values of the last evaluation."""
        return self.built.scene

    @property
    def initial(self) -> dict[str, Array]:
        """Return the initial values by name; a pose has two: ``KEY:translation`` and ``KEY:rotation``."""
        return {v.key: np.array(v.start, np.float32) for v in self.built.variables}

    def render(
        self, values: Mapping[str, ArrayLike] | None = None, view: int | str = 0, spp: int | None = None
    ) -> Image:
        """Render a view.

        Args:
            values: arrays by name, or numbers for all entries; default: initial values.
            view: index or name of the view.
            spp: samples per pixel; default: ``eval_spp``.

        Returns:
            Linear pixels (height, width, channels).

        Raises:
            PathreplayError: a value is not finite, or has the wrong name or shape, the view does not exist, or another
                variant is active than when the problem was created.
        """
        return rendered(self.built, self.complete(values), view, spp)

    def complete(self, values: Mapping[str, ArrayLike] | None) -> dict[str, Array]:
        """Add initial values for missing ones.

        Raises PathreplayError if a value is not finite, or has the wrong name or shape.
        """
        given, starts = values or {}, {v.key: v.start for v in self.built.variables}
        if unknown := set(given) - set(starts):
            raise PathreplayError(f"No parameter '{min(unknown)}' in the problem; it has {', '.join(starts)}")
        return {
            key: _fitted(key, given[key], start.shape) if key in given else np.array(start, np.float32)
            for key, start in starts.items()
        }

    def require_variant(self) -> None:
        """Raise PathreplayError if another variant is active than when the problem was created."""
        require_variant(self.built.config.variant)

    def configured(self, changes: Mapping[str, object], name: str) -> inner.Problem:
        """Return the problem with changed settings.

        Args:
            changes: keys of a job and their values.
            name: start of error messages.

        Returns:
            A problem with the same scene and targets, and with the job's settings overridden by the changes.

        Raises:
            PathreplayError: a setting is invalid, or can be set only when the problem is created, or another variant
                is active than when the problem was created.
        """
        self.require_variant()
        if fixed := sorted(OF_A_PROBLEM & set(changes)):
            raise PathreplayError(f"{name}: '{fixed[0]}' belongs to the problem; give it to Problem")
        job = {key: value for key, value in self.job.items() if key != "iterations" or "stages" not in changes}
        checked = make_config({**job, **changes}, name, {"iterations": "steps"})
        config = self.built.config.model_copy(update={key: getattr(checked, key) for key in {*changes, "iterations"}})
        config.__dict__["learning_rate_schedule"] = checked.learning_rate_schedule
        built = replace(self.built, config=config)
        if isinstance(built, inner_joint.JointProblem):
            built = replace(built, parts=tuple(replace(part, config=config) for part in built.parts))
        elif "stages" in changes:
            built = replace(built, variables=_refined_in_stages(built))
        require_possible(built)
        return built

    def assign(self, values: Arrays, scene: mi.Scene) -> None:
        """Set the parameters of a scene to these values.

        Raises PathreplayError if this is not a `mi.Scene`, lacks a parameter, or stores a parameter in a type that
        cannot hold its value.
        """
        if not isinstance(scene, mi.Scene):
            raise PathreplayError(f"{shown(scene)} is not a scene of the active variant, {mi.variant()}; load it first")
        params, known = traversed(scene), self.built.scenes()
        found = [inner.scene_values(each, inner.variables_of(each, values)) for each in known]
        fitting = [each for each in found if each.keys() <= set(params.keys())]
        if not fitting:
            missing = next(key for key in found[0] if key not in params)
            raise PathreplayError(f"The scene has no parameter '{missing}'; give a scene with the problem's parameters")
        for each in fitting:
            for key in each:
                require_settable(params, key)
        for each in fitting:
            for key, value in each.items():
                _put(params, key, value)
        params.update()


def _refined_in_stages(built: inner.Problem) -> tuple[Variable, ...]:
    """Return the variables such that grids without ``refine_at`` are refined at the stages of the problem's config."""
    config = built.config
    named, _ = keys_of(built.params, config.parameters, config.derived, built.integrator)
    entries = named | free_of(built.params, config.parameters)
    refine_at = {key: config.completed_entry(entry).refine_at or [] for key, entry in entries.items()}
    return tuple(
        v if v.levels is None else replace(v, levels=replace(v.levels, begins=(0, *refine_at[v.key])))
        for v in built.variables
    )


def _put(params: mi.SceneParameters, key: str, value: SceneValue) -> None:
    """Set a parameter, which some plugins store as a plain number. Raises PathreplayError if the types do not fit."""
    stored = params[key]
    try:
        params[key] = float(get_array(value).item()) if isinstance(stored, float) else value
    except (RuntimeError, TypeError, ValueError):
        raise PathreplayError(
            f"Parameter '{key}' is a {type(stored).__name__} in this scene and a {type(value).__name__} in the "
            "problem's; give a scene with the same plugins"
        ) from None


def run_settings(name: str, steps: int | None, options: Json | None, settings: Mapping[str, object]) -> Json:
    """Collect the settings of a run by job key, without those that are None. ``name`` starts error messages."""
    _require_no_output(name, settings)
    if "iterations" in settings:
        raise PathreplayError(f"{name}: 'iterations' is called 'steps' here")
    given = {"iterations": steps, "optimizer": options, **settings}
    return {key: value for key, value in given.items() if value is not None}


def _require_no_output(name: str, settings: Mapping[str, object]) -> None:
    if settings.get("output") is not None:
        raise PathreplayError(f"{name}: only minimize writes a run folder; give it 'output'")


def _require_none_of_views(settings: Mapping[str, object]) -> None:
    """Raise PathreplayError if a setting beside 'views' would be replaced by them."""
    if dropped := [key for key in OF_VIEWS if settings.get(key) is not None]:
        raise PathreplayError(f"'{dropped[0]}' would be replaced by 'views'; use {OF_VIEWS[dropped[0]]} instead")


def _fitted(key: str, value: ArrayLike, wanted: tuple[int, ...]) -> Array:
    """Convert a value to the ``wanted`` shape of its parameter. Textures and grids may have another resolution.

    The entries of a flat parameter, such as vertices, may be rows of an array, or points of Dr.Jit. A number is the
    value of all entries, except for poses. Raises PathreplayError if the shape does not fit, or a value is not finite.
    """
    if dr.is_array_v(value):
        points = not dr.is_tensor_v(value) and dr.depth_v(value) > 1 and len(wanted) == 1
        value = get_array(dr.ravel(value) if points else value)
    try:
        with np.errstate(over="ignore"):  # values beyond single precision become infinite, and are refused below
            array = np.array(value, np.float32)
    except (TypeError, ValueError, OverflowError):
        raise PathreplayError(f"Value of '{key}' is {shown(value)}; give an array of numbers") from None
    require_finite_array(f"Value of '{key}'", array)
    if array.ndim == 0 and not key.endswith(PART_NAMES):
        return np.full(wanted, array)
    resized = len(wanted) >= 3 and array.ndim == len(wanted) and array.shape[-1] == wanted[-1]
    rows = len(wanted) == 1 and array.size == wanted[0]
    of_vertices = key.rpartition(".")[2].startswith("vertex_")
    if rows and of_vertices and array.ndim > 1 and array.shape[0] < array.shape[-1]:  # (3, n) in place of (n, 3)
        raise PathreplayError(
            f"Value of '{key}' has the shape {array.shape}, not the shape {wanted}; transpose it, so that each vertex "
            "is a row"
        )
    if array.shape != wanted and not resized and not rows:
        raise PathreplayError(f"Value of '{key}' has the shape {array.shape}, not the shape {wanted}; reshape it")
    return array if resized else array.reshape(wanted)


def _loaded(scene: object, job: Json, base: Path) -> tuple[mi.Scene, tuple[str, ...]]:
    """Load a scene so that the job's parameters are differentiable. Returns the scene and notes on changes.

    If ``scene`` is a `mi.Scene`, it is returned unchanged. See `load_scene_for`.
    """
    if isinstance(scene, mi.Scene):
        return scene, ()
    if not isinstance(scene, (Mapping, str, Path)):
        raise PathreplayError(
            f"scene: {shown(type(scene).__name__)} is not a scene of the active variant, {mi.variant()}; load it in "
            "this variant, or give a dictionary, a file or the name of a built-in scene"
        )
    tables = [*job.get("parameters", []), *job.get("derived", [])]
    wanted = [table["key"] for table in tables if table.get("shape") is None]
    given = job.get("scene_parameters", {}) if isinstance(scene, str) else {}
    return load_scene_for(dict(scene) if isinstance(scene, Mapping) else scene, wanted, base, **given)


def _moved(job: Json, scene: mi.Scene, views: Sequence[View] | None) -> Targets | None:
    """Replace the scene in the tables of a job by a reference to a scene in memory.

    If ``views`` are given, they replace the sensors and targets of the job. Returns their targets, or None.
    """
    said, job["scene"] = job.get("scene"), IN_MEMORY
    if views is None:
        if "images" not in job.get("target", {}) and "capture" not in job:
            job["target"] = {"scene": said, **job.get("target", {})}  # keep rendering the targets from the job's scene
        return None
    named = by_name(scene, views)
    job.pop("capture", None)
    job["sensors"] = list(named)
    job["test_views"] = [name for name, view in named.items() if view.test]
    job["view_weights"] = {name: view.share for name, view in named.items() if view.share != 1}
    job["target"] = {"images": list(named)}
    return targets_of(scene, named)


def load_job(
    path: str | Path,
    *,
    scene: mi.Scene | Mapping[str, object] | str | Path | None = None,
    parameters: Mapping[str, Parameter | None] | Sequence[str] | str | None = None,
    views: View | Sequence[View] | None = None,
    loss: str | Callable[[mi.TensorXf, mi.TensorXf], mi.TensorXf] | None = None,
    integrator: Mapping[str, object] | mi.Integrator | str | None = None,
    derived: Mapping[str, Derived] | None = None,
    define: Sequence[str] = (),
    **settings: object,
) -> Problem:
    """Create a problem from a job file, with changes.

    The optimizer, iterations and schedule of the file are the defaults of `minimize`. The ``output`` of the file is
    ignored: only `minimize` with ``output`` writes a folder.

    Args:
        path: a TOML, YAML or JSON file; relative paths in it refer to its folder.
        scene: replaces the scene of the file; see `Problem`.
        parameters: replaces the parameters of the file; see `Problem`.
        views: replaces sensors and targets of the file; see `Problem`.
        loss: replaces the loss of the file; see `Problem`.
        integrator: replaces the integrator of the file; see `Problem`.
        derived: replaces the derived parameters of the file; see `Problem`.
        define: changes to the file, each ``KEY=VALUE`` like ``--set`` on the command line.
        **settings: keys of a job and their values, such as ``spp=8`` or ``stages=[...]``; None removes a key.

    Returns:
        The problem. Targets are read or rendered, and the ``variant`` of the file is set.

    Raises:
        PathreplayError: the file cannot be read, or the problem is invalid.
    """
    if views is not None:
        _require_none_of_views(settings)
    _require_no_output("load_job", settings)
    table = read_table(Path(path), define)
    make_config(table, str(path))  # checks the file alone, so that error messages name the file
    table = {key: value for key, value in {**table, **settings}.items() if value is not None}
    problem = Problem.__new__(Problem)
    problem._build(table, Path(path).parent.absolute(), scene, parameters, views, loss, integrator, derived)
    return problem
