"""What our integrators share: their common properties, the walk that they set up, and care around each pass."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi

from ..errors import PathreplayError
from ..transport.media import scene_media
from ..transport.traits import Tables, nodes_of, scene_traits
from ..transport.vertex import Walk
from .properties import flag, whole_number

UNBOUNDED = 0xFFFFFFFF


@contextmanager
def plain_errors() -> Iterator[None]:
    """Within this block a PathreplayError that Dr.Jit wrapped in others comes out as itself."""
    try:
        yield
    except RuntimeError as error:
        mended = _mendable(error)
        if mended is error:
            raise
        raise mended from None


def _mendable(error: BaseException) -> BaseException:
    """The PathreplayError that Dr.Jit wrapped in errors of its own on the way out of a loop; else the error itself."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, PathreplayError):
        cause = cause.__cause__
    return cause or error


def path_integrator() -> type:
    """The base class of our integrators, for the active variant, which must be an AD variant."""
    # The name under which Mitsuba runs its Python modules anew for every variant. Of `mitsuba.ad`, the public name, an
    # import statement makes a copy, which stays what it was in the first variant.
    from mitsuba.python.ad.integrators.common import RBIntegrator

    class PathIntegrator(RBIntegrator):  # type: ignore[misc]
        """Properties ``max_depth`` (6; -1 = unbounded), ``rr_depth`` (5) and ``hide_emitters`` (False).

        Classes below have a ``name`` (the plugin's), ``attach`` (as `Walk` has it) and Mitsuba's ``sample``. Raises
        PathreplayError for unusable properties and in polarised variants.
        """

        name = ""
        attach = "none"

        def __init__(self, props: Any) -> None:
            if mi.is_polarized:
                raise PathreplayError(
                    f"{self.name}: variant {mi.variant()!r} tracks polarisation, which is not supported: "
                    f"use {mi.variant().replace('_polarized', '')!r}"
                )
            # All three are Mitsuba's, too, which takes what it is given or says less.
            whole_number(props, self.name, "max_depth", 6, lowest=0, unbounded=True)
            whole_number(props, self.name, "rr_depth", 5, lowest=1)
            hide_emitters = flag(props, self.name, "hide_emitters", False)
            super().__init__(props)
            self.hide_emitters = hide_emitters
            self.sensor: Any = None  # that is rendered
            # Mitsuba asks for radiance before it goes back, for integrators that replay it. Ours find it themselves and
            # nobody looks at this one; but tracing it takes time.
            self.goes_back = False
            self.tables: Tables | None = None  # of the scene, in a frozen function, which cannot make them
            self.of_pass: Any = None  # what tells passes apart: seed, samples per pixel, sensor

        def render_backward(
            self, scene: Any, params: Any, grad_in: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0
        ) -> None:
            """Back-propagate an image gradient into the parameters: see Mitsuba's ADIntegrator."""
            # Isolated, so that what the scene computes from its parameters can be differentiated in the next pass, too.
            with self._looking_through(scene, sensor, seed, spp), dr.isolate_grad():
                self.goes_back = True
                try:
                    super().render_backward(scene, params, grad_in, sensor, seed, spp)
                finally:
                    self.goes_back = False

        def render_forward(self, scene: Any, params: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0) -> Any:
            """Tangent of the image along those of the parameters: see Mitsuba's ADIntegrator."""
            with self._looking_through(scene, sensor, seed, spp):
                return super().render_forward(scene, params, sensor, seed, spp)

        def render(
            self,
            scene: Any,
            sensor: Any = 0,
            seed: Any = 0,
            spp: int = 0,
            develop: bool = True,
            evaluate: bool = True,
        ) -> Any:
            """Render an image: see Mitsuba's ADIntegrator."""
            with self._looking_through(scene, sensor, seed, spp):
                return super().render(scene, sensor, seed, spp, develop, evaluate)

        @contextmanager
        def _looking_through(self, scene: Any, sensor: Any, seed: Any, spp: int) -> Iterator[None]:
            """Remember the sensor, which may be in a medium, and what tells passes apart; make errors plain.

            No garbage is collected on the way: should an old scene vanish between two virtual calls, Dr.Jit counts
            their instances differently and writes functions that both call twice ("invalid redefinition").
            """
            if not isinstance(scene, mi.Scene) or not isinstance(self, mi.Integrator):
                raise PathreplayError(
                    f"{self.name}: scene or integrator belongs to another variant than the active one, "
                    f"{mi.variant()!r}: load it anew, or set its variant"
                )
            self.sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            self.of_pass = seed, spp, self.sensor.ptr
            collecting = gc.isenabled()
            gc.disable()
            try:
                with plain_errors():
                    yield
            finally:
                self.sensor = self.of_pass = None
                if collecting:
                    gc.enable()

        def _pass_key(self) -> tuple[int, int, int] | None:
            """What tells the pass under way from others (None if there is none). The seed is read: that takes time."""
            if self.of_pass is None:
                return None
            seed, spp, sensor = self.of_pass
            return seed if isinstance(seed, int) else int(seed[0]), spp, sensor

        def _walk(self, scene: Any, differentiate: bool) -> Walk:
            """How the scene is walked through; ``differentiate`` says that it is for a gradient."""
            nodes = nodes_of(scene)
            media = scene_media(nodes, self.sensor)
            return Walk(
                scene=scene,
                traits=scene_traits(nodes, scene, media is not None, self.tables),
                media=media,  # type: ignore[arg-type]
                attach=self.attach,
                hide_emitters=self.hide_emitters,
                max_depth=self.max_depth,
                rr_depth=self.rr_depth,
                skip_area_emitters=self.skip_area_emitters,
            )

        def _described(self, **more: Any) -> str:
            depth = -1 if self.max_depth == UNBOUNDED else self.max_depth
            values = {"max_depth": depth, "rr_depth": self.rr_depth, **more}
            return f"{type(self).__name__}[{', '.join(f'{key} = {value}' for key, value in values.items())}]"

        def to_string(self) -> str:
            return self._described()

    return PathIntegrator
