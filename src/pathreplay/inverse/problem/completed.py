"""What a job leaves out is taken from elsewhere: its integrator from the scene, that of the targets from the job's."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from pathreplay.integrators.path_limits import Limits, read_limits
from pathreplay.integrators.scene_facts import facts_of
from pathreplay.inverse.config.schema import Config
from pathreplay.inverse.config.tables import Plugin
from pathreplay.scenes.descriptions import load_integrator

SHOWN = {"max_depth": "how long paths are", "hide_emitters": "whether emitters are seen"}
"""Limits that change the expected picture, and what each decides."""


def completed(config: Config, scene: mi.Scene) -> tuple[Config, tuple[str, ...]]:
    """The job with all of its integrators, and one line where targets show something else than the job renders.

    Where the job has no `integrator`, it is `pathreplay` with the options of the scene's own. Targets that are rendered
    and have no integrator are rendered by `path`, or `volpath` where the scene has media, with the limits of the job's.
    Raises PathreplayError for integrators that cannot be made.
    """
    if "integrator" not in config.model_fields_set and (options := _options(scene.integrator())):
        config = config.model_copy(update={"integrator": Plugin(type="pathreplay", **options)})
    if config.brings_pictures:
        return config, ()
    limits = read_limits(load_integrator(config.integrator.model_dump()))
    asked = config.target.integrator
    if asked is not None:
        return config, _differences(limits, read_limits(load_integrator(asked.model_dump())), config)
    name = "volpath" if facts_of(scene).has_media else "path"
    plugin = Plugin(type=name, **({"max_depth": 6} if limits is None else vars(limits)))
    return config.model_copy(update={"target": config.target.model_copy(update={"integrator": plugin})}), ()


def _options(own: Any) -> dict[str, Any]:
    """The options of `pathreplay` that a scene's integrator implies; empty without one, or if it has no limits."""
    limits = None if own is None else read_limits(own)
    if limits is None:
        return {}
    if hasattr(own, "options"):
        return vars(limits) | own.options()
    # Mitsuba's integrators are unbounded unless they are told, and unbounded paths would be walked twice.
    return {name: value for name, value in vars(limits).items() if name != "max_depth" or value >= 0}


def _differences(ours: Limits | None, theirs: Limits | None, config: Config) -> tuple[str, ...]:
    if ours is None or theirs is None:
        return ()
    others = [name for name in SHOWN if getattr(ours, name) != getattr(theirs, name)]
    if not others:
        return ()
    target = config.target.integrator
    assert target is not None
    said = ", ".join(f"{name} = {getattr(theirs, name)} for {getattr(ours, name)}" for name in others)
    why = " and ".join(SHOWN[name] for name in others)
    return (
        f"targets are rendered by '{target.type}' with {said} of the job's '{config.integrator.type}', which decides "
        f"{why}: what is recovered makes up for that; leave [target] integrator out, or set both alike",
    )
