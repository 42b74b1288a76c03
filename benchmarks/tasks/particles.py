"""Task `particles`: gradients of light paths and a caustic design, relative to plain AD of `ptracer`."""

from __future__ import annotations

import statistics as st
from collections.abc import Iterable, Sequence

import numpy as np

from ..inverse.caustic import CELLS, FLAT, TRANSPORT
from ..measures.caustic import chosen
from ..measures.estimates import Estimate, Versus, bias_share, mean_ratio
from ..measures.job import Curve, Job, Point, Record
from ..measures.methods import parts
from ..scenes.caustics import CAUSTIC_ROOM, FLOOR, HEIGHTS, LAMP, LIT_ROOM
from ..tables import groups, markdown, pooled
from .depth import fastest, memory_or_error, seconds_cell

TITLE = "particles"
TAKES = (60, 3700)
OURS, BASELINE = "particles", "ptracer"

#: Memory: light paths of a pass, as samples per pixel of 50 x 50 pixels.
SAMPLES = {40: 10**5, 400: 10**6, 4000: 10**7}
QUICK_SAMPLES = (40,)
#: Time and variance: scene and parameter, and their name in the table.
CASES = {
    (CAUSTIC_ROOM, HEIGHTS): "heights of a slab",
    (LIT_ROOM, FLOOR): "floor texture",
    (LIT_ROOM, LAMP): "lamp position",
}
DEPTHS, QUICK_DEPTHS = (4, 16, 48), (4,)
#: Caustic designs: the grid of learning rates (in widths of the slab) and samples per pixel, and processor seconds.
SMALL, LARGE = CELLS
RATES, QUICK_RATES = (1e-7, 3e-7, 3e-6, 3e-5), (3e-5,)
DESIGN_SAMPLES, QUICK_DESIGN_SAMPLES = (4, 32), (4,)
SECONDS, QUICK_SECONDS = 180.0, 2.0
#: Fractions of these seconds.
MOMENTS = (0.1, 0.3, 1.0)


def jobs(quick: bool) -> list[Job]:
    """List the jobs of memory, one for each method, and those of time and of designs, in which methods take turns.

    Each process has one thread. Russian roulette starts beyond the last vertex, so that all paths in the closed rooms
    are as long as ``max_depth`` allows, and because it biases the gradient of `ptracer`.
    """
    memory = [
        _job(CAUSTIC_ROOM, HEIGHTS, (method,), DEPTHS[0], resolution=50, spp=spp, rounds=1, warmup=0)
        for spp in (QUICK_SAMPLES if quick else SAMPLES)
        for method in (OURS, BASELINE)
    ]
    time = [
        _job(
            scene,
            key,
            (OURS, BASELINE),
            depth,
            resolution=32,
            spp=16 if quick else 256,
            rounds=3 if quick else 8,
            warmup=1,
        )
        for scene, key in CASES
        for depth in (QUICK_DEPTHS if quick else DEPTHS)
    ]
    return memory + time + [_design(start, quick) for start in (TRANSPORT, FLAT)]


def _design(start: str, quick: bool) -> Job:
    return Job(
        scene=SMALL if quick else LARGE,
        parameters=(),
        methods=tuple(f"{method}, {start}" for method in (OURS, BASELINE)),
        max_depth=0,  # see the problem
        rr_depth=0,
        resolution=32 if quick else 128,
        spp=1,
        rounds=1,
        warmup=1,
        threads=1,
        measure="caustic",
        budget=QUICK_SECONDS if quick else SECONDS,
        rates=QUICK_RATES if quick else RATES,
        samples=QUICK_DESIGN_SAMPLES if quick else DESIGN_SAMPLES,
    )


def _job(
    scene: str, key: str, methods: tuple[str, ...], depth: int, resolution: int, spp: int, rounds: int, warmup: int
) -> Job:
    return Job(
        scene=scene,
        parameters=(key,),
        methods=methods,
        max_depth=depth,
        rr_depth=depth + 1,
        resolution=resolution,
        spp=spp,
        rounds=rounds,
        warmup=warmup,
        threads=1,
        measure="light paths",
        weights="wave",
        reference=OURS if len(methods) > 1 else None,
    )


