"""Surfaces that refract light to an image: rays that are traced through them by other code arrive there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.ndimage

import pathreplay
from pathreplay import Optics, PathreplayError
from pathreplay.inverse.caustics.heights import _density, _receivers, _sources
from pathreplay.inverse.caustics.monge_ampere import hessian, potential
from pathreplay.inverse.images.io import exr_bytes
from pathreplay.inverse.problem.problem import build_problem
from pathreplay.jobs import make_config

ETA = 1.5


def smooth(rows: int, columns: int) -> np.ndarray:
    v, u = np.meshgrid(*((np.arange(n) + 0.5) / n for n in (rows, columns)), indexing="ij")
    return 0.2 + np.exp(-30 * ((u - 0.3) ** 2 + (v - 0.4) ** 2)) + 0.7 * np.exp(-60 * ((u - 0.7) ** 2 + (v - 0.7) ** 2))


def photograph(rows: int, columns: int) -> np.ndarray:
    """Edges, black, white and fine texture: noise whose amplitude falls with frequency, and three shapes."""
    random = np.random.default_rng(3)
    f = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.fftfreq(columns)) + 1 / max(rows, columns)
    noise = np.fft.ifft2(np.fft.fft2(random.normal(size=(rows, columns))) / f).real
    image = np.clip(0.4 + 0.25 * noise / noise.std(), 0, 1)
    v, u = np.meshgrid(*((np.arange(n) + 0.5) / n for n in (rows, columns)), indexing="ij")
    image[(u - 0.3) ** 2 + (v - 0.35) ** 2 < 0.03] = 1.0
    image[(abs(u - 0.7) < 0.15) & (abs(v - 0.3) < 0.1)] = 0.0
    image[(v > 0.75) & (np.floor(20 * u) % 2 == 0)] *= 0.3
    return image


PICTURES = {"smooth": smooth, "photograph": photograph}


def refracted(d: np.ndarray, n: np.ndarray, ratio: float) -> np.ndarray:
    """Snell's law in vector form; ``ratio`` is that of the indices before and behind, and n looks along d."""
    cosine = np.sum(d * n, -1, keepdims=True)
    root = 1 - ratio**2 * (1 - cosine**2)
    assert root.min() > 0
    return ratio * d + (np.sqrt(root) - ratio * cosine) * n


def irradiance(heights: np.ndarray, optics: Optics, bins: tuple[int, int], side: int = 8) -> np.ndarray:
    """Mean 1, of rays through a surface with linearly interpolated heights and normals, as those of a smooth mesh."""
    rows, columns = heights.shape
    cell, random = optics.width / columns, np.random.default_rng(0)
    slopes = np.gradient(heights, cell)
    half = np.array([optics.width, rows * cell]) / 2

    def at(field: np.ndarray, p: np.ndarray) -> np.ndarray:
        place = [p[..., 1] / cell + (rows - 1) / 2, p[..., 0] / cell + (columns - 1) / 2]
        return scipy.ndimage.map_coordinates(field, place, order=1, mode="nearest")

    wide = (optics.receiver_width or optics.width) / 2
    high = wide * rows / columns
    strata = np.stack(np.meshgrid(np.arange(columns * side), np.arange(rows * side)), -1)
    places = (random.random(strata.shape) + strata) / side
    p = np.zeros((*strata.shape[:2], 3))
    weight = np.ones(strata.shape[:2])
    if optics.mirror_angle is not None:
        # Rays through a part of the plane z = 0 that is larger than the mirror.
        angle = np.radians(optics.mirror_angle)
        along = np.array([np.sin(angle), 0.0, -np.cos(angle)])
        p[..., :2] = (places * cell - half) * 1.2
        d = np.broadcast_to(along, p.shape)
        if optics.source_distance is not None:
            d = p + optics.source_distance * along
            length = np.linalg.norm(d, axis=-1, keepdims=True)
            d, weight = d / length, -d[..., 2] / length[..., 0] ** 3
    elif optics.source_distance is None:
        p[..., :2] = places * cell - half
        d = np.broadcast_to([0.0, 0.0, 1.0], p.shape)
    else:
        # Rays to a plane at the entry that is larger than what reaches the exit, by their solid angles.
        p[..., :2] = (places * cell - half) * 1.2
        p[..., 2] = optics.source_distance
        length = np.linalg.norm(p, axis=-1, keepdims=True)
        weight = p[..., 2] / length[..., 0] ** 3
        d = refracted(p / length, np.array([0.0, 0.0, 1.0]), 1 / optics.eta)
        p[..., 2] = -optics.thickness
    for _ in range(30):
        p = p + d * ((at(heights, p) - p[..., 2]) / d[..., 2])[..., None]
    n = np.stack([-at(slopes[1], p), -at(slopes[0], p), np.ones(p.shape[:2])], -1)
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    out = refracted(d, n, optics.eta) if optics.eta else d - 2 * np.sum(d * n, -1, keepdims=True) * n
    q = p + out * ((optics.distance - p[..., 2]) / out[..., 2])[..., None]
    centre = optics.distance * np.tan(np.radians(optics.mirror_angle or 0))
    weight = weight * (np.abs(p[..., :2]) < half - cell / 2).all(-1)
    total = np.histogram2d(
        q[..., 1].ravel(), q[..., 0].ravel() - centre, bins, [[-high, high], [-wide, wide]], weights=weight.ravel()
    )[0]
    return total / total.mean()


