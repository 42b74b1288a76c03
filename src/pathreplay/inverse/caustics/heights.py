"""Initial height maps of lenses and mirrors that cast a given image as their caustic, computed by optimal transport.

Gradients of renderings change a caustic only locally. An optimisation with these gradients ends in a local minimum if
light has to travel far across the image. The initial height map therefore comes from optimal transport of the light, as
in Schwartzburg et al. (2014) and Sun et al. (2024):

1. Optimal transport assigns a point T(x) of the receiver to each point x of the surface.
2. Snell's law or the law of reflection gives the normal that directs the light at x to T(x).
3. A Poisson equation gives the heights. These heights minimise the mean squared difference between their slopes and
   the slopes of a surface with the normals of step 2.

For small slopes, the light is shifted on the receiver in proportion to the slope. The transport then minimises the
mean square slope. The optimal T is the gradient of a potential, so the slopes of step 2 are nearly the gradient of a
height map.

The normals of step 2 depend on the heights, so steps 2 and 3 are repeated. Fresnel reflection is ignored.
"""

from __future__ import annotations

import math

import numpy as np
import scipy.interpolate
import scipy.ndimage
from numpy.typing import ArrayLike, NDArray

from pathreplay.errors import PathreplayError
from pathreplay.inverse.caustics.monge_ampere import Field, poisson_solver, potential
from pathreplay.inverse.caustics.optics import Optics
from pathreplay.platform import memory

_A_CELL = 800
"""Peak memory of the transport, in bytes per cell of the height map."""
_MARGIN = 1e-9
"""Tolerance of the test whether a point is inside a triangle, in barycentric coordinates."""
_ROUNDS = 5
"""Number of executions of steps 2 and 3. Step 1 is also repeated if the incident light depends on the heights."""


def caustic_heights(
    image: ArrayLike, optics: Optics, shape: tuple[int, int] | None = None, floor: float = 0.02
) -> NDArray[np.float32]:
    """Compute the heights of a surface whose caustic approximates an image.

    The surface is a mirror or the exit surface of a slab of glass. Row 0 and column 0 of the heights are at the
    smallest y and x of the surface, and row 0 and column 0 of the image at the smallest y and x of the receiver. The
    image is therefore upright for a camera that looks at the receiver from the side of the surface, with x to the right
    and y down.

    Args:
        image: irradiance (rows, columns), nonnegative; its scale is arbitrary.
        optics: arrangement of light, slab or mirror, and receiver.
        shape: rows and columns of the heights; default: the shape of the image. The image is resampled to this shape.
        floor: fraction of the light that is distributed evenly over the image. It must be above 0, because the caustic
            of a continuous surface has no black parts.

    Returns:
        Heights of shape (rows, columns, 1) and mean zero, positive towards the receiver.

    Raises:
        PathreplayError: the image has a wrong shape or values, a light ray would have to be refracted by too large an
            angle, or the transport does not converge.
    """
    density = _density(image, shape, floor)
    rows, columns = density.shape
    cell, scale = optics.width / columns, (optics.receiver_width or optics.width) / columns
    y, x = ((np.arange(n) - (n - 1) / 2) * cell for n in (rows, columns))
    x, y = np.meshgrid(x, y)
    h, φ = np.zeros_like(x), np.zeros_like(x)
    solve, aspect = poisson_solver(h.shape), optics.foreshortening
    for n in range(_ROUNDS):
        incoming, flux = optics.incidence(x, y, h)
        if n == 0 or optics.depends_on_heights:
            slope_y, slope_x = np.gradient(h, cell)
            # Convert the flux through the plane z = const to the flux on the tilted surface above the same area.
            flux = flux * (1 - (incoming[..., 0] * slope_x + incoming[..., 1] * slope_y) / incoming[..., 2])
            _require_lit(flux)
            there = scipy.ndimage.map_coordinates(flux, _sources(φ, aspect), order=1, mode="nearest")
            φ = potential(density / there, φ, aspect)
            to_y, to_x = _receivers(φ, aspect)
        end_x, end_y = optics.centre + (to_x - (columns - 1) / 2) * scale, (to_y - (rows - 1) / 2) * scale
        ends = np.stack([end_x, end_y, np.full_like(h, optics.distance)], -1)
        outgoing = ends - np.stack([x, y, h], -1)
        outgoing /= np.linalg.norm(outgoing, axis=-1, keepdims=True)
        normal = optics.normal(incoming, outgoing)
        h = solve(_divergence(-normal[..., 0] / normal[..., 2], -normal[..., 1] / normal[..., 2]) * cell)
        h -= h.mean()
    return h[..., None].astype(np.float32)


def _density(image: ArrayLike, shape: tuple[int, int] | None, floor: float) -> Field:
    """Resample an image to ``shape``, scale it to mean 1, and return (1 - ``floor``) · image + ``floor``."""
    density = np.asarray(image, np.float64)
    if density.ndim == 3 and density.shape[2] == 1:
        density = density[..., 0]
    if density.ndim != 2 or min(density.shape) < 2:
        raise PathreplayError(f"The image of the caustic has the shape {density.shape}; give (rows, columns)")
    if not np.isfinite(density).all() or density.min() < 0 or not density.any():
        raise PathreplayError(
            "The image of the caustic is not an irradiance; give finite values, none below 0 and not all 0"
        )
    if not 0 < floor < 1:
        raise PathreplayError(f"floor is {floor:g}; give a fraction between 0 and 1, such as 0.02")
    cells = math.prod(density.shape if shape is None else shape)
    memory.require(_A_CELL * cells, f"Transport of light for {cells} heights", "use fewer cells")
    if shape is not None and tuple(shape) != density.shape:
        if min(shape) < 2:
            raise PathreplayError(f"The height map has the shape {tuple(shape)}; give at least two rows and columns")
        density = _resampled(density, shape)
    return (1 - floor) * density / density.mean() + floor


