"""Grids in a job: other resolutions, coarse to fine (also when stopped half-way), errors across resolutions, slices."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

import pathreplay
from pathreplay.errors import PathreplayError
from pathreplay.inverse.loop.loop import new_run
from pathreplay.inverse.parameters import grids
from pathreplay.inverse.problem.problem import errors_of
from pathreplay.jobs import make_config, optimize
from pathreplay.report.recovered import recovered_of
from room_job import JOB, TEXTURE, interrupt_at, room, run  # noqa: F401 (room: its folder, for every test)

GRID = np.random.default_rng(3).random((3, 4, 5, 2), np.float32)


@pytest.mark.parametrize("shape", [(6, 8, 10, 2), (7, 4, 3, 2), (1, 1, 1, 2), (3, 4, 5, 2)])
def test_resampling_is_mitsuba_s_lookup_at_the_new_centres(shape: tuple[int, ...]) -> None:
    z, y, x = (a.ravel() for a in np.indices(shape[:3]))
    it = mi.Interaction3f()
    centres = [(i.astype(np.float32) + 0.5) / n for i, n in ((x, shape[2]), (y, shape[1]), (z, shape[0]))]
    it.p = mi.Point3f(*(mi.Float(centre) for centre in centres))
    channels = [mi.VolumeGrid(np.ascontiguousarray(GRID[..., c : c + 1])) for c in range(2)]
    looked_up = [mi.load_dict({"type": "gridvolume", "grid": channel}).eval_1(it) for channel in channels]
    expected = np.stack([np.array(v) for v in looked_up], axis=-1).reshape(shape)
    # Dr.Jit's texture units round coordinates to float32; entries are below 1.
    assert grids.resampled(GRID, shape) == pytest.approx(expected, abs=1e-5)


def test_environment_maps_are_resampled_across_the_seam() -> None:
    """A map that begins at another column is resampled to the same map."""
    sky = np.array([[[0], [1], [2], [9]]], np.float32)
    found = grids.resampled(sky, (2, 8, 1), wraps=True)
    np.testing.assert_allclose(found[0, :, 0], [2.25, 0.25, 0.75, 1.25, 1.75, 3.75, 7.25, 6.75], rtol=1e-6)
    turned = grids.resampled(np.roll(sky, 1, axis=1), (2, 8, 1), wraps=True)
    np.testing.assert_allclose(turned, np.roll(found, 2, axis=1), rtol=1e-6)


def test_errors_of_a_coarse_environment_map_are_taken_across_the_seam() -> None:
    sky = np.random.default_rng(4).random((2, 4, 3), np.float32)
    fine = grids.resampled(sky, (4, 8, 3), wraps=True)
    light = {"type": "envmap", "bitmap": mi.Bitmap(fine)}
    small = {"type": "hdrfilm", "width": 4, "height": 4}
    scene = mi.load_dict({"type": "scene", "sky": light, "sensor": {"type": "perspective", "film": small}})
    view = pathreplay.View(target=np.ones((4, 4, 3), np.float32))
    problem = pathreplay.Problem(scene, {"sky.data": pathreplay.Parameter(resolutions=[4])}, view, eval_spp=1).built
    (variable,) = problem.variables
    problem = replace(problem, variables=(replace(variable, truth=fine),))
    assert errors_of(problem, {"sky.data": sky}) == {"sky.data": pytest.approx(0, abs=1e-6)}
    run = new_run(problem, problem.integrator)
    run.values = {"sky.data": sky}
    (item,) = recovered_of(problem, run)
    assert item.error() == pytest.approx(0, abs=1e-6) and item.relative_error() == pytest.approx(0, abs=1e-6)


def test_levels_keep_proportions_and_begin_in_their_iteration() -> None:
    levels = grids.make_levels((16, 32, 8, 1), [4, 16], [10])
    assert [levels.shape_at(t) for t in (0, 9.5, 10, 50)] == [(2, 4, 2, 1), (2, 4, 2, 1), (8, 16, 4, 1), (8, 16, 4, 1)]
    assert grids.make_levels((1, 32, 3), [8], []).shape_at(0) == (1, 8, 3)


def test_error_is_taken_at_the_resolution_of_the_truth() -> None:
    fine = grids.resampled(GRID, (6, 8, 10, 2))
    assert grids.rmse(GRID, fine) == 0
    assert grids.rmse(GRID, fine + 0.25) == pytest.approx(0.25, rel=1e-5)
    assert grids.comparable(GRID.shape, fine.shape)
    assert not grids.comparable((4, 4, 3), (4, 4, 1)) and not grids.comparable((3,), (6,))


def test_slices_cut_through_the_middle_with_y_up() -> None:
    volume = np.zeros((4, 6, 8, 1), np.float32)
    volume[2, 5, 1] = 1  # z in the middle, y on top, x at the left: in the first slice only
    picture = grids.slices(volume)
    assert picture.shape == (6, 8 + 1 + 8 + 1 + 4, 1)
    assert np.argwhere(picture[:, :, 0]).tolist() == [[0, 1]]
    volume[2, 5, 4] = 2  # x in the middle, too: also in the last slice, above the middle of z
    assert np.argwhere(grids.slices(volume)[:, :, 0] == 2).tolist() == [[0, 4], [0, 18 + 2]]


FINER = [{"key": TEXTURE, "initial": 0.5, "lower": 0.0, "upper": 1.0, "resolutions": [2, 3, 4], "refine_at": [2, 4]}]


def test_refined_grid_ends_in_its_last_resolution_with_the_truth_in_another() -> None:
    result = run(iterations=40, spp=8, parameters=FINER, optimizer={"iterate_averaging": False})
    assert result.parameters[TEXTURE].shape == (4, 4, 3)
    # Start 0.5, truth 2 x 2 texels from 0.06 to 0.9; what is left is noise (see test_recovers_texture_and_colour), more
    # of it than there, for 16 texels share the pixels of 4.
    assert result.errors[TEXTURE] < 0.1
    assert result.history[0].errors[TEXTURE] > 2.5 * result.errors[TEXTURE]
    assert result.history[-1].errors[TEXTURE] == pytest.approx(result.errors[TEXTURE], rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("stops", [(2, 3), (1, 4)])
def test_a_stop_around_a_refinement_changes_nothing(stops: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    whole = run(parameters=FINER)
    for stop_after in stops:
        with monkeypatch.context() as patch:
            interrupt_at(stop_after, patch)
            stopped = run(parameters=FINER)
        # The next resolution begins with the iteration that is named: after two iterations the first is still there.
        assert stopped.parameters[TEXTURE].shape == ((2, 2, 3) if stop_after <= 2 else (3, 3, 3))
        resumed = optimize(resume=stopped.folder, progress=False)
        assert resumed.parameters[TEXTURE] == pytest.approx(whole.parameters[TEXTURE], abs=1e-4)
        assert [e.loss for e in resumed.history] == pytest.approx([e.loss for e in whole.history], rel=1e-4)


def test_a_colour_has_no_resolutions(tmp_path: Path) -> None:
    colour = {"key": "floor.reflectance.value", "resolutions": [4]}
    with pytest.raises(PathreplayError, match=r"floor\.reflectance\.value' of shape \(3,\) is not a texture"):
        optimize(make_config({**JOB, "parameters": [colour]}), progress=False)
