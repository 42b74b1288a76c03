"""The loss of one view and its gradient by the scene's parameters: traced anew, or recorded as a frozen function.

A loss whose derivative is linear in each pixel can be back-propagated while its image is rendered, see `pixel_sweep`;
for the others an image is rendered first, and paths of their own are differentiated. Where Dr.Jit can record all that
as a frozen function, later calls launch its kernels without tracing them again.
"""

from __future__ import annotations

import gc
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi

from pathreplay.integrators.path_integrator import FrozenInputs
from pathreplay.inverse.losses.pixelwise import Loss, mean_loss
from pathreplay.inverse.objective.pixel_batches import Batch
from pathreplay.inverse.parameters.exposures import derivative
from pathreplay.scenes.parameters import keep_only

# Integrators of Mitsuba's that look at nothing on the host while they render; they do not say so. Ours does.
_OF_MITSUBA = frozenset({"PRBIntegrator", "BasicPRBIntegrator"})

# What Dr.Jit says, whatever the cause, where a function cannot be frozen. Plugins do not show beforehand whether they
# can: the arrays of some (Mitsuba 3.9.1: `orthographic`, `thinlens`) are hidden from it.
_RECORDING = "while recording a frozen function"


MOST_RECORDINGS = 8
"""Of a view: where what kernels take for constants changes more often, recording is not worth its time."""
_OTHER = 0x5EED
"""Makes another seed of one."""


class NotRecordable(Exception):
    """A plugin of the scene keeps Dr.Jit from recording a pass."""


def is_recordable(integrator: mi.Integrator, has_media: bool) -> bool:
    """Whether passes of the integrator can be recorded in a scene with or without media, as far as that is known."""
    # Spectral variants look up the eye's response in tables of Mitsuba's library: no input of ours, as a recorded
    # function must have them, leads there.
    if mi.is_spectral:
        return False
    return getattr(integrator, "recordable", type(integrator).__name__ in _OF_MITSUBA and not has_media)


class Recordings:
    """Frozen functions for `differentiate`, by view, shapes of the parameters, and what kernels take for constants."""

    def __init__(self) -> None:
        self._frozen: dict[Any, Callable[..., Any]] = {}
        self._made: Counter[Any] = Counter()  # of each view with such shapes

    def differentiate(
        self, params: mi.SceneParameters, scene: mi.Scene, sensor: int, integrator: mi.Integrator, *args: Any
    ) -> Any:
        """As the function of that name. Raises NotRecordable; a part of the gradient may be there, then."""
        frozen_inputs = _inputs_to_freeze(integrator, scene)
        keys = list(params.keys())
        # By view, since Dr.Jit thinks that something is wrong with a function that it has to record often.
        view = (sensor, *(dr.shape(params[key]) for key in keys))
        which = view, None if frozen_inputs is None else frozen_inputs.constants
        if which not in self._frozen:
            self._made[view] += 1
            if self._made[view] > MOST_RECORDINGS:
                raise NotRecordable
            gc.collect()  # scenes of the past would be traced, too
            self._frozen[which] = _recording(keys)
        try:
            return self._frozen[which](scene, frozen_inputs, sensor, integrator, *args)
        except RuntimeError as error:
            if _RECORDING not in str(error):
                raise
            raise NotRecordable from error


def _recording(keys: list[str]) -> Callable[..., Any]:
    """`differentiate` as a frozen function, which holds neither scene nor problem when the run is over."""

    def frozen(scene: Any, *args: Any) -> tuple[Any, Any, Any]:
        params = mi.traverse(scene)
        keep_only(params, keys)
        return _differentiate(params, scene, *args)

    return dr.freeze(frozen)


def differentiate(
    params: mi.SceneParameters, scene: mi.Scene, sensor: int, integrator: mi.Integrator, *args: Any
) -> tuple[Any, Any, Any]:
    """The loss of a view and its gradient, traced anew: see `_differentiate`."""
    return _differentiate(params, scene, _inputs_to_freeze(integrator, scene), sensor, integrator, *args)


def _inputs_to_freeze(integrator: Any, scene: mi.Scene) -> FrozenInputs | None:
    """What an integrator of ours is handed; others want nothing."""
    return integrator.inputs_to_freeze(scene) if hasattr(integrator, "inputs_to_freeze") else None


def _differentiate(
    params: mi.SceneParameters,
    scene: mi.Scene,
    frozen_inputs: FrozenInputs | None,
    sensor: int,
    integrator: mi.Integrator,
    target: mi.TensorXf,
    weight: mi.TensorXf | None,
    seed: int | mi.UInt32,
    spp: int,
    loss: Loss,
    share: float,
    sweeps: bool,
    factor: mi.TensorXf | None = None,
    batch: Batch | None = None,
) -> tuple[Any, Any, Any]:
    """``share`` times the loss of a view, whose gradient is added to the parameters; ``sweeps``: in one pass.

    With a ``batch``, which only sweeps take, target and weight are its rows, and so is the loss an estimate by them.
    An integrator of ours takes its ``frozen_inputs``. Also returns the `DeferredDiagnostics` (None of another), and
    the derivative by the logarithm of the ``factor`` on the picture (see `exposures`) for each channel, if there is
    one.
    """
    with _with_frozen_inputs(integrator, frozen_inputs):
        if sweeps:
            share, pixels = (share, None) if batch is None else (share * batch.share, batch.pixels)
            offset, slope = (term * share for term in linear_derivative(loss, target, weight))
            # By the chain rule, of what is linear in the factor times the image.
            offset, slope = _times(offset, factor), _times(_times(slope, factor), factor)
            image = integrator.render_value_and_grad(scene, offset, slope, scene.sensors()[sensor], seed, spp, pixels)
            value = mean_loss(loss, _times(image, factor), target, weight).array * share
        else:
            image = mi.render(scene, params, sensor=sensor, integrator=integrator, spp=spp, seed=seed)
            value = mean_loss(loss, _times(image, factor), target, weight).array * share
            if dr.grad_enabled(value):
                dr.backward(value)
        by_factor = None
        if factor is not None:
            with dr.suspend_grad():
                other: Any = mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(_OTHER))[0]
                again = mi.render(scene, sensor=sensor, integrator=integrator, spp=spp, seed=other)
            by_factor = derivative(loss, image, again, factor, target, weight) * share
    return dr.detach(value), integrator.take_deferred() if hasattr(integrator, "take_deferred") else None, by_factor


def _times(tensor: Any, factor: Any) -> Any:
    return tensor if factor is None else tensor * factor


@contextmanager
def _with_frozen_inputs(integrator: Any, frozen_inputs: FrozenInputs | None) -> Iterator[None]:
    """Within this block an integrator of ours has what it is handed."""
    if frozen_inputs is None:
        yield
        return
    integrator.frozen_inputs = frozen_inputs
    try:
        yield
    finally:
        integrator.frozen_inputs = None


def linear_derivative(loss: Loss, target: Any, weight: Any = None) -> tuple[Any, Any]:
    """Offset and slope of the derivative of a quadratic loss by the image, from two images far apart."""
    bright = 1 + dr.abs(target)
    offset = _derivative(loss, dr.zeros(mi.TensorXf, target.shape), target, weight)
    return offset, (_derivative(loss, mi.TensorXf(bright), target, weight) - offset) / bright


def _derivative(loss: Loss, image: Any, target: Any, weight: Any) -> Any:
    """Derivative of a loss by the image, a tensor like it."""
    dr.enable_grad(image)
    dr.backward(mean_loss(loss, image, target, weight))
    return dr.grad(image)
