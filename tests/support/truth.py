"""The cases of the truth tests (scene, parameter, direction), what is asserted of their gradients, and a table.

The objective is always J = Σ W·image with fixed random weights W in [0, 1): no two pixels can cancel by symmetry.
The parameter moves along a curve, value(t), and all gradients are dJ/dt at t = 0. What measures is pathreplay.testing.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.testing.objective import Move, Objective
from pathreplay.testing.statistics import gap
from pathreplay.testing.stencil import CENTRAL, Stencil
from pathreplay.testing.verdict import RESOLUTION, Z_LIMIT

RES = 16


@dataclass(frozen=True)
class Case:
    """A scene, a parameter of it, and how the parameter moves with t."""

    name: str
    scene: Callable[[], dict]
    key: str | tuple[str, ...]  # several: they move together
    move: Move
    depth: int = 4
    rr_depth: int = 3
    step: float = 1e-2  # of t, for finite differences
    spp: int = 64
    seeds: int = 12
    options: dict = field(default_factory=dict)  # of the integrator
    drivers: tuple[str, ...] = ("recorded", "replay")
    reference: str = "path"  # the plugin whose images are differenced
    reference_spp: int = 0  # of the reference; 0: spp
    stencil: Stencil = CENTRAL
    same_seed_spp: int = 16  # forward by reverse: they add up in another order, and rounding shows with more samples
    lanes: float | None = 1e-3  # largest relative L1 error lane by lane; None: random choices depend on the parameter


@dataclass(frozen=True)
class Row:
    """A line of the table: gradient against finite differences, in expectation, lane by lane, forward by reverse."""

    name: str
    driver: str
    gradient: float
    reference: float
    error: float  # standard error of their difference
    z: float  # their difference as a normal deviate
    lanes: float  # relative L1 error lane by lane; nan where not defined
    transpose: float  # |<W, Jv> - <J^T W, v>| / Σ|W·Jv|; nan where not defined


ROWS: list[Row] = []


def table() -> str:
    """All rows so far, as text."""
    lines = [f"{'cell':44s} {'driver':8s} {'gradient':>11s} {'fin. diff.':>11s} {'std. error':>10s} {'z':>6s} "
             f"{'lanes':>8s} {'fwd=rev':>8s}"]  # fmt: skip
    for r in ROWS:
        lines.append(
            f"{r.name:44s} {r.driver:8s} {r.gradient:+11.5f} {r.reference:+11.5f} {r.error:10.5f} {r.z:+6.2f} "
            f"{_number(r.lanes)} {_number(r.transpose)}"
        )
    return "\n".join(lines)


def _number(x: float) -> str:
    return f"{x:8.0e}" if np.isfinite(x) else f"{'-':>8s}"


def add(direction: float | list[float] = 1.0) -> Move:
    """value + t · direction, for scalars, colours and points; a direction for arrays is `random`."""
    return lambda value, t: value + t * (direction if isinstance(direction, float) else type(value)(direction))


def random(scale: float = 1.0, planes: int | None = None, seed: int = 7) -> Move:
    """tensor + t · (random positive numbers up to ``scale``), only in the first ``planes`` channels if given.

    All entries move the same way, so that the effects of neighbours do not cancel.
    """

    def move(value: Any, t: Any) -> Any:
        direction = np.random.default_rng(seed).uniform(0.2 * scale, scale, value.shape).astype(np.float32)
        if planes is not None:
            direction[..., planes:] = 0
        return value + t * mi.TensorXf(direction)

    return move


def translate(x: float, y: float, z: float) -> Move:
    """A transformation that is followed by a translation by t (x, y, z)."""
    return lambda value, t: mi.Transform4f().translate([x * t, y * t, z * t]) @ mi.Transform4f(value)


def rotate(x: float, y: float, z: float) -> Move:
    """A transformation that is followed by a rotation by t radians about the axis (x, y, z)."""
    return lambda value, t: mi.Transform4f().rotate([x, y, z], dr.rad2deg(t)) @ mi.Transform4f(value)


def tilt_vertices(scale: float = 0.3) -> Move:
    """Flat vertex positions (x, y, z), moved by t · scale · (y, 0, x z): normals turn, front against back."""

    def move(value: Any, t: Any) -> Any:
        x, y, z = (dr.gather(mi.Float, value, dr.arange(mi.UInt32, dr.width(value) // 3) * 3 + k) for k in range(3))
        moved = mi.Point3f(x + t * scale * y, y, z + t * scale * x * z)
        return dr.ravel(moved)

    return move


def turn_vertices(x: float, y: float, z: float) -> Move:
    """Flat vertex positions, rotated by t radians about the axis (x, y, z)."""

    def move(value: Any, t: Any) -> Any:
        return dr.ravel(mi.Transform4f().rotate([x, y, z], dr.rad2deg(t)) @ dr.unravel(mi.Point3f, value))

    return move


def translate_vertices(x: float, y: float, z: float) -> Move:
    """Flat vertex positions, translated by t (x, y, z)."""
    return lambda value, t: value + t * mi.Float(np.tile(np.array([x, y, z], np.float32), dr.width(value) // 3))


class Bench(Objective):
    """A loaded case."""

    def __init__(self, case: Case) -> None:
        gc.collect()  # scenes of earlier cases would be traced, too
        self.case = case
        scene = mi.load_dict(case.scene(), optimize=False)
        params = mi.traverse(scene)
        key, *others = (case.key,) if isinstance(case.key, str) else case.key
        super().__init__(scene, params, key, case.move)
        self.others = {name: dr.copy(params[name]) for name in others}
        self.weigh(np.random.default_rng(0).uniform(0, 1, (RES, RES, 3)).astype(np.float32) / RES**2)

    def integrator(self, plugin: str = "pathreplay", **options: Any) -> mi.Integrator:
        held = {"boundary": "none"} if plugin == "pathreplay" else {}  # most cases are about the interior alone
        made = mi.load_dict({"type": plugin, "max_depth": self.case.depth, **held, **options})
        if plugin.startswith("pathreplay"):
            made.rr_depth = dr.opaque(mi.UInt32, made.rr_depth)  # with roulette and without it: the same kernels
        return made

    def reference(self, count: int, spp: int = 0, first: int = 0, **options: Any) -> np.ndarray:
        """Finite differences of the weighted image by the case's reference, for so many seeds from ``first`` on."""
        case = self.case
        plain = self.integrator(case.reference, rr_depth=case.rr_depth, **options)
        spp = spp or case.reference_spp or case.spp
        images = (self.difference(plain, case.stencil, case.step, 1000 + first + k, spp) for k in range(1, count + 1))
        return np.array([self.dot(image) for image in images])

    def backwards(self, integrator: mi.Integrator, count: int = 0) -> np.ndarray:
        """The gradient by the reverse pass, for so many seeds (the case's)."""
        case = self.case
        return np.array([self.backward(integrator, k, case.spp) for k in range(1, (count or case.seeds) + 1)])

    def lane_error(self, integrator: mi.Integrator, h: float, seed: int, spp: int) -> float:
        """Relative L1 error, lane by lane, of the forward pass against differences with its own random numbers."""
        found, expected = self.forward(integrator, seed, spp), self.difference(integrator, CENTRAL, h, seed, spp)
        return float(np.abs(found - expected).sum() / np.abs(expected).sum())

    def put(self, t: mi.Float) -> None:
        for name, value in self.others.items():
            self.params[name] = self.move(value, t)
        super().put(t)

    def collect(self, t: mi.Float) -> float:
        for name in self.others:
            dr.enqueue(dr.ADMode.Backward, self.params[name])
        return super().collect(t)

    def release(self) -> None:
        """Detach the parameter: Dr.Jit traces virtual calls through all scenes alive, and trips over attached ones."""
        for name, value in {self.key: self.value, **self.others}.items():
            self.params[name] = value
        self.params.update()


