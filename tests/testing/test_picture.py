"""Derivative images beside finite differences."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from driven import BALL, FLOOR, world
from pathreplay.errors import PathreplayError
from pathreplay.report.derivatives import derivatives_figure
from pathreplay.testing import derivative_images
from pathreplay.testing.command import pictured, require_picture


def test_both_images_agree_and_the_scene_is_as_before() -> None:
    scene = world()
    before = np.array(mi.traverse(scene)[FLOOR])
    images = derivative_images(scene, FLOOR, seeds=8, spp=256)
    assert images.gradient.shape == images.reference.shape == (8, 8, 3)
    # One direction for all channels: every pixel that sees the floor gets brighter.
    gap = np.abs(images.gradient - images.reference)
    assert gap.mean() < 0.02 * np.abs(images.reference).mean()
    assert (np.array(mi.traverse(scene)[FLOOR]) == before).all()


def test_a_wrong_gradient_is_seen() -> None:
    images = derivative_images(
        world(), "ball.to_world", seeds=4, spp=1024, integrator={"type": "pathreplay", "boundary": "none"}
    )
    edges = derivative_images(world(), "ball.to_world", seeds=4, spp=1024)
    gaps = [np.abs(each.gradient - each.reference).mean() for each in (images, edges)]
    assert gaps[0] > 2 * gaps[1]


def test_rows_are_drawn_in_every_format(tmp_path: Path) -> None:
    rows = pictured(world(), [FLOOR, BALL], seeds=2, spp=4)
    assert [row[0] for row in rows] == [FLOOR, BALL]
    png, svg, pdf = (derivatives_figure(rows, format) for format in ("png", "svg", "pdf"))
    assert png.startswith(b"\x89PNG") and pdf.startswith(b"%PDF") and b"finite differences" in svg
    black = [("nothing", "pathreplay", np.zeros((4, 5, 3)), np.zeros((4, 5, 3)))]
    assert derivatives_figure(black, "png").startswith(b"\x89PNG")


def test_other_formats_are_refused_before_anything_is_computed() -> None:
    with pytest.raises(PathreplayError, match=r"--picture is 'a.exr': give a name that ends in .png, .pdf or .svg"):
        require_picture(Path("a.exr"))
