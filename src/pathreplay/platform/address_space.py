"""The limit on the address space (``ulimit -v``): if it is too low, native libraries hang or crash on loading."""

from __future__ import annotations

from pathreplay.errors import PathreplayError

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

LEAST = 700_000 * 1024
"""Smallest usable limit in bytes.

With 600 000 kB, matplotlib's libraries cannot be mapped; with 450 000 kB, loading Mitsuba hangs.
"""

_SIGNS = ("failed to map segment", "cannot allocate memory")


def is_too_small() -> bool:
    """Whether the limit is too low to load Mitsuba and its dependencies."""
    if resource is None:
        return False
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return limit != resource.RLIM_INFINITY and limit < LEAST


def require() -> None:
    """Raise PathreplayError if the limit is too low."""
    if is_too_small():
        raise PathreplayError(_line())


def describe_failure(error: ImportError) -> str:
    """Return a one-line message if a library could not be loaded for lack of address space, otherwise ""."""
    return f"{_line()} ({error})" if any(sign in str(error).lower() for sign in _SIGNS) else ""


def _line() -> str:
    limit = None if resource is None else resource.getrlimit(resource.RLIMIT_AS)[0]
    limited = "" if limit in (None, -1) else f"{limit // 1024} kB of address space (ulimit -v) is "
    return (
        f"{limited or 'The available memory is '}too little to load Mitsuba and LLVM, which need {LEAST // 1024} kB, "
        "and more with many cores; raise the limit: ulimit -v unlimited"
    )
