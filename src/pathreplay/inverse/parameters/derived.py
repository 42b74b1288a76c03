"""Derived parameters: scene parameters that are computed from variables of the job.

    p = f(p₀, a, b, ...),      where p₀ is the value in the scene and a, b, ... are variables

Examples are a mesh whose bending depends on two numbers, one colour for three materials, a camera on a turntable, or
a texture that a neural network predicts. The function f is written in Dr.Jit, and derivatives propagate through f.
Either the user provides f, or f is the built-in displacement of a mesh by height maps (`displace`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.parameter_options import Derivation
from pathreplay.inverse.config.user_functions import Imported, Modules
from pathreplay.inverse.parameters.displace import displacement_of, require_map
from pathreplay.inverse.parameters.grids import resampled
from pathreplay.inverse.parameters.values import Array, seen
from pathreplay.inverse.parameters.variables import Variable
from pathreplay.scenes.parameters import SceneValue, is_transform
from pathreplay.scenes.stored import Form, form_of


@dataclass(frozen=True)
class Derived:
    """One derived parameter of the scene."""

    key: str
    function: Imported
    of: tuple[str, ...]
    """Keys of the variables that the function takes after p₀."""
    first: SceneValue
    """The decoded value p₀ in the scene (see `Form`), detached."""
    form: Form
    """Conversion between the decoded value and the value that Mitsuba stores."""
    truth: Array | None = None

    def value(self, variables: Mapping[str, SceneValue]) -> SceneValue:
        """Compute the decoded value p. Derivatives propagate to the variables.

        Args:
            variables: Dr.Jit values by key.

        Raises:
            PathreplayError: the function fails, or returns a value whose shape differs from that of p₀.
        """
        kind = type(self.first)
        p = self.function(
            (lambda value: kind(_matrix(kind, value))) if is_transform(self.first) else kind,
            kind(self.first),
            *(type(variables[name])(variables[name]) for name in self.of),  # copies, which the function may modify
        )
        shapes = [dr.shape(value.matrix if is_transform(value) else value) for value in (p, self.first)]
        if shapes[0] != shapes[1]:
            raise PathreplayError(
                f"{self.function} returns the shape {shapes[0]} for '{self.key}'; return the shape {shapes[1]}"
            )
        return p

    def require_finite(self, variables: Mapping[str, SceneValue]) -> SceneValue:
        """Return the value. Raises PathreplayError if it is NaN or infinite."""
        p = self.value(variables)
        if not dr.all(dr.isfinite(dr.ravel(p.matrix if is_transform(p) else p)))[0]:
            raise PathreplayError(
                f"{self.function} returns NaN or infinite values for '{self.key}'; fix it, or bound its arguments"
            )
        return p


def _matrix(kind: type, value: object) -> object:
    """Convert a matrix to a type that the constructor of the transform ``kind`` accepts."""
    return value if isinstance(value, kind) else type(kind().matrix)(value)


def make_derived(
    params: mi.SceneParameters, keys: Mapping[str, Derivation], variables: list[Variable], modules: Modules
) -> tuple[Derived, ...]:
    """Make the derived parameters, and evaluate each of them once per resolution of its variables.

    The caller sets the reference values of the parameters (``truth``) later.

    Raises:
        PathreplayError: a variable does not exist, or a displacement does not fit its mesh or its height map. The error
            is also raised if a function cannot be imported, fails, returns an invalid value, or does not depend on one
            of its variables.
    """
    derived = []
    for key, entry in keys.items():
        arguments = [_named(name, key, keys, params, variables) for name in entry.of]
        form, value = form_of(params, key), seen(params, key)
        # A copy, because `params` holds a reference to the scene's value, which changes during the run.
        first, function = type(value)(dr.detach(value)), _function(params, key, entry, arguments, modules)
        parameter = Derived(key, function, tuple(entry.of), first, form)
        for k in range(max(len(v.levels.shapes) if v.levels else 1 for v in arguments)):
            _require(parameter, {v.key: v.held(_at_level(v, k)) for v in arguments})
        derived.append(parameter)
    return tuple(derived)


def _function(
    params: mi.SceneParameters, key: str, entry: Derivation, arguments: list[Variable], modules: Modules
) -> Imported:
    """Return the function of a derived parameter: a user function or a displacement."""
    if entry.displace is None:
        assert entry.function is not None  # `Derivation` requires a function or a displacement
        return modules.function("Derivation", entry.function, "values")
    for argument in arguments:
        require_map(key, argument.key, argument.start.shape)
    return Imported("Derivation", "displace", displacement_of(params, key, entry.displace))


def _named(
    name: str, key: str, keys: Mapping[str, Derivation], params: mi.SceneParameters, variables: list[Variable]
) -> Variable:
    """Return the variable with the key ``name``. Raises PathreplayError if there is no such variable."""
    known = {v.key: v for v in variables}
    if name in known:
        return known[name]
    if name in keys:
        remedy = f"which is derived itself; name the parameters that it is derived from: {', '.join(keys[name].of)}"
    elif name in params:
        remedy = f"which the job does not recover; add [[parameters]] with key = '{name}'"
    else:
        names = ", ".join(known) or "none"
        remedy = f"which is not a parameter of the job ({names}); add [[parameters]] with this key and a 'shape'"
    raise PathreplayError(f"Parameter '{key}' is derived from '{name}', {remedy}")


def _at_level(variable: Variable, k: int) -> Array:
    """Resample the initial value of a variable to its k-th resolution, or to the last one if there are fewer."""
    if variable.levels is None:
        return variable.start
    shape = variable.levels.shapes[min(k, len(variable.levels.shapes) - 1)]
    return resampled(variable.start, shape, variable.form.wraps)


def _require(derived: Derived, variables: dict[str, SceneValue]) -> None:
    """Raise PathreplayError unless the value of a derived parameter is finite and depends on all of its variables."""
    derived.require_finite(variables)
    for name, variable in variables.items():
        dr.enable_grad(variable)
        if not dr.grad_enabled(derived.value(variables)):
            raise PathreplayError(
                f"{derived.function} returns a value for '{derived.key}' that does not depend on '{name}'; compute it "
                "with Dr.Jit arrays throughout, or remove the name from 'of'"
            )
        dr.disable_grad(variable)
