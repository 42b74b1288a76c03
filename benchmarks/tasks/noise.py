"""Task `noise`: error of attached path replay relative to the sweep, by number of bounces, noise and kind of replay.

Two bent sheets face each other under a smooth environment. The image is differentiated with respect to the vertices of
one sheet. Both drivers trace the same paths. The error |g_replay - g_sweep| / |g_sweep| therefore has only two causes.
The first is the noise ε added to the Jacobians. Its contribution grows with ε, has mean zero and averages out. The
second is rounding, magnified by the inverses of the Jacobians. This contribution grows as ε shrinks, and does not
average out. The sweep inverts no Jacobians; its rounding error is 1e-6.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.stats import gmean

from ..measures.estimates import Versus
from ..measures.job import Job, Point, Record
from ..measures.replay_error import KINDS, NOISES, RECOVERIES, SWEEP
from ..tables import groups, markdown

TITLE = "noise"
TAKES = (7, 130)
KEY = "low.vertex_positions"

NOISY = tuple(name for name, (noise, *_) in RECOVERIES.items() if noise)
QUIET = tuple(name for name, (noise, *_) in RECOVERIES.items() if not noise and name.startswith("directions"))
QUIET += ("everywhere, float32, 0",)

#: Scene, bounces, methods.
ROWS = (
    ("glass panes", 15, QUIET),
    ("glass before a diffuse wall", 9, NOISY),
    *(("diffuse sheets", bounces, NOISY) for bounces in (2, 3, 5, 9)),
    *(("rough metal sheets", bounces, NOISY) for bounces in (3, 9)),
)
QUICK = (("diffuse sheets", 2, ("everywhere, float32, 0.01", "directions, float64, 0.01")),)


def jobs(quick: bool) -> list[Job]:
    """List one job for each scene and number of bounces."""
    return [
        Job(
            scene=scene,
            parameters=(KEY,),
            methods=(SWEEP, *methods),
            max_depth=bounces + 1,
            rr_depth=10_000,
            resolution=16,
            spp=16,
            rounds=2 if quick else 3,
            warmup=1,
            measure="noise",
        )
        for scene, bounces, methods in (QUICK if quick else ROWS)
    ]


def table(record: Record) -> str:
    """Format errors by scene, bounces and kind (rows) and noise (columns), the sweep's Monte Carlo error, and time."""
    levels = [level for level in (*NOISES, 0) if any(p.method.endswith(f", {level:g}") for p in record.points)]
    rows = []
    for (scene, _, depth, _), found in groups(record.points).items():
        sweep = found.get(SWEEP)
        for kind in KINDS:
            points = [found.get(f"{kind}, {level:g}") for level in levels]
            if any(points):
                cells = [kind, *map(_error, points), _error(sweep), _slowness(points, sweep)]
                rows.append([scene, str(depth - 1), *cells])
    header = ["scene", "bounces", "noise added to", *(f"{level:g}" for level in levels), "Monte Carlo", "time / sweep"]
    return markdown(header, rows)


def _error(point: Point | None) -> str:
    if point is None:
        return ""
    if point.error:
        return point.error
    finite = np.isfinite(point.values).all() and len(point.values) > 0
    return f"{gmean(point.values):.1e}" if finite else "not finite"


def _slowness(points: Iterable[Point | None], sweep: Point | None) -> str:
    """Return the time of the slowest noise level relative to the sweep."""
    if sweep is None or sweep.error:
        return ""
    ratios = [Versus(point, sweep).time().value for point in points if point and not point.error]
    return f"{max(ratios):.1f}" if ratios else ""
