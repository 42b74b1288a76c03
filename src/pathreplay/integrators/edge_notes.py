"""Messages about gradients without boundary terms."""

from __future__ import annotations

from collections.abc import Iterable

import drjit as dr
import mitsuba as mi

from pathreplay.platform import compat
from pathreplay.scenes.parameters import needs_ray_adjoint

# Parameters that move points of a surface. Other parameters that move such points have Mitsuba's flag
# `Discontinuous`.
_POSITIONS = {*compat.POSITIONS, "to_world", "control_points"}


def moves_edges(params: mi.SceneParameters, key: str) -> bool:
    """Return whether a parameter of ``mi.traverse(scene)`` moves silhouettes or shadows.

    Parameters of shapes, of cameras, and of emitters that cast hard shadows can move them.
    """
    node, name = params.properties[key][2], key.rsplit(".", 1)[-1]
    if isinstance(node, mi.Shape):
        marked = bool(params.flags(key) & mi.ParamFlags.Discontinuous) and name not in compat.NORMALS
        return name in _POSITIONS or marked
    if isinstance(node, mi.Emitter) and not mi.has_flag(node.flags(), mi.EmitterFlags.Delta):
        return False  # the emitter casts no hard shadows
    return needs_ray_adjoint(params, key)


def keys_that_move_edges(params: mi.SceneParameters) -> list[str]:
    """Return the keys of parameters that have gradients and move edges."""
    with dr.resume_grad():
        return [key for key in params.keys() if moves_edges(params, key) and dr.grad_enabled(params[key])]


def edges_note(keys: Iterable[str], edges: str = "none") -> str:
    """Format the message about parameters that move edges, with the remedy.

    ``edges`` is the value of the property ``boundary``.
    """
    first, *others = keys
    more = f" (and {len(others)} more)" if others else ""
    if edges == "primary":
        return (
            f"'{first}'{more} moves, and boundary = 'primary' leaves out edges that only surfaces see (soft "
            "shadows, indirect light): use boundary = 'all' where that matters; see docs/boundary.md"
        )
    return (
        f"'{first}'{more} moves, and the gradient leaves out moving edges (silhouettes, shadows, borders of lights): "
        "use boundary = 'all' of the integrator 'pathreplay', or let textures or shading show the motion rather than "
        "outlines, and measure the error with 'pathreplay check'; see docs/boundary.md"
    )
