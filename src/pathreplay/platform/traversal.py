"""Traverses a scene or object, without the parameters whose value is None.

For example, ``sigma_a`` of hair with ``eumelanin`` is None, and Mitsuba raises a TypeError when ``sigma_a`` is read.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mitsuba as mi


def traversed(thing: mi.Object) -> mi.SceneParameters:
    """Return `mi.traverse(thing)` without parameters that are None."""
    params = mi.traverse(thing)
    known = {key for key, _ in known_values(params)}
    for key in set(params.keys()) - known:
        del params[key]
    return params


def known_values(params: mi.SceneParameters) -> Iterator[tuple[str, Any]]:
    """Yield the keys and values of parameters that are not None.

    Callers must not change the values in place, because `params.update` would not notice the change.
    """
    for key, (value, kind, node, _) in params.properties.items():
        current = value if kind is None else params.get_property(value, kind, node)
        if current is not None:
            yield key, current
