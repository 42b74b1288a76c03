"""Where kernels run, and all that is decided by that: what a lane may remember, what memory there is, what is random.

On LLVM a kernel has as many lanes under way as threads have places in a packet, and local memory is a part of each
thread's stack. A GPU sets local memory aside for every thread that can be resident, whatever is launched: a record of
124 bytes x depth 2048 x 2048 threads x 132 multiprocessors is 69 GB. So deep records are for processors.

What stands here about GPUs was measured on an H100 (docs/memory.md), is tested with devices that are made up, and is
measured by `pathreplay doctor --gpu` elsewhere.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cache

from pathreplay.errors import PathreplayError
from pathreplay.platform import memory

SHARE = 0.25
"""Of a GPU's memory that records may take: the rest is for scene, film, and what else runs there."""
LARGEST_LOCAL = 56 * 1024
"""Bytes that a CUDA thread may remember: OptiX gives it a stack of 64 KiB, and ends the process where that is not
enough. A record of 560 x 96 bytes fits, one of 700 x 96 does not."""
FEWEST_RECORDS = 9
"""That a GPU makes room for: an array of up to eight is kept in registers, and reading one of these by its index makes
a pass take more than twice as long."""

# CUDA's numbers for what it is asked.
_MULTIPROCESSORS, _THREADS_EACH = 16, 39


@dataclass(frozen=True)
class Device:
    """Where kernels of a variant run.

    ``lanes`` is how many hold local memory at once, and ``memory`` how many bytes the device has of its own; both are 0
    for processors, whose limits are those of stack and machine.
    """

    backend: str  # llvm, cuda, metal: how names of variants begin
    name: str = ""
    lanes: int = 0
    memory: int = 0

    @property
    def is_gpu(self) -> bool:
        return self.backend != "llvm"

    @property
    def keeps_order(self) -> bool:
        """Whether one thread adds in an order that is always the same. On a GPU it is random."""
        return not self.is_gpu

    def local_bytes(self) -> int | None:
        """Bytes that a lane may remember in local memory; None: as much as the drivers are made for."""
        if not self.is_gpu:
            return None
        known = self.lanes > 0 and self.memory > 0
        return min(LARGEST_LOCAL, int(SHARE * self.memory) // self.lanes) if known else LARGEST_LOCAL

    def most_records(self, size: int, otherwise: int) -> int:
        """How many records of ``size`` bytes a lane may hold, and ``otherwise`` at most."""
        room = self.local_bytes()
        return otherwise if room is None else min(otherwise, room // size)

    def room(self, records: int) -> int:
        """For how many records to make room, where so many are needed."""
        return max(records, FEWEST_RECORDS) if self.is_gpu else records


def backend_of(variant: str) -> str:
    """The back end of a variant, by its name."""
    return variant.split("_")[0]


def device_of(variant: str) -> Device:
    """The device that a variant of Mitsuba runs on; a GPU that cannot be asked is taken as one without limits."""
    kind = backend_of(variant)
    return _cuda_device() if kind == "cuda" else Device(kind)


@cache
def _cuda_device() -> Device:
    """What the driver tells of the device that Dr.Jit takes, the first one."""
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
    """Bytes that renderings can still get: of the machine, and on a GPU no more than it has."""
    device, left = device_of(variant), memory.available()
    return min(left, device.memory) if device.memory else left


def require_order(variant: str) -> None:
    """Raise PathreplayError where the additions of a variant have a random order."""
    if not device_of(variant).keeps_order:
        raise PathreplayError(
            f"deterministic = true needs an LLVM variant, this is '{variant}': on a GPU the order of additions "
            "is random; set variant = 'llvm_ad_rgb', or leave 'deterministic' out"
        )