def table(record: Record) -> str:
    """Format a table of memory, one of time and variance, and one of caustic designs."""
    points = pooled(record.points)
    designs = [point for point in points if point.measure == "caustic"]
    passes = [point for point in points if point.measure != "caustic"]
    memory = [point for point in passes if point.paths in SAMPLES.values()]
    timed = [point for point in passes if point.paths not in SAMPLES.values()]
    tables = ((_memory, memory), (_time, timed), (_designs, designs))
    return "\n\n".join(formatted(of) for formatted, of in tables if of)


def _memory(points: Iterable[Point]) -> str:
    """Format peak memory by the number of light paths and method, and its growth."""
    cells = {(point.paths, point.method): point for point in points}
    methods, sizes = (list(dict.fromkeys(values)) for values in zip(*((m, n) for n, m in cells), strict=True))
    rows = [[f"{n:,}", *(memory_or_error(cells.get((n, method))) for method in methods)] for n in sorted(sizes)]
    return markdown(
        ["light paths: MiB", *methods],
        [*rows, ["last / first", *(_growth(cells[n, method] for n in sorted(sizes)) for method in methods)]],
    )


def _growth(points: Iterable[Point]) -> str:
    peaks = [point.peak_mib for point in points if not point.error and point.peak_mib]
    return f"{peaks[-1] / peaks[0]:.2f}" if peaks else ""


def _time(points: Iterable[Point]) -> str:
    """Format seconds, and the ratios of time, variance and their product, by parameter and depth."""
    header = ["gradient of", "depth", f"{OURS}: seconds", f"{BASELINE}: seconds", "time", "variance", "time x variance"]
    header += [f"{BASELINE}: bias² / variance"]
    rows = [
        [CASES.get((key.scene, key.parameters[0]), key.scene), str(key.max_depth), *_cells(of_method)]
        for key, of_method in groups(points).items()
    ]
    return markdown(header, rows)


def _cells(of_method: dict[str, Point]) -> list[str]:
    """Return the cells of a row; ratios are those of `ptracer` to ours."""
    ours, baseline = of_method.get(OURS), of_method.get(BASELINE)
    cells = [seconds_cell(ours), seconds_cell(baseline)]
    if ours is None or baseline is None or ours.error or baseline.error:
        return [*cells, "", "", "", ""]
    cells.append(f"{fastest(baseline) / fastest(ours):.2f}")
    if not (ours.squared_errors and baseline.squared_errors):
        return [*cells, "", "", ""]
    told = bias_share(baseline.bias_products, baseline.squared_errors) if baseline.bias_products else ""
    variance = mean_ratio(baseline.squared_errors, ours.squared_errors)
    return [*cells, _brief(variance), _brief(Versus(ours, baseline).efficiency()), str(told)]


def _brief(estimate: Estimate) -> str:
    """Format an estimate that may span many orders of magnitude."""
    return str(estimate) if estimate.high < 1000 else f"{estimate.value:.1e} [{estimate.low:.1e}, {estimate.high:.1e}]"


def _designs(points: Sequence[Point]) -> str:
    """Format the error of the image by time, for the chosen rate and samples of each start and method."""
    header = ["start", "method", "rate", "spp", "iterations", "first error"]
    header += [f"error after {SECONDS * part:g} s" for part in MOMENTS] + [f"{BASELINE} / {OURS}"]
    return markdown(header, [_design_row(point, points) for point in points])


def _design_row(point: Point, points: Sequence[Point]) -> list[str]:
    method, start = parts(point.method)
    if point.error or not _runs(point):
        return [start, method, f"raises: {point.error}", *[""] * (4 + len(MOMENTS))]
    choice, run = chosen(list(point.curves)), _runs(point)[0]
    ours = next((other for other in points if other.method == f"{OURS}, {start}" and _runs(other)), None)
    ratio = "" if ours is None else f"{_last(point) / _last(ours):.2f}"
    moments = [f"{error_after(run, SECONDS * part):.4f}" for part in MOMENTS]
    return [
        start,
        method,
        f"{choice.rate:g}",
        str(choice.spp),
        str(run.steps[-1]),
        f"{run.errors[0]:.4f}",
        *moments,
        ratio,
    ]


def _runs(point: Point) -> list[Curve]:
    return [curve for curve in point.curves if not curve.searched]


def _last(point: Point) -> float:
    """Return the median over seeds of the last error."""
    return st.median(curve.errors[-1] for curve in _runs(point))


def error_after(curve: Curve, seconds: float) -> float:
    """Return the error after a time, linear in time between two measurements; after the last one, that."""
    return float(np.interp(seconds, curve.seconds, curve.errors))
