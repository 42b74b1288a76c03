"""The parts of the boundary term: places on the film, lines that find edges, and what is refused or costs nothing."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import combinations
from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import edge_media_scenes as media
import edge_scenes as scenes
from edge_truth import loaded, ours
from pathreplay.boundary import search
from pathreplay.boundary.chains import transmittance_of_chain
from pathreplay.boundary.crofton import BEYOND, BISECTIONS, PlaneSegment, VisibilityProbe, bisect, detect, heading
from pathreplay.boundary.emitters import BORDER, sample_at
from pathreplay.boundary.observer import ObserverVertex
from pathreplay.boundary.search import Resampled, SegmentDensity
from pathreplay.boundary.searches.primary import FilmCrossing, PrimarySearch
from pathreplay.boundary.searches.secondary import SecondarySearch
from pathreplay.boundary.searches.volumetric import VolumetricSearch
from pathreplay.integrators.boundary_term import INNER_LENGTHS
from pathreplay.integrators.camera_pass import Pass
from pathreplay.integrators.film.domain import FilmPlaces
from pathreplay.integrators.lifetimes import careful
from pathreplay.integrators.scene_facts import SceneFacts
from pathreplay.platform.threads import one_thread
from pathreplay.samplers.counter_sampler import ROUNDS, CounterSampler, key_of, quasi_random
from pathreplay.testing.statistics import gap
from pathreplay.testing.verdict import Z_LIMIT
from pathreplay.transport.facts.smoothing_groups import smoothing_groups
from truth import Bench, bitmap, camera


def world(**film: Any) -> mi.Scene:
    """A square before a sky."""
    picture = {"type": "hdrfilm", "width": 12, "height": 8, "component_format": "float32", "pixel_format": "rgb"} | film
    to_world = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    camera = {"type": "perspective", "fov": 40, "to_world": to_world, "film": picture}
    square = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}}
    sky = {"type": "constant", "radiance": 0.7}
    return mi.load_dict({"type": "scene", "camera": camera, "square": square, "sky": sky})


FILMS = {
    "box": {"rfilter": {"type": "box"}},
    "gaussian": {"rfilter": {"type": "gaussian"}},
    "tent, border": {"rfilter": {"type": "tent"}, "sample_border": True},
    "crop": {
        "rfilter": {"type": "gaussian"},
        "crop_offset_x": 3,
        "crop_offset_y": 2,
        "crop_width": 6,
        "crop_height": 5,
    },
    "alpha": {"rfilter": {"type": "box"}, "pixel_format": "rgba"},
    "luminance": {"rfilter": {"type": "box"}, "pixel_format": "luminance"},
}


def some_places(view: Pass, n: int = 100000) -> tuple[FilmPlaces, mi.Point2f]:
    places = FilmPlaces.of(view)
    return places, mi.Point2f(quasi_random(dr.arange(mi.UInt32, n), n, mi.UInt32(1))) * places.size


@pytest.mark.parametrize("film", FILMS.values(), ids=FILMS)
def test_importance_is_the_transpose_of_the_image(film: dict[str, Any]) -> None:
    places, s = some_places(Pass.of(world(**film), 0, 0, 1), 500)
    rng = np.random.default_rng(0)
    L = mi.Color3f(rng.random((3, 500), np.float32))
    with dr.suspend_grad():
        image = np.array(places.image(s, L, []))
        wanted = rng.random(image.shape, np.float32)
        W = places.importance(places.undeveloped(mi.TensorXf(wanted)), s, [])
    assert np.sum(wanted * image) == pytest.approx(float(dr.sum(dr.dot(W, L))[0]), rel=1e-4)


@pytest.mark.parametrize("film", FILMS.values(), ids=FILMS)
def test_light_that_is_one_everywhere_makes_an_image_of_ones(film: dict[str, Any]) -> None:
    places, s = some_places(Pass.of(world(**film), 0, 0, 1))
    area = places.size.x * places.size.y / dr.width(s)
    with dr.suspend_grad():
        image = np.array(places.image(s, mi.Color3f(area), []))
    assert np.abs(image[..., :3] - 1).max() < 0.02  # a thousand places in each pixel


def test_nothing_comes_from_outside_of_the_film() -> None:
    places, _ = some_places(Pass.of(world(**FILMS["gaussian"]), 0, 0, 1))
    outside = mi.Point2f([-0.1, 12.1, 5, 5], [4, 4, -0.1, 8.1])
    with dr.suspend_grad():
        W = places.importance(places.undeveloped(dr.ones(mi.TensorXf, (8, 12, 3))), outside, [])
    assert dr.all(W == 0, axis=None)


def test_centres_are_drawn_with_their_density() -> None:
    even = SegmentDensity.uniform(mi.ScalarVector2f(5, 3), 0.5)
    rng = np.random.default_rng(1)
    seen = mi.Point2f(2.0, 1.0) + 0 * mi.Float(rng.random(50))
    centres = even.refined(seen, mi.Float(1))
    n = 200000
    c, density = centres.draw(*mi.Point2f(rng.random((2, n), np.float32)))
    corner = c + centres.margin
    pixel = np.array(mi.UInt32(corner.y) * centres.width + mi.UInt32(corner.x))
    counts = np.bincount(pixel, minlength=centres.width * centres.height) / n
    told = np.zeros_like(counts)
    told[pixel] = np.array(density)
    assert told.sum() == pytest.approx(1, rel=1e-4)
    assert np.abs(counts - told).max() < 5 * (0.25 / n) ** 0.5
    assert counts.argmax() == centres.width + 2
    # 1 / density is an unbiased estimate of the area.
    assert np.mean(1 / np.array(density)) == pytest.approx(centres.width * centres.height, rel=0.01)


def test_centres_reach_all_pixels_of_a_large_film() -> None:
    """Single precision gives most pixels of such a film the probability 0, and some a negative one."""
    even = SegmentDensity.uniform(mi.ScalarVector2f(4096, 4096), 0.5)
    centres = even.refined(mi.Point2f(2000.0, dr.linspace(mi.Float, 1000, 3000, 2000)), mi.Float(1))
    n = 2**18
    c, density = centres.draw(*quasi_random(dr.arange(mi.UInt32, n), n, mi.UInt32(1)))
    assert dr.all(density > 0)
    below = np.where(np.array(c.y) > 3500, 1 / np.array(density), 0).mean()  # an estimate of an area
    assert below == pytest.approx(4098 * (4097.5 - 3500), rel=0.05)
    assert np.mean(np.array(c.x) % 1) == pytest.approx(0.5, abs=0.01)


def sight(signature: int, p: list[float], n: list[float]) -> VisibilityProbe:
    return VisibilityProbe(mi.UInt32(signature), mi.Point3f(p), mi.Normal3f(n))


def test_a_shape_that_hides_itself_is_seen() -> None:
    here = sight(7, [0, 0, 0], [0, 0, 1])
    assert not here.differs(sight(7, [1, 0.3, 0.01], [0, 0.1, 1]))[0]  # on, around a slight bend
    assert here.differs(sight(7, [0.1, 0, -3], [0, 0, 1]))[0]  # behind
    assert here.differs(sight(8, [0.1, 0, 0], [0, 0, 1]))[0]
    assert not VisibilityProbe.of().differs(VisibilityProbe.of())[0]


def test_a_mesh_falls_into_pieces_where_vertices_are_written_twice() -> None:
    """Where a piece meets itself, the triangles at the tear are pieces of their own."""
    square = np.array([[0, 1, 2], [0, 2, 3]])
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    assert not smoothing_groups(square, corners).any()
    assert not smoothing_groups(np.zeros((0, 3), int), np.zeros((0, 3))).any()
    folded = np.concatenate([corners, corners[[0, 1]], [[1, 0, 1], [0, 0, 1]]])
    assert list(smoothing_groups(np.concatenate([square, square + 4]), folded)) == [0, 0, 1, 1]
    n = 8
    turns = 2 * np.pi * np.append(np.arange(n), 0) / n  # closed by places, open by vertices
    ring = np.stack([np.cos(turns), np.sin(turns), 0 * turns], 1)
    i = np.arange(n)
    faces = np.concatenate([np.stack([i, i + 1, i + n + 2], 1), np.stack([i, i + n + 2, i + n + 1], 1)])
    groups = smoothing_groups(faces, np.concatenate([ring, ring + np.array([0, 0, 1])]))
    apart = np.bincount(groups)[groups] == 1
    assert list(np.flatnonzero(apart)) == [n - 1, n]  # the triangles at the tear


@pytest.mark.parametrize("centre", [0.0, 50.0])
def test_vertices_that_differ_in_their_last_bits_are_in_one_place(centre: float) -> None:
    n = 8
    a = np.linspace(0, 2 * np.pi, n + 1)
    rims = [np.stack([np.cos(a), np.sin(a), 0 * a + z], 1).astype(np.float32) for z in (0, 1)]
    positions = np.concatenate(rims) + np.float32(centre)
    assert (positions[0] != positions[n]).any() or centre
    positions[n] = np.nextafter(positions[n], np.float32(np.inf))
    i = np.arange(n)
    faces = np.concatenate([np.stack([i, i + 1, i + n + 2], 1), np.stack([i, i + n + 2, i + n + 1], 1)])
    groups = smoothing_groups(faces, positions)
    assert list(np.flatnonzero(np.bincount(groups)[groups] == 1)) == [n - 1, n]


@pytest.mark.parametrize(
    ("width", "halves"), [(0.5, 1), (0.08, 1), (0.5, 2)], ids=["wide", "thinner than a line", "of two triangles"]
)
def test_lines_count_crossings_with_the_sides_of_a_rectangle(width: float, halves: int) -> None:
    """Crofton: four sides and four corners, at which two crossings of one line go unseen by its ends.

    Nor are there more of them where a diagonal, which is not counted here, ends in a corner.
    """

    def inside(p: mi.Point2f) -> mi.Bool:
        return (p.x > 0.3) & (p.y > 0.4) & (p.x < 0.3 + width) & (p.y < 0.7)

    def count(n: int, l: float, seed: int) -> mi.Float:
        number = dr.opaque(mi.UInt32, seed)

        def segment(i: mi.UInt32) -> PlaneSegment:
            c = mi.Point2f(quasi_random(i, n, number)) * (1 + 2 * l) - l
            return PlaneSegment(c, heading(mi.sample_tea_float32(i, number)), mi.Float(l))

        def probe(segment: PlaneSegment, t: mi.Float, active: mi.Bool) -> VisibilityProbe:
            p = segment.at(t)
            half = dr.select((p.x - 0.3) * 0.3 > (p.y - 0.4) * width, mi.UInt32(halves), 1)
            return VisibilityProbe.of(dr.select(inside(p), half, 0))

        drawn = segment(dr.arange(mi.UInt32, n))
        picked = Resampled.of(detect(partial(probe, drawn), drawn.length, mi.Bool(True)), n // 4, number)
        chosen, generator = segment(picked.index), mi.PCG32(n // 4, initstate=number)
        found = bisect(partial(probe, chosen), chosen.length, picked.weight, generator)
        side = inside(chosen.at(found.a)) != inside(chosen.at(found.b))
        per_length = found.per_length(l, mi.Float(n / (1 + 2 * l) ** 2))
        return dr.sum(dr.select(side, per_length, 0))

    lengths = [count(1 << 18, 0.1, seed)[0] for seed in range(1, 9)]
    error = np.std(lengths, ddof=1) / len(lengths) ** 0.5
    assert error < 0.01
    assert abs(np.mean(lengths) - 2 * (width + 0.3)) < 4 * error, (np.mean(lengths), error)


@pytest.mark.parametrize("at", [-0.5, 0.0, 0.5], ids=["begin", "middle", "end"])
def test_cracks_are_no_edges(at: float) -> None:
    """Between triangles rays slip through, on a line's begin, middle or end: an edge as close to it is one, though."""

    def halved(differs: Callable[[mi.Float], mi.Bool]) -> float:
        def probe(t: mi.Float, active: mi.Bool) -> VisibilityProbe:
            return VisibilityProbe.of(differs(t))

        found = detect(probe, mi.Float(1), mi.Bool(True))
        assert found[0] > 0
        return bisect(probe, mi.Float(1), found, mi.PCG32(1)).weight[0]

    assert halved(lambda t: dr.abs(t - at) < 1e-6) == 0
    assert BEYOND * INNER_LENGTHS[0] < BORDER * 2**BISECTIONS  # among samples of an emitter one looks at samples
    beside = at + 1e-5 if at < 0 else at - 1e-5
    assert halved(lambda t: t > beside) == 1


