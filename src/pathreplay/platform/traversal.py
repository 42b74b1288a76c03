"""Parameters of a scene or object, without parameters whose value is None.

For example, ``sigma_a`` of hair with ``eumelanin`` is None, and Mitsuba raises a TypeError when it is read.
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
    """Yield the parameters with their values, for reading only: `params.update` does not notice changes in place."""
    for key, (value, kind, node, _) in params.properties.items():
        current = value if kind is None else params.get_property(value, kind, node)
        if current is not None:
            yield key, current
