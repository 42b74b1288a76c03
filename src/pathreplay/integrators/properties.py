"""Validation of plugin properties: one-line errors name the property, its value and the remedy."""

from __future__ import annotations

from typing import TypeVar

import mitsuba as mi

from pathreplay.errors import PathreplayError, shown

T = TypeVar("T")

#: Largest integer that Mitsuba's integrators can store.
LARGEST = 2**31 - 1


def choice(props: mi.Properties, plugin: str, name: str, default: T, choices: tuple[T, ...]) -> T:
    """Read a property. Raises PathreplayError if its value is not one of ``choices``."""
    value = props.get(name, default)
    # Compare types as well, since 1 == True.
    if not any(type(value) is type(allowed) and value == allowed for allowed in choices):
        listed = ", ".join(map(repr, choices))
        raise PathreplayError(f"{plugin}: {name} = {shown(value)} is unknown: use one of {listed}")
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
    """Read an integer from ``lowest`` to `LARGEST`; if ``unbounded``, -1 is valid as well.

    Raises PathreplayError for any other value; the message calls the value a ``kind``.
    """
    value = props.get(name, default)
    if type(value) is int and (lowest <= value <= LARGEST or (unbounded and value == -1)):
        return value
    besides = "-1 (unbounded) or " if unbounded else ""
    raise PathreplayError(
        f"{plugin}: {name} = {shown(value)}: use {besides}a {kind} >= {lowest}, a whole number of at most {LARGEST}"
    )


def deviation(props: mi.Properties, plugin: str, name: str, default: float) -> float:
    """Read a standard deviation. Raises PathreplayError if the value is not a finite number of at least 0."""
    value = props.get(name, default)
    if type(value) not in (int, float) or not 0 <= value < float("inf"):
        raise PathreplayError(f"{plugin}: {name} = {shown(value)}: use a finite standard deviation >= 0 (0 = off)")
    return float(value)


def flag(props: mi.Properties, plugin: str, name: str, default: bool) -> bool:
    """Read a boolean property. Raises PathreplayError if the value is not a boolean."""
    value = props.get(name, default)
    if type(value) is not bool:
        raise PathreplayError(f"{plugin}: {name} = {shown(value)}: use true or false")
    return value
