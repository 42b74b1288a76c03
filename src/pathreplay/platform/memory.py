"""Available memory and memory budgets, to refuse requests that cannot fit before anything is allocated."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil

from pathreplay.errors import PathreplayError

# Files with the memory limit, memory usage and memory statistics of a container. The first row is for version 2 of the
# control groups of Linux, the second row for version 1.
_CONTAINERS = tuple(
    tuple(Path("/sys/fs/cgroup", name) for name in names)
    for names in (
        ("memory.max", "memory.current", "memory.stat"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "memory/memory.stat"),
    )
)


def available() -> int:
    """Return the bytes that this process can allocate without swapping.

    The result is limited by the free memory of the machine, the limit of the container, and the budget of `within`.
    """
    left = int(psutil.virtual_memory().available)
    for limit, used, statistics in _CONTAINERS:
        try:
            # The usage of a container includes cached files, but their memory is available: it is freed when needed.
            cached = dict(re.findall(r"^(?:total_)?((?:in)?active_file) (\d+)$", statistics.read_text(), re.MULTILINE))
            left = min(left, int(limit.read_text()) - int(used.read_text()) + sum(map(int, cached.values())))
        except (OSError, ValueError):  # the file does not exist, or contains 'max' (no limit)
            continue
    if _budgets:
        left = min(left, min(_budgets) - taken())
    return max(left, 0)


_budgets: list[int] = []
"""Budgets of the active blocks of `within`, in bytes."""


@contextmanager
def within(budget: int | None) -> Iterator[None]:
    """Set the memory budget of this process, in bytes, within this block. None sets no budget.

    `available` respects the budget, and `require_kept` enforces it. Several blocks can be active and end in any order.
    The smallest of their budgets applies.
    """
    given = [] if budget is None else [budget]
    _budgets.extend(given)
    try:
        yield
    finally:
        for each in given:
            _budgets.remove(each)


def taken() -> int:
    """Return the bytes of memory private to this process.

    File-backed pages are not counted, because the system can drop them and read them again.
    """
    info = psutil.Process().memory_info()
    return int(info.rss - getattr(info, "shared", 0))


def is_crowded() -> bool:
    """Return whether this process uses more than half of its budget, so that caches should be dropped."""
    return bool(_budgets) and taken() > min(_budgets) // 2


def require_kept() -> None:
    """Raise PathreplayError if the process has exceeded its budget."""
    if _budgets and (now := taken()) > (budget := min(_budgets)):
        raise PathreplayError(
            f"The run uses {_readable(now)} of memory, and its 'memory_limit' is {_readable(budget)}; use smaller "
            "films or parameters, or raise the limit"
        )


def require(needed: int, thing: str, remedy: str) -> None:
    """Raise PathreplayError unless ``needed`` bytes are available; the message names ``thing`` and ``remedy``."""
    if needed > (left := available()):
        asked = f"needs about {_readable(needed)} of memory"
        raise PathreplayError(f"{thing} {asked}, {_readable(left)} is available; {remedy}")


def _readable(count: int) -> str:
    return f"{count / 1e9:.2g} GB" if count < 1e15 else "more than 1000 TB"
