"""Finds the box that a capture shows: the part of space that many cameras see, around the point that they look at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.jobs.photographs.pictures import Frame

REACH = 0.75
"""Half of the side of the cube that is searched, as a fraction of the median distance of the cameras."""
SEEN_BY = 0.4
"""Fraction of the cameras that see a cell of the region."""
NEAR = 0.35
"""Distance from which a camera sees the medium, as a fraction of the smallest distance of a camera from the centre."""
ACROSS = 8
"""Approximate number of pixels of the sky along the shorter side of a photograph."""
LEAST_ROWS, MOST_ROWS = 16, 128
"""Smallest and largest height of the sky in pixels."""
CELLS = 40
"""Number of cells along a side of the cube."""


@dataclass(frozen=True)
class Box:
    """An axis-aligned box."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    @property
    def size(self) -> np.ndarray:
        return np.subtract(self.high, self.low)

    @property
    def centre(self) -> np.ndarray:
        return np.add(self.low, self.high) / 2


def find_region(frames: Sequence[Frame]) -> Box:
    """Find the region of a capture.

    The point closest to the optical axes of all cameras is the centre of a cube, whose size follows from the distances
    of the cameras to this point. The cube is divided into cells. The region is the bounding box of all cells that at
    least the fraction `SEEN_BY` of the cameras see.

    Raises:
        PathreplayError: the cameras have the same position, or no part of the cube is seen by enough of them.
    """
    places = np.array([frame.place for frame in frames])
    centre = _focus(places)
    distance = float(np.median(np.linalg.norm(places[:, :3, 3] - centre, axis=1)))
    if not np.ptp(places[:, :3, 3], axis=0).max() > 1e-6 * max(1.0, float(np.abs(places[:, :3, 3]).max())):
        raise PathreplayError("All cameras of the capture have the same position; photograph from several positions")
    half = REACH * distance
    edges = np.linspace(-half, half, CELLS + 1)
    middle = (edges[1:] + edges[:-1]) / 2
    cells = np.stack(np.meshgrid(middle, middle, middle, indexing="ij"), axis=-1).reshape(-1, 3)
    counts = sum(_sees(frame, cells + centre).astype(np.int64) for frame in frames)
    inside = cells[counts >= max(2.0, SEEN_BY * len(frames))]
    if not len(inside):
        raise PathreplayError(
            "No part of space is seen by enough cameras; check the poses, or remove photos that show other objects"
        )
    pad = half / CELLS
    low, high = inside.min(axis=0) - pad + centre, inside.max(axis=0) + pad + centre
    return Box(tuple(low.tolist()), tuple(high.tolist()))


def near_clip(frames: Sequence[Frame]) -> float:
    """Return a near clipping distance.

    Without near clipping, fog directly in front of a camera could reproduce the photograph of this camera.
    """
    places = np.array([frame.place for frame in frames])
    return NEAR * float(np.linalg.norm(places[:, :3, 3] - _focus(places), axis=1).min())


def sky_rows(frames: Sequence[Frame]) -> int:
    """Return the height of the sky in pixels, a power of two. The narrower the photographs, the finer the sky."""
    sides = np.array([min(frame.width, frame.height) / frame.focal for frame in frames])
    angle = 2 * np.arctan(np.median(sides) / 2)
    return int(np.clip(2 ** np.round(np.log2(np.pi * ACROSS / angle)), LEAST_ROWS, MOST_ROWS))


def _focus(places: np.ndarray) -> np.ndarray:
    """Return the point with the least sum of squared distances from the optical axes.

    Almost parallel axes determine no such point. A small multiple of the squared distances from the cameras' positions
    is therefore added to the sum, which keeps the result finite.
    """
    positions, axes = places[:, :3, 3], -places[:, :3, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    spring = 1e-3 * len(places) * np.eye(3)
    towards = np.einsum("nij,nj->i", across, positions) + spring @ positions.mean(axis=0)
    return np.linalg.solve(across.sum(axis=0) + spring, towards)


def _sees(frame: Frame, points: np.ndarray) -> np.ndarray:
    """Return which points project into the image of a camera."""
    local = (points - frame.place[:3, 3]) @ frame.place[:3, :3]
    depth = -local[:, 2]
    front = depth > 1e-9
    z = np.where(front, depth, 1.0)
    u, v = frame.focal * local[:, 0] / z + frame.cx, -frame.focal * local[:, 1] / z + frame.cy
    return front & (u >= 0) & (u <= frame.width) & (v >= 0) & (v <= frame.height)
