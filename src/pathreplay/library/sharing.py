"""Checks that problems can be combined: what they share must have the same options in each of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel

from pathreplay.errors import PathreplayError, shown
from pathreplay.inverse.config.parameter_options import MEMORY, Parameter
from pathreplay.inverse.config.schema import Config
from pathreplay.inverse.parameters.variables import free_of, keys_of
from pathreplay.inverse.problem.problem import Problem
from pathreplay.types import Json

_OF_EACH = frozenset(
    "scene scene_parameters sensors test_views variant integrator baseline parameters derived capture exposure "
    "response view_weights target loss learning_rate output".split()
)
"""Keys of a job whose values each problem keeps, or that joint problems do not support."""
_COMPARED = [name for name in Parameter.model_fields if name not in ("key", "initial", "lower", "upper", "regularizer")]


@dataclass(frozen=True)
class Part:
    """A problem, its job, and the functions in memory that the job names."""

    built: Problem
    job: Json
    functions: Mapping[str, Callable[..., object]]


def require_alike(parts: Sequence[Part]) -> None:
    """Check that parameters of one name have the same options and initial values, and that the settings are equal.

    Args:
        parts: the problems to combine. Shared variables have the same shapes.

    Raises:
        PathreplayError: a joint problem would have to drop an option, an initial value or a setting of a problem.
    """
    first = parts[0]
    for n, part in enumerate(parts):
        for name in Config.model_fields:
            if name not in _OF_EACH and _setting(first, name) != _setting(part, name):
                _refuse(f"'{name}'", (0, _plain(_setting(first, name))), (n, _plain(_setting(part, name))))
    known: dict[str, tuple[int, dict[str, object], object]] = {}
    starts: dict[str, tuple[int, np.ndarray]] = {}
    for n, part in enumerate(parts):
        for key, entry in _entries(part).items():
            options, function = _options(entry), part.functions.get(entry.regularizer or "", entry.regularizer)
            before, others, other = known.setdefault(key, (n, options, function))
            for name, value in options.items():
                if name == "regularizer" and other == function:
                    continue
                if name == "regularizer" and others[name] == value:
                    raise PathreplayError(
                        f"problems: parameter '{key}': 'regularizer' is one function {shown(value)} in problem "
                        f"{before} and another in problem {n}; create the problems with the same function"
                    )
                if others[name] != value:
                    _refuse(f"parameter '{key}': '{name}'", (before, others[name]), (n, value))
        for variable in part.built.variables:
            before, start = starts.setdefault(variable.key, (n, variable.start))
            if len(differs := np.argwhere(~np.isclose(start, variable.start))):
                at = tuple(map(int, differs[0]))
                values = (before, float(start[at])), (n, float(variable.start[at]))
                _refuse(f"parameter '{variable.key}': 'initial'", *values, f" (at index {at})")


def _refuse(what: str, one: tuple[int, object], other: tuple[int, object], where: str = "") -> None:
    values = " and ".join(
        f"{f'{value:g}' if isinstance(value, float) else shown(value)} in problem {n}" for n, value in (one, other)
    )
    raise PathreplayError(f"problems: {what} is {values}{where}; create the problems with the same value")


def _setting(part: Part, name: str) -> object:
    """Return a setting of the problem, or the default that `minimize` uses if its job does not contain the setting."""
    if name in part.job:
        return getattr(part.built.config, name)
    return Config.model_fields[name].get_default(call_default_factory=True)


def _plain(value: object) -> object:
    return value.model_dump(exclude_none=True) if isinstance(value, BaseModel) else value


def _entries(part: Part) -> dict[str, Parameter]:
    """Return the complete tables of the parameters by key, where the problem's own tables may have globs."""
    built, config = part.built, part.built.config
    named, _ = keys_of(built.params, config.parameters, config.derived, built.integrator)
    entries = named | free_of(built.params, config.parameters)
    return {key: config.completed_entry(entry) for key, entry in entries.items()}


def _options(entry: Parameter) -> dict[str, object]:
    """Return the options of a parameter under the names of the library, without its initial value."""
    function = entry.regularizer and entry.regularizer.removeprefix(MEMORY)
    options = {name: getattr(entry, name) for name in _COMPARED}
    return {"bounds": (entry.lower, entry.upper), **options, "regularizer": function}
