"""Registers our plugins for the active variant of Mitsuba and for every later one.

A Python plugin is known to Mitsuba in the variant it was registered in, and a variant callback is called only for
variants set after it was added. Where nothing can be differentiated, as in scalar variants, stand-ins say so and name
the variant to use. Polarised variants get the plugins themselves, which say that they are not supported.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

from pathreplay.errors import PathreplayError

#: Each has `register() -> None`, which registers its plugins for the active variant; doing so again is harmless.
PLUGIN_MODULES = (
    "pathreplay.render.integrator",
    "pathreplay.rivals.integrators",
    "pathreplay.bsdfs.smoothdielectric",
    "pathreplay.media.gridmedium",
)

#: All that they register: name -> the function of Mitsuba's that does it.
PLUGINS = {
    "pathreplay": "register_integrator",
    "pathreplay_tape": "register_integrator",
    "pathreplay_rb": "register_integrator",
    "pathreplay_listing": "register_integrator",
    "smoothdielectric": "register_bsdf",
    "gridmedium": "register_medium",
}


def register(variant: str) -> None:
    """Register all plugins for the active variant, whose name is `variant`; stand-ins where it has no derivatives."""
    if "_ad_" not in variant:
        _register_stand_ins(variant)
        return
    if variant.startswith("llvm"):
        from pathreplay.backend import warn_of_bad_llvm

        warn_of_bad_llvm()
    for module in PLUGIN_MODULES:
        importlib.import_module(module).register()


def on_base(template: type, base: type) -> type:
    """The class that a template describes, on a base class of Mitsuba's. Each variant has its own, so that a template,
    which is there before any of them, cannot have it; its methods call those of the base by their class."""
    parts = [vars(part) for part in reversed(template.__mro__[:-1])]
    body = {name: value for part in parts for name, value in part.items() if name not in ("__dict__", "__weakref__")}
    return type(base)(template.__name__, (base,), body)  # type: ignore[no-any-return]


def _register_stand_ins(variant: str) -> None:
    import mitsuba as mi

    from pathreplay.backend import is_usable_variant

    usable = [name for name in mi.variants() if is_usable_variant(name)]
    colours = variant.removesuffix("_polarized").rsplit("_", 1)[-1]
    alike = [name for name in usable if name.endswith(colours)] or usable

    def stand_in(plugin: str) -> Callable[[Any], Any]:
        def refuse(props: Any) -> Any:
            raise PathreplayError(f"{plugin}: variant {variant!r} has no derivatives: use {' or '.join(alike)}")

        return refuse

    for plugin, how in PLUGINS.items():
        getattr(mi, how)(plugin, stand_in(plugin))


def install() -> None:
    """Register for the active variant, if any, and from now on for each one that is set. Sets no variant."""
    import mitsuba as mi

    mi.detail.add_variant_callback(lambda _old, new: register(new))
    if (active := mi.variant()) is not None:
        register(active)
