"""Start: sample the first ray of a light path from the emitters of a scene."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.platform import compat
from pathreplay.samplers.sampler import Sampler
from pathreplay.transport.emitters import area_growth
from pathreplay.transport.facts.nodes import is_mesh
from pathreplay.transport.facts.traits import is_painted
from pathreplay.transport.meet import meet
from pathreplay.transport.start import medium_around
from pathreplay.transport.vertex import Arrival, TraceConfig, reciprocal
from pathreplay.transport.volume.passage import medium_at_end, medium_at_origin

#: Classes of emitters that can emit rays.
EMITTERS = frozenset(
    {
        "AreaLight",
        "ConstantBackgroundEmitter",
        "DirectionalArea",
        "DirectionalEmitter",
        "EnvironmentMapEmitter",
        "PointLight",
        "Projector",
        "SpotLight",
    }
)
MAP = "EnvironmentMapEmitter"
SPHERE = "Sphere"
SUN = "DirectionalEmitter"

# Largest accepted distance between the origin of a ray and the triangle that emitted the ray. The unit is the distance
# by which Mitsuba offsets origins along the normal. Only rays nearly parallel to the triangle have a larger distance.
# These rays carry almost no flux, and are rejected.
CLOSE = 100

# Direction of the ray on which the medium around the scene is found. It is parallel to no axis, because axes are often
# parallel to surfaces.
AWAY = 0.31, 0.83, 0.47


@dataclass
class EmitterSamples:
    """The random numbers of the first ray."""

    time: mi.Float
    emitter: mi.Float  # selects the emitter, and is reused to sample the wavelengths
    place: mi.Point2f
    direction: mi.Point2f

    @staticmethod
    def draw(sampler: Sampler) -> EmitterSamples:
        return EmitterSamples(sampler.next_1d(), sampler.next_1d(), sampler.next_2d(), sampler.next_2d())


@dataclass(frozen=True)
class Emission:
    """The emitters of a scene, and the probabilities with which light paths start at them."""

    scene: mi.Scene
    sensor: mi.Sensor  # its shutter determines the time of the rays
    weights: tuple[float, ...]  # relative probability of starting a path, for each emitter
    maps: tuple[mi.Emitter, ...]  # environment maps
    suns: tuple[mi.Emitter, ...]  # directional emitters
    rounded: tuple[mi.Emitter, ...]  # emissive meshes with interpolated normals
    spheres: tuple[mi.Emitter, ...]  # emissive spheres whose origins Mitsuba samples uniformly
    outside: mi.MediumPtr = None  # type: ignore[assignment]  # the medium around the scene; None in scenes without media

    @staticmethod
    def of(scene: mi.Scene, sensor: mi.Sensor, caustics: bool) -> Emission | None:
        """Describe the emitters of a scene; None if no light path starts at them.

        With ``caustics``, light paths start at all emitters except environments. Raises PathreplayError for emitters
        that cannot emit rays.
        """
        emitters = scene.emitters()
        weights = [0.0 if caustics and each.is_environment() else _weight(each) for each in emitters]
        if not sum(weights) > 0:
            return None
        for each, weight in zip(emitters, weights, strict=True):
            if weight > 0:
                _require_rays(each)
        maps, suns = (tuple(each for each in emitters if each.class_name() == kind) for kind in (MAP, SUN))
        rounded, spheres = (tuple(filter(test, emitters)) for test in (_has_smooth_mesh, _is_uniform_sphere))
        return Emission(scene, sensor, tuple(weights), maps, suns, rounded, spheres)

    def surrounded(self, trace: TraceConfig) -> Emission:
        """Return the emission with the medium around the scene, found on a ray that leaves the scene from the sensor.

        Raises PathreplayError if an emitter at infinity would emit into fog without bounds.
        """
        if trace.media is None:
            return self
        for each, weight in zip(self.scene.emitters(), self.weights, strict=True):
            infinite = mi.has_flag(each.flags(), mi.EmitterFlags.Infinite)
            if weight > 0 and infinite and trace.media.around is not None and not trace.media.bounded:
                raise PathreplayError(
                    f"no light path can start at emitter '{each.id()}': it is at infinity, in a medium without bounds, "
                    "which absorbs all of its light; put the medium into a shape with a 'null' BSDF"
                )
        shape = self.sensor.get_shape()
        origin = self.sensor.world_transform() @ mi.Point3f(0) if shape is None else mi.Point3f(shape.bbox().center())
        away = mi.Ray3f(dr.detach(origin), dr.normalize(mi.Vector3f(*AWAY)))
        outside = medium_at_end(trace, away, medium_around(trace))
        dr.eval(outside)
        return replace(self, outside=outside)

    def pick(self, u: mi.Float) -> tuple[mi.UInt32, mi.Float, mi.Float]:
        """Select an emitter; return its index, a random number independent of the index, and its probability."""
        used = [weight for weight in self.weights if weight > 0]
        if min(used) == max(used):
            place = u * len(used)
            index = dr.minimum(mi.UInt32(place), len(used) - 1)
            again = place - mi.Float(index)
            for k, weight in enumerate(self.weights):
                if not weight > 0:
                    index += dr.select(index >= k, mi.UInt32(1), 0)
            return index, again, mi.Float(1 / len(used))
        total = sum(self.weights)
        index, low, high = mi.UInt32(0), mi.Float(0), mi.Float(0)
        begin = 0.0
        for k, weight in enumerate(self.weights):
            end = begin + weight / total
            here = (u >= begin) & (end > begin)
            index, low, high = dr.select(here, k, index), dr.select(here, begin, low), dr.select(here, end, high)
            begin = end
        return index, (u - low) / (high - low), high - low

    def emit(self, trace: TraceConfig, u: EmitterSamples, active: mi.Bool) -> tuple[mi.Ray3f, mi.Spectrum]:
        """Sample a ray, and compute its weight. Both are differentiable in the parameters of the emitters.

        The weight is the emitted radiance times the cosine at the emitter, divided by the sampling density. The origin
        of the ray has fixed coordinates on the emitter, and its direction has fixed coordinates in the local frame.
        Origin and direction therefore move with the emitter.
        """
        index, again, probability = self.pick(u.emitter)
        emitter = dr.gather(mi.EmitterPtr, self.scene.emitters_dr(), index, active)
        time = mi.Float(self.sensor.shutter_open()) + u.time * self.sensor.shutter_open_time()
        ray, weight = emitter.sample_ray(time, again, u.place, u.direction, active)
        center, radius = trace.traits.tables.scene_sphere()
        for each in self.suns:
            o, power = _from_sun(each, center, radius, u.place, again)
            here = emitter == mi.EmitterPtr(each)
            ray.o, weight = dr.select(here, o, ray.o), dr.select(here, power, weight)
        if self.maps:
            # Mitsuba 3.9 samples origins on a disk that does not rotate with the environment map. Compute the origin
            # again.
            disk = mi.warp.square_to_uniform_disk_concentric(u.place)
            start = mi.Frame3f(dr.detach(ray.d)).to_world(mi.Vector3f(disk.x, disk.y, 0)) - ray.d
            ray.o = dr.select(_is_one_of(self.maps, emitter), center + start * radius, ray.o)
        for each in self.spheres:
            o, d = _from_sphere(each, ray.d, u.place)
            here = emitter == mi.EmitterPtr(each)
            ray.o, ray.d = dr.select(here, o, ray.o), dr.select(here, d, ray.d)
        deform = trace.traits.lights_deform
        if deform or self.rounded:
            rounded = active & _is_one_of(self.rounded, emitter)
            origin = _origin(trace, emitter, ray, active if deform else rounded)
            if deform:
                # Mitsuba's `sample_ray` omits the derivative of the areas of triangles, unless the radiance is
                # textured.
                hit, back, on_mesh = origin
                weight *= area_growth(hit, back, on_mesh & ~mi.Bool(is_painted(emitter)))
            if self.rounded:
                weight = dr.select(~rounded | _outwards(*origin), weight, 0)
        return ray, weight * dr.detach(reciprocal(probability))


def _weight(emitter: mi.Emitter) -> float:
    """Return the relative probability of starting light paths at an emitter.

    Camera paths that hit an emitter find its light even if its ``sampling_weight`` is 0. Light paths only find the
    light of an emitter at which they start.
    """
    flags, weight = emitter.flags(), emitter.sampling_weight()
    directed = mi.has_flag(flags, mi.EmitterFlags.DeltaDirection)
    found = emitter.is_environment() or (mi.has_flag(flags, mi.EmitterFlags.Surface) and not directed)
    return weight if weight > 0 or not found else 1.0


def _require_rays(emitter: mi.Emitter) -> None:
    """Raise PathreplayError unless the emitter can emit rays."""
    known = emitter.class_name() in EMITTERS
    try:
        if known:
            emitter.sample_ray(mi.Float(0), mi.Float(0.5), mi.Point2f(0.5), mi.Point2f(0.5))
    except RuntimeError:  # the emitter has a texture that Mitsuba cannot sample
        known = False
    if not known:
        raise PathreplayError(
            f"no light path can start at emitter '{emitter.id()}': Mitsuba samples no rays of {emitter.class_name()}, "
            "or of its texture; replace it, or trace all paths from the sensor"
        )


def _has_smooth_mesh(emitter: mi.Emitter) -> bool:
    shape = emitter.get_shape()
    return shape is not None and is_mesh(shape) and compat.has_normals(shape)


def _is_uniform_sphere(emitter: mi.Emitter) -> bool:
    """Return whether Mitsuba samples origins uniformly on a sphere, as it does unless the radiance is textured."""
    shape = emitter.get_shape()
    return shape is not None and shape.class_name() == SPHERE and not is_painted(emitter)


def _from_sun(
    emitter: mi.Emitter, center: mi.Point3f, radius: mi.Float, u: mi.Point2f, again: mi.Float
) -> tuple[mi.Point3f, mi.Spectrum]:
    """Return origin and weight of a ray from a directional emitter. The rays cover the bounding sphere of the scene.

    The sphere is an argument, because Mitsuba 3.9 hides its own bounding sphere from Dr.Jit: a recorded pass would keep
    the sphere that the scene had when the pass was recorded.
    """
    disk = mi.warp.square_to_uniform_disk_concentric(u)
    offset = mi.traverse(emitter)["to_world"] @ mi.Vector3f(disk.x, disk.y, -1)
    _, irradiance = emitter.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), again)
    return center + offset * radius, irradiance * (dr.pi * dr.square(radius))


def _from_sphere(emitter: mi.Emitter, d: mi.Vector3f, u: mi.Point2f) -> tuple[mi.Point3f, mi.Vector3f]:
    """Return origin and direction of a ray from a sphere, from the direction ``d`` that Mitsuba has sampled.

    Mitsuba 3.9 does not apply the rotation of ``to_world`` to the normal at a sampled point, around which it samples
    ``d``. The direction must be rotated, and the origin offset along the rotated normal.
    """
    to_world = mi.traverse(emitter.get_shape())["to_world"]
    normal = mi.warp.square_to_uniform_sphere(u)
    side = dr.select(dr.dot(normal, d) < 0, mi.Float(-1), 1)  # spheres with flipped normals emit to the inside
    p, n = to_world @ mi.Point3f(normal), dr.normalize(to_world @ mi.Vector3f(normal))
    offset = dr.detach(side * mi.math.RayEpsilon * (1 + dr.max(dr.abs(p))))
    return p + n * offset, dr.normalize(to_world @ d)


def _origin(
    trace: TraceConfig, emitter: mi.EmitterPtr, ray: mi.Ray3f, active: mi.Bool
) -> tuple[mi.PreliminaryIntersection3f, mi.Ray3f, mi.Bool]:
    """Find the triangle that emitted a ray, by tracing the reversed ray from the same origin.

    Returns the hit of the reversed ray, the reversed ray, and whether the hit is on a mesh with this emitter.
    """
    back = mi.Ray3f(dr.detach(ray))
    back.d = -back.d
    hit = trace.scene.ray_intersect_preliminary(back, active=active)
    return hit, back, active & hit.is_valid() & hit.shape.is_mesh() & (hit.shape.emitter() == emitter)


def _outwards(hit: mi.PreliminaryIntersection3f, back: mi.Ray3f, on_mesh: mi.Bool) -> mi.Bool:
    """Return whether a ray leaves its mesh emitter on the outside. The arguments are those that `_origin` returns.

    Mitsuba samples directions around the interpolated normal. Some of these directions point below the triangle, so
    that the mesh itself blocks the light. Such rays must be rejected, because Mitsuba offsets their origins to the
    outside, and they would then hit the mesh.
    """
    n = hit.compute_surface_interaction(back, compat.shading(), on_mesh).n
    reach = CLOSE * mi.math.RayEpsilon * (1 + dr.max(dr.abs(back.o)))
    return on_mesh & (hit.t < reach) & (dr.dot(n, back.d) < 0)


def _is_one_of(emitters: tuple[mi.Emitter, ...], emitter: mi.EmitterPtr) -> mi.Bool:
    result = mi.Bool(False)
    for each in emitters:
        result |= emitter == mi.EmitterPtr(each)
    return result


@dataclass
class EmitterStart:
    """The start of light paths. The adjoints of the first ray and of its weight are back-propagated to the emitters."""

    trace: TraceConfig
    emission: Emission
    u: EmitterSamples
    sampler: Sampler  # source of the random numbers of the path
    active: mi.Bool
    ray: mi.Ray3f = field(init=False)  # the first ray, detached
    W: mi.Spectrum = field(init=False)  # the weight of this ray, detached

    def __post_init__(self) -> None:
        self.ray, self.W = dr.detach(self.emit())

    def emit(self) -> tuple[mi.Ray3f, mi.Spectrum]:
        """Return the first ray and its weight, differentiably: see `Emission.emit`."""
        return self.emission.emit(self.trace, self.u, self.active)

    def choose(self, trace: TraceConfig, active: mi.Bool) -> Arrival:
        ray = mi.Ray3f(self.ray)
        hit = meet(trace, ray, active)
        at = Arrival(ray=ray, hit=hit, pdf=mi.Float(1), delta=mi.Bool(True), camera=mi.Bool(True))
        if trace.media is not None:
            at.medium = medium_at_origin(trace, ray, hit, self.emission.outside, active)
            at.behind = mi.Float(0)
        return at

    def repeat(self) -> tuple[mi.Point3f, mi.Vector3f]:
        ray, _ = self.emit()
        return ray.o, ray.d