def measure(case: Case) -> list[Row]:
    """Level 1 to 3 for all drivers of a case; the rows are kept for the table.

    Finite differences are of the case's reference; lane by lane they are of our own primal image, without Russian
    roulette, whose probabilities move with the parameters.
    """
    bench = Bench(case)
    try:
        reference = bench.reference(case.seeds)
        steady = bench.integrator(rr_depth=1000, **case.options)
        lanes = np.nan if case.lanes is None else bench.lane_error(steady, case.step, 1, case.spp)
        rows = []
        for driver in ("forward", *case.drivers):
            props = case.options if driver == "forward" else {"adjoint": driver, **case.options}
            integrator, transpose = bench.integrator(rr_depth=case.rr_depth, **props), np.nan
            if driver == "forward":
                images = (bench.forward(integrator, seed, case.spp) for seed in range(1, case.seeds + 1))
                g = np.array([bench.dot(image) for image in images])
            else:
                g = bench.backwards(integrator)
                same = bench.integrator(rr_depth=1000, **props)
                transpose = bench.transpose_error(steady, same, 1, case.same_seed_spp)
            rows.append(Row(case.name, driver, g.mean(), reference.mean(), *gap(g, reference)[1:], lanes, transpose))
    finally:
        bench.release()
    ROWS.extend(rows)
    return rows


