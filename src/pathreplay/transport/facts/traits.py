"""Facts about a scene, computed on the host before a kernel is traced: lobes, emitters, outlines, gradients."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from pathreplay.errors import PathreplayError
from pathreplay.platform import compat
from pathreplay.platform.owned_arrays import owned
from pathreplay.transport.facts.nodes import is_mesh, nodes_of
from pathreplay.transport.facts.seams import CHECKERBOARD
from pathreplay.transport.facts.smoothing_groups import mesh_smoothing_groups
from pathreplay.transport.velocity import blend_length

# BSDFs are identified by class name, because Mitsuba does not expose the properties that matter here. ATTACHABLE BSDFs
# sample a direction that is a smooth function of the random numbers, and choose a lobe independently of all parameters.
ATTACHABLE = frozenset({"SmoothDiffuse", "RoughConductor", "RoughDielectric"})
MASK, BLEND, TWO_SIDED, PLASTIC = "MaskBSDF", "BlendBSDF", "TwoSidedBRDF", "RoughPlastic"
RELIEFS = frozenset({"NormalMap", "BumpMap"})
FRAMES = RELIEFS | {TWO_SIDED}
# BSDFs that have no narrow lobe of their own. BSDFs nested in them may have one.
DULL = FRAMES | {MASK, "SmoothDiffuse"}
# BSDFs whose sampled weights are differentiated correctly: see `scatter._delta_weight`.
EXACT = frozenset({"SmoothConductor", "SmoothDielectric", "DielectricAD"})
INSTANCE, PROJECTOR, SPOT, SUNSKY = "Instance", "Projector", "SpotLight", "SunskyEmitter"
DIRECTED_AREA = "DirectionalArea"
WHOLE, FACETS = 0, 0xFFFFFFFF
"""Entries of `Tables.groups_at`: WHOLE for shapes whose only edges are outlines, FACETS for flat-shaded meshes."""
MOST_RUNS = 4096
"""Largest number of runs of equal values in an array that `_array` creates while `dr.freeze` records."""

T = TypeVar("T")
V = TypeVar("V")
A = TypeVar("A", bound="dr.ArrayBase")


@dataclass
class Tables:
    """Facts about BSDFs and shapes by registry index, as arrays for lookup in kernels.

    A frozen function receives the tables as input or from the integrator. If both sources lack the tables, the tables
    are created while `dr.freeze` records (see `_array`).
    """

    attachable: mi.Bool | None  # for each BSDF, whether its smooth lobes may be sampled attached; None if all are False
    blend_lengths: mi.Float  # `velocity.blend_length` of each shape
    groups_at: mi.UInt32  # for each shape, the offset of its triangles in `groups`, or `WHOLE` or `FACETS`
    groups: mi.UInt32  # `smoothing_groups` of all meshes that have an offset, concatenated; entry 0 is unused
    emitter_bounds: mi.Float  # bounding sphere of each emitter: see `emitter_bounds`
    scene_bounds: mi.Float  # bounding sphere of the scene: centre and radius

    def scene_sphere(self) -> tuple[mi.Point3f, mi.Float]:
        """Return centre and radius of the bounding sphere of the scene."""
        sphere = dr.gather(mi.Vector4f, self.scene_bounds, mi.UInt32(0))
        return mi.Point3f(sphere.x, sphere.y, sphere.z), sphere.w


@dataclass(frozen=True)
class Traits:
    """Facts about the BSDFs, emitters and shapes of a scene, and about the gradients of their parameters."""

    mirrors: tuple[mi.BSDF, ...]  # BSDFs with delta lobes
    lobes: int  # one more than the largest component index of a delta lobe, without BSDFs made of `EXACT` ones
    attachables: tuple[mi.BSDF, ...]  # BSDFs whose smooth lobes may be sampled attached
    detached_names: tuple[str, ...]  # class names of BSDFs with smooth lobes that are never sampled attached
    area_lights: bool  # some emitter has an outline
    hard_lights: bool  # some emitter casts hard shadows
    projectors: tuple[mi.Emitter, ...]  # projectors: the illuminated region has a hard boundary
    spots: tuple[mi.Emitter, ...]  # spot lights: their cone has a hard boundary if beam_width >= cutoff_angle
    sunsky: mi.Emitter | None  # the environment, if it is a `sunsky`: it is black below its horizon
    directed_areas: bool  # some emitter is a `directionalarea`, which camera paths do not find
    broken_lights: bool  # the samples of some emitter are discontinuous: see `_bounding_sphere`
    sphere_lights: bool  # some sphere emits
    painted_meshes: bool  # some mesh emits with a textured radiance
    renumbered: bool  # some sampled component may differ from its number in ``component``: see `_delta_weight`
    copies: bool  # there are instances
    splines: bool  # there are B-spline curves
    veils: bool  # some surface may scatter part of the light and transmit the rest unscattered
    masks_mirrors: bool  # some mask covers delta lobes
    blended_veils: bool  # some blend transmits a part of the light unscattered
    blended_mirrors: bool  # some blend contains lobes of delta reflection or transmission
    narrow: bool  # some surface may have a narrow smooth lobe
    glossy: bool  # `narrow` is True, and there is no checkerboard, whose seams boundary terms do not cover
    outlines: bool  # a surface point may see an outline, a texture seam, or the sun or horizon of a `sunsky`
    tables: Tables = None  # type: ignore[assignment]  # for the current pass, like all fields below
    coarse_meshes: bool = False  # some smooth-shaded mesh is coarse: see `facets`
    brushed_meshes: tuple[mi.Shape, ...] = ()  # meshes whose triangles all count as edges: see `Facets.brushed`
    # The fields `lights_deform` to `lights_vary` tell whether the parameters in their comments have gradients.
    lights_deform: bool = False  # vertex positions of an emissive mesh
    instances_move: bool = False  # the to_world of an instance
    opacity_moves: bool = False  # the opacity of a mask
    tables_move: bool = False  # the alpha or eta of a `roughplastic`, from which Mitsuba computes tables
    splines_move: bool = False  # the control points of B-spline curves
    skies_move: bool = False  # a parameter of a `sunsky`
    lights_vary: bool = False  # any parameter of an emitter, or of an emissive shape
    moving: tuple[mi.Shape, ...] | None = None  # shapes that may move; None: all shapes and the camera
    turning: tuple[mi.Shape, ...] = ()  # static shapes with gradients in a BSDF, medium or emitter: rays may turn there

    @property
    def reflects_sun(self) -> bool:
        """Whether mirrors or glass may show the sun of a `sunsky`. The edge of the sun's disc is not sampled there."""
        sky = self.sunsky
        return sky is not None and mi.traverse(sky)["sun_scale"] > 0 and any(map(is_specular, self.mirrors))


