"""Traverse the objects and parameters of a scene without reference cycles that would keep the objects alive.

A class defined inside a function is part of a reference cycle. The class, and all objects in the closures of its
methods, live until the cyclic garbage collector runs. If such a closure contains scene objects, an area light can
outlive its shape. The light has a raw pointer to the shape, and Dr.Jit still traces the light in every virtual function
call. The traversal class is therefore created once per variant, with an empty closure.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

if TYPE_CHECKING:
    from typing_extensions import TypeIs

_COLLECTORS: dict[type, type] = {}
"""Traversal classes by the variant's base class."""


def _collector() -> Any:
    """Create a traversal callback for the active variant that collects the child objects and values of a node."""
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
    """Return the child objects of a node, and its values with their C++ types."""
    callback = _collector()
    callback.children, callback.values = [], []
    node.traverse(callback)
    return callback.children, callback.values


def _current(node: mi.Object, value: object, cpptype: type | None) -> Any:
    """Return the current value of a parameter of a node, from its value and type in `_contents`."""
    return value if cpptype is None else mi.get_property(value, cpptype, node)


def is_mesh(shape: mi.Shape) -> TypeIs[mi.Mesh]:
    """Check whether a shape is a mesh, and narrow its type."""
    return shape.is_mesh()


def children_of(node: mi.Object) -> dict[str, mi.Object]:
    """Return the child objects of a node by name."""
    return dict(_contents(node)[0])


def nodes_of(root: mi.Object) -> set[mi.Object]:
    """Find all objects reachable from ``root``, a scene or one of its objects."""
    seen: set[mi.Object] = set()
    waiting = [root]
    while waiting:
        for _, child in _contents(waiting.pop())[0]:
            if child not in seen:
                seen.add(child)
                waiting.append(child)
    return seen


def plain_numbers(node: mi.Object) -> tuple[object, ...]:
    """Return the parameters of a node that a frozen function treats as constants.

    Mitsuba stores most of them as plain numbers. The sampling weights of emitters are left out, because a scene copies
    them to arrays. The parameters of phase functions are arrays, which phase functions do not show to Dr.Jit. They are
    left out if they have gradients, because a function that uses such arrays cannot be frozen.
    """
    plain: list[object] = []
    hides = isinstance(node, mi.PhaseFunction)
    for name, value, cpptype in _contents(node)[1]:
        value = _current(node, value, cpptype)
        if isinstance(value, (bool, int, float)) and name != "sampling_weight":
            plain.append(value)
        elif isinstance(value, (mi.ScalarTransform3f, mi.ScalarTransform4f)):
            plain.append(np.array(value.matrix).tobytes())
        elif hides and dr.is_array_v(value) and not dr.grad_enabled(value):
            plain.append(np.array(value).tobytes())
    return tuple(plain)


def may_have_gradients(node: mi.Object) -> bool:
    """Return whether a parameter of a node itself, not of its descendants, has gradients.

    The result is also True for all objects of Python classes, because such objects may have gradients in members that
    `mi.traverse` does not show.
    """
    if hasattr(node, "__dict__"):
        return True
    with dr.resume_grad():
        return any(dr.grad_enabled(_current(node, value, cpptype)) for _, value, cpptype in _contents(node)[1])


def with_gradients(root: mi.Object, *names: str) -> list[Any]:
    """Find the parameters of an object and its descendants that have gradients.

    If ``names`` are given, only parameters under one of them count: a parameter ``a.b`` is under ``a.b`` and under
    ``a``.
    """
    parameters: list[Any] = []
    seen, waiting = {root}, [("", root)]
    while waiting:
        prefix, node = waiting.pop()
        children, values = _contents(node)
        for name, value, cpptype in values:
            if not names or any(f"{prefix}{name}.".startswith(f"{n}.") for n in names):
                value = _current(node, value, cpptype)
                if value is not None:  # hair with ``eumelanin`` has no ``sigma_a``
                    parameters.append(value)
        for name, child in children:
            if child not in seen:
                seen.add(child)
                waiting.append((f"{prefix}{name}.", child))
    with dr.resume_grad():
        return [value for value in parameters if dr.grad_enabled(value)]
