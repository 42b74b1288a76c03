"""How much memory is left, so that what cannot fit is refused before anything of it is made; and budgets, kept."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
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
    if _budget is not None:
        left = min(left, _budget - taken())
    return max(left, 0)


_budget: int | None = None
"""Bytes that this process may take, where somebody has said so."""


@contextmanager
def within(budget: int | None) -> Iterator[None]:
    """Within this block the process may take so many bytes: `available` knows, `require_kept` holds it to that."""
    global _budget
    before = _budget
    _budget = budget
    try:
        yield
    finally:
        _budget = before


def taken() -> int:
    """Bytes that this process has to itself: pages of files, which can be read again, do not count."""
    info = psutil.Process().memory_info()
    return int(info.rss - getattr(info, "shared", 0))


def is_crowded() -> bool:
    """Whether there is a budget, and half of it is taken: what is kept for later should go."""
    return _budget is not None and taken() > _budget // 2


def require_kept() -> None:
    """Raise PathreplayError if the process has taken more than its budget."""
    if _budget is not None and (now := taken()) > _budget:
        raise PathreplayError(
            f"The run takes {_readable(now)} of memory, and its 'memory_limit' is {_readable(_budget)}; take smaller "
            "films or parameters, or raise it"
        )


def require(needed: int, thing: str, way_out: str) -> None:
    """Raise PathreplayError, from ``thing`` to ``way_out``, unless ``needed`` bytes are available."""
    if needed > (left := available()):
        asked = f"needs about {_readable(needed)} of memory"
        raise PathreplayError(f"{thing} {asked}, {_readable(left)} are left; {way_out}")


def _readable(count: int) -> str:
    return f"{count / 1e9:.2g} GB" if count < 1e15 else "more than 1000 TB"
