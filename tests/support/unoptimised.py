"""Kernels that LLVM compiles without optimisation: most kernels of tests run for less time than it takes.

    PATHREPLAY_TEST_KERNELS=unoptimised python -m pytest ...

is what `make test` does; `make test-all` runs the same tests with the kernels that users have. Dr.Jit knows a kernel by
its code, and not by how it was compiled: so these are kept in a folder of their own.
"""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

#: Options of LLVM: skip every pass that may be skipped, and do not say so.
OPTIONS = ("-opt-bisect-limit=0", "-opt-bisect-verbose=0")


def is_asked_for() -> bool:
    """Whether the kernels of this process shall be such."""
    return os.environ.get("PATHREPLAY_TEST_KERNELS") == "unoptimised"


def keep_apart() -> None:
    """Have Dr.Jit keep the kernels of this process in a folder beside the others. Call it before Dr.Jit is imported."""
    folder = Path(os.environ.get("DRJIT_CACHE_DIR") or Path.home() / ".drjit")
    if folder.name != "unoptimised":  # by the process that started this one
        folder = folder / "unoptimised"
    folder.mkdir(parents=True, exist_ok=True)
    os.environ["DRJIT_CACHE_DIR"] = str(folder)


def leave_unoptimised(*more: str) -> None:
    """Have the LLVM that Dr.Jit has loaded compile so from now on, with further options of its own."""
    arguments = [option.encode() for option in ("drjit", *OPTIONS, *more)]
    llvm = ctypes.CDLL(os.environ["DRJIT_LIBLLVM_PATH"])
    llvm.LLVMParseCommandLineOptions(len(arguments), (ctypes.c_char_p * len(arguments))(*arguments), None)
