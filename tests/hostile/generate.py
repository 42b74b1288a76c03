"""The list of cases for a seed: every recipe once, then those with randomness in them again and again."""

from __future__ import annotations

from . import (
    of_capture,
    of_command,
    of_config,
    of_format,
    of_mesh,
    of_own,
    of_picture,
    of_process,
    of_python,
    of_ray,
    of_run,
    of_scene,
    of_stages,
    of_volume,
    of_watch,
)
from .case import RECIPES, Case

KINDS = tuple(
    module.KIND
    for module in (
        of_config,
        of_stages,
        of_command,
        of_scene,
        of_mesh,
        of_picture,
        of_format,
        of_capture,
        of_volume,
        of_run,
        of_python,
        of_own,
        of_process,
        of_watch,
        of_ray,
    )
)

#: How many cases are tried by default. The recipes alone are more than 400.
COUNT = len(RECIPES) + 60


def make_case(seed: int, number: int) -> Case:
    """Case ``number`` of a seed; the same whenever it is asked for."""
    if number < len(RECIPES):
        return Case(seed, number, RECIPES[number])
    fuzzy = [recipe for recipe in RECIPES if recipe.fuzz]
    return Case(seed, number, fuzzy[(number - len(RECIPES)) % len(fuzzy)])
