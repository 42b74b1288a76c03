"""Image of a view, and the derivatives of the image with respect to every entry of the variables.

Image and derivatives are computed twice, from two independent halves of the samples. For each half, forward-mode
differentiation renders one tangent image per entry, with the same random numbers as the image of this half.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.integrators.camera_pass import Which
from pathreplay.integrators.pass_state import PassState
from pathreplay.integrators.stateful import StatefulIntegrator
from pathreplay.inverse.objective.frozen import Recordings, RenderRequest, linear_derivative
from pathreplay.inverse.objective.shared_sensors import SharedSensors
from pathreplay.inverse.parameters.exposures import EXPOSURE, derivatives_by_factors, factor_of
from pathreplay.inverse.parameters.gauss_newton import GaussNewton, Half, model_of, places
from pathreplay.inverse.parameters.values import Array, Arrays, split
from pathreplay.inverse.problem.problem import Problem, scene_values
from pathreplay.platform import memory
from pathreplay.platform.owned_arrays import with_space

IMAGE = ""
"""Key by which `Jacobians` requests the image. The key of a variable requests a derivative with respect to it."""


class Jacobians:
    """Differentiates the images of a problem with respect to the variables ``moving``.

    Between calls, the scene contains the values of the last call.

    Args:
        problem: the problem, with a quadratic loss.
        integrator: integrator of the problem.
        moving: keys of the variables.
        sensors: sensors of passes that are recorded as frozen functions; None if no pass is recorded.
    """

    def __init__(
        self, problem: Problem, integrator: StatefulIntegrator, moving: Collection[str], sensors: SharedSensors | None
    ) -> None:
        self.problem, self.integrator, self._sensors = problem, integrator, sensors
        self._recordings = Recordings()
        self._traced: set[tuple[str, Which]] = set()  # pairs of a variable (or IMAGE) and a kind of view
        self._moving = [v.key for v in problem.variables if v.key in moving]
        self._reached = {key: problem.reached(frozenset({key})) if key != EXPOSURE else set() for key in self._moving}

    def model(
        self, values: Arrays, view: int, seed: int, spp: int
    ) -> tuple[float, dict[str, Array], dict[str, int], GaussNewton]:
        """Compute the contribution of a view to the loss, with gradients and the Gauss-Newton model.

        Args:
            values: values of all variables.
            view: index of the view.
            seed: seed of the view.
            spp: samples per pixel of both halves together.

        Returns:
            The loss, the gradients by key, the number of entries with NaN or infinite derivatives by key, and the
            model. NaN and infinite derivatives count as zero.

        Raises:
            NotRecordable: a plugin of the scene prevents Dr.Jit from recording a pass.
            PathreplayError: the derivatives do not fit into memory.
        """
        about = self.problem.views[view]
        sizes = {key: values[key].size for key in self._moving}
        memory.require(
            12 * sum(sizes.values()) * about.target.size,
            f"The derivatives of view '{about.name}' with respect to {sum(sizes.values())} entries",
            "use fewer parameters or smaller films",
        )
        seeds = [int(s) for s in np.random.SeedSequence([seed]).generate_state(2)]
        # Seeds are inputs of recorded passes, as in `Evaluator`.
        opaque = [half if self._sensors is None else dr.opaque(mi.UInt32, half) for half in seeds]
        a, b = (self._half(values, view, RenderRequest(about.sensor, half, spp // 2)) for half in opaque)
        dropped = {}
        for key, here in places(sizes).items():
            lost = 0
            for rows in zip(a.jacobian[here], b.jacobian[here], strict=True):
                finite = np.isfinite(rows[0]) & np.isfinite(rows[1])
                lost += not finite.all()
                for row in rows:
                    row[~finite] = 0
            if lost:
                dropped[key] = lost
        share = about.share / len(self.problem.trained())
        weight = None if about.weight is None else mi.TensorXf(with_space(about.weight))
        target = mi.TensorXf(with_space(about.target))
        slope = np.array(linear_derivative(self.problem.loss, target, weight)[1]) * share
        loss, gradient, model = model_of(a, b, np.broadcast_to(slope, about.target.shape), sizes)
        return loss, split(gradient, {key: values[key].shape for key in self._moving}), dropped, model

    def _half(self, values: Arrays, view: int, request: RenderRequest) -> Half:
        """Render the image of a view, and its derivatives with respect to all entries."""
        target = self.problem.views[view].target
        factor = factor_of(values, view, target.shape[2])
        variables = self.problem.cache.variables(self.problem, values)
        self.problem.params.update(scene_values(self.problem, variables))
        image = self._pass(IMAGE, view, request)
        n = sum(values[key].size for key in self._moving)
        jacobian, row = np.zeros((n, *target.shape), np.float32), 0
        by_key = {v.key: v for v in self.problem.variables}
        try:
            for key in self._moving:
                size = values[key].size
                if key == EXPOSURE:
                    jacobian[row : row + size] = derivatives_by_factors(values, view, image)
                elif view in self._reached[key]:
                    for k in range(size):
                        unit = np.zeros(values[key].shape, np.float32)
                        unit.flat[k] = 1
                        self._carry(variables, key, by_key[key].held(unit))
                        found = self._pass(key, view, request)
                        jacobian[row + k] = found if factor is None else found * factor
                row += size
        finally:
            dr.disable_grad(variables)
            self.problem.params.update(scene_values(self.problem, variables))
        return Half((image if factor is None else image * factor) - target, jacobian)

    def _carry(self, variables: dict[str, dr.ArrayBase], key: str, unit: dr.ArrayBase) -> None:
        """Enable the gradient of one variable only, and propagate the tangent ``unit`` from it to the scene."""
        dr.disable_grad(variables)
        dr.enable_grad(variables[key])
        dr.set_grad(variables[key], unit)
        self.problem.params.update(scene_values(self.problem, variables))
        dr.forward_from(variables[key], dr.ADFlag.ClearEdges)

    def _pass(self, key: str, view: int, request: RenderRequest) -> Array:
        """Render the image, or its derivative along the tangent of a variable.

        If passes are recorded, the first call for a pair of key and kind of view is not recorded. Later calls use a
        recorded pass.
        """
        scene, integrator, run = self.problem.scene, self.integrator, _image if key == IMAGE else _tangent
        state = integrator.begin(scene)
        # The first call is not recorded: see `Evaluator`.
        kind = request.sensor if self._sensors is None else self._sensors.kind(view)
        if self._sensors is not None and (key, kind) in self._traced:
            request = replace(request, sensor=self._sensors.of(view))
            which = key, request.sensor, request.spp
            arguments = scene, integrator, state.to_record(), request
            image, state = self._recordings.called(which, lambda: dr.freeze(run), *arguments)
        else:
            image, state = run(scene, integrator, state, request)
        self._traced.add((key, kind))
        integrator.keep(scene, state)
        result = np.array(image, np.float32)
        film = scene.sensors()[self.problem.views[view].sensor].film()
        if key != IMAGE and mi.has_flag(film.flags(), mi.FilmFlags.Alpha):
            # Alpha has no derivative. Mitsuba's integrators write alpha itself into this channel of tangents.
            result[..., film.base_channels_count() - 1] = 0
        return result


def _image(
    scene: mi.Scene, integrator: StatefulIntegrator, state: PassState, request: RenderRequest
) -> tuple[mi.TensorXf, PassState]:
    return integrator.image_pass(integrator.pass_of(scene, request.sensor, request.seed, request.spp), state), state


def _tangent(
    scene: mi.Scene, integrator: StatefulIntegrator, state: PassState, request: RenderRequest
) -> tuple[mi.TensorXf, PassState]:
    return integrator.tangent_pass(integrator.pass_of(scene, request.sensor, request.seed, request.spp), state)
