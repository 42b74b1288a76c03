"""Makes Dr.Jit load a working libLLVM, and sets the variant of Mitsuba.

Dr.Jit searches for libLLVM once, when `drjit` is imported. It loads the file named by DRJIT_LIBLLVM_PATH, or else the
newest libLLVM in a few folders. The variable must therefore be set before the import, and `import pathreplay` calls
`point_drjit` first. `point_drjit` tests no library, because the libLLVM that pathreplay installs as a dependency (wheel
karellen-llvm-core) is known to work. `set_variant` and `pathreplay doctor` test libraries in a subprocess
(pathreplay.platform.llvm).
"""

from __future__ import annotations

import ctypes
import difflib
import logging
import os
import sys

from pathreplay.errors import PathreplayError
from pathreplay.platform import llvm
from pathreplay.platform.llvm import ENVIRONMENT_VARIABLE, OLDEST_USABLE_MAJOR

logger = logging.getLogger("pathreplay")


def point_drjit() -> None:
    """Make Dr.Jit load a working libLLVM, without testing it. Raises nothing.

    If drjit is not imported yet, DRJIT_LIBLLVM_PATH is set to the libLLVM of the wheel karellen-llvm-core, or else to
    the newest system library that is not known to fail. If the variable already names a library that can be loaded and
    is not known to fail, its value is kept. If drjit is already imported and has loaded a library that is known to
    fail, that library is replaced if possible (see `reload_llvm`).
    """
    if "drjit" in sys.modules:
        path = None if loaded_is_plausible() else _untried_choice()
        if path is not None and not reload_llvm(path) and not loaded_version():
            logger.warning("drjit was imported before pathreplay and found no libLLVM: %s", _remedy(path))
        return
    asked_for = os.environ.get(ENVIRONMENT_VARIABLE, "")
    problem = _known_problem(asked_for) if asked_for else ""
    if (path := _untried_choice()) is not None and (problem or not asked_for):
        if problem:
            logger.warning("%s=%s: %s; using %s", ENVIRONMENT_VARIABLE, asked_for, problem, path)
        os.environ[ENVIRONMENT_VARIABLE] = path
        _preload(llvm.unlinked_siblings(path))


def _known_problem(path: str) -> str:
    """Return a reason why a libLLVM cannot work, or "". The library is loaded, but not tested."""
    version = llvm.version_in_path(os.path.realpath(path))
    if version and version < (OLDEST_USABLE_MAJOR,):
        return f"LLVM {version[0]} is refused by Dr.Jit or aborts the process"
    return _preload([*llvm.unlinked_siblings(path), path])


def _remedy(path: str | None) -> str:
    if path is None:
        return llvm.WAY_OUT
    return f"import pathreplay before mitsuba, or start Python with {ENVIRONMENT_VARIABLE}={path}"


def _untried_choice() -> str | None:
    usable = (path for path in llvm.system_libraries() if llvm.version_in_path(path) >= (OLDEST_USABLE_MAJOR,))
    return llvm.pip_library() or next(usable, None)


def _preload(paths: list[str]) -> str:
    """Load shared libraries into this process; return a one-line reason if one cannot be loaded, otherwise ""."""
    for path in paths:
        try:
            ctypes.CDLL(path)
        except OSError as error:
            return str(error)
    return ""


def loaded_version() -> tuple[int, ...]:
    """Return the version of the loaded libLLVM, e.g. (23, 1, 4). It is empty if the LLVM back end is inactive."""
    import drjit as dr

    return tuple(dr.detail.llvm_version()) if dr.has_backend(dr.JitBackend.LLVM) else ()


def loaded_is_plausible() -> bool:
    """Whether Dr.Jit's LLVM back end is active, with a version that is not known to abort the process."""
    return loaded_version() >= (OLDEST_USABLE_MAJOR,)


def reload_llvm(path: str) -> bool:
    """Make an imported Dr.Jit release its libLLVM and load `path`; return False if this is impossible.

    Replacing is impossible while Dr.Jit holds variables or a CUDA device, which would be lost. Replacing is also
    impossible if Dr.Jit found no loadable file at all, because Dr.Jit does not search a second time. The function calls
    `jit_shutdown` and `jit_init` of libdrjit-core, which have no Python bindings.
    """
    import drjit as dr

    active = bool(dr.has_backend(dr.JitBackend.LLVM))
    in_use = active and "No variables registered" not in (dr.whos(as_string=True) or "")
    if in_use or (active and dr.has_backend(dr.JitBackend.CUDA)):
        return False
    try:
        core = ctypes.CDLL(os.path.join(os.path.dirname(dr.__file__), "libdrjit-core.so"))
        shutdown, init = core._Z12jit_shutdowni, core._Z8jit_initj
    except (OSError, AttributeError):  # unsupported platform or Dr.Jit version
        return False
    before = os.environ.get(ENVIRONMENT_VARIABLE)
    os.environ[ENVIRONMENT_VARIABLE] = path
    _preload(llvm.unlinked_siblings(path))
    if active:
        shutdown(ctypes.c_int(0))
    init(ctypes.c_uint(1 << int(dr.JitBackend.LLVM.value)))
    if not (works := loaded_is_plausible()):
        del os.environ[ENVIRONMENT_VARIABLE]
        if before is not None:
            os.environ[ENVIRONMENT_VARIABLE] = before
    return works