def test_lines_are_picked_as_often_as_they_count() -> None:
    """What picks stand for adds up to what there is, line by line; where nothing was found they stand for nothing."""
    rng = np.random.default_rng(0)
    mass = np.where(rng.random(1000) < 0.1, rng.choice([1, 4], 1000), 0).astype(np.float32)
    found = np.zeros(1000)
    for seed in range(200):
        picked = Resampled.of(mi.Float(mass), 50, dr.opaque(mi.UInt32, seed))
        np.add.at(found, np.array(picked.index), np.array(picked.weight) / 200)
    assert (found[mass == 0] == 0).all()
    assert np.abs(found[mass > 0] - 1).max() < 5 * (mass.sum() / 50 / 200) ** 0.5
    assert found.sum() == pytest.approx((mass > 0).sum(), rel=0.02)
    assert dr.all(Resampled.of(dr.zeros(mi.Float, 100), 50, mi.UInt32(1)).weight == 0)


def test_one_line_of_one_pixel_finds_its_place() -> None:
    """As a meter of light has it: Dr.Jit gives numbers in place of arrays where tables have one entry."""
    (x, y), one = quasi_random(mi.UInt32(0), 1, mi.UInt32(5)), dr.ones(mi.Float, 1)
    assert 0 <= x[0] < 1 and 0 <= y[0] < 1
    place, density = SegmentDensity(1, 1, 0.0).refined(mi.Point2f(0.5), one).draw(x, y)
    assert dr.all((place >= 0) & (place < 1)) and dr.allclose(density, 1)
    picked = Resampled.of(one, 1, dr.opaque(mi.UInt32, 3))
    assert picked.index == 0 and picked.weight == 1


