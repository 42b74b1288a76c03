"""Derivative images beside finite differences."""

from __future__ import annotations

from pathlib import Path
from typing import Any

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
        world(), "ball.to_world", seeds=4, spp=256, integrator={"type": "pathreplay", "boundary": "none"}
    )
    edges = derivative_images(world(), "ball.to_world", seeds=4, spp=256)
    gaps = [np.abs(each.gradient - each.reference).mean() for each in (images, edges)]
    assert gaps[0] > 2 * gaps[1]


def test_rows_are_drawn_in_every_format(tmp_path: Path) -> None:
    rows = pictured(world(), [FLOOR, BALL], seeds=2, spp=4)
    assert [row[0] for row in rows] == [FLOOR, BALL]
    png, svg, pdf = (derivatives_figure(rows, format) for format in ("png", "svg", "pdf"))
    assert png.startswith(b"\x89PNG") and pdf.startswith(b"%PDF") and b"finite differences" in svg
    black = [("nothing", "pathreplay", np.zeros((4, 5, 3)), np.zeros((4, 5, 3)))]
    assert derivatives_figure(black, "png").startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"integrator": "prbvolpath"}, f"'prbvolpath' cannot differentiate '{FLOOR}' in forward mode: "),
        ({"sensor": 9}, "Sensor 9 does not exist"),
        ({"seeds": 0}, "seeds is 0; give at least 1"),
        ({"seeds": 2.5}, "seeds is 2.5; give a whole number"),
        ({"fd_spp": 0}, "fd_spp is 0; give at least 1 sample per pixel"),
    ],
)
def test_unusable_arguments_are_refused_in_one_line(options: dict[str, Any], message: str) -> None:
    with pytest.raises(PathreplayError, match=message) as error:
        derivative_images(world(), FLOOR, **{"seeds": 1, "spp": 1, **options})
    assert "\n" not in str(error.value)


def test_other_formats_are_refused_before_anything_is_computed() -> None:
    with pytest.raises(PathreplayError, match=r"--picture is 'a.exr': give a name that ends in .png, .pdf or .svg"):
        require_picture(Path("a.exr"))
