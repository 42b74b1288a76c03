"""Registers our plugins for the active variant of Mitsuba and for every variant set later.

Mitsuba knows a Python plugin only in the variant in which the plugin was registered, and calls a variant callback only
for variants set after the callback was added. In variants without derivatives, such as scalar ones, each plugin is
replaced by a function that raises an error and names a variant to use. In polarised variants, the plugins are
registered, and report that polarisation is not supported.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from functools import partial
from typing import Any, NoReturn

from pathreplay.errors import PathreplayError
from pathreplay.platform.device import backend_of

#: Plugin name -> its Mitsuba plugin type, and the module and class of its template (see `on_base`).
PLUGINS = {
    "pathreplay": ("integrator", "pathreplay.integrators.integrator", "PathReplayIntegrator"),
    "pathreplay_particles": ("integrator", "pathreplay.integrators.particles.integrator", "ParticleIntegrator"),
    "dielectric_ad": ("bsdf", "pathreplay.plugins.dielectric_ad", "DielectricAD"),
    "gridmedium": ("medium", "pathreplay.plugins.gridmedium", "GridMedium"),
}
#: Integrators for comparison, which `pathreplay.baselines` registers on request.
BASELINES = {
    "naive_ad": ("integrator", "pathreplay.integrators.baselines.plugins", "NaiveIntegrator"),
    "radiative_backprop": ("integrator", "pathreplay.integrators.baselines.plugins", "RadiativeIntegrator"),
    "prb_volume_listing": ("integrator", "pathreplay.integrators.baselines.plugins", "ListingIntegrator"),
}
Plugins = Mapping[str, tuple[str, str, str]]


def register(variant: str, plugins: Plugins = PLUGINS) -> None:
    """Register ``plugins`` for the active ``variant``.

    If the variant has no derivatives, functions that raise an error are registered instead.
    """
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
    """Return Mitsuba's class ADIntegrator for the active variant. Its method `prepare` seeds the sampler of a pass."""
    # Mitsuba executes the module `common` again for every variant. An import from the public `mitsuba.ad` would create
    # a copy of `common` that stays bound to the first variant.
    from mitsuba.python.ad.integrators.common import ADIntegrator

    return ADIntegrator


def on_base(template: type, base: type) -> type:
    """Build a class that has the attributes of a template and inherits from a base class of Mitsuba.

    Each variant of Mitsuba has its own base classes. A template is defined before a variant is set, and therefore
    cannot inherit from a base class. The methods of a template call the methods of the base class by the name of the
    base class, for example ``mi.BSDF.__init__(self, props)``.
    """
    parts = [vars(part) for part in reversed(template.__mro__[:-1])]
    body = {name: value for part in parts for name, value in part.items() if name not in ("__dict__", "__weakref__")}
    return type(base)(template.__name__, (base,), body)


def _register_stand_ins(variant: str, plugins: Plugins) -> None:
    import mitsuba as mi

    from pathreplay.platform.backend import is_usable_variant

    usable = [name for name in mi.variants() if is_usable_variant(name)]
    colours = variant.removesuffix("_polarized").rsplit("_", 1)[-1]
    alike = [name for name in usable if name.endswith(colours)] or usable

    def refuse(plugin: str, props: mi.Properties) -> NoReturn:
        raise PathreplayError(f"{plugin}: variant {variant!r} has no derivatives: use {' or '.join(alike)}")

    for plugin, (kind, *_) in plugins.items():
        getattr(mi, f"register_{kind}")(plugin, partial(refuse, plugin))


def install(plugins: Plugins = PLUGINS) -> None:
    """Register ``plugins`` for the active variant, if any, and for each variant set later. Set no variant."""
    import mitsuba as mi

    mi.detail.add_variant_callback(lambda _old, new: register(new, plugins))
    if (active := mi.variant()) is not None:
        register(active, plugins)