@pytest.mark.parametrize("attach", ["all", "none"])
def test_edges_of_what_follows_its_samples_are_refused(attach: str) -> None:
    with pytest.raises(RuntimeError, match=f"boundary = 'primary' with attach = '{attach}'"):
        mi.load_dict({"type": "pathreplay", "boundary": "primary", "attach": attach})


def test_where_nothing_moves_nothing_is_added() -> None:
    """A reflectance has no edges: the same gradient, from as many kernels."""
    found = {}
    for edges in ("none", "all", "auto"):
        scene = world()
        params = mi.traverse(scene)
        integrator = mi.load_dict({"type": "pathreplay", "max_depth": 3, "boundary": edges})
        key = "square.bsdf.reflectance.value"
        dr.enable_grad(params[key])
        params.update()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.eval()  # what other tests have left
            dr.kernel_history_clear()
            with one_thread(True):  # several add to a gradient in the order in which they come
                integrator.render_backward(scene, params, dr.ones(mi.TensorXf, (8, 12, 3)), spp=4)
                grad = np.array(dr.grad(params[key]))
            kernels = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
        found[edges] = grad, len(kernels)
    for edges in ("all", "auto"):
        assert np.array_equal(found["none"][0], found[edges][0])
        assert found["none"][1] == found[edges][1]


