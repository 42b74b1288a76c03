"""Parameters of the scene that are made from those that a job recovers, by a function of the user's.

    p = f(p₀, a, b, ...),      p₀ what the scene has, a, b, ... what is recovered

so that a mesh bends by two numbers, three materials are one, a camera goes round on a turntable, or a texture is what a
network makes of its weights. Derivatives go through f, which is written in Dr.Jit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config import Derivation
from pathreplay.inverse.imported import Imported, imported
from pathreplay.inverse.values import Array, seen
from pathreplay.inverse.variables import Variable
from pathreplay.scenes.parameters import get_array, is_transform
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
            *(variables[name] for name in self.of),
        )
        shapes = [dr.shape(value.matrix if is_transform(value) else value) for value in (found, self.first)]
        if shapes[0] != shapes[1]:
            raise PathreplayError(
                f"{self.function} gives the shape {shapes[0]} for '{self.key}', which has {shapes[1]}; return that"
            )
        return found


def _matrix(kind: Any, value: Any) -> Any:
    """What a transform is made of: the value, if it is none already."""
    return value if isinstance(value, kind) else type(kind().matrix)(value)


def make_derived(
    params: mi.SceneParameters, keys: Mapping[str, Derivation], variables: list[Variable], base: Path
) -> tuple[Derived, ...]:
    """The derived parameters, each computed once. Raises PathreplayError for what cannot be; truths are not known."""
    starts = {v.key: v.held(v.start) for v in variables}
    made = []
    for key, entry in keys.items():
        for name in entry.of:
            if name not in starts:
                raise PathreplayError(
                    f"Parameter '{key}' is derived of '{name}', which is none that the job recovers; name one of "
                    f"{', '.join(starts)}, or add [[parameters]] with key = '{name}' and a 'shape'"
                )
        form, value = form_of(params, key), seen(params, key)
        # A copy: the map hands out a reference to what the scene holds, and the scene is about to change.
        first = type(value)(dr.detach(value))
        found = Derived(key, imported("Derivation", entry.function, base, "values"), tuple(entry.of), first, form)
        if not np.isfinite(get_array(found.value(starts))).all():
            raise PathreplayError(f"{found.function} gives NaN or infinite numbers for '{key}'; mend it, or its start")
        made.append(found)
    return tuple(made)
