"""Loads what a dictionary describes, after a look for what Mitsuba does not survive."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mitsuba as mi

from pathreplay.errors import PathreplayError


def load_description(description: Mapping[str, Any]) -> Any:
    """`mi.load_dict`, where a None is told instead of ending the process. Raises that, and what Mitsuba raises."""
    require_values(description)
    return mi.load_dict(dict(description))


def require_values(description: Mapping[str, Any]) -> None:
    """Raise PathreplayError if a value of a dictionary, or of one in it, is None: Mitsuba dies of that (SIGSEGV)."""
    for name, value in description.items():
        if value is None:
            raise PathreplayError(
                f"'{name}' of {description.get('type', 'a dictionary')!r} is None; give it a value, or leave it out"
            )
        if isinstance(value, Mapping):
            require_values(value)