def test_edges_before_a_glow_need_no_emitter() -> None:
    """A card moves before a box of glowing gas: its edge sweeps over the radiance 1 - exp(-2)."""
    glow = {"type": "gridmedium", "albedo": 0.0, "sigma_t": 1.0, "radiance": 1.0}
    card = {"type": "rectangle", "to_world": scenes.T().translate([0.3, 0, 2]).scale(0.4)}
    box = {"type": "cube", "bsdf": {"type": "null"}, "interior": glow}
    scene = mi.load_dict({"type": "scene", "camera": camera((0, 0, 5)), "card": card, "box": box}, optimize=False)
    params, x = mi.traverse(scene), mi.Float(0)
    dr.enable_grad(x)
    params["card.to_world"] = mi.Transform4f().translate([x, 0, 0]) @ mi.Transform4f(params["card.to_world"])
    params.update()
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 3, "boundary": "all"})
    integrator.render_backward(scene, params, dr.full(mi.TensorXf, 1 / 768, (16, 16, 3)), spp=1024)
    dr.enqueue(dr.ADMode.Backward, params["card.to_world"].matrix)
    dr.traverse(dr.ADMode.Backward)
    width = 2 * 3 * np.tan(np.deg2rad(5))  # of what the camera sees, where the card is
    assert np.array(dr.grad(x)) == pytest.approx((1 - np.exp(-2)) / width, rel=0.01)