def warn_of_bad_llvm() -> None:
    """Log a warning if Dr.Jit has loaded a libLLVM that aborts the process. Called when an LLVM variant is set."""
    if not loaded_is_plausible():
        logger.warning(
            "Dr.Jit has loaded libLLVM %s, which aborts the process at the first minimum or maximum: %s",
            ".".join(map(str, loaded_version())), _remedy(_untried_choice()),
        )  # fmt: skip


def ensure_llvm() -> None:
    """Ensure that Dr.Jit's LLVM back end works in this process.

    If Dr.Jit has loaded the libLLVM of the wheel karellen-llvm-core, no test is made. Any other library is tested
    (0.3 s), and replaced if the test fails.

    Raises PathreplayError if no library works, or if the loaded library can no longer be replaced.
    """
    current = os.environ.get(ENVIRONMENT_VARIABLE, "")
    plausible = loaded_is_plausible()
    if plausible and current == llvm.pip_library():
        return
    tried = llvm.probe(current)
    if plausible and tried.works:
        return
    library = llvm.find_llvm()
    if current and library.path != current:
        logger.warning("%s=%s does not work (%s): using %s", ENVIRONMENT_VARIABLE, current, tried.message, library.path)
    if not reload_llvm(library.path):
        raise PathreplayError(
            f"Dr.Jit has loaded {current or 'a libLLVM'} that does not work ({tried.message or 'back end inactive'}), "
            f"and can no longer replace it: start again with {ENVIRONMENT_VARIABLE}={library.path}"
        )


def is_usable_variant(name: str) -> bool:
    """Whether a Mitsuba variant is usable: with automatic differentiation and without polarisation."""
    return "_ad_" in name and not name.endswith("_polarized")


def set_variant(name: str | None = None) -> str:
    """Set a Mitsuba variant that runs on this machine, and return its name.

    Without a name, an active variant with automatic differentiation is kept. If there is none, the variant is
    `cuda_ad_rgb` on a machine with a CUDA device, and `llvm_ad_rgb` elsewhere.

    Raises PathreplayError if the named variant does not exist, has no derivatives or is polarised, or if it does not
    run on this machine.
    """
    try:
        import mitsuba as mi
    except Exception as error:
        raise PathreplayError(
            f"Mitsuba cannot be imported ({error}): install it with `pip install 'mitsuba>=3.9.1,<3.10'`"
        ) from error
    if name is None:
        active = mi.variant()
        if active is not None and is_usable_variant(active):
            return str(active)
        name = default_variant()
    _check_name(name, mi.variants())
    if name.startswith("llvm"):
        ensure_llvm()
    try:
        mi.set_variant(name)
    except ImportError as error:  # raised by Mitsuba if a back end is unavailable
        if (error.name or "").startswith("pathreplay"):
            raise  # one of our own modules is missing: not an error that the user can fix
        reason = " ".join(str(error).split())
        raise PathreplayError(f"variant {name} does not run here ({reason}): see `pathreplay doctor`") from error
    return name


def default_variant() -> str:
    """Return the variant that `set_variant` sets if none is named and none is active."""
    import drjit as dr

    return "cuda_ad_rgb" if dr.has_backend(dr.JitBackend.CUDA) else "llvm_ad_rgb"


def _check_name(name: str, known: list[str]) -> None:
    usable = [variant for variant in known if is_usable_variant(variant)]
    if name in usable:
        return
    use, plain = f"use one of {', '.join(usable)}", name.removesuffix("_polarized")
    if name in known and "_ad_" in name:
        use = f"use {plain}" if plain in usable else use
        raise PathreplayError(f"variant {name} is polarised, which pathreplay does not support: {use}")
    if name in known:
        raise PathreplayError(f"variant {name} has no derivatives: {use}")
    near = difflib.get_close_matches(name, usable, n=1)
    raise PathreplayError(f"there is no variant {name!r}: {f'did you mean {near[0]}?' if near else use}")
