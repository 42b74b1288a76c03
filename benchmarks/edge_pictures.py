"""Draws the figures of docs/boundary.md: how edges are searched, and derivatives beside finite differences.

    python -m benchmarks.edge_pictures [FOLDER]

The command writes `edges-seen.svg` and `edges-derivatives.png` to the folder (default: docs/images). It takes some
minutes.
"""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import drjit as dr
import matplotlib as mpl
import mitsuba as mi
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Polygon, Rectangle

from pathreplay.platform.backend import set_variant
from pathreplay.testing.objective import Objective
from pathreplay.testing.stencil import CENTRAL

from .plots import BLUE, GREY, IMAGES, ORANGE, RED

RESOLUTION = 96
COLUMNS = ("picture", "finite differences", "boundary='all'", "boundary='none'")
BRIGHTEST = 98.5
"""Percentile of the absolute differences that bounds the colour scale."""

# ------------------------------ Derivatives ------------------------------


class Motion(NamedTuple):
    """A motion, and its numbers of samples."""

    title: str
    build: Callable[[], dict[str, Any]]
    key: str
    move: Callable[[Any, Any], Any]
    step: float
    depth: int
    spp: int  # of finite differences
    boundary_spp: int


def shift(x: float, y: float, z: float) -> Callable[[Any, Any], Any]:
    """Translation of vertices or of a transform by t times the vector."""

    def move(value: Any, t: Any) -> Any:
        by = mi.Transform4f().translate(mi.Vector3f(x, y, z) * t)
        if isinstance(value, mi.Float):
            return dr.ravel(by @ dr.unravel(mi.Point3f, value))
        return by @ mi.Transform4f(value)

    return move


def film() -> dict[str, Any]:
    return {"type": "hdrfilm", "width": RESOLUTION, "height": RESOLUTION, "rfilter": {"type": "box"}}


def cornell_box() -> dict[str, Any]:
    room = mi.cornell_box()
    room["sensor"]["film"] = film()
    return room


def glass_ball() -> dict[str, Any]:
    """A glass ball in front of an area light and a textured wall."""
    T, rgb = mi.ScalarTransform4f, lambda *value: {"type": "rgb", "value": list(value)}
    texels = np.random.default_rng(4).uniform(0.05, 0.8, (8, 8, 3)).astype(np.float32)
    paint = {"type": "bitmap", "raw": True, "data": mi.TensorXf(texels), "filter_type": "bilinear"}
    glow = {"type": "area", "radiance": rgb(1.5, 1.5, 1.5)}
    wall = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": paint}}
    return {
        "type": "scene",
        "camera": {"type": "perspective", "fov": 35, "to_world": T().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
                   "film": film()},
        "ball": {"type": "sphere", "radius": 0.8, "bsdf": {"type": "dielectric_ad", "int_ior": 1.5}},
        "wall": {"type": "rectangle", "to_world": T().translate([0, 0, -2]).scale([4, 4, 1]), "bsdf": wall},
        "lamp": {"type": "rectangle", "to_world": T().translate([0.4, 0.3, -1.7]).scale([0.5, 0.4, 1]),
                 "emitter": glow},
        "sky": {"type": "constant", "radiance": 0.6},
    }  # fmt: skip


BOX = "small-box.vertex_positions"
MOTIONS = (
    Motion("the small box moves to the right", cornell_box, BOX, shift(1, 0, 0), 0.01, 4, 4096, 1024),
    Motion("the camera moves to the right", cornell_box, "sensor.to_world", shift(1, 0, 0), 0.005, 4, 2048, 512),
    Motion("the index of the ball grows", glass_ball, "ball.bsdf.eta", lambda eta, t: eta + t, 0.005, 8, 2048, 512),
)