def test_a_medium_out_of_view_takes_no_edges_from_a_large_film() -> None:
    """The two rays that enclose an edge are close, and yet meet different surfaces behind the medium's part of them."""
    card = {
        "type": "rectangle",
        "to_world": scenes.T().translate([0.3, 0, 2]).scale(0.4),
        "bsdf": {"type": "diffuse", "reflectance": 0.0},
    }
    fog = {"type": "homogeneous", "albedo": 0.0, "sigma_t": 1.0}
    aside = {"type": "cube", "to_world": scenes.T().translate([5, 0, -3]), "bsdf": {"type": "null"}, "interior": fog}
    eye = camera((0, 0, 5), 40)
    eye["film"] = {**eye["film"], "width": 256, "height": 256}
    weights, integrator = [], mi.load_dict({"type": "pathreplay", "max_depth": 3})
    worlds = [{"type": "scene", "eye": eye, "card": card, "sky": {"type": "constant"}, **p} for p in ({}, {"a": aside})]
    for scene in [mi.load_dict(each) for each in worlds]:  # both stay alive
        with careful(), dr.suspend_grad():
            view = Pass.of(scene, 0, 0, 1)
            trace = integrator._trace_config(scene, view.sensor)
            (edges,) = PrimarySearch.of(trace, FilmPlaces.of(view), 0.5).find(2**16, 8, mi.UInt32(1))
        weights.append(np.abs(np.array(edges.crossings[0].weight)[0]))
    # Of the edges, 5 % had no weight, because both rays met the same surface. Threads add in varying order, so that the
    # two searches do not resample the same crossings.
    assert [(found > 0).mean() > 0.998 for found in weights] == [True, True]
    assert weights[1].sum() == pytest.approx(weights[0].sum(), rel=1e-2)


def test_parts_of_a_search_draw_different_numbers() -> None:
    mass = dr.ones(mi.Float, 1000)
    one, same, other = (Resampled.of(mass, 50, mi.UInt32(1), first).index for first in (0, 0, 50))
    assert dr.all(one == same) and dr.count(one == other)[0] < 25


