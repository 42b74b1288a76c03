"""Load objects from dictionaries, reject input that crashes Mitsuba, and convert errors to one-line messages."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import drjit as dr
import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.types import SceneDict


def require_values(description: Mapping[str, object]) -> None:
    """Raise PathreplayError if a dictionary, or one nested in it, contains None, which crashes Mitsuba (SIGSEGV)."""
    for name, value in description.items():
        if value is None:
            raise PathreplayError(
                f"'{name}' of {description.get('type', 'a dictionary')!r} is None; give it a value, or leave it out"
            )
        if isinstance(value, Mapping):
            require_values(value)


def copied(description: Mapping[str, object]) -> SceneDict:
    """Copy a dictionary, its tensors and its bitmaps.

    When Mitsuba loads a dictionary, it moves the tensors out of it, and converts bitmaps in place in spectral variants.
    Raises PathreplayError for a dictionary that Mitsuba has loaded before, if tensors are missing from it.
    """

    def copy(value: object) -> object:
        if isinstance(value, Mapping):
            return copied(value)
        if dr.is_tensor_v(value) and len(value.array) == 0:
            raise PathreplayError(
                "The scene's dictionary contains an empty tensor; if mi.load_dict has loaded the dictionary before, it "
                "has moved the tensors into that scene: give the scene, or build the dictionary again"
            )
        return type(value)(value) if dr.is_array_v(value) or isinstance(value, mi.Bitmap) else value

    return {name: copy(value) for name, value in description.items()}


def load_integrator(description: Mapping[str, object]) -> mi.Integrator:
    """Load the integrator that a dictionary describes. Raises PathreplayError if Mitsuba cannot create it."""
    require_values(description)
    name = description.get("type")
    with errors_as(f"Integrator '{name}' cannot be created", (Exception,)):  # Python plugins may raise anything
        integrator = mi.load_dict(dict(description))
    if not isinstance(integrator, mi.Integrator):
        raise PathreplayError(
            f"'{name}' is a {type(integrator).__name__}, not an integrator; give the name of one, such as 'pathreplay' "
            "(or 'path' for targets)"
        )
    return integrator


@contextmanager
def errors_as(what: str, kinds: tuple[type[Exception], ...] = (RuntimeError,)) -> Iterator[None]:
    """Convert exceptions of the given ``kinds`` into a PathreplayError whose message begins with ``what``.

    The message quotes the first exception of the chain. Later exceptions, raised by Dr.Jit's calls and loops, are
    uninformative. If the first exception is a KeyboardInterrupt (Ctrl-C), a KeyboardInterrupt is raised instead.
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
    """Convert a Mitsuba or Dr.Jit error to one readable line, without C++ source positions and Python tracebacks."""
    text = str(error)
    if "PathreplayError: " in text:  # a plugin of this package raised the error, with a message for users
        return " ".join(text.rsplit("PathreplayError: ", 1)[1].split())
    text = re.sub(r"Traceback \(most recent call last\):\n(?:[ ]+.*\n)*", "", text)
    text = re.sub(r"\[[A-Za-z_]+\.cpp:\d+\] ", "", text)
    return " ".join(re.sub(r'(At|While loading) dictionary node "root": ', "", text).split())
