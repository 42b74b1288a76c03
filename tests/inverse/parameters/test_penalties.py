"""Penalties are what they say, and their gradients are those of finite differences."""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import numpy as np
import pytest

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.user_functions import Imported, Modules
from pathreplay.inverse.parameters.regularizers import Laplacian, Own, Penalty, Prior, Term, TotalVariation
from pathreplay.scenes.bodies import ball

H = 1e-3


def require_slope(penalty: Penalty, v: np.ndarray, rel: float = 1e-3) -> None:
    """The gradient along a random direction is that of central differences."""
    δ = np.random.default_rng(1).uniform(-1, 1, v.shape).astype(np.float32)
    slope = (penalty.of(v + H * δ)[0] - penalty.of(v - H * δ)[0]) / (2 * H)
    gradient = penalty.of(v)[1]
    assert gradient.shape == v.shape and gradient.dtype == np.float32
    assert np.vdot(gradient, δ) == pytest.approx(slope, rel=rel)


def uniform(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(0, 1, shape).astype(np.float32)


@pytest.mark.parametrize("shape", [(5, 4, 3), (3, 1, 4, 1)])
def test_total_variation_and_prior(shape: tuple[int, ...]) -> None:
    v, start = uniform(2, *shape)
    penalty = Penalty((TotalVariation(0.3), Prior(0.2, start)))
    axes = [np.diff(v.astype(float), axis=k) for k in range(len(shape) - 1) if shape[k] > 1]
    expected = sum(0.3 * (np.sqrt(Δ**2 + 1e-6) - 1e-3).mean() for Δ in axes) + 0.2 * ((v - start) ** 2).mean()
    assert penalty.of(v)[0] == pytest.approx(expected, rel=1e-6)
    require_slope(penalty, v)


def test_total_variation_of_an_environment_map_is_the_same_from_any_column() -> None:
    v = uniform(4, 5, 3)
    wraps = TotalVariation(0.3, wraps=True)
    penalties = [wraps(np.roll(v, k, axis=1))[0] for k in range(5)]
    assert penalties == pytest.approx([penalties[0]] * 5) and penalties[0] != TotalVariation(0.3)(v)[0]
    require_slope(Penalty((wraps,)), v)


def test_a_grid_that_is_refined_is_pulled_to_its_start() -> None:
    start = np.full((2, 2, 2, 1), 0.25, np.float32)
    assert Prior(1.0, start)(np.full((4, 4, 4, 1), 0.75, np.float32))[0] == pytest.approx(0.25)


def laplacian_by_hand(points: np.ndarray, faces: np.ndarray) -> float:
    """The mean of the squares of what vertices are away from the mean of their neighbours."""
    squares = []
    for i, point in enumerate(points):
        near = {int(j) for face in faces if i in face for j in face} - {i}
        squares.append(float(np.sum((point - np.mean([points[j] for j in near], axis=0)) ** 2)) if near else 0.0)
    return float(np.mean(squares))


def test_the_laplacian_of_a_mesh() -> None:
    points, faces = ball(1)
    bumpy = (points + 0.2 * uniform(*points.shape)).astype(np.float32)
    term = Laplacian(3.0, bumpy.ravel(), faces.ravel())
    assert term(bumpy.ravel())[0] == pytest.approx(3 * laplacian_by_hand(bumpy, faces), rel=1e-5)
    require_slope(Penalty((term,)), bumpy.ravel())


def test_copies_of_a_vertex_count_as_one_and_lonely_ones_not_at_all() -> None:
    points, faces = ball(1)
    seams = np.concatenate([points, points[:4], [[9, 9, 9]]]).astype(np.float32)  # and one that no face has
    cut = faces.copy()
    for k in range(4):
        at = np.flatnonzero((cut == k).any(axis=1))[0]  # one of its faces takes the copy
        cut[at] = np.where(cut[at] == k, len(points) + k, cut[at])
    term = Laplacian(1.0, seams.ravel(), cut.ravel())
    assert term(seams.ravel())[0] == pytest.approx(
        laplacian_by_hand(points, faces) * len(points) / (len(points) + 1), rel=1e-5
    )
    moved = seams + 0.1 * uniform(*seams.shape)
    require_slope(Penalty((term,)), moved.astype(np.float32).ravel())
    gradient = term(moved.ravel())[1].reshape(-1, 3)
    assert np.array_equal(gradient[:4], gradient[len(points) : -1]) and not gradient[-1].any()


def own(function: object) -> Own:
    return Own(Imported("Regularizer", "own:f", function))  # type: ignore[arg-type]


def test_a_function_of_ones_own() -> None:
    v = uniform(3, 4, 2)
    term = own(lambda x: dr.mean(dr.square(x) * x, axis=None) * 2)
    assert term(v)[0] == pytest.approx(2 * float(np.mean(v.astype(float) ** 3)), rel=1e-6)
    require_slope(Penalty((term, Prior(0.5, 0 * v))), v)


WRONG = {
    "two": (lambda x: dr.gather(type(x.array), x.array, [0, 1]), "returns 2 numbers"),
    "none": (lambda x: None, "returns None; return numbers"),
    "raises": (lambda x: 1 / 0, "cannot be computed (division by zero); fix it"),
    "infinite": (lambda x: dr.sum(1 / (x - x), axis=None), "is not finite"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_no_penalty_is_told_in_one_line(name: str) -> None:
    function, told = WRONG[name]
    with pytest.raises(PathreplayError) as caught:
        own(function)(uniform(4))
    assert told in str(caught.value) and "\n" not in str(caught.value)


def test_a_module_is_looked_for_in_the_folder_first(tmp_path: Path) -> None:
    (tmp_path / "json.py").write_text("def loads(v):\n    return 7\n")
    assert Modules(tmp_path).function("Regularizer", "json:loads", "values")(int, "1") == 7
    assert Modules().function("Regularizer", "json:loads", "values")(int, "1") == 1


def test_terms_are_added() -> None:
    v = uniform(2, 3, 1)
    terms: list[Term] = [TotalVariation(0.1), Prior(0.2, 0 * v)]
    both = Penalty(tuple(terms)).of(v)
    assert both[0] == pytest.approx(sum(term(v)[0] for term in terms))
    assert both[1] == pytest.approx(sum(term(v)[1] for term in terms), rel=1e-5)
