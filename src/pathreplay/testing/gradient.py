"""Gradient checks: the derivative of any integrator against finite differences of images of the same expectation.

Each check draws two sets of independent samples of one directional derivative, and derives standard errors and a
verdict from them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from pathreplay.errors import PathreplayError, shown
from pathreplay.integrators.film.image import require_film
from pathreplay.platform.traversal import traversed
from pathreplay.scenes.parameters import get_array, require_differentiable, require_finite
from pathreplay.scenes.spectra import coefficient_channels
from pathreplay.testing.direction import Line, choose_line
from pathreplay.testing.objective import Loss, Mode, Objective, alone, integrator_name
from pathreplay.testing.reference import Spec, integrator_under_test, reference_integrator
from pathreplay.testing.verdict import Judgement

_MOST_SEEDS = 1_000_000


@dataclass(frozen=True)
class GradientCheck(Judgement):
    """A directional derivative of the objective, estimated in two ways, and the verdict."""

    key: str
    direction: str
    """Choice of the direction: 'scalar', 'random, seed 0', 'given'."""
    integrator: str
    reference_integrator: str
    mode: Mode
    objective: float
    """Value of the objective F at the point of the gradient."""
    step: float
    """Step h: the distance that an entry with direction 1 moves."""
    stencil: str
    """'central', or 'one-sided, up' or 'one-sided, down' if the parameter is at its bound 0."""
    seeds: int
    spp: int
    fd_spp: int
    gradient_samples: tuple[float, ...]
    reference_samples: tuple[float, ...]

    @property
    def passed(self) -> bool:
        """True for the verdicts 'pass' and 'zero'."""
        return self.verdict in ("pass", "zero")

    def __str__(self) -> str:
        tracer = self.reference_integrator
        rows = (
            (f"gradient ({self.integrator}, {self.mode})", f"{self.gradient:+.6g} ± {self.gradient_se:.2g}"),
            (f"reference ({tracer}, {self.stencil})", f"{self.reference:+.6g} ± {self.reference_se:.2g}"),
            ("step, remaining error", f"{self.step:.3g}, {self.step_error:.2g}"),
            ("seeds, spp, reference spp", f"{self.seeds}, {self.spp}, {self.fd_spp}"),
            ("z", f"{self.z:+.2f}"),
            ("verdict", f"{self.verdict.upper()}: {self.reason}"),
        )
        width = max(len(name) for name, _ in rows)
        return "\n".join([f"{self.key} ({self.direction})", *(f"  {name:<{width}}  {value}" for name, value in rows)])


def check_gradient(  # noqa: PLR0913 (most are keyword-only)
    scene: mi.Scene,
    key: str,
    *,
    integrator: Spec = None,
    reference: Spec = None,
    max_depth: int | None = None,
    sensor: int = 0,
    seeds: int = 16,
    spp: int = 16,
    fd_spp: int | None = None,
    step: float | None = None,
    direction: ArrayLike | None = None,
    mode: Mode = "backward",
    loss: Loss | None = None,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> GradientCheck:
    """Compare a directional derivative of the image with finite differences, over independent seeds.

    The derivative is dF/dt at t = 0. F(t) is the weighted mean of the image (see ``loss``) if the parameter is set to
    value + t · direction.

    Args:
        scene: a scene of an AD variant; its parameters and gradients are restored in any case.
        key: a differentiable parameter of ``mi.traverse(scene)``.
        integrator: the integrator under test: an object, a dictionary, a plugin name, or None. None selects the scene's
            own integrator if it is differentiable, else ``pathreplay``. A plugin given by name gets the path limits of
            the scene's integrator.
        reference: the integrator whose images are differenced; None for Mitsuba's ``path`` (``volpath`` with media)
            with the same path limits. If ``integrator`` traces light paths, None selects an integrator of its kind.
        max_depth: path length, if ``integrator`` is None or a name.
        sensor: index of the sensor; its film determines the resolution.
        seeds: number n of independent seeds for the gradient; the reference uses n other seeds.
        spp: samples per pixel of one gradient.
        fd_spp: samples per pixel of one image of the reference (None: ``spp``). Each reference seed takes four images,
            at ±h and ±h/2 with common random numbers.
        step: h; None for a hundredth of max(1, largest absolute entry).
        direction: array of the parameter's shape, not normalised. None selects 1 for a scalar, a random translation for
            ``to_world`` (a rotation for sun and sky), and random positive entries with maximum 1 otherwise.
        mode: 'backward' (``dr.backward`` through ``mi.render``) or 'forward' (``dr.forward``).
        loss: a function from the image (TensorXf, height x width x channels) to a scalar, or None. The function is
            linearised once at a rendered image, because a nonlinear loss of a noisy image would be biased, and the
            check concerns the renderer. None selects the mean of the image under smooth weights between 0.5 and 1.5.
            These weights differ between channels and places, so that errors of opposite sign do not cancel.
        seed: determines all random numbers and the direction.
        progress: called with (finished renderings, total renderings), first with 0 after all arguments are validated,
            and with 1 before the first gradient.

    Returns:
        the estimates, their standard errors and the verdict (see :mod:`pathreplay.testing.verdict`).

    Not checked: components of the gradient orthogonal to the direction, the loss itself, and the alpha channel, which
    no integrator differentiates.

    Raises:
        PathreplayError: a bad argument, a parameter without derivative, NaN in the scene, an integrator that cannot
            differentiate this parameter.
    """
    fd_spp = spp if fd_spp is None else fd_spp
    require_types(key, sensor=sensor, seeds=seeds, spp=spp, fd_spp=fd_spp, seed=seed)
    if loss is not None and not callable(loss):
        raise PathreplayError(f"loss is {shown(loss)}; give a function from the image to a number, or leave it out")
    require_arguments(scene, sensor, seeds, spp, fd_spp, seed)
    if seeds < 2:
        raise PathreplayError(f"seeds is {seeds}; a standard error needs at least 2; use 8 or more")
    if mode not in ("backward", "forward"):
        raise PathreplayError(f"mode is '{mode}'; choose 'backward' or 'forward'")
    params = traversed(scene)
    tested = integrator_under_test(integrator, scene, max_depth)
    line = line_of(params, key, tested, step, direction, seed)
    plain = reference_integrator(reference, scene, tested)
    plan = _Plan(mode, seeds, spp, fd_spp, seed, progress)
    with alone(params, key):
        return plan.carry_out(Objective(scene, params, key, line.move, sensor), line, tested, plain, loss)


@dataclass
class _Plan:
    """The sampling plan of a check, with its progress callback."""

    mode: Mode
    seeds: int
    spp: int
    fd_spp: int
    seed: int
    progress: Callable[[int, int], None] | None
    done: int = 0

    def carry_out(
        self, objective: Objective, line: Line, tested: mi.Integrator, plain: mi.Integrator, loss: Loss | None
    ) -> GradientCheck:
        n, stencil = self.seeds, line.stencil
        self._tell()
        # All seeds have 32 bits. Each of the n gradients has one seed for its primal image and one for its derivative
        # pass. The reference has n seeds, and the weights have one seed.
        words = [int(word) for word in np.random.SeedSequence(self.seed).generate_state(3 * n + 1)]
        objective.weigh_by(loss, plain, words[-1], self.fd_spp)
        self._tick()
        pairs, others = zip(words[:n], words[n : 2 * n], strict=True), words[2 * n : -1]
        gradients = [self._tick(objective.derivative(tested, self.mode, *pair, self.spp)) for pair in pairs]
        values = {}
        for o in stencil.points():
            images = (objective.image(plain, seed, self.fd_spp, o * line.step) for seed in others)
            values[o] = np.array([self._tick(objective.dot(image)) for image in images])
        full, half = (differences(values.__getitem__) / line.step for differences in (stencil, stencil.halved()))
        return GradientCheck(
            key=objective.key,
            direction=line.description,
            integrator=integrator_name(tested),
            reference_integrator=integrator_name(plain),
            mode=self.mode,
            objective=float(np.mean(values.get(0.0, list(values.values())))),
            step=line.step,
            stencil=stencil.name,
            seeds=n,
            spp=self.spp,
            fd_spp=self.fd_spp,
            gradient_samples=tuple(gradients),
            reference_samples=tuple(((4 * half - full) / 3).tolist()),
            **vars(objective.judge(line, np.array(gradients), full, half)),
        )

    def _tick(self, result: float = 0.0) -> float:
        self.done += 1
        self._tell()
        return result

    def _tell(self) -> None:
        if self.progress is not None:
            self.progress(self.done, 1 + 5 * self.seeds)


def line_of(
    params: mi.SceneParameters, key: str, by: mi.Integrator, step: float | None, direction: ArrayLike | None, seed: int
) -> Line:
    """Choose the line in parameter space along which a check moves the parameter ``key``.

    Raises PathreplayError for a parameter without derivative or in half precision.
    """
    require_differentiable(params, key, by)
    require_finite(params)
    value, owner = get_array(params[key]), params.properties[key][2]
    if value.dtype == np.float16:
        raise PathreplayError(
            f"Parameter '{key}' is stored in half precision, too coarse for finite differences; give the texture the "
            "option format='variant'"
        )
    # An infinitely distant emitter can be rotated, but translation does not change it.
    infinite = mi.EmitterFlags.Infinite | mi.EmitterFlags.DeltaDirection
    far = isinstance(owner, mi.Emitter) and bool(mi.has_flag(owner.flags(), infinite))
    spectra = coefficient_channels(params, key) > 0
    return choose_line(key, value.astype(np.float64), direction, step, seed, far=far, spectra=spectra)


def require_types(key: object, **numbers: object) -> None:
    """Raise PathreplayError unless ``key`` is a string and all ``numbers`` are whole numbers."""
    if not isinstance(key, str):
        raise PathreplayError(
            f"key is {shown(key)}; give the name of one parameter, for example 'wall.reflectance.data'"
        )
    for name, number in numbers.items():
        if isinstance(number, bool) or not isinstance(number, (int, np.integer)):
            raise PathreplayError(f"{name} is {shown(number)}; give a whole number")


def require_arguments(scene: object, sensor: int, seeds: int, spp: int, fd_spp: int, seed: int) -> None:
    """Raise PathreplayError for an unsuitable variant, scene or film, and for numbers out of range."""
    if mi.variant() is None or not dr.is_diff_v(mi.Float):
        raise PathreplayError(
            f"Variant '{mi.variant()}' has no derivatives; call mi.set_variant('llvm_ad_rgb') before loading the scene"
        )
    if type(scene).__name__ == "Scene" and isinstance(scene, mi.Object) and not isinstance(scene, mi.Scene):
        raise PathreplayError(
            f"scene belongs to another variant than the active one, '{mi.variant()}': load it again, or set its variant"
        )
    if not isinstance(scene, mi.Scene):
        raise PathreplayError(
            f"scene is a {type(scene).__name__}, not a mitsuba.Scene; load it with mi.load_file or load_dict"
        )
    if not 0 <= sensor < len(scene.sensors()):
        raise PathreplayError(f"Sensor {sensor} does not exist; the scene has {len(scene.sensors())}, counted from 0")
    if seeds > _MOST_SEEDS:
        raise PathreplayError(f"seeds is {shown(seeds)}; give at most {_MOST_SEEDS}, and more samples instead")
    if seeds < 1:
        raise PathreplayError(f"seeds is {seeds}; give at least 1")
    counts = {"spp": spp, "fd_spp": fd_spp}
    for name, count in counts.items():
        if count < 1:
            raise PathreplayError(f"{name} is {count}; give at least 1 sample per pixel")
    require_film(scene.sensors()[sensor], f"sensor {sensor}", counts)
    if seed < 0:
        raise PathreplayError(f"seed is {seed}; give a whole number of at least 0")