def derivatives(motion: Motion) -> list[np.ndarray]:
    """Image, finite differences, and our derivatives with and without boundary terms."""
    gc.collect()
    loaded = mi.load_dict(motion.build(), optimize=False)
    objective = Objective(loaded, mi.traverse(loaded), motion.key, motion.move)
    limits = {"max_depth": motion.depth, "rr_depth": 100}
    plain = mi.load_dict({"type": "path"} | limits)
    images = [
        objective.image(plain, 1, motion.spp),
        objective.difference(plain, CENTRAL, motion.step, 2, motion.spp),
        *(
            objective.forward(mi.load_dict({"type": "pathreplay", "boundary": edges} | limits), 3, motion.boundary_spp)
            for edges in ("all", "none")
        ),
    ]
    objective.put(mi.Float(0))
    return images


def draw_derivatives() -> Figure:
    """A row for each motion, with a common colour scale: red is brighter, blue is darker."""
    figure = Figure(figsize=(9.6, 2.5 * len(MOTIONS) + 0.3), layout="constrained")
    rows = figure.subplots(len(MOTIONS), len(COLUMNS))
    for motion, row in zip(MOTIONS, rows, strict=True):
        picture, *rest = derivatives(motion)
        greys = [image.mean(-1) for image in rest]
        limit = float(np.percentile(np.abs(greys[0]), BRIGHTEST))
        row[0].imshow(
            np.array(
                mi.Bitmap(picture.astype(np.float32)).convert(srgb_gamma=True, component_format=mi.Struct.Type.UInt8)
            )
        )
        row[0].set_ylabel(motion.title)
        for axes, image in zip(row[1:], greys, strict=True):
            axes.imshow(image, cmap="RdBu_r", vmin=-limit, vmax=limit)
        for axes in row:
            axes.set(xticks=[], yticks=[])
    for axes, title in zip(rows[0], COLUMNS, strict=True):
        axes.set_title(title, fontsize=10)
    return figure


# ------------------------------ Where edges are looked for ------------------------------


def draw_seen() -> Figure:
    """Three drawings: a segment on the film, a segment in the samples of a light, and an arc of directions."""
    figure = Figure(figsize=(9.6, 3.6), layout="constrained")
    panels = figure.subplots(1, 3)
    for axes, draw in zip(panels, (_film_line, _square_line, _arc), strict=True):
        axes.set(aspect="equal", xlim=(0, 10), ylim=(0, 10.6))
        axes.axis("off")
        draw(axes)
    return figure


def _label(axes: Axes, x: float, y: float, text: str, colour: str = "black", **more: Any) -> None:
    axes.text(x, y, text, color=colour, fontsize=9, ha="center", va="center", **more)


def _ray(axes: Axes, begin: tuple[float, float], end: tuple[float, float], colour: str) -> None:
    axes.annotate(
        "", end, begin, arrowprops={"arrowstyle": "->", "color": colour, "linewidth": 1.3, "shrinkA": 0, "shrinkB": 0}
    )


def _ends(axes: Axes, a: tuple[float, float], b: tuple[float, float]) -> None:
    """The segment that is searched for an edge: the end on the far side is blue, the near end red."""
    axes.plot([a[0], b[0]], [a[1], b[1]], color="black", linewidth=1.6, zorder=3)
    axes.plot(*a, "o", color=RED, markersize=6, zorder=4)
    axes.plot(*b, "o", color=BLUE, markersize=6, zorder=4)


def _film_line(axes: Axes) -> None:
    _label(axes, 5, 10.2, "film: what the camera sees", weight="bold")
    axes.add_patch(Rectangle((1, 1.6), 8, 7.2, facecolor="white", edgecolor=GREY))
    for k in range(1, 8):
        axes.plot([1 + k, 1 + k], [1.6, 8.8], color="#eeeeee", linewidth=0.8, zorder=0)
        axes.plot([1, 9], [1.6 + 0.9 * k] * 2, color="#eeeeee", linewidth=0.8, zorder=0)
    axes.add_patch(Ellipse((3.9, 5.1), 4.2, 4.6, angle=20, facecolor="#f3d9b1", edgecolor=ORANGE, linewidth=1.5))
    _ends(axes, (5.3, 5.9), (6.8, 6.5))
    _label(axes, 3.7, 5, "near")
    _label(axes, 7.6, 3, "far")
    _label(axes, 7.3, 7.6, "line of\nhalf a pixel")
    _ray(axes, (1.9, 2.5), (3.2, 2.5), GREY)
    _label(axes, 2.5, 2.1, "moves", GREY)
    _label(axes, 5, 0.7, "silhouettes, creases, borders of lamps,\nalso in mirrors and through glass")


