"""The cloud: the density of a grid, seen from six sides, with two more views held out."""

from __future__ import annotations

from pathreplay.scenes import builtin

from .problem import Problem, Unknown

_DENSITY = "cloud.interior_medium.sigma_t.data"


def cloud(pixels: int, cells: int) -> Problem:
    """The density (at most 10 in a cube of side 2) starts at 1 everywhere."""
    views = [f"view{n + 1}" for n in range(8)]
    held_out = ("view3", "view5")
    return Problem(
        builtin.cloud(pixels, grid=cells, views=8),
        {_DENSITY: Unknown(1.0, 0.0, 20.0)},
        tuple(name for name in views if name not in held_out),
        held_out,
        {"max_depth": 64, "rr_depth": 16},
        judge="volpath",
        target_paths=2**19,
        judge_paths=2**16,
    )
