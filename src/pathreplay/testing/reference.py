"""The two integrators of a check: the integrator under test, and the integrator used as its reference.

The reference must estimate the same image as the integrator under test. Both therefore need the same path length, and
must treat directly visible emitters alike. These settings are read from the integrator under test.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.integrators.path_limits import (
    copied_limits,
    counterpart,
    nested_in,
    notes_on_visibility,
    read_limits,
    without_channels,
)
from pathreplay.integrators.stateful import PARTICLES, light_path_plugin, stateful
from pathreplay.scenes.descriptions import load_integrator
from pathreplay.testing.objective import integrator_name

Spec: TypeAlias = "mi.Integrator | Mapping[str, object] | str | None"
"""An integrator: an object, a dictionary, a plugin name, or None for the default."""

NO_ROULETTE = 2**30
"""A ``rr_depth`` that no path reaches."""

LONGEST_WITHOUT_ROULETTE = 64
"""Largest ``max_depth`` at which the reference disables Russian roulette. Without roulette, paths in a closed room end
only at ``max_depth``."""

_OURS = ("pathreplay", PARTICLES)
"""Our plugins, which have the properties ``boundary`` and ``boundary_spp``."""

_ONLY_LIMITS = {"PRBIntegrator": "prb", "BasicPRBIntegrator": "prb_basic", "PRBVolpathIntegrator": "prbvolpath"}
"""Plugins by class, for the differentiable integrators of Mitsuba that have no other properties than `Limits`."""


def integrator_under_test(
    spec: Spec, scene: mi.Scene, max_depth: int | None = None, boundary: Mapping[str, object] | None = None
) -> mi.Integrator:
    """Return the integrator that ``spec`` describes: an object (used unchanged), a dictionary, a plugin name, or None.

    None selects the scene's own integrator if it is differentiable, else ``pathreplay``. A plugin given by name, or
    selected by None, gets the path limits of the scene's own integrator. If these are unbounded, as is the default of
    ``path``, our plugins keep their own default, as in a job. ``max_depth`` replaces the path length of the
    integrator. ``boundary`` contains additional properties (``boundary``, ``boundary_spp``). With ``boundary``, None
    selects the scene's own integrator if it has these properties, else ``pathreplay``. If the scene's own integrator is
    selected, it keeps its other properties. If the scene's own integrator adds channels to the image (``aov``), the
    integrator inside of it takes its place, and a warning says that the channels are not checked.

    Raises PathreplayError if Mitsuba cannot create the integrator, if ``max_depth`` is invalid or given with an object,
    if the other properties of the scene's own integrator cannot be read to replace its ``max_depth``, or if boundary
    terms are requested from an integrator without these properties.
    """
    if max_depth is not None and (type(max_depth) is not int or (max_depth < 1 and max_depth != -1)):
        raise PathreplayError(f"max_depth is {max_depth!r}; give a path length of at least 1, or -1 for no bound")
    whole = scene.integrator()
    own = None if whole is None else without_channels(whole)
    unchanged = max_depth is None and not boundary and isinstance(own, mi.CppADIntegrator)
    if spec is None and whole is not None and whole.aov_names() and nested_in(whole):
        tested = f": '{integrator_name(own)}' inside of it is" if unchanged else ""
        mi.Log(
            mi.LogLevel.Warn,
            f"pathreplay: the scene's integrator '{integrator_name(whole)}' adds channels to the image, which are not "
            f"checked{tested}",
        )
    if spec is None and unchanged:
        return own
    if isinstance(spec, mi.Integrator):
        if max_depth is not None or boundary:
            what = "max_depth" if max_depth is not None else "boundary"
            raise PathreplayError(f"{what} cannot be given along with an integrator object; set it in the integrator")
        return spec
    if isinstance(spec, Mapping):
        description = dict(spec)
    else:
        for note in () if own is None else notes_on_visibility(own, scene):
            mi.Log(mi.LogLevel.Warn, f"pathreplay: {note}")
        limits = None if own is None else read_limits(own)
        name = spec or _own_name(own, bool(boundary))
        options = {} if own is None or name not in _OURS else stateful(own).options()
        description = {"type": name}
        if own is not None and limits is not None:
            description |= copied_limits(own) if name in _OURS else vars(limits)
        if name == PARTICLES:
            options.pop("caustics", None)
        kept = ("boundary", "boundary_spp", "caustics") if spec else tuple(options)
        description |= {option: options[option] for option in kept if option in options}
    if max_depth is not None:
        description["max_depth"] = max_depth
    if boundary and description.get("type") not in _OURS:
        raise PathreplayError(
            f"'{min(boundary)}' is a property of 'pathreplay', and the integrator is '{description.get('type')}'; test "
            "'pathreplay', or leave it out"
        )
    return load_integrator(description | dict(boundary or {}))


def _own_name(own: mi.Integrator | None, has_boundary: bool) -> str:
    """Return the plugin that continues the scene's own integrator with other properties.

    With ``has_boundary``, properties of boundary terms are among them; otherwise only ``max_depth``. Raises
    PathreplayError if the integrator is differentiable, and may have properties that cannot be read.
    """
    name = type(own).__name__
    if own is not None and stateful(own).options():
        return PARTICLES if light_path_plugin(own) == PARTICLES else "pathreplay"
    if has_boundary or not isinstance(own, mi.CppADIntegrator):
        return "pathreplay"
    if name not in _ONLY_LIMITS:
        raise PathreplayError(
            f"max_depth cannot be given for the scene's own {name}, whose other properties would be lost; set it in "
            "the scene, or name the integrator"
        )
    return _ONLY_LIMITS[name]


def reference_integrator(spec: Spec, scene: mi.Scene, tested: mi.Integrator) -> mi.Integrator:
    """Return the integrator whose images are differenced: ``spec`` if given, else the `counterpart` of ``tested``.

    Russian roulette is disabled if ``max_depth`` is bounded by `LONGEST_WITHOUT_ROULETTE`. The expected image does
    not change. With roulette, a path could end at +h and continue at -h. Roulette also cannot handle negative
    throughputs, which occur if -h makes a reflectance negative.

    Raises PathreplayError if the path length of the tested integrator cannot be read, if ``spec`` cannot be created, or
    if the images of the two integrators have different numbers of channels.
    """
    reference = spec if isinstance(spec, mi.Integrator) else load_integrator(_described(spec, scene, tested))
    more, fewer = sorted((tested, reference), key=lambda integrator: -len(integrator.aov_names()))
    if len(more.aov_names()) != len(fewer.aov_names()):
        raise PathreplayError(
            f"Integrator '{integrator_name(more)}' adds channels to the image, which '{integrator_name(fewer)}' lacks: "
            "pass the integrator inside of it, or a reference with as many channels"
        )
    return reference


def _described(spec: Mapping[str, object] | str | None, scene: mi.Scene, tested: mi.Integrator) -> dict[str, object]:
    """Return the description of the reference: see `reference_integrator`."""
    if isinstance(spec, Mapping):
        return dict(spec)
    limits = read_limits(tested)
    if limits is None:
        raise PathreplayError(
            f"Integrator {type(tested).__name__} does not expose its max_depth; pass a reference integrator that "
            "computes the same image, for example reference={'type': 'path', 'max_depth': 6}"
        )
    plain = counterpart(tested, scene) if spec is None else {"type": spec, **vars(limits)}
    assert plain is not None  # only an integrator without limits has no counterpart
    if 0 <= limits.max_depth <= LONGEST_WITHOUT_ROULETTE:
        plain["rr_depth"] = NO_ROULETTE
    return plain
