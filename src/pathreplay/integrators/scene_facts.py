"""Facts about a scene. The scene's objects are collected once. Each pass determines which objects have gradients."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.integrators.lifetimes import SCENES, is_recording
from pathreplay.platform import compat
from pathreplay.transport.facts.absent_lobes import AbsentLobes, ranges_of
from pathreplay.transport.facts.dark_texels import DarkTexels
from pathreplay.transport.facts.facets import Facets
from pathreplay.transport.facts.lobe_choice import LobeChoice
from pathreplay.transport.facts.nodes import is_mesh, nodes_of, plain_numbers, with_gradients
from pathreplay.transport.facts.seams import has_seams, has_steps
from pathreplay.transport.facts.traits import (
    BLEND,
    INSTANCE,
    MASK,
    PLASTIC,
    Tables,
    Traits,
    blend_lengths,
    emitter_bounds,
    fixed_traits,
    is_veil,
    scene_bounds,
    smoothing_groups_of,
    tables_of,
)
from pathreplay.transport.volume.media import Media, scene_media, wants_branch


class SceneFacts:
    """Facts about one scene.

    This object keeps references to the objects of the scene. New objects therefore cannot get the addresses of these
    objects.
    """

    def __init__(self, scene: mi.Scene) -> None:
        nodes = nodes_of(scene)
        self._replaceable = _replaceable(scene)
        self._traits = fixed_traits(nodes, scene)
        self._tables: Tables | None = None
        self._shapes = [node for node in nodes if isinstance(node, mi.Shape)]
        for shape in self._shapes:
            if is_mesh(shape) and shape.face_count() == 0:
                raise PathreplayError(f"pathreplay: mesh '{shape.id()}' has no faces, and cannot be traced: remove it")
        self._boxes = [shape.bbox() for shape in self._shapes]
        self._facets = Facets(self._shapes)
        self._faces = _faces(self._shapes)
        self._placed = scene.shapes()
        self._lights = scene.emitters()
        self._infinite = [light for light in self._lights if mi.has_flag(light.flags(), mi.EmitterFlags.Infinite)]
        self._box: mi.ScalarBoundingBox3f | None = None  # bounding box of the scene that infinite emitters know
        self._emitters = [*scene.emitters(), *(shape for shape in self._shapes if shape.is_emitter())]
        self._mesh_emitters = [shape for shape in self._shapes if shape.is_mesh() and shape.is_emitter()]
        self._instances = [shape for shape in self._shapes if shape.class_name() == INSTANCE]
        self._masks = [node for node in nodes if isinstance(node, mi.BSDF) and node.class_name() in (MASK, BLEND)]
        self._plastics = [node for node in nodes if isinstance(node, mi.BSDF) and node.class_name() == PLASTIC]
        self._splines = [s for s in self._shapes if s.shape_type() == mi.ShapeType.BSplineCurve]
        self._textures = [node for node in nodes if isinstance(node, mi.Texture)]
        self._volumes = [node for node in nodes if isinstance(node, mi.Volume)]
        self._seams: bool | None = None
        self._steps: bool | None = None
        self._media = [node for node in nodes if isinstance(node, mi.Medium)]
        self._bounded = any(shape.is_medium_transition() for shape in self._shapes)
        self._bsdfs = [node for node in nodes if isinstance(node, mi.BSDF)]
        self._absent_lobes, self._dark_texels = AbsentLobes(self._bsdfs), DarkTexels(self._lights)
        self._lobe_choice = LobeChoice(self._bsdfs)
        self._with_constants = [
            node for node in nodes if isinstance(node, _kinds_with_constants()) and plain_numbers(node)
        ]

    def are_about(self, scene: mi.Scene) -> bool:
        """Return whether the facts describe this scene with its current sensors, emitters, shapes and BSDFs."""
        parts = _replaceable(scene)
        return len(parts) == len(self._replaceable) and all(
            a is b for a, b in zip(parts, self._replaceable, strict=True)
        )

    @property
    def has_media(self) -> bool:
        return bool(self._media)

    @property
    def has_seams(self) -> bool:
        """Whether a texture has discontinuities. True in a recording, unless an earlier pass found no discontinuity."""
        if self._seams is None and not is_recording():
            self._seams = has_seams(self._textures)
        return self._seams is not False

    @property
    def has_steps(self) -> bool:
        """Whether a volume has discontinuities. True in a recording, unless an earlier pass found no discontinuity."""
        if self._steps is None and not is_recording():
            self._steps = has_steps(self._volumes)
        return self._steps is not False

    @cached_property
    def has_wrapping_textures(self) -> bool:
        """Whether a sphere or another shape without triangles has a texture, which may jump where it wraps."""
        return any(_is_painted(shape) for shape in self._shapes if not shape.is_mesh())

    def absent_lobes(self) -> tuple[str, ...]:
        """Return the parameters that lack the derivative of a lobe (see `AbsentLobes`). Empty in a recording."""
        return () if is_recording() else self._absent_lobes.find()

    def lobe_choice(self) -> tuple[str, ...]:
        """Return the BSDFs that ignore the choice of a lobe (see `LobeChoice`). Empty in a recording."""
        return () if is_recording() else self._lobe_choice.find()

    def dark_texels(self) -> tuple[str, ...]:
        """Return the emitters at whose black texels no light path starts (see `DarkTexels`). Empty in a recording."""
        return () if is_recording() else self._dark_texels.find()

    def ranges(self) -> dict[mi.Object, tuple[float, float]]:
        """Return bounds that keep parameters of BSDFs away from values at which a lobe is absent (see `ranges_of`)."""
        return ranges_of(self._bsdfs)

    def media(self, sensor: mi.Sensor | None, branches: bool | None = None) -> Media | None:
        """Return the current media of the scene. ``sensor`` may be inside a medium."""
        return scene_media(self._media, self._traits.veils, sensor, branches, self._bounded)

    def constants(self) -> tuple[object, ...]:
        """Return the current values that kernels treat as constants.

        These are the parameters that Mitsuba stores as plain numbers, such as the ``eta`` of `dielectric`, the lobes of
        BSDFs, whether meshes are coarse, and the values of `GridMedium.constants`.
        """
        self._facets.update()
        of_media = tuple(medium.constants for medium in self._media if hasattr(medium, "constants"))
        return (
            self._facets.coarse,
            self._facets.brushed,
            *of_media,
            *map(plain_numbers, self._with_constants),
            *(bsdf.flags() for bsdf in self._bsdfs),
        )

    def branches(self) -> bool:
        """Return the current value of `Media.branches`."""
        return wants_branch(self._media)

    def traits(self, tables: Tables | None = None) -> Traits:
        """Return the current traits: facts about the scene on which the drivers depend.

        The traits contain ``tables`` or, by default, the current lookup tables.
        """
        if not is_recording():
            self._facets.update()
        return replace(
            self._traits,
            tables=self.tables() if tables is None else tables,
            coarse_meshes=self._facets.coarse,
            brushed_meshes=tuple(self._facets.meshes[i] for i in self._facets.brushed),
            lights_deform=any(with_gradients(mesh, *compat.POSITIONS) for mesh in self._mesh_emitters),
            instances_move=any(with_gradients(instance, "to_world") for instance in self._instances),
            opacity_moves=any(with_gradients(mask, "opacity", "weight") for mask in self._masks if is_veil(mask)),
            tables_move=any(with_gradients(plastic, "alpha", "eta") for plastic in self._plastics),
            splines_move=any(with_gradients(curve, "control_points") for curve in self._splines),
            skies_move=self._traits.sunsky is not None and bool(with_gradients(self._traits.sunsky)),
            lights_vary=any(map(with_gradients, self._emitters)),
        )

    def tables(self) -> Tables:
        """Return the current lookup tables of BSDFs, shapes and emitters. Only changed tables are rebuilt."""
        boxes, faces = [shape.bbox() for shape in self._shapes], _faces(self._shapes)
        if self._tables is None:
            self._tables = tables_of(self._traits.attachables, self._shapes, self._lights, self._bounding_box())
        elif boxes != self._boxes:
            lengths, sphere = blend_lengths(self._shapes), scene_bounds(self._bounding_box())
            self._tables = replace(self._tables, blend_lengths=lengths, scene_bounds=sphere)
        if self._traits.broken_lights:  # vertices may move without a change of the bounding box
            spheres = emitter_bounds(self._lights, self._shapes)
            if not np.array_equal(np.array(spheres), np.array(self._tables.emitter_bounds)):
                self._tables = replace(self._tables, emitter_bounds=spheres)
        if [array.index for array in faces] != [array.index for array in self._faces]:
            begins, groups = smoothing_groups_of(self._shapes)
            self._tables = replace(self._tables, groups_at=begins, groups=groups)
        self._boxes, self._faces = boxes, faces
        return self._tables

    def recorded_tables(self, known: Tables | None, edges: bool) -> Tables:
        """Return the lookup tables for a pass that `dr.freeze` records.

        Returns the ``known`` tables if they belong to this scene. Otherwise the recording computes new tables. The
        new tables include smoothing groups only if ``edges`` is set, that is, if the pass searches for edges.
        """
        if known is not None and known is self._tables:
            return known
        return tables_of(self._traits.attachables, self._shapes, self._lights, self._bounding_box(), edges)

    def enclose(self, scene: mi.Scene) -> None:
        """Update the bounding sphere of the scene that infinite emitters know.

        Shadow rays to such emitters end on this sphere, and light paths start on it. Mitsuba 3.9 sets it when the scene
        is loaded, but not when shapes move.
        """
        box = scene.bbox()
        if self._infinite and box != self._box:
            for light in self._infinite:
                light.set_scene(scene)
            self._box = box

    def _bounding_box(self) -> mi.ScalarBoundingBox3f:
        box = mi.ScalarBoundingBox3f()
        for shape in self._placed:
            box.expand(shape.bbox())
        return box


def _is_painted(shape: mi.Shape) -> bool:
    return any(isinstance(node, mi.Texture) and node.is_spatially_varying() for node in nodes_of(shape))


def _kinds_with_constants() -> tuple[type, ...]:
    """Return the types of objects whose plain numbers are constants of kernels."""
    return mi.BSDF, mi.Texture, mi.Volume, mi.Medium, mi.PhaseFunction, mi.Emitter


def _faces(shapes: list[mi.Shape]) -> list[mi.UInt32]:
    """Return the faces of all meshes. New faces are another array, with another index as long as this one is kept."""
    return [faces for shape in shapes if is_mesh(shape) and (faces := compat.faces_array(shape)) is not None]


def _replaceable(scene: mi.Scene) -> list[mi.Object]:
    """Return the sensors, emitters, shapes and BSDFs, which identify a scene and can be replaced in it."""
    shapes = scene.shapes()
    return [*scene.sensors(), *scene.emitters(), *shapes, *(shape.bsdf() for shape in shapes)]


def facts_of(scene: mi.Scene) -> SceneFacts:
    """Return the facts about a scene. They are collected once, and again if objects of the scene were replaced."""
    return SCENES.about(scene, lambda facts: facts.are_about(scene), lambda: SceneFacts(scene))
