"""Derive the default integrator of a job from its scene, and the default integrator of targets from job and target."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi

from pathreplay.integrators.path_limits import (
    Limits,
    copied_limits,
    counterpart,
    notes_on_visibility,
    read_limits,
    without_channels,
)
from pathreplay.integrators.stateful import stateful
from pathreplay.inverse.config.schema import Config
from pathreplay.inverse.config.tables import Plugin
from pathreplay.scenes.descriptions import load_integrator
from pathreplay.types import Json

SHOWN = {"max_depth": "the length of paths", "hide_emitters": "whether emitters are visible"}
"""Options that change the expected image, with descriptions for messages."""


def completed(config: Config, scene: mi.Scene, own: mi.Integrator | None = None) -> tuple[Config, tuple[str, ...]]:
    """Fill in the integrator of a job that leaves it out, and compare it with the integrator of the targets.

    The default integrator of a job is `pathreplay` with the options of the scene's integrator. The default integrator
    of rendered targets depends on the target scene: see `with_default_target`.

    Args:
        config: the job.
        scene: scene of the job.
        own: integrator object that takes the place of the job's integrator.

    Returns:
        The completed job, and notes: the scene does not tell whether emitters are visible, or the integrators of job
        and targets have different limits.

    Raises:
        PathreplayError: an integrator cannot be created.
    """
    notes: tuple[str, ...] = ()
    shown = scene.integrator()
    if shown is not None and "integrator" not in config.model_fields_set and (options := _options(shown)):
        config = config.model_copy(update={"integrator": Plugin(type="pathreplay", **options)})
        if own is None:
            notes = notes_on_visibility(shown, scene)
    asked = config.target.integrator
    if config.brings_pictures or asked is None:
        return config, notes
    ours = load_integrator(config.integrator.model_dump()) if own is None else own
    return config, notes + _differences(read_limits(ours), _limits(asked), config)


def with_default_target(config: Config, ours: mi.Integrator, scene: mi.Scene) -> Config:
    """Let the `counterpart` of the job's integrator render the targets from ``scene``, unless the job names another."""
    if config.target.integrator is not None:
        return config
    plugin = Plugin(**(counterpart(ours, scene) or {"type": "path", "max_depth": 6}))
    return config.model_copy(update={"target": config.target.model_copy(update={"integrator": plugin})})


def _limits(plugin: Plugin) -> Limits | None:
    """Return the limits of a plugin. Mitsuba's `ptracer` does not expose its ``hide_emitters``."""
    description = plugin.model_dump()
    limits = read_limits(load_integrator(description))
    if limits is None:
        return None
    return replace(limits, hide_emitters=bool(description.get("hide_emitters", limits.hide_emitters)))


def _options(own: mi.Integrator) -> Json:
    """Return options of `pathreplay` that match the scene's integrator, or none if its path limits are unknown."""
    limits = copied_limits(own)
    return limits | stateful(without_channels(own)).options() if limits else {}


def _differences(ours: Limits | None, theirs: Limits | None, config: Config) -> tuple[str, ...]:
    if ours is None or theirs is None:
        return ()
    others = [name for name in SHOWN if getattr(ours, name) != getattr(theirs, name)]
    if not others:
        return ()
    target = config.target.integrator
    assert target is not None
    said, own = (", ".join(f"{name} = {getattr(limits, name)}" for name in others) for limits in (theirs, ours))
    why = " and ".join(SHOWN[name] for name in others)
    return (
        f"targets are rendered by '{target.type}' with {said}, but the job's '{config.integrator.type}' has {own}; the "
        f"images differ in {why}, which biases the recovered values: remove [target] integrator, or set both alike",
    )