def fixed_traits(nodes: set[mi.Object], scene: mi.Scene) -> Traits:
    """Inspect all BSDFs and shapes of a scene, including nested BSDFs and instanced shapes.

    `SceneFacts` adds the tables and the facts about gradients. In scenes with media, null boundaries do not count as
    mirrors, because paths pass straight through null boundaries.
    """
    media = any(isinstance(node, mi.Medium) for node in nodes)
    bsdfs = [node for node in nodes if isinstance(node, mi.BSDF) and not (media and is_null(node))]
    shapes = [node for node in nodes if isinstance(node, mi.Shape)]
    attachables = _attachables(nodes, shapes)
    others = [
        bsdf for bsdf in bsdfs if not _is_made_of(bsdf, ATTACHABLE) and mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    ]
    masked = [n for bsdf in bsdfs if bsdf.class_name() == MASK for n in nodes_of(bsdf) if isinstance(n, mi.BSDF)]
    blends = [bsdf for bsdf in bsdfs if bsdf.class_name() == BLEND]
    narrow = any(mi.has_flag(b.flags(), mi.BSDFFlags.Smooth) and b.class_name() not in DULL for b in bsdfs)
    sunsky = next((light for light in scene.emitters() if light.class_name() == SUNSKY), None)
    return Traits(
        mirrors=tuple(bsdf for bsdf in bsdfs if _delta_lobes(bsdf)),
        lobes=max((_delta_lobes(bsdf) for bsdf in bsdfs if not _is_made_of(bsdf, EXACT)), default=0),
        attachables=tuple(attachables),
        detached_names=tuple(sorted({bsdf.class_name() for bsdf in others})),
        area_lights=any(mi.has_flag(light.flags(), mi.EmitterFlags.Surface) for light in scene.emitters()),
        hard_lights=any(mi.has_flag(light.flags(), mi.EmitterFlags.Delta) for light in scene.emitters()),
        projectors=tuple(light for light in scene.emitters() if light.class_name() == PROJECTOR),
        spots=tuple(light for light in scene.emitters() if light.class_name() == SPOT),
        sunsky=sunsky,
        directed_areas=any(light.class_name() == DIRECTED_AREA for light in scene.emitters()),
        broken_lights=any(_bounding_sphere(shape)[3] > 0 for shape in shapes if shape.is_emitter()),
        sphere_lights=any(shape.is_emitter() and shape.shape_type() == mi.ShapeType.Sphere for shape in shapes),
        painted_meshes=any(is_painted(s.emitter()) for s in shapes if s.is_emitter() and is_mesh(s)),
        renumbered=any(bsdf.class_name() in (TWO_SIDED, BLEND) for bsdf in bsdfs),
        copies=any(shape.class_name() == INSTANCE for shape in shapes),
        splines=any(shape.shape_type() == mi.ShapeType.BSplineCurve for shape in shapes),
        veils=any(map(is_veil, bsdfs)),
        masks_mirrors=any(map(_delta_lobes, masked)),
        blended_veils=any(map(is_veil, blends)),
        blended_mirrors=any(map(is_specular, blends)),
        narrow=narrow,
        glossy=narrow and not any(node.class_name() == CHECKERBOARD for node in nodes),
        outlines=not _seamless(shapes, nodes) or sunsky is not None,
    )