@pytest.mark.parametrize("name", ["shadow_occluder", pytest.param("indirect_rough", marks=pytest.mark.slow)])
def test_a_search_in_parts_finds_as_much(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory is proportional to the size of a part. Neither mean nor noise of a gradient depends on it."""
    bench = Bench(scenes.BY_NAME[name])
    bench.weigh(scenes.weights())
    seeds, spp = range(8), 5
    whole = np.array([bench.backward(ours(bench), seed, spp) for seed in seeds])
    searched, importances = [], SecondarySearch._importances

    def counted(self: SecondarySearch, path: Any) -> Any:
        searched.append(dr.width(path.key))
        return importances(self, path)

    monkeypatch.setattr(search, "AT_ONCE", 600)
    monkeypatch.setattr(SecondarySearch, "_importances", counted)
    parts = np.array([bench.backward(ours(bench), seed + 100, spp) for seed in seeds])
    bench.release()
    assert max(searched) <= 600 < sum(searched) / len(seeds)
    assert abs(gap(parts, whole).z) < Z_LIMIT, gap(parts, whole)
    assert 1 / 3 < parts.std() / whole.std() < 3


def test_hard_shadows_on_large_films_lose_no_edges() -> None:
    """The two sides of an edge are so close there that a shadow ray of each could end on the same side of the ball."""
    eye = camera((0, 0, 5), 40)
    eye["film"] = {**eye["film"], "width": 1024, "height": 1024}
    parts = {
        "floor": {"type": "rectangle", "to_world": scenes.T().scale(3)},
        "ball": {"type": "sphere", "center": [0, 0, 1], "radius": 0.3},
        "light": {"type": "point", "position": [1, 0.5, 3]},
    }
    scene, integrator = mi.load_dict({"type": "scene", "eye": eye, **parts}), mi.load_dict({"type": "pathreplay"})
    with careful(), dr.suspend_grad():
        view = Pass.of(scene, 0, 0, 1)
        trace = integrator._trace_config(scene, view.sensor)
        (edges,) = PrimarySearch.of(trace, FilmPlaces.of(view), 0.5).find(2**16, 8, mi.UInt32(1))
        crossing = edges.crossings[0]
        assert isinstance(crossing, FilmCrossing) and crossing.edge.crease.shadow is not None
        on_floor = crossing.edge.active & crossing.edge.crease.shadow.exists
        on_floor &= crossing.edge.near.hit.shape == mi.ShapePtr(next(s for s in scene.shapes() if s.id() == "floor"))
    weights = np.array(crossing.weight)[0][np.array(on_floor)]
    assert len(weights) > 1000
    assert (weights == 0).mean() < 1e-3  # it was zero for half of them


def test_the_cone_around_a_mesh_lamp_follows_it() -> None:
    """Also where vertices move within a box that stays."""
    scene = mi.load_dict(scenes.scene(wall=scenes.shape(scenes.BACK, scenes.BLACK), lamp=scenes.ball_of_triangles()))
    facts, params = SceneFacts(scene), mi.traverse(scene)
    key = next(key for key in params.keys() if key.endswith("vertex_positions"))
    before = np.array(facts.tables().emitter_bounds).reshape(-1, 4)
    assert before[0, 3] == pytest.approx(0.4, rel=0.05)
    vertices = np.array(params[key]).reshape(-1, 3)
    box = vertices.min(axis=0), vertices.max(axis=0)
    vertices[5] = box[1]
    params[key] = mi.Float(vertices.ravel())
    params.update()
    centre, radius = np.mean(box, axis=0), np.linalg.norm(box[1] - box[0]) / 2
    assert np.array(facts.tables().emitter_bounds) == pytest.approx([*centre, radius], rel=1e-4)
    params[key] = mi.Float((vertices + 1).ravel())
    params.update()
    assert np.array(facts.tables().emitter_bounds) == pytest.approx([*(centre + 1), radius], rel=1e-4)


@pytest.mark.parametrize(
    ("kind", "place"),
    [
        ("rectangle", scenes.OVERHEAD),
        pytest.param("sphere", scenes.T().translate([1.6, 1.2, 2.5]).scale(0.4), marks=pytest.mark.slow),
    ],
)
def test_the_texels_of_a_lamp_are_no_edges(kind: str, place: Any) -> None:
    """Samples of a textured lamp jump between texels. Its shadows still move like those of a lamp without a texture."""
    texels = {**bitmap(np.full((8, 8, 3), 5)), "filter_type": "bilinear"}
    found = []
    for radiance in (5.0, texels):
        make = scenes.shadow(light=partial(scenes.lamp, place, radiance, kind))
        case = scenes.cell("lamp", make, scenes.OBJECT, scenes.translate(*scenes.ASIDE))
        with loaded(case) as bench:
            found.append(np.mean([bench.backward(ours(bench), seed, 256) for seed in range(4)]))
    assert found[1] == pytest.approx(found[0], rel=0.12)


def test_distant_sensors_see_outlines_move() -> None:
    """A black card before a white sky, seen by a sensor whose rays end on a square of 3 x 3."""
    film = {"type": "hdrfilm", "width": 1, "height": 1, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    seen = {"type": "rectangle", "to_world": scenes.T().scale(1.5)}
    eye = {"type": "distant", "direction": [0, 0, -1], "target": seen, "film": film}
    card = scenes.shape(scenes.T().translate([0.3, 0.2, 0]).rotate([0, 0, 1], 20).scale([0.5, 0.4, 1]), scenes.BLACK)
    scene = mi.load_dict({"type": "scene", "eye": eye, "card": card, "sky": {"type": "constant", "radiance": 1.0}})
    params, size = mi.traverse(scene), mi.Float(1)
    still = mi.Transform4f(params["card.to_world"])
    dr.enable_grad(size)
    params["card.to_world"] = still @ mi.Transform4f().scale(mi.Point3f(size, size, 1))
    params.update()
    image = mi.render(scene, params, integrator=mi.load_dict({"type": "pathreplay", "max_depth": 2}), spp=2**17)
    dr.backward(dr.mean(image, axis=None))
    params["card.to_world"] = still
    params.update()
    assert dr.grad(size)[0] == pytest.approx(-2 * 0.8 / 9, rel=0.08)


def test_passes_share_no_random_numbers() -> None:
    """With keys of i ^ seed, lines of all passes would be the same, in another order."""
    lanes = 2**14
    keys = [set(np.array(key_of(dr.arange(mi.UInt32, lanes), mi.UInt32(seed))).tolist()) for seed in (1, 2, 3)]
    assert all(len(each) > lanes - 4 for each in keys)
    assert len(set.union(*keys)) > 3 * lanes - 12


def most_together(numbers: list[np.ndarray]) -> float:
    """z of chi² of those two that go together most, on 16 x 16 cells."""
    cells, n = [np.minimum((16 * x).astype(int), 15) for x in numbers], len(numbers[0])
    counts = [np.bincount(16 * a + b, minlength=256) for a, b in combinations(cells, 2)]
    return max((((each - n / 256) ** 2).sum() * 256 / n - 255) / np.sqrt(2 * 255) for each in counts)


def test_numbers_of_a_key_know_nothing_of_each_other() -> None:
    """With four rounds they do: what a vertex sees went together with how paths had come to it."""
    keys = key_of(dr.arange(mi.UInt32, 2**20), mi.UInt32(3))
    numbers = CounterSampler.of(keys)
    found = [np.array(numbers.next_1d()) for _ in range(12)]
    assert most_together(found) < 5
    fewer = [np.array(mi.sample_tea_float32(keys, mi.UInt32(i), ROUNDS // 2)) for i in range(12)]
    assert most_together(fewer) > 100


def test_what_is_closer_than_rays_begin_is_rounding() -> None:
    """On an H100 rays that left a can by its rim met its side at 2e-9, and one edge there counted a thousand others."""
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.p, si.n = mi.Point3f(2, -7, 0.5), mi.Normal3f(0, 0, 1)
    beside = dr.norm(si.spawn_ray(mi.Vector3f(0, 0, 1)).o - si.p)
    observer: Any = SimpleNamespace(origin=si)
    far = ObserverVertex.is_far(observer, beside * mi.Float(0, 1e-5, 9.9, 10.1, 100))
    assert np.array(far).tolist() == [False, False, False, True, True]


def test_samples_of_a_ball_are_asked_for_on_a_disk() -> None:
    """As many by area, and places that are close to each other have directions that are."""
    trace: Any = SimpleNamespace(traits=SimpleNamespace(sphere_lights=True))
    lamp: Any = SimpleNamespace(polar=mi.Bool(True))
    x, y = dr.meshgrid(*2 * (dr.linspace(mi.Float, 0.005, 0.995, 100),))
    u = sample_at(trace, lamp, mi.Point2f(x, y))
    counts, *_ = np.histogram2d(*np.array(u), bins=4, range=((0, 1), (0, 1)))
    assert counts.sum() == 10_000 and np.abs(counts - 625).max() < 40
    close = [sample_at(trace, lamp, mi.Point2f(0.5 + d, 0.5)) for d in (-1e-3, 1e-3)]
    there = [dr.sqrt(p.x) * mi.Point2f(dr.cos(dr.two_pi * p.y), dr.sin(dr.two_pi * p.y)) for p in close]
    assert dr.all(dr.norm(there[1] - there[0]) < 1e-2)
    assert dr.all(sample_at(trace, SimpleNamespace(polar=mi.Bool(False)), close[0]).x == close[0].x)


def test_chains_in_fog_are_not_ended_by_roulette() -> None:
    """Between two mirrors: of a chain that ends early, transmittance would be that of a part of its way."""
    behind = scenes.T().translate([0, 0, 5]).rotate([0, 1, 0], 180).scale([6, 6, 1])
    mirrors = [scenes.shape(place, {"type": "conductor"}) for place in (scenes.BACK, behind)]
    scene = mi.load_dict(media.in_fog(media.thin(), 5, front=mirrors[0], back=mirrors[1]))
    view, key = Pass.of(scene, 0, 0, 1), dr.arange(mi.UInt32, 2000)
    places = FilmPlaces.of(view)
    trace = mi.load_dict({"type": "pathreplay", "max_depth": 8, "rr_depth": 1})._trace_config(scene, view.sensor)
    with dr.suspend_grad():
        s = mi.Point2f(quasi_random(key, 2000, mi.UInt32(1))) * places.size
        ray, reach = places.ray(s, key)[0], 0.5
        T, _ = transmittance_of_chain(
            trace, ray, places.medium(trace, ray, mi.Bool(True)), key, mi.UInt32(4), mi.Float(reach), mi.Bool(True)
        )
    length = (5 + 3 * 6) / dr.abs(ray.d.z) + reach
    assert np.array(T) == pytest.approx(np.exp(-0.25 * np.array(length)) * np.ones((3, 1)), rel=0.02)


@pytest.mark.parametrize(("depth", "by_chance", "dark"), [(2, False, False), (1, False, True), (2, True, True)])
def test_beams_have_edges_where_they_are_seen(depth: int, by_chance: bool, dark: bool) -> None:
    """Not if paths end before they are scattered, or if only chance finds a light, which never finds a point."""
    scene = mi.load_dict(media.shadow_in_fog(media.point, **(media.BY_CHANCE if by_chance else {}))())
    view = Pass.of(scene, 0, 0, 1)
    trace = mi.load_dict({"type": "pathreplay", "max_depth": depth})._trace_config(scene, view.sensor)
    with careful(), dr.suspend_grad():
        (edges,) = VolumetricSearch.of(trace, FilmPlaces.of(view), 0.5).find(2000, 10, mi.UInt32(1))
        weight = np.abs(edges.crossings[0].weight).sum()
    assert (weight == 0) == dark


def test_a_single_line_has_a_place() -> None:
    """As in the search of a film of few pixels, which looks closer at every sixteenth line."""
    places = quasi_random(mi.UInt32(0), 1, mi.UInt32(7), 3)
    assert all(0 <= x[0] < 1 for x in places)
