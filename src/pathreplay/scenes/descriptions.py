"""Loads what a dictionary describes, after a look for what Mitsuba does not survive; Mitsuba's errors as one line."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import mitsuba as mi

from pathreplay.errors import PathreplayError


def require_values(description: Mapping[str, Any]) -> None:
    """Raise PathreplayError if a value of a dictionary, or of one in it, is None: Mitsuba dies of that (SIGSEGV)."""
    for name, value in description.items():
        if value is None:
            raise PathreplayError(
                f"'{name}' of {description.get('type', 'a dictionary')!r} is None; give it a value, or leave it out"
            )
        if isinstance(value, Mapping):
            require_values(value)


def load_integrator(description: Mapping[str, Any]) -> mi.Integrator:
    """The integrator that a dictionary describes. Raises PathreplayError if it describes none that Mitsuba can make."""
    require_values(description)
    name = description.get("type")
    with told(f"Integrator '{name}' cannot be made", (Exception,)):  # plugins in Python raise whatever they like
        integrator = mi.load_dict(dict(description))
    if not isinstance(integrator, mi.Integrator):
        raise PathreplayError(
            f"'{name}' is a {type(integrator).__name__}, which is no integrator; name one, such as 'pathreplay' (or "
            "'path' for targets)"
        )
    return integrator


@contextmanager
def told(what: str, kinds: tuple[type[Exception], ...] = (RuntimeError,)) -> Iterator[None]:
    """An error of these kinds within becomes a PathreplayError, whose line begins with ``what``.

    It tells the error that came first: Dr.Jit's calls and loops raise others that say nothing. A Ctrl-C that Dr.Jit has
    turned into such an error comes out as what it was.
    """
    try:
        yield
    except PathreplayError:
        raise
    except kinds as error:
        first: BaseException = error
        while first.__cause__ is not None:
            first = first.__cause__
        if isinstance(first, KeyboardInterrupt):
            raise first from None
        raise PathreplayError(f"{what}: {one_line(first)}") from error


def one_line(error: BaseException) -> str:
    """A Mitsuba or Dr.Jit error as one readable line: without C++ source positions, without a plugin's traceback."""
    text = str(error)
    if "PathreplayError: " in text:  # raised by a plugin of ours: it already is what the user should read
        return " ".join(text.rsplit("PathreplayError: ", 1)[1].split())
    text = re.sub(r"Traceback \(most recent call last\):\n(?:[ ]+.*\n)*", "", text)
    text = re.sub(r"\[[A-Za-z_]+\.cpp:\d+\] ", "", text)
    return " ".join(re.sub(r'(At|While loading) dictionary node "root": ', "", text).split())
