"""What ``--set KEY=VALUE`` changes in a job, before it is checked."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pathreplay.errors import PathreplayError, shown
from pathreplay.inverse.config.parsing import from_toml

DEEPEST = 16
"""Parts of a key: no job has tables as deep."""
_VALUES = (bool, int, float, str, list, dict)


def defined(job: Any, changes: Sequence[str], option: str = "--set") -> Any:
    """The job with these changes, as TOML has it; ``job`` itself is not changed. ``option`` is where they were given.

    A key is one of TOML's, where a number leads into a list: ``parameters.0.learning_rate``. A value that is no TOML is
    a text, so that names need no quotes. Raises PathreplayError for what is no change, or leads nowhere.
    """
    for change in changes:
        key, equals, text = change.partition("=")
        if not equals:
            raise PathreplayError(f"{option} {shown(change)} has no '='; write KEY=VALUE, as in {option} spp=32")
        job = _put(job, _path(key, f"{option} {shown(change)}"), _value(text), f"{option} {shown(change)}")
    return job


def _path(key: str, told: str) -> list[str]:
    try:
        found = from_toml(f"{key} = 0")
    except (ValueError, RecursionError):
        found = {}
    path: list[str] = []
    while isinstance(found, dict) and len(found) == 1:
        ((name, found),) = found.items()
        path.append(name)
    if found != 0 or not 0 < len(path) <= DEEPEST:
        raise PathreplayError(
            f"{told} names no key; write it as in TOML, such as integrator.max_depth, and quote what has dots in "
            "its name"
        )
    return path


def _value(text: str) -> Any:
    try:
        found = from_toml(f"value = {text}")
    except (ValueError, RecursionError):
        return text
    return found["value"] if len(found) == 1 and isinstance(found["value"], _VALUES) else text


def _put(table: Any, path: list[str], value: Any, option: str) -> Any:
    if not path:
        return value
    name, *rest = path
    if isinstance(table, list):
        if not name.isdecimal() or len(name) > 9 or int(name) >= len(table):
            raise PathreplayError(f"{option}: {shown(name)} is no place in a list of {len(table)}; count from 0")
        return [_put(each, rest, value, option) if i == int(name) else each for i, each in enumerate(table)]
    if not isinstance(table, dict):
        raise PathreplayError(f"{option}: {shown(name)} is asked of {shown(table)}, which is no table; correct the key")
    return {**table, name: _put(table.get(name, {}), rest, value, option)}