def _square_line(axes: Axes) -> None:
    _label(axes, 5, 10.2, "samples of a lamp: shadows", weight="bold")
    axes.plot([0.6, 9.4], [1.7, 1.7], color=GREY, linewidth=2)
    axes.plot([2.2, 8.2], [9, 9], color=ORANGE, linewidth=4)
    axes.plot([1.6, 5.2], [5.2, 5.2], color="black", linewidth=4)
    x = (5, 1.7)
    for u, end, colour in ((4.4, 5.2, RED), (6.2, 9.0, BLUE)):
        top = (x[0] + (u - x[0]) * (end - x[1]) / (9 - x[1]), end)
        _ray(axes, x, top, colour)
    _ends(axes, (4.4, 9), (6.2, 9))
    axes.plot([x[0], x[0] + (5.2 - x[0]) * 7.3 / 3.5], [x[1], 9], color=GREY, linewidth=0.9, linestyle="--")
    axes.plot(*x, "o", color="black", markersize=5)
    _label(axes, 5.4, 1.2, "x")
    _label(axes, 8.9, 9.0, "lamp", ORANGE)
    _label(axes, 0.9, 5.7, "near")
    _label(axes, 2.9, 7.6, "in shadow", RED)
    _label(axes, 7.2, 6.6, "lit", BLUE)
    _label(axes, 5, 0.4, "a line in the unit square of the lamp's samples,\nseen from a point x that scatters")


def _arc(axes: Axes) -> None:
    _label(axes, 5, 10.2, "arcs of directions: indirect light", weight="bold")
    axes.plot([0.6, 9.4], [1.7, 1.7], color=GREY, linewidth=2)
    x, reach = np.array((5, 1.7)), 4.0
    turn = np.linspace(0, np.pi, 60)
    axes.plot(x[0] + reach * np.cos(turn), x[1] + reach * np.sin(turn), color="#dddddd", linewidth=1)
    axes.add_patch(Polygon([(1.2, 5.2), (3.6, 7.4), (2.2, 8.4), (0.2, 6.4)], facecolor="#f3d9b1", edgecolor=ORANGE))
    axes.plot([9.3, 9.3], [1.7, 9.3], color=GREY, linewidth=2)
    axes.plot([1, 9.3], [9.3, 9.3], color=GREY, linewidth=2)
    edge = np.arctan2(7.4 - x[1], 3.6 - x[0])
    near, far = edge + 0.17, edge - 0.17
    arc = np.linspace(near, far, 20)
    axes.plot(x[0] + reach * np.cos(arc), x[1] + reach * np.sin(arc), color="black", linewidth=1.8, zorder=3)
    for angle, length, colour in ((near, 5.5, RED), (far, 7.7, BLUE)):
        d = np.array((np.cos(angle), np.sin(angle)))
        _ray(axes, tuple(x), tuple(x + length * d), colour)
        axes.plot(*(x + reach * d), "o", color=colour, markersize=6, zorder=4)
    axes.plot(*x, "o", color="black", markersize=5)
    _label(axes, 5.4, 1.2, "x")
    _label(axes, 1.9, 6.8, "near")
    _label(axes, 5.6, 8.8, "far")
    _label(axes, 7.0, 4.6, "around a\nsample of\nthe BSDF")
    _label(axes, 5, 0.4, "what stands before what,\nseen from a point x that scatters")


def main(folder: Path = IMAGES) -> None:
    """Draw both figures."""
    set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    folder.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context({"svg.hashsalt": "pathreplay", "font.size": 9}):
        draw_seen().savefig(folder / "edges-seen.svg", metadata={"Date": None})
        draw_derivatives().savefig(folder / "edges-derivatives.png", dpi=110)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
