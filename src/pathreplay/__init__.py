"""pathreplay: reverse-mode differentiable light transport on Mitsuba 3.

`import pathreplay` registers the plugins for the active variant of Mitsuba and for each variant that is set later. The
import sets no variant. It raises nothing, even if Mitsuba is missing; `pathreplay doctor` names the remedy.
"""

from __future__ import annotations

from typing import Any

from pathreplay.errors import PathreplayError

__version__ = "0.1.0"

__all__ = [
    "Derived",
    "Iteration",
    "Optics",
    "Parameter",
    "PathreplayError",
    "Problem",
    "Result",
    "State",
    "View",
    "__version__",
    "baselines",
    "caustic_heights",
    "check_gradient",
    "exclusive",
    "from_photos",
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

#: Public names that are imported on first access, with the package of each name. These packages take long to import.
_LAZY = {
    "Derived": "pathreplay.library",
    "Iteration": "pathreplay.library",
    "Optics": "pathreplay.inverse.caustics.optics",
    "Parameter": "pathreplay.library",
    "Problem": "pathreplay.library",
    "Result": "pathreplay.library",
    "State": "pathreplay.library",
    "View": "pathreplay.library",
    "caustic_heights": "pathreplay.inverse.caustics.heights",
    "check_gradient": "pathreplay.testing",
    "exclusive": "pathreplay.integrators.lifetimes",
    "from_photos": "pathreplay.jobs",
    "init": "pathreplay.library",
    "iterate": "pathreplay.jobs",
    "load_job": "pathreplay.library",
    "minimize": "pathreplay.library",
    "optimize": "pathreplay.jobs",
    "step": "pathreplay.library",
    "value_and_grad": "pathreplay.library",
}
#: Full name of each module that has a short name in `pathreplay`.
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
        return  # With a removed current folder, Mitsuba would crash Python at exit. `main` reports the error.
    from pathreplay.platform import address_space

    if address_space.is_too_small():
        return  # Mitsuba would hang while loading; `address_space.require` reports the error later
    # `point_drjit` must be called before mitsuba is first imported, because that import makes Dr.Jit look for libLLVM.
    from pathreplay.platform import backend, interrupts, registration

    backend.point_drjit()
    try:
        with interrupts.undisturbed():  # Ctrl-C during this import would crash the process
            import mitsuba  # noqa: F401
    except Exception:
        return  # Mitsuba is missing or broken: `set_variant` and `pathreplay doctor` report the remedy
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
