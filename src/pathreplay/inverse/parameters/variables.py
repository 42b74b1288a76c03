"""Variables of the optimiser, made from the parameters of a job: bounds, learning rates and initial values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import prod
from pathlib import Path
from types import MappingProxyType

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pathreplay.errors import PathreplayError
from pathreplay.integrators.scene_facts import facts_of
from pathreplay.inverse.config.parameter_options import Derivation, Displacement, Parameter, TransportStart
from pathreplay.inverse.config.user_functions import Modules
from pathreplay.inverse.parameters import limits as parameter_limits
from pathreplay.inverse.parameters.exposures import EXPOSURE
from pathreplay.inverse.parameters.grids import Levels, make_levels, resampled
from pathreplay.inverse.parameters.mesh import Surface
from pathreplay.inverse.parameters.pose import PART_NAMES, Pose, make_pose
from pathreplay.inverse.parameters.pyramid import Pyramid
from pathreplay.inverse.parameters.regularizers import Laplacian, Own, Penalty, Prior, Term, TotalVariation
from pathreplay.inverse.parameters.reparameterization import Coordinates, Transform
from pathreplay.inverse.parameters.response import RESPONSE
from pathreplay.inverse.parameters.values import Array, Arrays, make_heights, make_value, require_finite_array, seen
from pathreplay.platform import compat
from pathreplay.platform.owned_arrays import with_space
from pathreplay.scenes import parameters
from pathreplay.scenes.parameters import SceneValue
from pathreplay.scenes.stored import AS_STORED, Form, form_of

RESERVED = frozenset({EXPOSURE, RESPONSE, "__metadata__"})
"""Keys with a special meaning in files of saved values. Parameters that have a ``shape`` cannot use them."""


@dataclass(frozen=True)
class Variable:
    """A variable of the optimiser. All its values are decoded (see `Form`).

    The key of a variable is the key of a scene parameter, the key of a pose followed by ':translation' or ':rotation',
    or the key of an array from which scene parameters are derived.
    """

    key: str
    like: SceneValue
    """A Dr.Jit value of the type and shape of the variable."""
    bounds: tuple[float, float]
    """Lower and upper bound, enforced by projection after each step."""
    learning_rate: float
    start: Array
    """Initial value."""
    truth: Array | None
    """True value if known, in the shape of ``start``, or in another resolution for a grid."""
    levels: Levels | None = None
    """Refinement schedule of a grid."""
    coordinates: Coordinates | None = None
    """Coordinates in which steps are taken; None for the values themselves."""
    penalty: Penalty | None = None
    """Regularizers of the values."""
    form: Form = AS_STORED
    """Conversion between decoded values and the values that Mitsuba stores."""

    def held(self, values: Array) -> dr.ArrayBase:
        """Convert an array of values to Dr.Jit. The resolution of a grid may differ from the initial resolution."""
        return (
            type(self.like)(with_space(values)) if dr.is_tensor_v(self.like) else parameters.to_value(self.like, values)
        )


def latents(variables: Iterable[Variable], values: Mapping[str, Array]) -> dict[str, Array]:
    """Convert ``values`` to the latent arrays that the optimiser steps, by key."""
    return {v.key: v.coordinates.latent(values[v.key]) if v.coordinates else values[v.key] for v in variables}


def decoded(variables: Iterable[Variable], latent: Arrays, values: Arrays) -> dict[str, Array]:
    """Return the values of ``latent`` arrays within their bounds, by key, and ``values`` of variables without one."""
    found = dict(values)
    for v in variables:
        if v.key in latent:
            value = v.coordinates.values(latent[v.key]) if v.coordinates else latent[v.key]
            found[v.key] = np.clip(value, *v.bounds)
    return found


def latent_bounds(variable: Variable) -> tuple[float, float]:
    """Return the bounds of the latent array of a variable, as far as they are equivalent to bounds of its values."""
    if variable.coordinates is None:
        return variable.bounds
    if isinstance(variable.coordinates, Transform):
        return variable.coordinates.bounds(*variable.bounds)
    return -np.inf, np.inf


def range_of(variable: Variable) -> tuple[float, float]:
    """Return the ends of the interval that values of a variable never leave: bounds, and the range of a `Transform`."""
    lower, upper = variable.bounds
    transform = variable.coordinates.inner if isinstance(variable.coordinates, Pyramid) else variable.coordinates
    if isinstance(transform, Transform):
        lower, upper = max(lower, transform.lower), min(upper, transform.upper)
    return lower, upper


def keys_of(
    params: mi.SceneParameters,
    recovered: Sequence[Parameter],
    derived: Sequence[Derivation],
    integrator: mi.Integrator,
) -> tuple[dict[str, Parameter], dict[str, Derivation]]:
    """Resolve the keys and globs of a job.

    Args:
        params: parameters of the scene.
        recovered: tables of the recovered parameters.
        derived: tables of the derived parameters.
        integrator: integrator that must be able to differentiate the parameters.

    Returns:
        Two dictionaries by scene key: the tables of the recovered parameters, and the tables of the derived parameters.

    Raises:
        PathreplayError: a parameter does not exist, is not differentiable, or is named twice.
    """
    tables: dict[str, Parameter | Derivation] = {}
    entries: list[Parameter | Derivation] = [entry for entry in recovered if entry.shape is None]
    for entry in [*entries, *derived]:
        for key in parameters.resolve_keys(params, entry.key):
            if key in tables:
                raise PathreplayError(
                    f"Parameter '{key}' is named twice, by '{tables[key].key}' and '{entry.key}'; remove one"
                )
            parameters.require_differentiable(params, key, integrator)
            tables[key] = entry
    return (
        {key: entry for key, entry in tables.items() if isinstance(entry, Parameter)},
        {key: entry for key, entry in tables.items() if isinstance(entry, Derivation)},
    )


def free_of(params: mi.SceneParameters, recovered: Sequence[Parameter]) -> dict[str, Parameter]:
    """Return the parameters that are not part of the scene (those with a ``shape``), by key.

    Raises PathreplayError if such a key is already in use or reserved.
    """
    free: dict[str, Parameter] = {}
    for entry in recovered:
        if entry.shape is None:
            continue
        if entry.key in params:
            raise PathreplayError(f"Parameter '{entry.key}' is part of the scene; remove 'shape', or rename it")
        if entry.key in RESERVED or entry.key.endswith(PART_NAMES):
            raise PathreplayError(f"Parameter '{entry.key}' with a 'shape' has a reserved name; rename it")
        if entry.key in free:
            raise PathreplayError(f"Parameter '{entry.key}' is named twice; remove one")
        free[entry.key] = entry
    return free


def make_variables(
    scene: mi.Scene,
    params: mi.SceneParameters,
    keys: dict[str, Parameter],
    base: Path,
    modules: Modules,
    starts: Mapping[str, Array] = MappingProxyType({}),
    limit_rates: bool = True,
) -> tuple[list[Variable], list[Pose]]:
    """Make the variables and poses of a job. The caller sets their reference values (``truth``) later.

    Args:
        scene: the scene.
        params: parameters of the scene.
        keys: tables of the parameters, by key (see `Config.completed_entry`).
        base: folder that relative paths start from.
        modules: finder of user functions.
        starts: initial values, by the ``key`` of a table. They replace the ``initial`` of this table.
        limit_rates: whether to refuse learning rates that are large for the range of values. Rates of SGD cannot be
            checked, because the length of its steps is proportional to the gradient.

    Returns:
        The variables, and the poses that are computed from some of them.

    Raises:
        PathreplayError: an initial value, learning rate or option does not fit the parameter.
    """
    variables: list[Variable] = []
    poses: list[Pose] = []
    ranges = facts_of(scene).ranges()
    for key, entry in keys.items():
        rate = entry.learning_rate
        assert rate is not None  # `Config.completed_entry` fills in a missing rate
        bounded = parameter_limits.require_learning_rate if limit_rates else lambda *_: None
        if entry.pose is None:
            form = AS_STORED if entry.shape else form_of(params, key)
            like = seen(params, key) if entry.shape is None else _numbers(key, entry.shape)
            start = _start(key, like, form, entry, base, starts.get(entry.key))
            bounds = -np.inf if entry.lower is None else entry.lower, np.inf if entry.upper is None else entry.upper
            if entry.shape is None and entry.parameterization is None and key.endswith((".value", ".data")):
                if (lobes := ranges.get(params.properties[key][2])) is not None:
                    bounds = _within(bounds, lobes)
                    start = np.clip(start, np.float32(bounds[0]), np.float32(bounds[1]))
            levels = _levels(key, entry, entry.refine_at or [], start)
            coordinates = _coordinates(params, key, entry, start, levels, form.wraps)
            if entry.parameterization is None:
                bounded(key, rate, start, (entry.lower, entry.upper))
            else:
                assert coordinates is not None
                bounded(key, rate, coordinates.latent(start))
            penalty = _penalty(params, key, entry, start, levels, modules, form.wraps)
            if levels is not None:
                start = resampled(start, levels.shapes[0], form.wraps)
            if dr.is_tensor_v(like):
                like = dr.zeros(type(like), start.shape)  # literal zeros, which take no memory
            variables.append(Variable(key, like, bounds, rate, start, None, levels, coordinates, penalty, form))
            continue
        parameter_limits.require_near(scene, key, parameters.get_array(params[key]), entry)
        pose = make_pose(key, params[key], entry.pose, entry.pivot, entry.error_scale)
        poses.append(pose)
        for part, name in pose.parts().items():
            start = np.array(getattr(entry.displacement, part) or [0.0, 0.0, 0.0], np.float32)
            if part == "rotation":
                # Rotations are in degrees in the job and in radians here. ``learning_rate`` is in radians. A rotation
                # then moves points at a distance of 1 from the pivot as fast as a translation does.
                start = np.radians(start)
                degrees = entry.rotation_learning_rate
                rate = rate if degrees is None else float(np.radians(degrees))
            bounded(name, rate, start)
            variables.append(Variable(name, mi.Vector3f(0), (-np.inf, np.inf), rate, start, None))
    return variables, poses


def _within(bounds: tuple[float, float], lobes: tuple[float, float]) -> tuple[float, float]:
    """Return ``bounds`` within ``lobes`` (see `SceneFacts.ranges`), or ``bounds`` if nothing would be left."""
    lower, upper = max(bounds[0], lobes[0]), min(bounds[1], lobes[1])
    return (lower, upper) if lower < upper else bounds


def _coordinates(
    params: mi.SceneParameters, key: str, entry: Parameter, start: Array, levels: Levels | None, wraps: bool
) -> Coordinates | None:
    transform = None
    if entry.parameterization is not None:
        transform = Transform(
            entry.parameterization, *(-np.inf if x is None else x for x in (entry.lower, entry.upper))
        )
        transform.require_inside(key, start)
    if entry.pyramid:
        _require_grid(key, start, "pyramid")
        shapes = [start.shape, *(levels.shapes if levels else ())]
        return Pyramid(shapes, wraps, transform)
    if entry.large_steps_lambda is None:
        return transform
    faces = _faces(params, key, "large_steps_lambda")
    return Surface(parameters.get_array(params[key]), faces, entry.large_steps_lambda)


def _require_grid(key: str, start: Array, option: str) -> None:
    if start.ndim < 3:
        raise PathreplayError(f"Parameter '{key}' of shape {start.shape} is not a texture or volume; remove '{option}'")


def _faces(params: mi.SceneParameters, key: str, option: str) -> NDArray[np.integer]:
    """Return the faces of the mesh whose vertex positions are ``key``. Raises PathreplayError for any other key."""
    if (faces := compat.faces_of_positions(params, key)) is None:
        name = compat.positions_name()
        raise PathreplayError(f"Parameter '{key}' is not the {name} of a mesh; remove '{option}'")
    return faces


def _penalty(
    params: mi.SceneParameters,
    key: str,
    entry: Parameter,
    start: Array,
    levels: Levels | None,
    modules: Modules,
    wraps: bool,
) -> Penalty | None:
    """Make the regularizers of a parameter. Raises PathreplayError if a regularizer fails in some resolution."""
    terms: list[Term] = []
    if entry.total_variation is not None:
        _require_grid(key, start, "total_variation")
        terms.append(TotalVariation(entry.total_variation, wraps))
    if entry.l2_to_initial is not None:
        terms.append(Prior(entry.l2_to_initial, start, wraps))
    if entry.laplacian_weight is not None:
        faces = _faces(params, key, "laplacian_weight")
        terms.append(Laplacian(entry.laplacian_weight, parameters.get_array(params[key]), faces))
    if entry.regularizer is not None:
        terms.append(Own(modules.function("Regularizer", entry.regularizer, "values")))
        for shape in levels.shapes if levels else [start.shape]:
            terms[-1](resampled(start, shape, wraps))
    return Penalty(tuple(terms)) if terms else None


def _numbers(key: str, shape: list[int]) -> mi.TensorXf:
    """Make a tensor of literal zeros. Raises PathreplayError if a full array of this shape does not fit into memory."""
    parameter_limits.require_values({key: prod(shape)})
    return dr.zeros(mi.TensorXf, shape)


def _levels(key: str, entry: Parameter, refine_at: list[int], start: Array) -> Levels | None:
    if entry.resolutions is None:
        return None
    _require_grid(key, start, "resolutions")
    parameter_limits.require_grid(key, start.shape, entry.resolutions)
    return make_levels(start.shape, entry.resolutions, refine_at)


def _start(key: str, like: SceneValue, form: Form, entry: Parameter, base: Path, given: Array | None) -> Array:
    if not dr.is_array_v(like):
        raise PathreplayError(
            f"Parameter '{key}' is a matrix, and steps of its 16 entries would not keep it rigid; set "
            "pose = 'translation', 'rotation' or 'rigid'"
        )
    if given is not None:
        start = np.array(given, np.float32)
        if start.shape != parameters.get_array(like).shape:
            raise PathreplayError(
                f"Parameter '{key}' starts at an array of shape {start.shape}, but has the shape "
                f"{parameters.get_array(like).shape} in the scene; reshape it"
            )
        require_finite_array(f"The initial value of '{key}'", start)
    elif entry.initial is None:
        start = parameters.get_array(like)
    elif isinstance(entry.initial, TransportStart):
        start = make_heights(key, parameters.get_array(like).shape, entry.initial, base)
    else:
        assert not isinstance(entry.initial, Displacement)  # the schema allows displacements for poses only
        start = form.of_colours(key, make_value(key, like, entry.initial, base))
    for bound, name, wrong in ((entry.lower, "lower", np.less), (entry.upper, "upper", np.greater)):
        if bound is not None and wrong(start, np.float32(bound)).any():
            extreme = start.min() if name == "lower" else start.max()
            raise PathreplayError(
                f"Parameter '{key}' starts at {extreme:g}, beyond its {name} bound {bound:g}; change one of them"
            )
    return start
