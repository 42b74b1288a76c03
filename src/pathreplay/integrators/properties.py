"""The properties of our plugins, read so that what cannot be is refused in one line with the way out."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from pathreplay.errors import PathreplayError, shown

#: What Mitsuba's own integrators can hold.
LARGEST = 2**31 - 1


def choice(props: mi.Properties, plugin: str, name: str, default: Any, choices: tuple[Any, ...]) -> Any:
    """A property of ``plugin`` that has to be one of the choices. Raises PathreplayError for another."""
    value = props.get(name, default)
    # By type, too: 1 == True.
    if not any(type(value) is type(allowed) and value == allowed for allowed in choices):
        known = ", ".join(map(repr, choices))
        raise PathreplayError(f"{plugin}: {name} = {shown(value)} is unknown: use one of {known}")
    return value


def whole_number(
    props: mi.Properties,
    plugin: str,
    name: str,
    default: int,
    lowest: int,
    unbounded: bool = False,
    kind: str = "depth",
) -> int:
    """A whole number from ``lowest`` to `LARGEST`, or -1 where it may be unbounded; ``kind`` says of what.

    Raises PathreplayError else.
    """
    value = props.get(name, default)
    if type(value) is int and (lowest <= value <= LARGEST or (unbounded and value == -1)):
        return value
    besides = "-1 (unbounded) or " if unbounded else ""
    raise PathreplayError(
        f"{plugin}: {name} = {shown(value)}: use {besides}a {kind} >= {lowest}, a whole number of at most {LARGEST}"
    )


def deviation(props: mi.Properties, plugin: str, name: str, default: float) -> float:
    """A finite standard deviation, at least 0. Raises PathreplayError for anything else."""
    value = props.get(name, default)
    if type(value) not in (int, float) or not 0 <= value < float("inf"):
        raise PathreplayError(f"{plugin}: {name} = {shown(value)}: use a finite standard deviation >= 0 (0 = off)")
    return float(value)


def flag(props: mi.Properties, plugin: str, name: str, default: bool) -> bool:
    """True or False. Raises PathreplayError for anything else."""
    value = props.get(name, default)
    if type(value) is not bool:
        raise PathreplayError(f"{plugin}: {name} = {shown(value)}: use true or false")
    return value
