"""The benchmark of light paths: gradients of both methods agree, designs get better, and tables compare."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest

from places import ROOT

sys.path.insert(0, str(ROOT))  # the benchmarks run from the checkout and are not installed

from benchmarks.inverse.caustic import CELLS, FLAT, TRANSPORT, Design, DesignLoop, picture
from benchmarks.inverse.search import followed
from benchmarks.measures.caustic import Caustic
from benchmarks.measures.job import Curve, Job, Machine, Point, Record
from benchmarks.measures.light_paths import LightPass
from benchmarks.scenes.caustics import FLOOR, LIT_ROOM
from benchmarks.tasks import particles
from benchmarks.tasks.particles import BASELINE, DEPTHS, HEIGHTS, OURS, SAMPLES, SECONDS, SMALL


def point(method: str, **facts) -> Point:
    known = {"scene": "caustic-room", "parameters": (HEIGHTS,), "max_depth": 4, "paths": 2**18, "seeds": (0, 1, 2)}
    known |= {"seconds": (), "squared_errors": (), "not_finite": (), "peak_mib": None, "measure": "light paths"}
    return Point(method=method, **known | facts)


def cells(*points: Point) -> list[list[str]]:
    machine = Machine("a processor", 2, 1, "Linux", "3.11", "3.9.1", "1.5.0", "0.1.0", "23.1.4", "llvm_ad_rgb")
    command = "pathreplay bench particles"
    record = Record("particles", command, "2026-01-01", "0123", (0.1, 0.2), (machine,), points)
    lines = [line for line in particles.table(record).splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines if not line.startswith("| ---")]


def test_both_methods_measure_the_same_gradient() -> None:
    """Up to the light beyond the border of the film, which `ptracer` leaves out."""
    job = Job(
        LIT_ROOM, (FLOOR,), (OURS, BASELINE), 4, 5, resolution=48, spp=64, rounds=3, measure="light paths",
        weights="wave",
    )  # fmt: skip
    measure = LightPass(job)
    rows = {method: [measure(method, seed)[1] for seed in range(3)] for method in job.methods}
    ours, theirs = (np.sum(of_method) for of_method in rows.values())
    assert 0 < theirs < ours < 1.03 * theirs
    assert len(measure.conclude(rows)[OURS]["squared_errors"]) == 3


def test_memory_grows_with_light_paths_where_it_does() -> None:
    sizes = SAMPLES.values()
    flat = [point(OURS, paths=n, peak_mib=200.0) for n in sizes]
    grows = [point(BASELINE, paths=n, peak_mib=100.0 + n / 1e4) for n in sizes]
    grows[-1] = replace(grows[-1], peak_mib=None, error="out of memory (of 8 GiB)")
    assert cells(*flat, *grows)[1:] == [
        ["100,000", "200", "110"],
        ["1,000,000", "200", "200"],
        ["10,000,000", "200", "out of memory (of 8 GiB)"],
        ["last / first", "1.00", "1.82"],
    ]


def test_times_are_those_of_the_fastest_rounds_and_ratios_those_of_ptracer_to_ours() -> None:
    ours = point(OURS, seconds=(2.0, 1.0, 3.0), squared_errors=(1.0, 1.0, 1.0))
    theirs = point(BASELINE, seconds=(4.0, 2.0, 6.0), squared_errors=(3e4, 3e4, 3e4), bias_products=(6e3, 6e3, 6e3))
    row = cells(ours, theirs)[1]
    assert row[:5] == ["heights of a slab", "4", "1.0000", "2.0000", "2.00"]
    assert row[5].startswith("3.0e+04 [") and row[6].startswith("6.0e+04 [") and row[7].startswith("0.20 [")
    failed = cells(ours, replace(theirs, error="died: SIGKILL"))[1]
    assert failed[2:] == ["1.0000", "died: SIGKILL", "", "", "", ""]


def test_designs_are_compared_after_equal_time() -> None:
    def design(method: str, last: float, rate: float) -> Point:
        run = Curve(rate, 4, 0, (0, 10, 20), (0.0, SECONDS / 2, SECONDS), (0.8, 0.4, last))
        worse = replace(run, rate=0.1, errors=(0.8, 0.8, 0.8))
        searched = [replace(curve, searched=True) for curve in (worse, run)]
        return point(f"{method}, {FLAT}", measure="caustic", curves=(*searched, run))

    rows = cells(design(OURS, 0.1, 1e-5), design(BASELINE, 0.3, 3e-5))[1:]
    assert [row[:6] for row in rows] == [
        [FLAT, method, rate, "4", "20", "0.8000"] for method, rate in ((OURS, "1e-05"), (BASELINE, "3e-05"))
    ]
    assert [row[-2:] for row in rows] == [["0.1000", "1.00"], ["0.3000", "3.00"]]
    failed = replace(design(BASELINE, 0.3, 3e-5), error="died: SIGKILL", curves=())
    assert cells(design(OURS, 0.1, 1e-5), failed)[2][2] == "raises: died: SIGKILL"


def test_methods_have_the_same_grid_and_take_turns() -> None:
    jobs = particles.jobs(quick=False)
    timed = [job for job in jobs if job.measure == "light paths" and len(job.methods) > 1]
    assert {job.max_depth for job in timed} == set(DEPTHS) and all(job.threads == 1 for job in jobs)
    assert all(job.rr_depth > job.max_depth for job in timed)
    for job in jobs:
        if job.measure == "caustic":
            assert [name.split(", ")[0] for name in job.methods] == [OURS, BASELINE] and len(job.rates) > 1


@pytest.fixture(scope="module")
def design() -> Design:
    return Design(CELLS[SMALL], 32)


def test_the_picture_has_a_ground_and_no_pixel_beyond_one_layer() -> None:
    image = picture(64)
    assert image.min() == pytest.approx(0.15) and image.max() == pytest.approx(1.15)


def test_transport_begins_closer_to_the_picture(design: Design) -> None:
    flat, transported = (design.error(design.start(kind)) for kind in (FLAT, TRANSPORT))
    assert 0 < transported < 0.7 * flat


@pytest.mark.parametrize("method", [OURS, BASELINE])
def test_a_design_reduces_its_error(method: str, design: Design) -> None:
    loop = DesignLoop(design, method, FLAT, rate=1e-4, spp=16, seed=0)
    curve = followed(loop, lambda values: design.error(values["heights"]), goal=0.9, budget=30)
    assert curve.errors[-1] < 0.9 * curve.errors[0]
    loop.reset()
    assert not loop.heights().any()


@pytest.mark.slow
def test_the_search_comes_first_and_its_best_point_runs() -> None:
    methods = (f"{OURS}, {FLAT}",)
    job = Job(
        SMALL, (), methods, 0, 0, resolution=16, spp=1, rounds=1, measure="caustic", budget=0.4, rates=(1e-9, 1e-4),
        samples=(4,),
    )  # fmt: skip
    measure = Caustic(job)
    measure(methods[0], seed=2**32 - 1)
    seconds, last = measure(methods[0], seed=0)
    curves = measure.conclude({methods[0]: []})[methods[0]]["curves"]
    assert [curve["searched"] for curve in curves] == [True, True, False]
    assert curves[-1]["errors"][-1] == last[0] and seconds >= 0.4
