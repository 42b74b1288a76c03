"""Kernels that LLVM compiles without optimisation: most kernels of tests run for less time than it takes.

    PATHREPLAY_TEST_KERNELS=unoptimised python -m pytest ...

is what `make test` does; `make test-all` runs the same tests with the kernels that users have, but for hostile cases,
which are forks of a process with unoptimised kernels (`hostile/server.py`). Dr.Jit knows a kernel by
its code, and not by how it was compiled: so these are kept in a folder of their own.
"""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

#: Options of LLVM: skip every pass that may be skipped, do not say so, and assign registers block by block.
OPTIONS = ("-opt-bisect-limit=0", "-opt-bisect-verbose=0", "-regalloc=fast", "-optimize-regalloc=false")


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


def leave_unoptimised(*more: str, library: str = "") -> None:
    """Have an LLVM compile so from now on, by default that of Dr.Jit, with further options of its own."""
    arguments = [option.encode() for option in ("drjit", *OPTIONS, *more)]
    llvm = ctypes.CDLL(library or os.environ["DRJIT_LIBLLVM_PATH"])
    llvm.LLVMParseCommandLineOptions(len(arguments), (ctypes.c_char_p * len(arguments))(*arguments), None)


def first_line() -> str:
    """Code with which a fresh Python does so, if this process does, and Dr.Jit is to load the same LLVM there."""
    if not is_asked_for() or not (library := os.environ.get("DRJIT_LIBLLVM_PATH")):
        return ""
    here = str(Path(__file__).parent)
    return f"import sys; sys.path.insert(0, {here!r}); import unoptimised; del sys.path[0]; " + (
        f"unoptimised.leave_unoptimised(library={library!r}); del sys, unoptimised\n"
    )