def coarser(image: np.ndarray, n: int) -> np.ndarray:
    return image.reshape(image.shape[0] // n, n, image.shape[1] // n, n).mean((1, 3))


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


COLLIMATED = Optics(1.0, 1.5, ETA)
OPTICS = {
    "collimated": COLLIMATED,
    "a larger image": Optics(1.0, 2.0, ETA, receiver_width=1.6),
    "a point light": Optics(0.8, 1.2, 1.6, receiver_width=1.0, source_distance=1.5, thickness=0.3),
    "a mirror": Optics(1.0, 1.5, mirror_angle=30.0),
    "a mirror at a large angle": Optics(1.0, 2.0, mirror_angle=45.0, receiver_width=0.8),
    "a mirror and a point light": Optics(0.8, 1.2, mirror_angle=25.0, receiver_width=1.0, source_distance=1.5),
}
#: Rows and columns of cells.
SIZES = {"smooth": (48, 64), "photograph": (72, 96)}
#: Least correlation with the picture in cells of the surface, and in pixels of four by four cells; the error of the
#: latter relative to that of a flat surface, whose image is even.
LEAST = {"smooth": (0.97, 0.999, 0.06), "photograph": (0.9, 0.985, 0.15)}


@pytest.mark.parametrize("name", OPTICS)
@pytest.mark.parametrize("picture", PICTURES)
def test_rays_through_the_surface_give_the_image(picture: str, name: str) -> None:
    rows, columns = SIZES[picture]
    image = PICTURES[picture](rows, columns)
    image /= image.mean()
    heights = pathreplay.caustic_heights(image, OPTICS[name])
    assert heights.shape == (rows, columns, 1) and heights.dtype == np.float32
    assert heights.mean() == pytest.approx(0, abs=1e-6)
    found = irradiance(heights[..., 0].astype(np.float64), OPTICS[name], (rows, columns))
    assert correlation(found, image) > LEAST[picture][0]
    assert correlation(coarser(found, 4), coarser(image, 4)) > LEAST[picture][1]
    error = np.std(coarser(found, 4) - coarser(image, 4))
    assert error < LEAST[picture][2] * np.std(coarser(image, 4))


def test_a_flat_surface_is_what_an_even_image_needs() -> None:
    """The surface ends at the centres of the outer cells, and so does its shadow."""
    optics = Optics(1.0, 1.5, ETA, receiver_width=31 / 32)
    assert pathreplay.caustic_heights(np.ones((32, 32)), optics) == pytest.approx(0, abs=1e-6)


def test_each_pixel_takes_its_part_of_the_light() -> None:
    g = photograph(64, 80) + 0.05
    g /= g.mean()
    a, b, c = hessian(potential(g))
    determinant = (1 + a) * (1 + b) - c**2
    assert determinant.mean() == pytest.approx(1, abs=0.03)
    np.testing.assert_allclose(determinant / determinant.mean(), g, atol=0.02)
    assert min((1 + a).min(), determinant.min()) > 0  # the potential is convex: no two rays cross


def test_an_image_of_another_size_keeps_its_light() -> None:
    image = photograph(60, 60)
    expected = _density(image, None, 0.02)
    np.testing.assert_allclose(_density(np.kron(image, np.ones((3, 2))), (60, 60), 0.02), expected, atol=1e-9)
    coarse = _density(image, (24, 40), 0.02)
    np.testing.assert_allclose(coarser(coarse, 4)[0, 0], expected[:10, :6].mean(), atol=1e-9)


@pytest.mark.slow
def test_512_rows_make_the_image() -> None:
    image = photograph(512, 512)
    heights = pathreplay.caustic_heights(image, COLLIMATED)
    found = irradiance(heights[..., 0].astype(np.float64), COLLIMATED, (512, 512), 3)
    assert correlation(coarser(found, 2), coarser(image, 2)) > 0.95


def test_a_job_starts_with_it(tmp_path: Path) -> None:
    image = smooth(40, 40).astype(np.float32)
    (tmp_path / "picture.exr").write_bytes(exr_bytes(image[..., None]))
    vertices = '<scene version="3.0.0"><shape type="rectangle" id="lens"/><emitter type="constant"/>'
    sensor = '<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="4"/><integer name="height" '
    (tmp_path / "scene.xml").write_text(f'{vertices}{sensor}value="4"/></film></sensor></scene>')
    (tmp_path / "own.py").write_text("def f(first, heights):\n    return first * 0 + heights[0, 0, 0].array\n")
    start = {"transport": "picture.exr", "width": 1.0, "distance": 1.5, "eta": 1.5}
    table = {"key": "heights", "shape": [40, 40, 1], "initial": start, "lower": -0.2, "upper": 0.2}
    job = {
        "scene": "scene.xml",
        "parameters": [table],
        "derived": [{"key": "lens.bsdf.reflectance.value", "function": "own:f", "of": ["heights"]}],
        "target": {"scene": "scene.xml", "spp": 1},
    }
    problem = build_problem(make_config(job), tmp_path)
    expected = pathreplay.caustic_heights(image, COLLIMATED)
    np.testing.assert_allclose(problem.variables[0].start, expected, atol=1e-7)
    assert np.abs(expected).max() > 0.01

    def told(**changes: Any) -> str:
        with pytest.raises(PathreplayError) as caught:
            build_problem(make_config({**job, "parameters": [{**table, **changes}]}), tmp_path)
        return str(caught.value)

    assert "beyond its upper bound 0.001; change one of them" in told(upper=0.001)
    assert "Parameter 'heights': The image requires that light turns by" in told(initial={**start, "distance": 0.1})
    assert "so that 'transport' does not apply; give it the shape [rows, columns, 1]" in told(shape=[40, 40, 3])
    assert "unknown key 'parameters.0.initial.wide'; did you mean 'width'?" in told(initial={**start, "wide": 1.0})
    assert "'parameters.0.initial.eta' is 1" in told(initial={**start, "eta": 1.0})
    assert "Parameter 'heights': The optics have both" in told(initial={**start, "mirror_angle": 30.0})
    assert "No image file" in told(initial={**start, "transport": "pictur.exr"})


@pytest.mark.parametrize("aspect", [1.0, 0.7])
@pytest.mark.parametrize("picture", PICTURES)
def test_each_point_of_the_surface_has_its_point_of_the_image(picture: str, aspect: float) -> None:
    """The inverse of the transport is found where corners of cells lie on circles and where cells vanish, too."""
    φ = potential(PICTURES[picture](40, 56) + 1e-3, width=aspect)
    rows, columns = _receivers(φ, aspect)
    place = [rows + 1, columns + 1]  # with a margin of one cell
    for coordinate, source in zip(np.indices(φ.shape), _sources(φ, aspect, 1), strict=True):
        back = scipy.ndimage.map_coordinates(source, place, order=1)
        assert np.abs(back - coordinate).max() < 0.5 and np.sqrt(np.mean((back - coordinate) ** 2)) < 0.03
    even = _receivers(np.zeros((5, 7)), aspect)
    index = np.indices((5, 7))
    expected = [i * n / (n - 1) - 0.5 for i, n in zip(index, (5, 7), strict=True)]  # all of the image is lit
    np.testing.assert_allclose(even, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("image", "optics", "options", "told"),
    [
        (np.ones((4, 4, 3)), {}, {}, "has the shape (4, 4, 3); give (rows, columns)"),
        (np.zeros((4, 4)), {}, {}, "is not an irradiance; give finite values"),
        (-np.ones((4, 4)), {}, {}, "is not an irradiance; give finite values"),
        (np.full((4, 4), np.nan), {}, {}, "is not an irradiance; give finite values"),
        (np.ones((4, 4)), {"eta": 1.0}, {}, "eta is 1; give an index of refraction above 1"),
        (np.ones((4, 4)), {"distance": 0.0}, {}, "distance is 0; give a positive length"),
        (np.ones((4, 4)), {"eta": None}, {}, "neither eta nor mirror_angle; give eta for a slab of glass, or"),
        (np.ones((4, 4)), {"mirror_angle": 30.0}, {}, "both eta and mirror_angle; give eta for a slab of glass, or"),
        (np.ones((4, 4)), {"eta": None, "mirror_angle": 90.0}, {}, "mirror_angle is 90; give an angle"),
        (np.ones((4, 4)), {"eta": None, "mirror_angle": 9.0, "thickness": 1.0}, {}, "but a mirror has none"),
        (smooth(32, 32), {"eta": None, "mirror_angle": 45.0, "distance": 0.02}, {}, "turns away from the light"),
        (np.ones((4, 4)), {"thickness": -1.0}, {}, "thickness is -1; give a length of 0 or more"),
        (np.ones((4, 4)), {}, {"floor": 0.0}, "floor is 0; give a fraction between 0 and 1"),
        (np.ones((4, 4)), {}, {"shape": (4, 1)}, "has the shape (4, 1); give at least two rows and columns"),
        (np.ones((4, 4)), {}, {"shape": (10**6, 10**6)}, "needs about 8e+05 GB of memory"),
        (np.eye(64), {}, {"floor": 1e-9}, "does not converge at a contrast of"),
        (np.ones((8, 8)), {"receiver_width": 9.0}, {}, "light turns by"),
    ],
    ids=lambda value: value[:24] if isinstance(value, str) else "",
)
def test_what_cannot_be_is_told_in_one_line(image: np.ndarray, optics: Any, options: Any, told: str) -> None:
    with pytest.raises(PathreplayError) as caught:
        pathreplay.caustic_heights(image, Optics(**{"width": 1.0, "distance": 1.5, "eta": 1.5, **optics}), **options)
    assert told in str(caught.value) and "\n" not in str(caught.value)
