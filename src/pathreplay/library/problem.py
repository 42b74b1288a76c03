"""An inverse problem in memory: a scene, what of it is sought, the images to match, and a loss."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

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
from pathreplay.inverse.parameters.values import Array, Arrays
from pathreplay.inverse.problem import joint as inner_joint
from pathreplay.inverse.problem import problem as inner
from pathreplay.library.descriptions import Derived, Objects, Parameter, View, by_key, require_kinds
from pathreplay.library.iterations import rendered
from pathreplay.library.views import by_name, targets_of
from pathreplay.platform import backend
from pathreplay.platform.device import require_order
from pathreplay.platform.traversal import traversed
from pathreplay.runs.run_folder import IN_MEMORY
from pathreplay.scenes.loading import load_scene_for

MOST_ITERATIONS = 10**6
"""Iterations of a problem that nobody minimises: above all at which a grid is refined."""
OF_A_PROBLEM = frozenset(
    "scene scene_parameters sensors test_views variant integrator baseline parameters derived capture exposure "
    "view_weights target loss learning_rate deterministic memory_limit".split()
)
"""Keys of a job that decide what is built, and do not change afterwards."""


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
        **settings: further keys of a job, such as ``eval_spp``, ``exposure``, ``memory_limit`` (docs/job-reference.md).

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
        **settings: Any,
    ) -> None:
        settings |= {"spp": spp, "learning_rate": learning_rate, "seed": seed, "deterministic": deterministic}
        self._build(settings, Path.cwd(), scene, parameters, views, loss, integrator, derived or {})

    def _build(
        self,
        job: dict[str, Any],
        base: Path,
        scene: Any = None,
        parameters: Any = None,
        views: Any = None,
        loss: Any = None,
        integrator: Any = None,
        derived: Any = None,
    ) -> None:
        """Put objects, those that are given, in the place of what a job says, and build all of it."""
        self.base, self.job, objects = base, job, Objects()
        self.notes: tuple[str, ...] = ()
        if mi.variant() is None or "variant" in job:
            backend.set_variant(job.get("variant"))
        wanted = None if parameters is None else by_key(parameters)
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
            job["integrator"] = {"type": type(integrator).__name__} if own_integrator else dict(integrator)
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
        """Whether it holds objects that no job could name."""
        known = {"iterations", "stages"} & set(job)
        config = make_config(job if known else {"iterations": MOST_ITERATIONS, **job}, "problem")
        self.built = inner.build_problem(config, base, targets, memory if self.in_memory else None)
        require_possible(self.built)

    @staticmethod
    def joint(problems: Sequence[Problem]) -> Problem:
        """Make one problem of several, each of a scene of its own: min of the mean of their losses.

        Args:
            problems: what they have in common are parameters of one name, which are one parameter; initial value,
                bounds, learning rate and regularizers are those of the first problem that has it. Settings (``spp``,
                ``seed``, ``deterministic``, ...) are those of the first problem.

        Returns:
            The problem, whose views are those of all, named ``0-left``, ``1-left``, ... It uses their scenes.

        Raises:
            PathreplayError: parameters of one name in several shapes, problems of one scene, and those with exposures
                or baselines.
        """
        if not problems:
            raise PathreplayError("problems: there is none; give two or more")
        joint: Problem = Problem.__new__(Problem)
        first = problems[0]
        joint.base, joint.in_memory = first.base, True
        joint.notes = tuple(dict.fromkeys(note for problem in problems for note in problem.notes))
        tables = {kind: [each for p in problems for each in p.job.get(kind, [])] for kind in ("parameters", "derived")}
        known = {kind: list({table["key"]: table for table in all_[::-1]}.values()) for kind, all_ in tables.items()}
        seen = {f"{n}-{view.name}": view for n, problem in enumerate(problems) for view in problem.built.views}
        joint.job = {
            **first.job, **known, "scene": IN_MEMORY, "sensors": list(seen), "target": {"images": list(seen)},
            "test_views": [name for name, view in seen.items() if view.is_test],
            "view_weights": {name: view.share for name, view in seen.items() if view.share != 1},
        }  # fmt: skip
        config = first.built.config.model_copy(update={"parameters": make_config(joint.job).parameters})
        joint.built = inner_joint.joined([problem.built for problem in problems], config)
        return joint

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

    def render(
        self, values: Mapping[str, ArrayLike] | None = None, view: int | str = 0, spp: int | None = None
    ) -> Image:
        """Render a view.

        Args:
            values: arrays by name; initial ones where left out.
            view: its place or its name.
            spp: samples per pixel; None: ``eval_spp``.

        Returns:
            Linear pixels (height, width, channels).

        Raises:
            PathreplayError: values that do not fit, or no such view.
        """
        return rendered(self.built, self.complete(values), view, spp)

    def complete(self, values: Mapping[str, ArrayLike] | None) -> dict[str, Array]:
        """Values of all parameters: those given, else initial ones. Raises PathreplayError for what does not fit."""
        given, starts = values or {}, {v.key: v.start for v in self.built.variables}
        if unknown := set(given) - set(starts):
            raise PathreplayError(f"No parameter '{min(unknown)}' in the problem; it has {', '.join(starts)}")
        return {
            key: _fitted(key, given[key], start.shape) if key in given else np.array(start, np.float32)
            for key, start in starts.items()
        }

    def configured(self, changes: Mapping[str, Any], name: str) -> inner.Problem:
        """The problem with other settings, checked as those of a job; ``name`` is who asks.

        Raises PathreplayError for what cannot be, and for what a problem cannot change.
        """
        if fixed := sorted(OF_A_PROBLEM & set(changes)):
            raise PathreplayError(f"{name}: '{fixed[0]}' belongs to the problem; give it where that is made")
        checked = make_config({**self.job, **changes}, name)
        config = self.built.config.model_copy(update={key: getattr(checked, key) for key in {*changes, "iterations"}})
        config.model_fields_set.update(changes)
        config.__dict__["learning_rate_schedule"] = checked.learning_rate_schedule
        built = replace(self.built, config=config)
        require_possible(built)
        return built

    def assign(self, values: Arrays, scene: mi.Scene) -> None:
        """Give a scene with the same parameters these values."""
        params, known = traversed(scene), self.built.scenes()
        found = [inner.scene_values(each, inner.variables_of(each, values)) for each in known]
        fitting = [each for each in found if each.keys() <= set(params.keys())]
        if not fitting:
            missing = next(key for key in found[0] if key not in params)
            raise PathreplayError(f"The scene has no parameter '{missing}'; give one that is built alike")
        for each in fitting:
            for key, value in each.items():
                params[key] = value
        params.update()


def _fitted(key: str, value: ArrayLike, wanted: tuple[int, ...]) -> Array:
    """A value of a parameter; textures and grids may have other sizes."""
    array = np.array(dr.detach(value) if dr.is_array_v(value) else value, np.float32)
    resized = len(wanted) >= 3 and array.ndim == len(wanted) and array.shape[-1] == wanted[-1]
    if array.shape != wanted and not resized and not (len(wanted) == 1 and array.size == wanted[0]):
        raise PathreplayError(f"Value of '{key}' has the shape {array.shape}, the parameter {wanted}; reshape it")
    return array if resized else array.reshape(wanted)


def _loaded(scene: Any, job: Mapping[str, Any], base: Path) -> tuple[mi.Scene, tuple[str, ...]]:
    """The scene, in which what is sought carries derivatives as far as exchanging plugins brings it, and notes."""
    if isinstance(scene, mi.Scene):
        return scene, ()
    if not isinstance(scene, (Mapping, str, Path)):
        raise PathreplayError(
            f"scene: {shown(type(scene).__name__)} is no scene of the active variant, {mi.variant()}; load it in "
            "this variant, or give a dictionary, a file or the name of a built-in scene"
        )
    tables = [*job.get("parameters", []), *job.get("derived", [])]
    wanted = [table["key"] for table in tables if table.get("shape") is None]
    given = job.get("scene_parameters", {}) if isinstance(scene, str) else {}
    return load_scene_for(dict(scene) if isinstance(scene, Mapping) else scene, wanted, base, **given)


def _moved(job: dict[str, Any], scene: mi.Scene, views: Sequence[View] | None) -> Targets | None:
    """Tell a job that its scene is in memory, and so are its images, if there are ``views``, which are returned."""
    said, job["scene"] = job.get("scene"), IN_MEMORY
    if views is None:
        if "images" not in job.get("target", {}) and "capture" not in job:
            job["target"] = {"scene": said, **job.get("target", {})}  # where they are rendered
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
    scene: mi.Scene | Mapping[str, Any] | str | Path | None = None,
    parameters: Mapping[str, Parameter | None] | Sequence[str] | str | None = None,
    views: View | Sequence[View] | None = None,
    loss: str | Callable[[Any, Any], Any] | None = None,
    integrator: Mapping[str, Any] | mi.Integrator | None = None,
    derived: Mapping[str, Derived] | None = None,
    define: Sequence[str] = (),
    **settings: Any,
) -> Problem:
    """Make a problem of what a job's file says, and of what shall be otherwise.

    `minimize` takes optimizer, iterations and schedule from the file, too, where it is given no others; it writes a
    folder only where it is asked to, and takes no notice of ``output``.

    Args:
        path: a TOML, YAML or JSON file; its relative paths start at its folder.
        scene: as in `Problem`; this and the next five take the place of the file's.
        parameters: as in `Problem`.
        views: as in `Problem`.
        loss: as in `Problem`.
        integrator: as in `Problem`.
        derived: as in `Problem`.
        define: changes as the command line has them, each ``KEY=VALUE``.
        **settings: keys of a job with their values, such as ``spp=8`` or ``stages=[...]``; None: as if left out.

    Returns:
        The problem, with the targets that the file names or renders. It sets the file's ``variant``.

    Raises:
        PathreplayError: what a file cannot say, and for whatever cannot work, before the first iteration.
    """
    table = read_table(Path(path), define)
    make_config(table, str(path))  # which says what is wrong with the file
    table = {key: value for key, value in {**table, **settings}.items() if value is not None}
    problem = Problem.__new__(Problem)
    problem._build(table, Path(path).parent.absolute(), scene, parameters, views, loss, integrator, derived)
    return problem
