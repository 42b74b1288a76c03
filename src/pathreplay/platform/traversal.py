"""The parameters of a scene or an object that have a value.

Hair with ``eumelanin`` has such a ``sigma_a``: it is None, and Mitsuba raises a TypeError where it is read.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mitsuba as mi


def traversed(thing: Any) -> Any:
    """`mi.traverse(thing)`, without parameters that are None."""
    params = mi.traverse(thing)
    known = {key for key, _ in known_values(params)}
    for key in set(params.keys()) - known:
        del params[key]
    return params


def known_values(params: Any) -> Iterator[tuple[str, Any]]:
    """The parameters with their values, to be looked at: `update` does not see what is written into them."""
    for key, (value, kind, node, _) in params.properties.items():
        found = value if kind is None else params.get_property(value, kind, node)
        if found is not None:
            yield key, found
