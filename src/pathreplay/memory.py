"""How much memory is left, so that what cannot fit is refused before anything of it is made."""

from __future__ import annotations

import re
from pathlib import Path

import psutil

from pathreplay.errors import PathreplayError

# Limit, use and statistics of a container, in the two versions of Linux' control groups.
_CONTAINERS = tuple(
    tuple(Path("/sys/fs/cgroup", name) for name in names)
    for names in (
        ("memory.max", "memory.current", "memory.stat"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "memory/memory.stat"),
    )
)


def available() -> int:
    """Bytes that this process can still get without swapping: of the machine, and of its container if it has one."""
    left = int(psutil.virtual_memory().available)
    for limit, used, statistics in _CONTAINERS:
        try:
            # Files that a container counts as used, and gives up when memory is wanted.
            cached = dict(re.findall(r"^(?:total_)?((?:in)?active_file) (\d+)$", statistics.read_text(), re.MULTILINE))
            left = min(left, int(limit.read_text()) - int(used.read_text()) + sum(map(int, cached.values())))
        except (OSError, ValueError):  # no such group, or 'max': no limit
            continue
    return max(left, 0)


def require(needed: int, thing: str, way_out: str) -> None:
    """Raise PathreplayError, from ``thing`` to ``way_out``, unless ``needed`` bytes are available."""
    if needed > (left := available()):
        asked = f"needs about {_readable(needed)} of memory"
        raise PathreplayError(f"{thing} {asked}, {_readable(left)} are left; {way_out}")


def _readable(count: int) -> str:
    return f"{count / 1e9:.2g} GB" if count < 1e15 else "more than 1000 TB"
