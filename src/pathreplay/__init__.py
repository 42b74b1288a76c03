"""pathreplay: reverse-mode differentiable light transport on Mitsuba 3.

Importing it registers the plugins for the active variant of Mitsuba and for every later one with automatic
differentiation. It sets no variant and raises nothing, even where Mitsuba is missing: `pathreplay doctor` then tells
what to do.
"""

from __future__ import annotations

from typing import Any

from pathreplay.errors import PathreplayError

__version__ = "0.1.0"

__all__ = [
    "Derived",
    "Iteration",
    "Parameter",
    "PathreplayError",
    "Problem",
    "Result",
    "State",
    "View",
    "__version__",
    "baselines",
    "check_gradient",
    "exclusive",
    "init",
    "iterate",
    "load_job",
    "losses",
    "minimize",
    "optimize",
    "regularizers",
    "step",
    "value_and_grad",
]

#: Public names that live in rooms which need more time to import than `import pathreplay` should take.
_LAZY = {
    "Derived": "pathreplay.library",
    "Iteration": "pathreplay.library",
    "Parameter": "pathreplay.library",
    "Problem": "pathreplay.library",
    "Result": "pathreplay.library",
    "State": "pathreplay.library",
    "View": "pathreplay.library",
    "check_gradient": "pathreplay.testing",
    "exclusive": "pathreplay.integrators.lifetimes",
    "init": "pathreplay.library",
    "iterate": "pathreplay.jobs",
    "load_job": "pathreplay.library",
    "minimize": "pathreplay.library",
    "optimize": "pathreplay.jobs",
    "step": "pathreplay.library",
    "value_and_grad": "pathreplay.library",
}
#: Modules that are called otherwise here.
_MODULES = {
    "baselines": "pathreplay.baselines",
    "losses": "pathreplay.inverse.losses.pixelwise",
    "regularizers": "pathreplay.inverse.parameters.regularizers",
}


def _set_up() -> None:
    import os

    try:
        os.getcwd()
    except OSError:
        return  # the folder was removed: Mitsuba would bring Python down at its end; the command says so
    from pathreplay.platform import address_space

    if address_space.is_too_small():
        return  # Mitsuba would hang; commands and functions say so
    # Before the first import of mitsuba: Dr.Jit looks for libLLVM while it is imported.
    from pathreplay.platform import backend, interrupts, registration

    backend.point_drjit()
    try:
        with interrupts.undisturbed():  # Ctrl-C in the middle of this brings the process down
            import mitsuba  # noqa: F401
    except Exception:
        return  # missing or broken: set_variant and the doctor say so, with the remedy
    registration.install()


_set_up()
del _set_up


def __getattr__(name: str) -> Any:
    if name in _LAZY or name in _MODULES:
        import importlib

        from pathreplay.platform import address_space

        address_space.require()
        return (
            importlib.import_module(_MODULES[name])
            if name in _MODULES
            else getattr(importlib.import_module(_LAZY[name]), name)
        )
    raise AttributeError(f"module 'pathreplay' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY, *_MODULES})