def tables_of(
    attachables: Iterable[mi.BSDF],
    shapes: list[mi.Shape],
    emitters: list[mi.Emitter],
    box: mi.ScalarBoundingBox3f,
    edges: bool = True,
) -> Tables:
    """Create the tables of a scene in its present state. Without ``edges``, omit the smoothing groups (long arrays)."""
    attachable = _by_index(mi.BSDFPtr, attachables, lambda bsdf: True, False)
    return Tables(
        _array(mi.Bool, attachable) if attachables else None,
        blend_lengths(shapes),
        *(smoothing_groups_of(shapes) if edges else (mi.UInt32(WHOLE), mi.UInt32(0))),
        emitter_bounds(emitters, shapes),
        scene_bounds(box),
    )


def _array(kind: type[A], values: ArrayLike) -> A:
    """Create an array of these values, in memory that Dr.Jit has allocated (see `owned`).

    While `dr.freeze` records, arrays must not be created from host memory. Recorded scatter operations then fill the
    array, with one operation for each run of equal values.
    """
    if not dr.flag(dr.JitFlag.FreezingScope):
        array = owned(kind(values))
        dr.eval(array)
        return array
    values = np.asarray(values)
    begins = [0, *(np.flatnonzero(values[1:] != values[:-1]) + 1), len(values)]
    if len(begins) > MOST_RUNS:
        raise PathreplayError(
            f"pathreplay: dr.freeze records a pass over a scene that was not rendered before, and would have to write "
            f"{len(begins)} facts about it: call the function once outside of dr.freeze, with the same integrator"
        )
    array = dr.full(kind, values[0].item(), len(values))
    for begin, end in pairwise(begins[1:]):
        dr.scatter(array, kind(values[begin].item()), int(begin) + dr.arange(mi.UInt32, int(end - begin)))
    dr.eval(array)
    return array


def blend_lengths(shapes: list[mi.Shape]) -> mi.Float:
    """Return the `blend_length` of each shape, by registry index."""
    return _array(mi.Float, _by_index(mi.ShapePtr, shapes, blend_length, 0.0))


def smoothing_groups_of(shapes: list[mi.Shape]) -> tuple[mi.UInt32, mi.UInt32]:
    """Create the tables of smoothing groups: the offset of each shape, and the group of each triangle."""
    blocks: list[np.ndarray] = [np.zeros(1, np.uint32)]

    def begin(shape: mi.Shape) -> int:
        if not is_mesh(shape):
            return WHOLE
        if shape.has_face_normals() or not compat.has_normals(shape):
            return FACETS
        groups = mesh_smoothing_groups(shape)
        if not groups.any():
            return WHOLE
        blocks.append(groups)
        return sum(map(len, blocks[:-1]))

    begins = _by_index(mi.ShapePtr, shapes, begin, WHOLE)
    return _array(mi.UInt32, begins), _array(mi.UInt32, np.concatenate(blocks).astype(np.uint32))


def emitter_bounds(emitters: list[mi.Emitter], shapes: list[mi.Shape]) -> mi.Float:
    """Return the bounding sphere of each emitter of the scene: centre, and radius (see `_bounding_sphere`)."""
    shape_of = {shape.emitter(): shape for shape in shapes if shape.is_emitter()}
    spheres = [_bounding_sphere(shape_of[emitter]) if emitter in shape_of else np.zeros(4) for emitter in emitters]
    return _array(mi.Float, np.ravel(spheres or [np.zeros(4)]))  # an empty array would crash the process


def scene_bounds(box: mi.ScalarBoundingBox3f) -> mi.Float:
    """Return centre and radius of the smallest sphere around the bounding box of a scene; zeros for an empty scene."""
    if not box.valid():
        return _array(mi.Float, np.zeros(4))
    extents = np.array([float(x) for x in box.extents()])
    return _array(mi.Float, np.array([*(float(x) for x in box.center()), 0.5 * np.linalg.norm(extents)]))


