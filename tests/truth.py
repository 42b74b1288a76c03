"""What the truth tests measure with: a case (scene, parameter, direction), three gradients of it, and a table.

The objective is always J = Σ W·image with fixed random weights W in [0, 1): no two pixels can cancel by symmetry.
The parameter moves along one direction, value(t), and all gradients are dJ/dt at t = 0.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

RES = 16
Move = Callable[[Any, Any], Any]  # (value at 0, t) -> value at t

# A finite difference Σ c f(o h) / h, as {o: c}. The wide ones, of third and fourth order, let h be a large share of the
# parameter: delta tracking decides anew at every h, so that its noise does not shrink with h as a smooth path's does.
CENTRAL = {-1: -0.5, 1: 0.5}
WIDE = {-2: 1 / 12, -1: -8 / 12, 1: 8 / 12, 2: -1 / 12}
UPWARD = {0: -11 / 6, 1: 3.0, 2: -1.5, 3: 1 / 3}  # where the parameter ends at its value


@dataclass(frozen=True)
class Case:
    """A scene, a parameter of it, and how the parameter moves with t."""

    name: str
    scene: Callable[[], dict]
    key: str
    move: Move
    depth: int = 4
    rr_depth: int = 3
    step: float = 1e-2  # of t, for finite differences
    spp: int = 64
    seeds: int = 12
    options: dict = field(default_factory=dict)  # of the integrator
    drivers: tuple[str, ...] = ("sweep", "replay")
    peer: bool = False  # measure Mitsuba's prb (prbvolpath beside volpath), too
    reference: str = "path"  # the plugin whose images are differenced
    reference_spp: int = 0  # of the reference; 0: spp
    stencil: dict[int, float] = field(default_factory=lambda: CENTRAL)
    lanes: float | None = 1e-3  # largest relative L1 error lane by lane; None: random choices depend on the parameter


@dataclass(frozen=True)
class Row:
    """A line of the table: gradient against finite differences, in expectation, lane by lane, forward by reverse."""

    name: str
    driver: str
    gradient: float
    reference: float
    error: float  # standard error of their difference
    z: float
    lanes: float  # relative L1 error lane by lane; nan where not defined
    transpose: float  # |<W, Jv> - <J^T W, v>| / Σ|W·Jv|; nan where not defined
    peer: float = np.nan  # Mitsuba's prb


ROWS: list[Row] = []
# Forward and reverse add up the same terms in another order; with more samples float32 rounding of the sums shows.
SAME_SEED_SPP = 16


def table() -> str:
    """All rows so far, as text."""
    lines = [f"{'cell':44s} {'driver':8s} {'gradient':>11s} {'fin. diff.':>11s} {'std. error':>10s} {'z':>6s} "
             f"{'lanes':>8s} {'fwd=rev':>8s} {'prb':>9s}"]  # fmt: skip
    for r in ROWS:
        lines.append(
            f"{r.name:44s} {r.driver:8s} {r.gradient:+11.5f} {r.reference:+11.5f} {r.error:10.5f} {r.z:+6.2f} "
            f"{_number(r.lanes)} {_number(r.transpose)} " + (f"{r.peer:+9.5f}" if np.isfinite(r.peer) else f"{'-':>9s}")
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


def translate_vertices(x: float, y: float, z: float) -> Move:
    """Flat vertex positions, translated by t (x, y, z)."""
    return lambda value, t: value + t * mi.Float(np.tile(np.array([x, y, z], np.float32), dr.width(value) // 3))


class Bench:
    """A loaded case: its scene, and gradients of it."""

    def __init__(self, case: Case) -> None:
        self.case = case
        self.scene = mi.load_dict(case.scene(), optimize=False)
        self.params = mi.traverse(self.scene)
        assert case.key in self.params, f"{case.key} is not among {list(self.params.keys())}"
        value = self.params[case.key]
        self.value = type(value)(value)
        self.weights = np.random.default_rng(0).uniform(0, 1, (RES, RES, 3)).astype(np.float32) / RES**2

    def integrator(self, plugin: str = "pathreplay", **options: Any) -> Any:
        return mi.load_dict({"type": plugin, "max_depth": self.case.depth, **options})

    def put(self, t: Any) -> None:
        self.params[self.case.key] = self.case.move(self.value, t)
        self.params.update()

    def image(self, integrator: Any, seed: int, t: float = 0.0, spp: int = 0) -> np.ndarray:
        self.put(dr.opaque(mi.Float, t))
        image = mi.render(self.scene, integrator=integrator, seed=seed, spp=spp or self.case.spp)
        return np.array(image).astype(np.float64)

    def difference(self, integrator: Any, seed: int, spp: int = 0, stencil: dict[int, float] = CENTRAL) -> np.ndarray:
        """Finite difference of the image with common random numbers."""
        h = self.case.step
        return sum(c * self.image(integrator, seed, o * h, spp) for o, c in stencil.items()) / h

    def forward(self, integrator: Any, seed: int, spp: int = 0) -> np.ndarray:
        t = dr.opaque(mi.Float, 0)
        dr.enable_grad(t)
        dr.set_grad(t, 1)
        self.put(t)
        dr.forward(t, dr.ADFlag.ClearEdges)
        return np.array(integrator.render_forward(self.scene, self.params, seed=seed, spp=spp or self.case.spp))

    def backward(self, integrator: Any, seed: int, spp: int = 0) -> float:
        t = dr.opaque(mi.Float, 0)
        dr.enable_grad(t)
        self.put(t)
        weights = mi.TensorXf(self.weights)
        integrator.render_backward(self.scene, self.params, weights, seed=seed, spp=spp or self.case.spp)
        value = self.params[self.case.key]
        dr.enqueue(dr.ADMode.Backward, value)
        dr.traverse(dr.ADMode.Backward)
        return float(dr.grad(t)[0])

    def release(self) -> None:
        """Detach the parameter: Dr.Jit traces virtual calls through all scenes alive, and trips over attached ones."""
        self.params[self.case.key] = self.value
        self.params.update()

    def dot(self, image: np.ndarray) -> float:
        return float((image * self.weights).sum())


def measure(case: Case) -> list[Row]:
    """Level 1 to 3 for all drivers of a case; the rows are kept for the table.

    Finite differences are of the case's reference; lane by lane they are of our own primal image, without Russian
    roulette, whose probabilities move with the parameters.
    """
    gc.collect()  # scenes of earlier cases would be traced, too
    bench = Bench(case)
    try:
        return _measure(case, bench)
    finally:
        bench.release()


def _measure(case: Case, bench: Bench) -> list[Row]:
    plain = bench.integrator(case.reference, rr_depth=case.rr_depth)
    seeds = range(1, case.seeds + 1)
    wide = {"spp": case.reference_spp, "stencil": case.stencil}
    reference = np.array([bench.dot(bench.difference(plain, 1000 + seed, **wide)) for seed in seeds])

    steady = bench.integrator(rr_depth=1000, **case.options)
    lanes = np.nan
    if case.lanes is not None:
        tangent = bench.forward(steady, 1)
        difference = bench.difference(steady, 1)
        lanes = float(np.abs(tangent - difference).sum() / np.abs(difference).sum())

    peer = _peer(bench, seeds) if case.peer else np.nan
    rows = []
    for driver in ("forward", *case.drivers):
        props = {} if driver == "forward" else {"driver": driver}
        integrator = bench.integrator(rr_depth=case.rr_depth, **props, **case.options)
        if driver == "forward":
            g = np.array([bench.dot(bench.forward(integrator, seed)) for seed in seeds])
            transpose = np.nan
        else:
            g = np.array([bench.backward(integrator, seed) for seed in seeds])
            same = bench.integrator(rr_depth=1000, driver=driver, **case.options)
            tangent = bench.forward(steady, 1, SAME_SEED_SPP)
            transpose = abs(bench.dot(tangent) - bench.backward(same, 1, SAME_SEED_SPP)) / bench.dot(np.abs(tangent))
        error = float(np.sqrt((g.var(ddof=1) + reference.var(ddof=1)) / case.seeds))
        z = float((g.mean() - reference.mean()) / error)
        rows.append(Row(case.name, driver, g.mean(), reference.mean(), error, z, lanes, transpose, peer))
    ROWS.extend(rows)
    return rows


def _peer(bench: Bench, seeds: range) -> float:
    """Mean gradient by Mitsuba's prb or prbvolpath; nan where it refuses."""
    prb = bench.integrator("prb" if bench.case.reference == "path" else "prbvolpath", rr_depth=bench.case.rr_depth)
    try:
        return float(np.mean([bench.backward(prb, seed) for seed in seeds]))
    except RuntimeError:
        return np.nan


# Beyond four standard errors an honest gradient falls once in ten thousand cells.
Z_MAX = 4.0
# A gradient must be resolved to count: a standard error of this share of it lets an error of four times that pass.
RESOLVED = 0.1
# Same seed, forward against reverse: float32 rounding of the sums, relative to the sum of magnitudes.
TRANSPOSE_MAX = 1e-5


def hold(case: Case, transpose: float = TRANSPOSE_MAX) -> None:
    """Measure a case and assert all three levels for every driver."""
    for row in measure(case):
        assert abs(row.z) < Z_MAX, row
        assert row.error < RESOLVED * max(abs(row.gradient), abs(row.reference)), row
        if case.lanes is not None:
            assert row.lanes < case.lanes, row
        if row.driver != "forward":
            assert row.transpose < transpose, row


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
