"""Registers our plugins for the active variant of Mitsuba and for every later one with automatic differentiation.

A Python plugin is known to Mitsuba in the variant it was registered in, and a variant callback is called only for
variants set after it was added. Scalar variants get no plugins: nothing in them can be differentiated. Polarised ones
do, so that loading a plugin there says clearly that it is not supported.
"""

from __future__ import annotations

import importlib

#: Each has `register() -> None`, which registers its plugins for the active variant; doing so again is harmless.
PLUGIN_MODULES = (
    "pathreplay.integrator",
    "pathreplay.rivals",
    "pathreplay.bsdfs.smoothdielectric",
    "pathreplay.media.gridmedium",
)


def has_derivatives(variant: str | None) -> bool:
    """Whether a variant of Mitsuba can differentiate at all."""
    return variant is not None and "_ad_" in variant


def register(variant: str | None) -> None:
    """Register all plugins for the active variant, whose name is `variant`; does nothing without derivatives."""
    if not has_derivatives(variant):
        return
    if str(variant).startswith("llvm"):
        from pathreplay.backend import warn_of_bad_llvm

        warn_of_bad_llvm()
    for module in PLUGIN_MODULES:
        importlib.import_module(module).register()


def _on_variant(_old: str | None, new: str) -> None:
    register(new)


def install() -> None:
    """Register for the active variant, if any, and from now on for each one that is set. Sets no variant."""
    import mitsuba as mi

    mi.detail.add_variant_callback(_on_variant)
    register(mi.variant())
