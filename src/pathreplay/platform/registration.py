"""Registers our plugins for the active variant of Mitsuba and for every later one.

A Python plugin is known to Mitsuba in the variant it was registered in, and a variant callback is called only for
variants set after it was added. Where nothing can be differentiated, as in scalar variants, stand-ins say so and name
the variant to use. Polarised variants get the plugins themselves, which say that they are not supported.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from functools import partial
from typing import Any

from pathreplay.errors import PathreplayError
from pathreplay.platform.device import backend_of

#: Each by name: what it is to Mitsuba, and the template of its class (see `on_base`).
PLUGINS = {
    "pathreplay": ("integrator", "pathreplay.integrators.integrator", "PathReplayIntegrator"),
    "dielectric_ad": ("bsdf", "pathreplay.plugins.dielectric_ad", "DielectricAD"),
    "gridmedium": ("medium", "pathreplay.plugins.gridmedium", "GridMedium"),
}
#: Integrators to compare with, which `pathreplay.baselines` registers on request.
BASELINES = {
    "naive_ad": ("integrator", "pathreplay.integrators.baselines.plugins", "NaiveIntegrator"),
    "radiative_backprop": ("integrator", "pathreplay.integrators.baselines.plugins", "RadiativeIntegrator"),
    "prb_volume_listing": ("integrator", "pathreplay.integrators.baselines.plugins", "ListingIntegrator"),
}
Plugins = Mapping[str, tuple[str, str, str]]


def register(variant: str, plugins: Plugins = PLUGINS) -> None:
    """Register ``plugins`` for the active variant, named ``variant``; stand-ins where it has no derivatives."""
    import mitsuba as mi

    if "_ad_" not in variant:
        _register_stand_ins(variant, plugins)
        return
    if backend_of(variant) == "llvm":
        from pathreplay.platform.backend import warn_of_bad_llvm

        warn_of_bad_llvm()
    bases = {"integrator": mitsuba_integrator(), "bsdf": mi.BSDF, "medium": mi.Medium}
    for name, (kind, module, template) in plugins.items():
        plugin = on_base(getattr(importlib.import_module(module), template), bases[kind])
        getattr(mi, f"register_{kind}")(name, plugin)


def mitsuba_integrator() -> Any:
    """Mitsuba's ADIntegrator of the active variant: what it does to prepare a pass is what its users' seeds mean."""
    # The name under which Mitsuba runs its Python modules anew for every variant. Of `mitsuba.ad`, the public name, an
    # import statement makes a copy, which stays what it was in the first variant.
    from mitsuba.python.ad.integrators.common import ADIntegrator

    return ADIntegrator


def on_base(template: type, base: type) -> type:
    """The class that a template describes, on a base class of Mitsuba's.

    Each variant has a base class of its own. A template exists before any of them and cannot inherit from one; its
    methods call those of the base by their class.
    """
    parts = [vars(part) for part in reversed(template.__mro__[:-1])]
    body = {name: value for part in parts for name, value in part.items() if name not in ("__dict__", "__weakref__")}
    return type(base)(template.__name__, (base,), body)  # type: ignore[no-any-return]


def _register_stand_ins(variant: str, plugins: Plugins) -> None:
    import mitsuba as mi

    from pathreplay.platform.backend import is_usable_variant

    usable = [name for name in mi.variants() if is_usable_variant(name)]
    colours = variant.removesuffix("_polarized").rsplit("_", 1)[-1]
    alike = [name for name in usable if name.endswith(colours)] or usable

    def refuse(plugin: str, props: Any) -> Any:
        raise PathreplayError(f"{plugin}: variant {variant!r} has no derivatives: use {' or '.join(alike)}")

    for plugin, (kind, *_) in plugins.items():
        getattr(mi, f"register_{kind}")(plugin, partial(refuse, plugin))


def install(plugins: Plugins = PLUGINS) -> None:
    """Register ``plugins`` for the active variant, if any, and for each one set later. Sets no variant."""
    import mitsuba as mi

    mi.detail.add_variant_callback(lambda _old, new: register(new, plugins))
    if (active := mi.variant()) is not None:
        register(active, plugins)
