"""`pathreplay render`: the same picture as Mitsuba's, in one file or none, and one line for what cannot be."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from pathreplay.errors import PathreplayError
from pathreplay.inverse.images.io import read_image
from pathreplay.output import picture
from pathreplay.output.render import RenderOptions, render_to_file
from pathreplay.platform import memory
from pathreplay.scenes.loading import load_scene

SIZE = {"size": "12x8", "spp": 4, "seed": 5}


def to_file(scene: str, path: Path, **asked: object) -> str:
    return render_to_file(scene, path, RenderOptions(**asked), progress=False)


def direct(integrator: dict, spp: int = 4, seed: int = 5) -> np.ndarray:
    """By Mitsuba's own function, at the size of the tests."""
    scene = load_scene("cornell-box")
    picture.set_size(scene.sensors()[0], "12x8")
    return np.array(mi.render(scene, integrator=mi.load_dict(integrator), spp=spp, seed=seed))


@pytest.mark.parametrize(
    ("integrator", "options"),
    [("path", ["max_depth=3"]), ("pathreplay", ["max_depth=3"]), ("direct", []), ("prb", ["max_depth=2"])],
)
def test_it_is_the_picture_of_mitsuba(tmp_path: Path, integrator: str, options: list[str]) -> None:
    path = tmp_path / "image.exr"
    told = to_file("cornell-box", path, integrator=integrator, options=options, **SIZE)
    own = {name: int(value) for name, value in (each.split("=") for each in options)}
    np.testing.assert_allclose(read_image(path), direct({"type": integrator, **own}), rtol=1e-5, atol=1e-6)
    assert told.startswith(f"{path}: 12 x 8, 4 samples per pixel")
    assert [each.name for each in tmp_path.iterdir()] == ["image.exr"]


def test_without_an_integrator_it_is_the_scenes(tmp_path: Path) -> None:
    to_file("cornell-box", tmp_path / "image.exr", **SIZE)
    expected = direct({"type": "path", "max_depth": 8})
    np.testing.assert_allclose(read_image(tmp_path / "image.exr"), expected, rtol=1e-5, atol=1e-6)


def test_a_png_is_srgb(tmp_path: Path) -> None:
    for name in ("image.exr", "image.png"):
        to_file("cornell-box", tmp_path / name, **SIZE)
    linear, decoded = (read_image(tmp_path / name) for name in ("image.exr", "image.png"))
    assert decoded.shape == (8, 12, 3)
    np.testing.assert_allclose(decoded, np.clip(linear, 0, 1), atol=0.006)


def test_sensors_are_named_or_counted_and_the_scene_takes_parameters(tmp_path: Path) -> None:
    for name, sensor in (("a", "closeup"), ("b", "1"), ("c", "overview")):
        to_file(
            "cornell-box-photo", tmp_path / f"{name}.exr", sensor=sensor, spp=1,
            define=["resolution=8", "texture=4"],
        )  # fmt: skip
    a, b, c = (read_image(tmp_path / f"{name}.exr") for name in "abc")
    assert a.shape == (8, 8, 3) and np.array_equal(a, b) and not np.array_equal(a, c)


def test_channels_of_an_aov_have_their_names(tmp_path: Path) -> None:
    import OpenEXR

    path = tmp_path / "image.exr"
    to_file("cornell-box", path, integrator="aov", options=["aovs=far:depth"], **SIZE)
    with OpenEXR.File(str(path)) as file:
        assert [name for name in file.channels()] == ["far.T"]
    with pytest.raises(PathreplayError, match=r"'far\.T'; use \.exr"):
        to_file("cornell-box", tmp_path / "image.png", integrator="aov", options=["aovs=far:depth"], **SIZE)
    assert not (tmp_path / "image.png").exists()


def test_passes_hold_what_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_scene("cornell-box")
    sensor = scene.sensors()[0]
    picture.set_size(sensor, "10")
    assert picture.passes(sensor, 7) == [7]
    monkeypatch.setattr(picture, "_A_PASS", 300)
    assert picture.passes(sensor, 7) == [3, 2, 2]
    assert picture.passes(sensor, 10**5)[:2] == [3, 3]
    monkeypatch.setattr(picture, "_A_PASS", 1)
    assert picture.passes(sensor, 3) == [1, 1, 1]


def test_samplers_that_spread_samples_are_split_only_where_memory_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    description = mi.cornell_box()
    description["sensor"]["sampler"] = {"type": "stratified"}
    sensor = mi.load_dict(description).sensors()[0]
    picture.set_size(sensor, "10")
    monkeypatch.setattr(picture, "_A_PASS", 300)
    assert picture.passes(sensor, 64) == [64]
    monkeypatch.setattr(memory, "available", lambda: 10**6)
    assert picture.passes(sensor, 300) == [64] * 5  # 78 would fit; they come in powers of four


def test_passes_add_up_to_one_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three passes are nearer to the truth than one of them: 0.58 times as far, if each has samples of its own."""
    scene = load_scene("cornell-box")
    sensor = scene.sensors()[0]
    picture.set_size(sensor, "8")
    truth, first = (picture.render(scene, sensor, scene.integrator(), spp, 1).image for spp in (2048, 32))
    seen: list[tuple[int, int]] = []
    monkeypatch.setattr(picture, "_A_PASS", 64 * 40)
    three = picture.render(scene, sensor, scene.integrator(), 96, 1, lambda *now: seen.append(now))
    assert seen == [(1, 3), (2, 3), (3, 3)] and three.spp == 96
    errors = [float(np.mean(np.abs(image - truth))) for image in (first, three.image)]
    assert 0.3 < errors[1] / errors[0] < 0.85


@pytest.mark.parametrize(
    ("output", "changes", "line"),
    [
        ("image.jpg", {}, r"ends in '\.jpg'; give -o a name"),
        ("nowhere/image.exr", {}, "nowhere for image.exr does not exist; create it first"),
        ("image.exr", {"sensor": "back"}, "No sensor 'back' in the scene; it has sensor"),
        ("image.exr", {"sensor": "1"}, "No sensor '1'"),
        ("image.exr", {"size": "12x"}, "--size '12x' is not a size"),
        ("image.exr", {"size": "99999999"}, "is not a size"),
        ("image.exr", {"spp": 0}, "--spp 0 is out of range"),
        ("image.exr", {"spp": 10**7}, "samples from 1 to 1000000"),
        ("image.exr", {"seed": -1}, "--seed -1 is out of range"),
        ("image.exr", {"integrator": "paht"}, "Integrator 'paht' cannot be created"),
        ("image.exr", {"integrator": "path", "options": ["max_depth=deep"]}, "max_depth"),
        ("image.exr", {"integrator": "path", "options": ["a.b=1"]}, "-I a is {'b': 1}; give a number"),
        ("image.exr", {"options": ["max_depth=3"]}, "name it with --integrator"),
        ("image.exr", {"define": ["res=3"]}, "has no parameter 'res'"),
        ("image.exr", {"define": ["resolution"]}, "has no '='"),
    ],
)
def test_what_cannot_be_is_told_and_leaves_the_file(
    tmp_path: Path, output: str, changes: dict[str, object], line: str
) -> None:
    path = tmp_path / output
    if path.parent == tmp_path:
        path.write_bytes(b"old")
    with pytest.raises(PathreplayError, match=line):
        to_file("cornell-box", path, **{**SIZE, **changes})
    if path.parent == tmp_path:
        assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


def test_an_interrupt_leaves_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "image.exr"
    path.write_bytes(b"old")

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("pathreplay.platform.atomic_files.os.replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        to_file("cornell-box", path, **SIZE)
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]
