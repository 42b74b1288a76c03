"""Parameters of the scene that are made from those that a job recovers, by a function of the user's.

    p = f(p₀, a, b, ...),      p₀ what the scene has, a, b, ... what is recovered

so that a mesh bends by two numbers, three materials are one, a camera goes round on a turntable, or a texture is what a
network makes of its weights. Derivatives go through f, which is written in Dr.Jit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.parameter_options import Derivation
from pathreplay.inverse.config.user_functions import Imported, Modules
from pathreplay.inverse.parameters.grids import resampled
from pathreplay.inverse.parameters.values import Array, seen
from pathreplay.inverse.parameters.variables import Variable
from pathreplay.scenes.parameters import is_transform
from pathreplay.scenes.stored import Form, form_of


@dataclass(frozen=True)
class Derived:
    """What is behind one key of the scene."""

    key: str
    function: Imported
    of: tuple[str, ...]
    """Names of the variables that it takes, after p₀."""
    first: Any
    """p₀, as people see it; detached."""
    form: Form
    """How Mitsuba stores it."""
    truth: Array | None = None

    def value(self, variables: Mapping[str, Any]) -> Any:
        """p for the optimiser's variables, as people see it; derivatives flow to them.

        Raises PathreplayError where the function fails, or gives another shape than p₀ has.
        """
        kind = type(self.first)
        found = self.function(
            (lambda value: kind(_matrix(kind, value))) if is_transform(self.first) else kind,
            kind(self.first),
            *(type(variables[name])(variables[name]) for name in self.of),  # which the function may change
        )
        shapes = [dr.shape(value.matrix if is_transform(value) else value) for value in (found, self.first)]
        if shapes[0] != shapes[1]:
            raise PathreplayError(
                f"{self.function} gives the shape {shapes[0]} for '{self.key}', which has {shapes[1]}; return that"
            )
        return found

    def require_finite(self, variables: Mapping[str, Any]) -> Any:
        """The value. Raises PathreplayError where it is NaN or infinite."""
        found = self.value(variables)
        if not dr.all(dr.isfinite(dr.ravel(found.matrix if is_transform(found) else found)))[0]:
            raise PathreplayError(
                f"{self.function} gives NaN or infinite numbers for '{self.key}'; mend it, or bound what it is made of"
            )
        return found


def _matrix(kind: Any, value: Any) -> Any:
    """What a transform is made of: the value, if it is none already."""
    return value if isinstance(value, kind) else type(kind().matrix)(value)


def make_derived(
    params: mi.SceneParameters, keys: Mapping[str, Derivation], variables: list[Variable], modules: Modules
) -> tuple[Derived, ...]:
    """The derived parameters, computed in each resolution. Raises PathreplayError for what cannot be.

    Truths are not known.
    """
    made = []
    for key, entry in keys.items():
        taken = [_named(name, key, keys, params, variables) for name in entry.of]
        form, value = form_of(params, key), seen(params, key)
        # A copy: the map hands out a reference to what the scene holds, and the scene is about to change.
        first, function = type(value)(dr.detach(value)), modules.function("Derivation", entry.function, "values")
        found = Derived(key, function, tuple(entry.of), first, form)
        for k in range(max(len(v.levels.shapes) if v.levels else 1 for v in taken)):
            _require(found, {v.key: v.held(_at_level(v, k)) for v in taken})
        made.append(found)
    return tuple(made)


def _named(
    name: str, key: str, keys: Mapping[str, Derivation], params: mi.SceneParameters, variables: list[Variable]
) -> Variable:
    """The variable of a name. Raises PathreplayError if there is none."""
    known = {v.key: v for v in variables}
    if name in known:
        return known[name]
    if name in keys:
        way_out = f"which is derived itself; name what that is derived from, {', '.join(keys[name].of)}"
    elif name in params:
        way_out = f"which the job does not recover; add [[parameters]] with key = '{name}'"
    else:
        names = ", ".join(known) or "none"
        way_out = f"which is none of the job's parameters ({names}); add [[parameters]] with this key and a 'shape'"
    raise PathreplayError(f"Parameter '{key}' is derived of '{name}', {way_out}")


def _at_level(variable: Variable, k: int) -> Array:
    """Its start in its k-th resolution, or the last one."""
    if variable.levels is None:
        return variable.start
    return resampled(variable.start, variable.levels.shapes[min(k, len(variable.levels.shapes) - 1)])


def _require(derived: Derived, variables: dict[str, Any]) -> None:
    """Raise PathreplayError unless a value is finite, and depends on all that it is made of."""
    derived.require_finite(variables)
    for name, variable in variables.items():
        dr.enable_grad(variable)
        if not dr.grad_enabled(derived.value(variables)):
            raise PathreplayError(
                f"{derived.function} gives '{derived.key}' a value that does not depend on '{name}'; compute it with "
                "Dr.Jit, without leaving its arrays, or leave the name out of 'of'"
            )
        dr.disable_grad(variable)