# Same seed, forward against reverse: float32 rounding of the sums, relative to the sum of magnitudes.
TRANSPOSE_MAX = 1e-5


def hold(case: Case) -> None:
    """Measure a case and assert all three levels for every driver."""
    for row in measure(case):
        assert abs(row.z) < Z_LIMIT, row
        # An error of four times this share would pass.
        assert row.error < RESOLUTION * max(abs(row.gradient), abs(row.reference)), row
        if case.lanes is not None:
            assert row.lanes < case.lanes, row
        if row.driver != "forward":
            assert row.transpose < TRANSPOSE_MAX, row


# ------------------------------ Scene parts ------------------------------


def rgb(*value: float) -> dict:
    return {"type": "rgb", "value": list(value)}


def bitmap(values: np.ndarray) -> dict:
    return {"type": "bitmap", "raw": True, "data": mi.TensorXf(values.astype(np.float32)), "wrap_mode": "clamp"}


def noise(n: int, channels: int, low: float, high: float, seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).uniform(low, high, (n, n, channels))


def camera(origin: tuple[float, float, float] = (0, 0, 5), fov: float = 10, target: Any = (0, 0, 0)) -> dict:
    return {
        "type": "perspective",
        "fov": fov,
        "to_world": mi.ScalarTransform4f().look_at(origin=list(origin), target=list(target), up=[0, 1, 0]),
        "film": {"type": "hdrfilm", "width": RES, "height": RES, "rfilter": {"type": "box"}},
        "sampler": {"type": "independent"},
    }


def environment(n: int = 1024) -> dict:
    """A smooth environment map: no edges, so that everything under it can be differentiated lane by lane."""
    y, x = np.mgrid[0 : n // 2, 0:n] / n * 2 * np.pi
    waves = [1 + 0.5 * np.sin(x) * np.sin(y), 1 + 0.5 * np.cos(x + 1) * np.sin(y), 1 + 0.3 * np.sin(2 * x) * np.sin(y)]
    return {"type": "envmap", "bitmap": mi.Bitmap(np.stack(waves, -1).astype(np.float32))}


def lit_room(bsdf: dict, shape: str = "sphere", light: dict | None = None) -> dict:
    """An object on a diffuse floor under a rectangle light and a dim constant sky."""
    T = mi.ScalarTransform4f
    panel = {
        "type": "rectangle",
        "to_world": T().translate([0.5, 3, 1]).rotate([1, 0, 0], 90).scale([1.5, 1, 1]),
        "emitter": {"type": "area", "radiance": rgb(3, 2, 1)},
    }
    return {
        "type": "scene",
        "camera": camera(fov=22),
        "floor": {
            "type": "rectangle",
            "to_world": T().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale([5, 5, 1]),
            "bsdf": {"type": "diffuse", "reflectance": rgb(0.5, 0.6, 0.7)},
        },
        "object": {"type": shape, "bsdf": bsdf},
        "light": light or panel,
        "sky": {"type": "constant", "radiance": rgb(0.2, 0.2, 0.3)},
    }


def under_sky(bsdf: dict, shape: str = "sphere", origin: tuple[float, float, float] = (0, 0, 5), **props: Any) -> dict:
    """An object that fills the picture, under the smooth environment map."""
    return {
        "type": "scene",
        "camera": camera(origin),
        "sky": environment(),
        "object": {"type": shape, "bsdf": bsdf, **props},
    }
