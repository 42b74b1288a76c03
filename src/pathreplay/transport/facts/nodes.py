"""The objects of a scene and their parameters, found without leaving cycles that keep some of the objects alive.

A class that is defined in a function is a reference cycle: the class, and what its methods close over, stay until the
cyclic garbage collector runs. Were that a set of scene objects, an area light could outlive its shape, to which it has
a bare pointer, and Dr.Jit would still trace it with every virtual call. So the class of a traversal is made once for
each variant, and closes over nothing.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

_COLLECTORS: dict[type, type] = {}
"""By the class of the variant from which they derive."""


def _collector() -> Any:
    """A traversal callback of the active variant: it lists the objects and the values that a node names."""
    base = mi.TraversalCallback
    if base not in _COLLECTORS:

        def put(self: Any, name: str, value: object, flags: int, cpptype: type | None = None) -> None:
            if isinstance(value, mi.Object):
                self.children.append((name, value))
            else:
                self.values.append((name, value, cpptype))

        _COLLECTORS[base] = type("Collector", (base,), {"put": put, "__module__": __name__})
    return _COLLECTORS[base]()


def _contents(node: mi.Object) -> tuple[list[tuple[str, mi.Object]], list[tuple[str, object, type | None]]]:
    """What a node names: objects, and values with their C++ types."""
    callback = _collector()
    callback.children, callback.values = [], []
    node.traverse(callback)
    return callback.children, callback.values


def nodes_of(root: mi.Object) -> set[mi.Object]:
    """All objects of a scene, or below one of its objects."""
    seen: set[mi.Object] = set()
    waiting = [root]
    while waiting:
        for _, child in _contents(waiting.pop())[0]:
            if child not in seen:
                seen.add(child)
                waiting.append(child)
    return seen


def with_gradients(root: mi.Object, *names: str) -> list[dr.ArrayBase]:
    """The parameters of an object, and of those below it, that have gradients; with names, those under one of them.

    A parameter ``a.b`` is under ``a.b`` and under ``a``.
    """
    found: list[dr.ArrayBase] = []
    seen, waiting = {root}, [("", root)]
    while waiting:
        prefix, node = waiting.pop()
        children, values = _contents(node)
        for name, value, cpptype in values:
            if not names or any(f"{prefix}{name}.".startswith(f"{n}.") for n in names):
                value = value if cpptype is None else mi.get_property(value, cpptype, node)
                if value is not None:  # as ``sigma_a`` of hair with ``eumelanin``
                    found.append(value)
        for name, child in children:
            if child not in seen:
                seen.add(child)
                waiting.append((f"{prefix}{name}.", child))
    with dr.resume_grad():
        return [value for value in found if dr.grad_enabled(value)]
