"""Overrides of a job by ``--set KEY=VALUE``, applied before the job is checked."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

from pathreplay.errors import PathreplayError, shown
from pathreplay.inverse.config.parsing import from_toml

T = TypeVar("T")

DEEPEST = 16
"""Maximum number of parts of a dotted key, far more than any real job needs."""
_VALUES = (bool, int, float, str, list, dict)


def defined(job: T, changes: Sequence[str], option: str = "--set") -> T:
    """Return a copy of the job with overrides applied; ``job`` itself is not changed.

    Args:
        job: the parsed job.
        changes: overrides ``KEY=VALUE``. A key is a dotted TOML key in which a number indexes a list, as in
            ``parameters.0.learning_rate``. A value that is not valid TOML is a string, so names need no quotes.
        option: name of the command-line option, for messages.

    Raises:
        PathreplayError: an override has no '=', its key is malformed, an index is outside of its list, or the key
            continues beyond a value that is neither a list nor a table. Keys that a table lacks are added.
    """
    for change in changes:
        key, equals, text = change.partition("=")
        if not equals:
            raise PathreplayError(f"{option} {shown(change)} has no '='; write KEY=VALUE, as in {option} spp=32")
        job = _put(job, _path(key, f"{option} {shown(change)}"), _value(text), f"{option} {shown(change)}")
    return job


def _path(key: str, option: str) -> list[str]:
    try:
        node = from_toml(f"{key} = 0")
    except (ValueError, RecursionError):
        node = {}
    path: list[str] = []
    while isinstance(node, dict) and len(node) == 1:
        ((name, node),) = node.items()
        path.append(name)
    if node != 0 or not 0 < len(path) <= DEEPEST:
        raise PathreplayError(
            f"{option} names no key; write a TOML key such as integrator.max_depth, and quote parts that contain dots"
        )
    return path


def _value(text: str) -> object:
    try:
        table = from_toml(f"value = {text}")
    except (ValueError, RecursionError):
        return text
    return table["value"] if len(table) == 1 and isinstance(table["value"], _VALUES) else text


def _put(table: object, path: list[str], value: object, option: str) -> Any:
    if not path:
        return value
    name, *rest = path
    if isinstance(table, list):
        if not name.isdecimal() or len(name) > 9 or int(name) >= len(table):
            raise PathreplayError(
                f"{option}: {shown(name)} is not an index into a list of {len(table)} entries; count from 0"
            )
        return [_put(entry, rest, value, option) if i == int(name) else entry for i, entry in enumerate(table)]
    if not isinstance(table, dict):
        raise PathreplayError(f"{option}: {shown(table)} is not a table and has no key {shown(name)}; correct the key")
    return {**table, name: _put(table.get(name, {}), rest, value, option)}