def _resampled(density: Field, shape: tuple[int, int]) -> Field:
    """Resample a density to another number of cells; each cell takes the light that falls into it."""
    for axis, n in enumerate(shape):
        columns = np.moveaxis(density, axis, 0)
        total = np.concatenate([np.zeros((1, columns.shape[1])), np.cumsum(columns, axis=0)])
        borders = np.linspace(0, len(columns), n + 1)
        at = scipy.interpolate.interp1d(np.arange(len(columns) + 1), total, axis=0)(borders)
        density = np.moveaxis(np.diff(at, axis=0), 0, axis)
    return density


def _sources(φ: Field, aspect: float, margin: int = 0) -> tuple[Field, Field]:
    """Return the point S(y) of the surface from which light arrives at y, for each cell y of the receiver.

    S is the gradient of the potential v = |y|²/2 + φ(y) (see `monge_ampere`), scaled to the extent of the surface. The
    cells of the potential have the width ``aspect`` and the height 1. The results are the row and the column of S(y),
    in units of cells. A ``margin`` adds results for cells beyond the border. The potential is continued there by
    reflection at the border.
    """
    p = np.pad(φ, margin + 1, mode="symmetric")
    rows, columns = (np.arange(-margin, n + margin) for n in φ.shape)
    y, x = rows[:, None] + (p[2:, 1:-1] - p[:-2, 1:-1]) / 2, columns + (p[1:-1, 2:] - p[1:-1, :-2]) / 2 / aspect**2
    # The surface ends at the centres of the outer cells.
    return (y + 0.5) * (1 - 1 / φ.shape[0]), (x + 0.5) * (1 - 1 / φ.shape[1])


def _receivers(φ: Field, aspect: float) -> tuple[Field, Field]:
    """Return the point T(x) of the receiver for each cell x of the surface, in units of cells. T is the inverse of S.

    S (see `_sources`) maps each square of four neighbouring cell centres of the receiver to a quadrilateral. The
    quadrilaterals cover the surface. T is linear in each of the two triangles of a quadrilateral. (A Delaunay
    triangulation of the corners takes minutes where S is close to the identity, because the corners of squares lie on
    circles.)
    """
    shape = np.array(φ.shape)
    points = np.stack(_sources(φ, aspect, 1), -1)
    rows, columns = (np.arange(-1.0, n + 1) for n in φ.shape)
    ends = np.stack(np.meshgrid(rows, columns, indexing="ij"), -1).reshape(-1, 2)
    index = np.arange(len(ends)).reshape(points.shape[:2])
    a, b, c, d = index[:-1, :-1].ravel(), index[:-1, 1:].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel()
    triangles = np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)])
    corners = points.reshape(-1, 2)[triangles]
    # List the cells in the bounding box of each triangle.
    low = np.clip(np.ceil(corners.min(axis=1)), 0, shape).astype(int)
    high = np.clip(np.floor(corners.max(axis=1)), -1, shape - 1).astype(int)
    sides = np.maximum(high - low + 1, 0)
    counts = sides.prod(axis=1)
    owner = np.repeat(np.arange(len(triangles)), counts)
    rank = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    cells = low[owner] + np.stack([rank // sides[owner, 1], rank % sides[owner, 1]], -1)
    p, q, r = (corners[owner, i] for i in range(3))
    area = _cross(q - p, r - p)
    area = np.where(area == 0, np.inf, area)
    second, third = _cross(cells - p, r - p) / area, _cross(q - p, cells - p) / area
    weights = np.stack([1 - second - third, second, third], -1)
    inside = weights.min(axis=1) > -_MARGIN
    found = np.full((*φ.shape, 2), np.nan)
    y, x = cells[inside].T
    found[y, x] = np.einsum("ni,nij->nj", weights[inside], ends[triangles[owner[inside]]])
    missing = np.isnan(found[..., 0])
    if missing.any():  # rounding errors can leave cells outside of all triangles, next to a triangle of zero area
        y, x = scipy.ndimage.distance_transform_edt(missing, return_distances=False, return_indices=True)
        found = found[y, x]
    return found[..., 0], found[..., 1]


def _cross(a: Field, b: Field) -> Field:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _divergence(slope_x: Field, slope_y: Field) -> Field:
    """Return the divergence of slopes at the cells, with zero flux through the border.

    The result is the right-hand side of the Poisson equation in step 3 (see the module).
    """
    result = np.zeros_like(slope_x)
    for axis, slope in enumerate((slope_y, slope_x)):
        flow, into = np.moveaxis(slope, axis, 0), np.moveaxis(result, axis, 0)
        between = (flow[1:] + flow[:-1]) / 2
        into[:-1] += between
        into[1:] -= between
    return result


def _require_lit(flux: Field) -> None:
    if flux.min() <= 0:
        raise PathreplayError(
            "The image requires that a part of the surface turns away from the light; enlarge the distance, reduce the "
            "image, or reduce mirror_angle"
        )
