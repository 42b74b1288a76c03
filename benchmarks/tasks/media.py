"""Task `media`: time x variance of gradients of media relative to `prbvolpath`, including the cost of learning."""

from __future__ import annotations

from ..measures.estimates import Versus, bias_share, mean_ratio
from ..measures.job import Job, Point, Record
from ..scenes.media import ALBEDO, ASYMMETRY, DENSITY, EXTINCTION
from ..tables import groups, markdown, median_seconds, method_cell

TITLE = "media"
TAKES = (18, 460)
RIVAL = "prbvolpath"
METHODS = (RIVAL, "score", "no branch", "listing")
# Unbiased in every scene, those with empty voxels too: so the tests say.
REFERENCE = "score"

#: Passes of a short optimisation, after which integrators forget what they learned: a longer one pays less for it.
RUN = 50

#: Scene, parameter, max_depth, rr_depth, runs. The dense core has no Russian roulette, for the longest paths.
#: The variance of a grid is a mean over its voxels, that of a single number needs more runs.
ROWS = (
    ("cloud", DENSITY, 64, 5, 1),
    ("dense-core", DENSITY, 96, 97, 1),
    ("room-with-cloud", DENSITY, 32, 5, 1),
    ("cloud-of-albedos", ALBEDO, 64, 5, 1),
    ("cloud", ASYMMETRY, 64, 5, 2),
    ("dark-cloud", DENSITY, 64, 5, 1),
    ("homogeneous", EXTINCTION, 64, 5, 2),
)
QUICK = (("cloud", DENSITY, 64, 5, 1), ("homogeneous", EXTINCTION, 64, 5, 1))
WHAT = {DENSITY: "density", ALBEDO: "albedo", ASYMMETRY: "g", EXTINCTION: "sigma_t"}


def jobs(quick: bool) -> list[Job]:
    """List one job for each row of the table."""
    return [
        Job(
            scene=scene,
            parameters=(parameter,),
            methods=METHODS,
            max_depth=max_depth,
            rr_depth=rr_depth,
            resolution=32,
            spp=16,
            rounds=4 if quick else runs * RUN,
            # Of kernels only, since what was learned is dropped; several, since a method may have two: with and without
            # something learned.
            warmup=3,
            restart=RUN,
            weights="wave",
            update=True,
            reference=REFERENCE,
        )
        for scene, parameter, max_depth, rr_depth, runs in (QUICK if quick else ROWS)
    ]


def table(record: Record) -> str:
    """Format each method relative to `prbvolpath`, with 95 % intervals."""
    header = ["scene", "gradient of", "method", "seconds (median)", "time ratio", "variance ratio"]
    header += ["along waves", "efficiency", "bias² / variance"]
    rows = [
        [point.scene, WHAT[point.parameters[0]], method_cell(point), *_cells(point, methods.get(RIVAL))]
        for methods in groups(record.points).values()
        for point in methods.values()
    ]
    return markdown(header, rows)


def _cells(point: Point, baseline: Point | None) -> list[str]:
    if point.error:
        return [point.error, *[""] * 5]
    cells = [median_seconds(point)]
    if baseline is None or baseline.error:
        cells += [""] * 4
    elif baseline is point:
        cells += ["1", "1", "1" if point.smooth_errors else "", "1"]
    else:
        cells.append(str((versus := Versus(point, baseline)).time()))
        smooth = bool(point.smooth_errors and baseline.smooth_errors)
        along = str(mean_ratio(point.smooth_errors, baseline.smooth_errors)) if smooth else ""
        finite = point.squared_errors and baseline.squared_errors
        cells += [str(versus.variance()), along, str(versus.efficiency())] if finite else [""] * 3
    told = point.bias_products and point.method != REFERENCE
    return [*cells, str(bias_share(point.bias_products, point.squared_errors)) if told else ""]
