"""Writes a dictionary as TOML on one line for each key, nested tables inline."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any


class Raw(str):
    """Text that goes into the file as it is."""


def toml(values: Mapping[str, Any]) -> str:
    """The TOML text of a dictionary of strings, numbers, truth values, lists, dictionaries and `Raw`."""
    return "".join(f"{_key(key)} = {token(value)}\n" for key, value in values.items())


def token(value: Any) -> str:
    """One value as TOML has it."""
    if isinstance(value, Raw):
        return str(value)
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(key)} = {token(entry)}" for key, entry in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(token(entry) for entry in value) + "]"
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value).replace("\x7f", "\\u007f")


def _key(key: str) -> str:
    return key if key.replace("_", "").isascii() and key.replace("_", "").isalnum() else json.dumps(key)
