"""The limit on this process's addresses (``ulimit -v``): under a low one native code hangs or dies as it is loaded."""

from __future__ import annotations

from pathreplay.errors import PathreplayError

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

LEAST = 700_000 * 1024
"""Bytes: with 600 000 kB matplotlib's libraries are not mapped, and with 450 000 Mitsuba's hang."""

_SIGNS = ("failed to map segment", "cannot allocate memory")


def is_too_small() -> bool:
    """Whether Mitsuba and the rest cannot be loaded under the limit."""
    if resource is None:
        return False
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return limit != resource.RLIM_INFINITY and limit < LEAST


def require() -> None:
    """Raise PathreplayError if the limit is too small."""
    if is_too_small():
        raise PathreplayError(_line())


def told(error: ImportError) -> str:
    """What is to be said of a library that could not be loaded for want of addresses; "" for another reason."""
    return f"{_line()} ({error})" if any(sign in str(error).lower() for sign in _SIGNS) else ""


def _line() -> str:
    limit = None if resource is None else resource.getrlimit(resource.RLIMIT_AS)[0]
    limited = "" if limit in (None, -1) else f"{limit // 1024} kB of addresses (ulimit -v) are "
    return (
        f"{limited or 'The memory that is left is '}too little to load Mitsuba and LLVM, which want {LEAST // 1024} kB "
        "and more with many cores; raise it: ulimit -v unlimited"
    )
