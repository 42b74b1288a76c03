"""Facts about a scene: its objects are collected once, and which of them have gradients is determined in every pass."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np

from pathreplay.integrators.lifetimes import SCENES, is_recording
from pathreplay.transport.facts.nodes import nodes_of, with_gradients
from pathreplay.transport.facts.seams import has_seams
from pathreplay.transport.facts.traits import (
    INSTANCE,
    MASK,
    Tables,
    Traits,
    blend_lengths,
    emitter_bounds,
    fixed_traits,
    smoothing_groups_of,
    tables_of,
)
from pathreplay.transport.volume.media import Media, scene_media, wants_branch


class SceneFacts:
    """Facts about one scene. They keep its objects alive, so no other object can reuse their addresses (`facts_of`)."""

    def __init__(self, scene: mi.Scene) -> None:
        nodes = nodes_of(scene)
        self._parts = _parts(scene)
        self._traits = fixed_traits(nodes, scene)
        self._tables: Tables | None = None
        self._shapes = [node for node in nodes if isinstance(node, mi.Shape)]
        self._boxes = [shape.bbox() for shape in self._shapes]
        self._sizes = _sizes(self._shapes)
        self._lights = scene.emitters()
        self._emitters = [*scene.emitters(), *(shape for shape in self._shapes if shape.is_emitter())]
        self._lamps = [shape for shape in self._shapes if shape.is_mesh() and shape.is_emitter()]
        self._instances = [shape for shape in self._shapes if shape.class_name() == INSTANCE]
        self._masks = [node for node in nodes if isinstance(node, mi.BSDF) and node.class_name() == MASK]
        self._textures = [node for node in nodes if isinstance(node, mi.Texture)]
        self._seams: bool | None = None
        self._media = [node for node in nodes if isinstance(node, mi.Medium)]

    def are_about(self, scene: mi.Scene) -> bool:
        """Whether they describe this scene with its current BSDFs."""
        parts = _parts(scene)
        return len(parts) == len(self._parts) and all(a is b for a, b in zip(parts, self._parts, strict=True))

    @property
    def has_media(self) -> bool:
        return bool(self._media)

    @property
    def has_seams(self) -> bool:
        """Whether a texture has discontinuities. Assumed in a recording unless it is known."""
        if self._seams is None and not is_recording():
            self._seams = has_seams(self._textures)
        return self._seams is not False

    def media(self, sensor: mi.Sensor | None, branches: bool | None = None) -> Media | None:
        """Media as they are now; ``sensor`` (or None) may be inside one."""
        return scene_media(self._media, self._traits.veils, sensor, branches)

    def constants(self) -> tuple[object, ...]:
        """All of media that kernels take for constants, now: see `GridMedium`. Those of Mitsuba have none."""
        return tuple(medium.constants for medium in self._media if hasattr(medium, "constants"))

    def branches(self) -> bool:
        """`Media.branches` of the scene as it is now."""
        return wants_branch(self._media)

    def traits(self, tables: Tables | None = None) -> Traits:
        """Traits as they are now, with these ``tables`` (default: `tables`)."""
        return replace(
            self._traits,
            tables=self.tables() if tables is None else tables,
            lights_deform=any(with_gradients(lamp, "vertex_positions") for lamp in self._lamps),
            instances_move=any(with_gradients(instance, "to_world") for instance in self._instances),
            opacity_moves=any(with_gradients(mask, "opacity") for mask in self._masks),
            lights_vary=any(map(with_gradients, self._emitters)),
        )

    def tables(self) -> Tables:
        """Tables of the scene as it is now; only changed parts are rebuilt."""
        boxes, sizes = [shape.bbox() for shape in self._shapes], _sizes(self._shapes)
        if self._tables is None:
            self._tables = tables_of(self._traits.attachables, self._shapes, self._lights)
        elif boxes != self._boxes:
            self._tables = replace(self._tables, blend_lengths=blend_lengths(self._shapes))
        if self._traits.mesh_lights:  # whose vertices may move within a box
            balls = emitter_bounds(self._lights, self._shapes)
            if not np.array_equal(np.array(balls), np.array(self._tables.emitter_bounds)):
                self._tables = replace(self._tables, emitter_bounds=balls)
        if sizes != self._sizes:
            begins, groups = smoothing_groups_of(self._shapes)
            self._tables = replace(self._tables, groups_at=begins, groups=groups)
        self._boxes, self._sizes = boxes, sizes
        return self._tables

    def recorded_tables(self, known: Tables | None, edges: bool) -> Tables:
        """The tables of a pass that `dr.freeze` records.

        The ``known`` tables are taken as they are if they belong to this scene. Otherwise the recording writes the
        tables of the scene as it is now, and smoothing groups only if it looks for ``edges``.
        """
        if known is not None and known is self._tables:
            return known
        return tables_of(self._traits.attachables, self._shapes, self._lights, edges)


def _sizes(shapes: list[mi.Shape]) -> list[tuple[int, int]]:
    return [(shape.vertex_count(), shape.face_count()) for shape in shapes if shape.is_mesh()]


def _parts(scene: mi.Scene) -> list[mi.Object]:
    """Objects that identify a scene, and all objects that can be replaced in it."""
    shapes = scene.shapes()
    return [*scene.sensors(), *scene.emitters(), *shapes, *(shape.bsdf() for shape in shapes)]


def facts_of(scene: mi.Scene) -> SceneFacts:
    """Return the facts about a scene, collected once, and again if the scene has changed."""
    return SCENES.about(scene, lambda facts: facts.are_about(scene), lambda: SceneFacts(scene))
