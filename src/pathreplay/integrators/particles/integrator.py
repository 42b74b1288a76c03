"""The `pathreplay_particles` integrator plugin: traces all light from the emitters, like Mitsuba's `ptracer`."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi

from pathreplay.integrators.camera_pass import Pass
from pathreplay.integrators.diagnostics import meter_note
from pathreplay.integrators.integrator import PathReplayIntegrator
from pathreplay.integrators.particles.term import ParticleTerm
from pathreplay.integrators.pass_state import PassState
from pathreplay.integrators.path_integrator import PathIntegrator
from pathreplay.integrators.properties import PARTICLES, SAMPLES_PER_PASS, whole_number
from pathreplay.integrators.term import Term
from pathreplay.transport.vertex import TraceConfig

MOST_RAYS = 2**20
LEAST_A_PIXEL = 16


def _shines(emitter: mi.Emitter) -> bool:
    """Return whether a sensor can see an emitter."""
    flags = emitter.flags()
    on_surface = mi.has_flag(flags, mi.EmitterFlags.Surface) and not mi.has_flag(flags, mi.EmitterFlags.DeltaDirection)
    return on_surface or emitter.is_environment()


class ParticleIntegrator(PathReplayIntegrator):
    """Differentiable particle tracer for surfaces and media.

    Light paths start at the emitters and are connected to the sensor at every vertex. The number of light paths is the
    number of pixels times the samples per pixel. Emitters that the sensor sees directly are rendered with camera rays.
    The number of camera rays is limited to 2^20 in total or 16 per pixel, whichever is more.

    Properties: see `PARTICLES` in `integrators/properties.py`.

    Sensors: ``perspective``, ``thinlens``, ``orthographic`` and ``irradiancemeter``. The image is the same as with
    ``sample_border = true`` in the film (see `ParticleFilm`).

    The integrator does not differentiate visibility that `ParticleBoundary` leaves out. With
    ``attach='none'``, it does not differentiate any motion. With a box filter, it does not differentiate the motion of
    film positions.

    Raises PathreplayError for unknown or unusable properties, for media that emit, and in polarised variants.
    """

    name, properties = "pathreplay_particles", PARTICLES
    without_light_paths = "take the integrator 'pathreplay'"
    particles: ParticleTerm

    def __init__(self, props: mi.Properties) -> None:
        if SAMPLES_PER_PASS.name in props:
            whole_number(props, self.name, SAMPLES_PER_PASS, lowest=1, kind="number of samples")
        PathReplayIntegrator.__init__(self, props)
        self.particles = ParticleTerm(self.max_depth, caustics=False)

    def _planned(self, view: Pass, state: PassState, follow: bool = True) -> tuple[Pass, TraceConfig, tuple[Term, ...]]:
        """Leave out the terms of the camera rays if no emitter is visible to the sensor."""
        if self.hide_emitters or not any(map(_shines, view.scene.emitters())):
            return view, self._trace_config(view.scene, view.sensor, state), ()
        return PathReplayIntegrator._planned(self, view, state, follow)

    def _camera_view(self, view: Pass) -> Pass:
        """Limit the number of camera rays of a pass."""
        width, height = view.size
        return replace(view, spp=min(view.spp, max(MOST_RAYS // (width * height), LEAST_A_PIXEL)))

    def _trace_config(self, scene: mi.Scene, sensor: mi.Sensor | None, state: PassState | None = None) -> TraceConfig:
        """Return the configuration of the camera rays, which see emitters directly. Warn of light that is missing."""
        trace = PathIntegrator._trace_config(self, scene, sensor, state)
        self.particles.require_no_emission(trace)
        if sensor is not None and (note := meter_note(trace, sensor)):
            self._warn_once(note)
        return replace(trace, max_depth=min(trace.max_depth, 1))
