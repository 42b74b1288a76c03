"""The progress panel of a run in a notebook, as HTML without scripts."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pathreplay.report.pages.document import template
from pathreplay.report.pages.page import View, thinned

WIDTH, HEIGHT, BORDER = 480, 120, 4
"""Size of the curve in pixels."""
MOST_POINTS = 240


@dataclass(frozen=True)
class Panel:
    """All content of the panel, from top to bottom. Texts are shown literally."""

    title: str
    status: str
    done: int = 0
    wanted: int = 0
    left: str = ""
    """Estimated remaining time, in words."""
    losses: tuple[float, ...] = ()
    views: tuple[View, ...] = ()
    notes: tuple[str, ...] = ()

    def html(self) -> str:
        """Render the panel as HTML. The loss curve is subsampled, and logarithmic if all losses are positive."""
        losses = [self.losses[i] for i in thinned(len(self.losses), MOST_POINTS)]
        log = bool(losses) and min(losses) > 0
        return template("panel.html.j2").render(
            panel=self, points=_points([math.log(x) for x in losses] if log else losses),
            log=log, width=WIDTH, height=HEIGHT,
        )  # fmt: skip


def _points(values: list[float]) -> str:
    """Return the points of an SVG polyline through the values, in pixels; "" for fewer than two values."""
    if len(values) < 2:
        return ""
    low, high = min(values), max(values)
    across, up = (WIDTH - 2 * BORDER) / (len(values) - 1), (HEIGHT - 2 * BORDER) / ((high - low) or 1)
    return " ".join(f"{BORDER + i * across:.1f},{BORDER + (high - y) * up:.1f}" for i, y in enumerate(values))
