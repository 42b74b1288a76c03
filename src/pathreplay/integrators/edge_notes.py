"""Messages about gradients without boundary terms."""

from __future__ import annotations

from collections.abc import Iterable

import drjit as dr
import mitsuba as mi

from pathreplay.scenes.parameters import needs_ray_adjoint

# Of shapes: what moves a point of the surface. Others, such as B-spline controls, Mitsuba marks as discontinuous.
_PLACES = {"vertex_positions", "to_world", "control_points"}


def moves_edges(params: mi.SceneParameters, key: str) -> bool:
    """Whether a parameter of ``mi.traverse(scene)`` moves silhouettes or shadows.

    These are shapes and their transforms, cameras, and lights that cast hard shadows.
    """
    node, name = params.properties[key][2], key.rsplit(".", 1)[-1]
    if isinstance(node, mi.Shape):
        marked = bool(params.flags(key) & mi.ParamFlags.Discontinuous) and name != "vertex_normals"
        return name in _PLACES or marked
    if isinstance(node, mi.Emitter) and not mi.has_flag(node.flags(), mi.EmitterFlags.Delta):
        return False  # of the sky
    return needs_ray_adjoint(params, key)


def keys_that_move_edges(params: mi.SceneParameters) -> list[str]:
    """The parameters with gradients that `moves_edges`."""
    with dr.resume_grad():
        return [key for key in params.keys() if moves_edges(params, key) and dr.grad_enabled(params[key])]


def edges_note(keys: Iterable[str], edges: str = "none") -> str:
    """One line that tells of parameters with which edges move, and what can be done; ``edges`` are looked at."""
    first, *others = keys
    more = f" (and {len(others)} more)" if others else ""
    if edges == "primary":
        return (
            f"'{first}'{more} moves, and boundary = 'primary' leaves out what surfaces see of moving edges (soft "
            "shadows, indirect light): use boundary = 'all' where that matters; see docs/boundary.md"
        )
    return (
        f"'{first}'{more} moves, and the gradient leaves out what moving edges do (silhouettes, shadows, borders of "
        "lights): use boundary = 'all' of the integrator 'pathreplay', or let paint or shading show the motion rather "
        "than outlines, and measure what is missing with 'pathreplay check'; see docs/boundary.md"
    )
