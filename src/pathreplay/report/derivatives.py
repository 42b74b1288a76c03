"""A figure of derivative images beside finite differences. All images have the same diverging colour scale."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO

import numpy as np

from pathreplay.report.drawing import Figure, own_settings

# The end of the colour scale, as a percentile of the absolute finite differences. Few pixels exceed the colour scale.
_PERCENTILE = 99.0


def derivatives_figure(rows: Sequence[tuple[str, str, np.ndarray, np.ndarray]], format: str) -> bytes:
    """Draw derivatives, finite differences, and the differences between the two.

    Args:
        rows: key, name of the integrator, derivative image and finite differences (height x width x channels) of each
            parameter. The channels are averaged.
        format: a format of matplotlib such as 'png', 'pdf' or 'svg'.

    Returns:
        The content of the file.
    """
    with own_settings():
        figure = Figure(figsize=(10.5, 3.1 * len(rows)), layout="constrained")
        grid = figure.subplots(len(rows), 3, squeeze=False)
        for axes, (key, name, gradient, reference) in zip(grid, rows, strict=True):
            ours, theirs = gradient[..., :3].mean(axis=-1), reference[..., :3].mean(axis=-1)
            scale = float(np.percentile(np.abs(theirs), _PERCENTILE)) or float(np.abs(ours).max()) or 1.0
            titles = (name, "finite differences", "difference of both")
            for ax, title, image in zip(axes, titles, (ours, theirs, ours - theirs), strict=True):
                shown = ax.imshow(image, cmap="RdBu_r", vmin=-scale, vmax=scale, interpolation="nearest")
                ax.set_title(title, fontsize=9)
                ax.set_xticks([])
                ax.set_yticks([])
            axes[0].set_ylabel(key, fontsize=8)
            figure.colorbar(shown, ax=list(axes), shrink=0.85, format="%.2g")
        content = BytesIO()
        figure.savefig(content, format=format, dpi=120)
        return content.getvalue()