def _bounding_sphere(shape: mi.Shape) -> np.ndarray:
    """Return centre and radius of the bounding sphere of an emissive shape.

    The radius is 0 for shapes whose emitter samples are continuous in the random numbers. The samples of meshes and of
    textured emitters are not continuous: they jump from triangle to triangle, and from texel to texel.
    """
    data = compat.mesh_arrays(mi.traverse(shape)) if is_mesh(shape) else None
    if data is not None:
        positions = data.positions.astype(np.float64)
        centre = (positions.min(axis=0) + positions.max(axis=0)) / 2
        return np.array([*centre, np.linalg.norm(positions - centre, axis=1).max()])
    if not is_painted(shape.emitter()):
        return np.zeros(4)
    box = shape.bbox()
    half = np.array([float(x) for x in box.extents()]) / 2
    radius = half.max() if shape.shape_type() == mi.ShapeType.Sphere else np.linalg.norm(half)
    return np.array([*(float(x) for x in box.center()), radius])


def _by_index(pointer: type, objects: Iterable[T], value: Callable[[T], V], otherwise: V) -> list[V]:
    """Return the list of the objects' values, ordered by Dr.Jit's registry index."""
    by_index = {dr.reinterpret_array(mi.UInt32, pointer(x))[0]: value(x) for x in objects}
    return [by_index.get(i, otherwise) for i in range(max(by_index, default=0) + 1)]


def is_null(bsdf: mi.BSDF | mi.BSDFPtr) -> bool | mi.Bool:
    """Return whether (or in which lanes) all light passes a BSDF unscattered."""
    others = mi.BSDFFlags.Smooth | mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.DeltaTransmission
    return bsdf.flags() & (others | mi.BSDFFlags.Null) == +mi.BSDFFlags.Null


def is_veil(bsdf: mi.BSDF) -> bool:
    """Return whether a BSDF transmits a part of the light unscattered, and not all of it."""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) and not is_null(bsdf)


def _attachables(nodes: set[mi.Object], shapes: list[mi.Shape]) -> list[mi.BSDF]:
    # Mitsuba adds a diffuse BSDF to an emissive shape without BSDF. Such a BSDF is not sampled attached.
    of_lamps = {shape.bsdf() for shape in shapes if shape.is_emitter()}
    seen = {shape.bsdf() for shape in shapes if not shape.is_emitter()}
    bsdfs = {node for node in nodes if isinstance(node, mi.BSDF)} - (of_lamps - seen)
    return [bsdf for bsdf in bsdfs if _is_made_of(bsdf, ATTACHABLE)]


def is_painted(emitter: mi.Emitter | mi.EmitterPtr) -> bool | mi.Bool:
    """Return whether (or in which lanes) the radiance of an emitter is textured."""
    return mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying)


def _seamless(shapes: list[mi.Shape], nodes: set[mi.Object]) -> bool:
    """Return whether the scene has a single shape, from whose points no edge is visible.

    A flat shape is not visible from its own points. The inside of a sphere is visible from its own points, but has no
    edge unless a texture has a seam.
    """
    if len(shapes) != 1 or shapes[0].is_emitter():
        return False
    textured = any(isinstance(node, mi.Texture) and node.is_spatially_varying() for node in nodes)
    kind = shapes[0].shape_type()
    return kind in (mi.ShapeType.Rectangle, mi.ShapeType.Disk) or (kind == mi.ShapeType.Sphere and not textured)


def is_specular(bsdf: mi.BSDF) -> bool:
    """Return whether a BSDF has a lobe of delta reflection or transmission. Transmission without scattering is none."""
    return bool(bsdf.flags() & (mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.DeltaTransmission))


def is_shiny(bsdf: mi.BSDFPtr) -> mi.Bool:
    """Return the lanes whose BSDF has a glossy lobe, or a lobe of delta reflection or transmission."""
    kinds = mi.BSDFFlags.Glossy | mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.DeltaTransmission
    return (bsdf.flags() & int(kinds)) != 0


def _delta_lobes(bsdf: mi.BSDF) -> int:
    delta = [k for k in range(bsdf.component_count()) if mi.has_flag(bsdf.flags(k), mi.BSDFFlags.Delta)]
    return max(delta) + 1 if delta else 0


def _is_made_of(bsdf: mi.BSDF, kinds: frozenset[str]) -> bool:
    """Return whether a BSDF is one of ``kinds``. A BSDF of `FRAMES` counts if all BSDFs nested in it do."""
    if bsdf.class_name() in FRAMES:
        return all(_is_made_of(nested, kinds) for nested in nodes_of(bsdf) if isinstance(nested, mi.BSDF))
    # Mitsuba calls Python plugins, such as `dielectric_ad`, by the name of their base class.
    ours = type(bsdf).__module__.startswith("pathreplay.")
    return (type(bsdf).__name__ if ours else bsdf.class_name()) in kinds
