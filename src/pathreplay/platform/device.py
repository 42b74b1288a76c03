"""The device that runs kernels: its local memory per lane, its total memory, and whether its sums are reproducible.

On LLVM, each CPU thread runs one vector packet of lanes at a time, and local memory is part of the thread's stack. A
GPU reserves local memory for every thread that can be resident, whatever the launch size. For example, 2048 vertex
records of 124 bytes per thread, for 2048 threads on each of 132 multiprocessors, take 69 GB. Long paths are therefore
recorded only on CPUs.

Runs on an H100 determined `LARGEST_LOCAL` and `FEWEST_RECORDS`. The resulting depths are computed, with simulated
devices in tests (docs/memory.md). On other GPUs, `pathreplay doctor --gpu` runs passes close to these depths.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cache

from pathreplay.errors import PathreplayError
from pathreplay.platform import memory

SHARE = 0.25
"""Fraction of GPU memory that vertex records may take; the rest is for the scene, the film and other processes."""
LARGEST_LOCAL = 56 * 1024
"""Largest number of bytes of local memory per CUDA thread. OptiX provides a stack of 64 KiB, and crashes the process if
the stack overflows. 560 records of 96 bytes fit; 700 records of this size do not."""
FEWEST_RECORDS = 9
"""Smallest number of records that are allocated on a GPU. Arrays of up to eight entries would be kept in registers.
Dynamic indexing of registers makes a pass more than twice as slow."""

# CUDA device attributes.
_MULTIPROCESSORS, _THREADS_EACH = 16, 39


@dataclass(frozen=True)
class Device:
    """The device that runs the kernels of a variant.

    ``lanes`` is the number of lanes that hold local memory at once, and ``memory`` is the size of GPU memory in bytes.
    Both are 0 for CPUs, which are limited by stack and main memory instead.
    """

    backend: str  # llvm, cuda or metal: the first part of the variant's name
    name: str = ""
    lanes: int = 0
    memory: int = 0

    @property
    def is_gpu(self) -> bool:
        return self.backend != "llvm"

    @property
    def keeps_order(self) -> bool:
        """Whether the order of additions is reproducible if a single thread is used. On a GPU the order is random."""
        return not self.is_gpu

    def most_records(self, size: int, otherwise: int) -> int:
        """Return the largest number of records of ``size`` bytes that a lane may have, which is at most ``otherwise``.

        On a GPU, the records must also fit into the local memory of the lane.
        """
        if not self.is_gpu:
            return otherwise
        known = self.lanes > 0 and self.memory > 0
        room = min(LARGEST_LOCAL, int(SHARE * self.memory) // self.lanes) if known else LARGEST_LOCAL
        return min(otherwise, room // size)

    def room(self, records: int) -> int:
        """Return the number of records to allocate if ``records`` are needed.

        On a GPU, the result is at least `FEWEST_RECORDS`.
        """
        return max(records, FEWEST_RECORDS) if self.is_gpu else records


def backend_of(variant: str) -> str:
    """Return the back end that is part of the name of a variant."""
    return variant.split("_")[0]


def device_of(variant: str) -> Device:
    """Return the device that a Mitsuba variant runs on; lanes and memory of a GPU that cannot be queried are 0."""
    kind = backend_of(variant)
    return _cuda_device() if kind == "cuda" else Device(kind)


@cache
def _cuda_device() -> Device:
    """Query the CUDA driver for the first device, which is the one that Dr.Jit uses."""
    try:
        driver = ctypes.CDLL("libcuda.so.1")
        device, count, threads = ctypes.c_int(), ctypes.c_int(), ctypes.c_int()
        size, name = ctypes.c_size_t(), ctypes.create_string_buffer(128)
        asked = (
            driver.cuInit(0),
            driver.cuDeviceGet(ctypes.byref(device), 0),
            driver.cuDeviceGetName(name, len(name), device),
            driver.cuDeviceTotalMem_v2(ctypes.byref(size), device),
            driver.cuDeviceGetAttribute(ctypes.byref(count), _MULTIPROCESSORS, device),
            driver.cuDeviceGetAttribute(ctypes.byref(threads), _THREADS_EACH, device),
        )
    except (OSError, AttributeError):
        return Device("cuda")
    if any(asked):
        return Device("cuda")
    return Device("cuda", name.value.decode(errors="replace"), count.value * threads.value, size.value)


def available(variant: str) -> int:
    """Return the bytes available for rendering.

    On a CPU, the result is the free main memory. On a GPU, it is the minimum of free main memory and total GPU memory.
    """
    device, left = device_of(variant), memory.available()
    return min(left, device.memory) if device.memory else left


def require_order(variant: str) -> None:
    """Raise PathreplayError if the device of a variant performs additions in random order."""
    if not device_of(variant).keeps_order:
        raise PathreplayError(
            f"deterministic = true needs an LLVM variant, this is '{variant}': on a GPU the order of additions "
            "is random; set variant = 'llvm_ad_rgb', or leave 'deterministic' out"
        )
