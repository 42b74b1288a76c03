"""Declarations of plugin properties, used for the defaults of plugins and for the reference pages of plugins."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

T = TypeVar("T", covariant=True)


@dataclass(frozen=True)
class Property(Generic[T]):
    """A property of a plugin.

    Args:
        name: name of the property in XML and in dictionaries.
        kind: type of the value, such as ``integer`` or ``texture``.
        default: default value. None means that the property has no default, or that ``meaning`` states the default.
        meaning: description of the property in Markdown.
        choices: all valid values, if there are few.
        see: page below ``docs/`` with more details, and a heading on this page.
        differentiable: key of the parameter that carries gradients, or "".
    """

    name: str
    kind: str
    default: T
    meaning: str
    choices: tuple[T, ...] = ()
    see: str = ""
    differentiable: str = ""
