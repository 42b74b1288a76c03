"""The particle term: light paths from the emitters to the sensor, and their derivative at fixed visibility."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import NonFiniteCounter, Unreached
from pathreplay.adjoint.baseline import Baseline
from pathreplay.errors import PathreplayError
from pathreplay.integrators.camera_pass import Pass
from pathreplay.integrators.film.image import picture_shape
from pathreplay.integrators.lifetimes import is_recording
from pathreplay.integrators.term import Term, TermResult
from pathreplay.particles.film import ParticleFilm
from pathreplay.particles.paths import Particles, link_of, particle_image, particle_sweep, particle_tangent
from pathreplay.particles.start import Emission
from pathreplay.samplers.owen_sobol import key_of
from pathreplay.samplers.streams import Stream
from pathreplay.transport.sensor import require_no_response
from pathreplay.transport.vertex import TraceConfig


@dataclass(frozen=True)
class ParticleTerm(Term):
    """Image and derivative of light paths. A pass traces as many light paths as it has samples.

    Every path is differentiated as in `PathReplay`, and also with respect to its film positions. The visibility of
    vertices from each other and from the sensor is not differentiated here: see `ParticleBoundary`. With a box filter,
    the motion of film positions is not differentiated.
    """

    max_depth: int  # depth of the whole path from emitter to sensor, counted as in Mitsuba
    caustics: bool  # trace only the paths that `TraceConfig.without_caustics` omits, not all light paths

    @staticmethod
    def require_no_emission(trace: TraceConfig) -> None:
        """Raise PathreplayError if the scene has media that emit light."""
        if trace.media is not None and trace.media.emissive:
            raise PathreplayError(
                "no light path can start in a medium that emits: set its radiance to 0, or trace all paths from the "
                "sensor (integrator 'pathreplay')"
            )

    def image(self, view: Pass, trace: TraceConfig) -> mi.TensorXf | None:
        """Render the image, with zero alpha; None if no light path starts in the scene."""
        work = self.work(view, trace)
        return None if work is None else particle_image(*work)

    def forward(self, view: Pass, trace: TraceConfig, learned: Baseline | None) -> TermResult:
        work, lost = self.work(view, trace), NonFiniteCounter()
        if work is None:
            return TermResult(dr.zeros(mi.TensorXf, picture_shape(view.sensor)))
        image, moves = particle_tangent(*work, lost)
        dr.eval(image)
        return TermResult(image, lost=lost.count, paths=work[1].number, moves=True) if moves else TermResult(image)

    def backward(self, view: Pass, trace: TraceConfig, grad_in: mi.TensorXf, learned: Baseline | None) -> TermResult:
        work, lost = self.work(view, trace), NonFiniteCounter()
        if work is None:
            raise Unreached("no light path starts at an emitter of the scene")
        moves = particle_sweep(*work, grad_in, lost)
        dr.eval()
        if not moves and trace.media is None:  # no path can be incomplete
            return TermResult()
        return TermResult(lost=lost.count, paths=work[1].number, moves=moves)

    def work(self, view: Pass, trace: TraceConfig) -> tuple[TraceConfig, Particles, ParticleFilm] | None:
        """Return the configuration of light paths, the paths and the film; None if no light path starts in the scene.

        ``trace`` is the configuration of the camera paths.
        """
        emission = Emission.of(view.scene, view.sensor, self.caustics)
        if emission is None:
            return None
        film = ParticleFilm.of(view.sensor)
        if mi.is_spectral and not is_recording():
            require_no_response(view.sensor)
        key = key_of(view.opaque_seed, mi.UInt32(int(Stream.PARTICLES)))
        trace = link_of(replace(trace, max_depth=self.max_depth), view.sensor, self.caustics)
        emission = emission.surrounded(trace)
        return trace, Particles(emission, key, film.pixels * view.spp), film
