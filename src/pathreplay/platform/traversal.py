"""Parameters of a scene or object, without those that have no value.

An example is ``sigma_a`` of hair with ``eumelanin``: it is None, and Mitsuba raises a TypeError when it is read.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mitsuba as mi


def traversed(thing: mi.Object) -> mi.SceneParameters:
    """`mi.traverse(thing)` without parameters that are None."""
    params = mi.traverse(thing)
    known = {key for key, _ in known_values(params)}
    for key in set(params.keys()) - known:
        del params[key]
    return params


def known_values(params: mi.SceneParameters) -> Iterator[tuple[str, Any]]:
    """Iterate over the parameters with their values, for reading only: `update` does not notice in-place changes."""
    for key, (value, kind, node, _) in params.properties.items():
        current = value if kind is None else params.get_property(value, kind, node)
        if current is not None:
            yield key, current
