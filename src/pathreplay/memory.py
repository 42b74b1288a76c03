"""How much memory is left, so that what cannot fit is refused before anything of it is made."""

from __future__ import annotations

from pathlib import Path

import psutil

from pathreplay.errors import PathreplayError

# Limit and use of a container, in the two versions of Linux' control groups.
_CONTAINERS = (
    (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory.current")),
    (
        Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"),
        Path("/sys/fs/cgroup/memory/memory.usage_in_bytes"),
    ),
)


def available() -> int:
    """Bytes that this process can still get without swapping: of the machine, and of its container if it has one."""
    left = int(psutil.virtual_memory().available)
    for limit, used in _CONTAINERS:
        try:
            left = min(left, int(limit.read_text()) - int(used.read_text()))
        except (OSError, ValueError):  # no such group, or 'max': no limit
            continue
    return max(left, 0)


def require(needed: int, thing: str, way_out: str) -> None:
    """Return quietly if ``needed`` bytes are available.

    Raises:
        PathreplayError: they are not; the line begins with ``thing`` and ends with ``way_out``.
    """
    left = available()
    if needed > left:
        asked = f"needs about {_readable(needed)} of memory"
        raise PathreplayError(f"{thing} {asked}, {_readable(left)} are left; {way_out}")


def _readable(count: int) -> str:
    return f"{count / 1e9:.2g} GB" if count < 1e15 else "more than 1000 TB"
