"""Target pictures: what a file holds is what is compared, whatever its format; names by pattern; what alpha does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import PIL.Image
import PIL.ImageCms
import pytest

from pathreplay.errors import PathreplayError
from pathreplay.inverse.dataset.globbing import matching
from pathreplay.inverse.dataset.views import sensors_of, shares_of
from pathreplay.inverse.images.io import encoded, exposure_for, exr_bytes, levels, over_black, png_bytes, read_image
from pathreplay.inverse.problem.problem import InMemory, Problem, build_problem
from pathreplay.jobs import make_config
from pathreplay.platform.threads import spare_thread

WIDTH, HEIGHT = 6, 4
SKY = [0.2, 0.4, 0.6]
SENSOR = {"type": "perspective", "fov": 40}


def scene(film: str = "rgb") -> str:
    return f"""<scene version="3.0.0">
      <sensor type="perspective" id="eye"><float name="fov" value="40"/>
        <film type="hdrfilm"><integer name="width" value="{WIDTH}"/><integer name="height" value="{HEIGHT}"/>
          <string name="pixel_format" value="{film}"/><rfilter type="box"/></film></sensor>
      <shape type="sphere" id="ball"><point name="center" x="0" y="0" z="9"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></shape>
      <emitter type="constant" id="sky"><rgb name="radiance" value="0.2, 0.4, 0.6"/></emitter>
    </scene>"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "room.xml").write_text(scene())
    return tmp_path


def problem_of(target: dict[str, Any], **more: Any) -> Problem:
    job = {"scene": "room.xml", "parameters": [{"key": "ball.bsdf.reflectance.value"}], "target": target} | more
    return build_problem(make_config(job), Path())


def target_of(file: str, **more: Any) -> np.ndarray:
    return problem_of({"images": [file], **more}).views[0].target


def colours(channels: int = 3) -> np.ndarray:
    return np.random.default_rng(1).uniform(0.02, 0.9, (HEIGHT, WIDTH, channels)).astype(np.float32)


# What a file of a format holds of a picture at best, in linear radiance.
FORMATS = {
    "exr": 1e-6,
    "pfm": 1e-6,
    "16.png": 1e-4,
    "png": 0.006,
    "hdr": 0.006,
}


@pytest.mark.parametrize("ending", FORMATS)
def test_formats_hold_the_same_picture(ending: str, folder: Path) -> None:
    """sRGB where the format is encoded, by the formula; as it is, where it is linear."""
    picture, path = colours(), folder / f"picture.{ending}"
    if ending == "exr":
        path.write_bytes(exr_bytes(picture))
    elif ending.endswith("png"):
        most = 65535 if ending.startswith("16") else 255
        whole = np.round(encoded(picture) * most).astype(np.uint16 if most > 255 else np.uint8)
        mi.Bitmap(whole).write(str(path))
    else:
        mi.Bitmap(picture).write(str(path))
    assert target_of(path.name) == pytest.approx(picture, abs=FORMATS[ending])


def test_a_jpeg_is_decoded_as_srgb(folder: Path) -> None:
    PIL.Image.new("RGB", (WIDTH, HEIGHT), (188, 55, 231)).save(folder / "picture.jpg", quality=100)
    expected = [0.503, 0.0382, 0.799]  # ((v / 255 + 0.055) / 1.055) ** 2.4
    assert target_of("picture.jpg")[1, 2] == pytest.approx(expected, abs=0.012)


def test_colour_profiles_are_ignored_with_a_word(folder: Path) -> None:
    grey = PIL.Image.new("RGB", (WIDTH, HEIGHT), (128, 128, 128))
    lab = PIL.ImageCms.ImageCmsProfile(PIL.ImageCms.createProfile("LAB")).tobytes()
    usual = PIL.ImageCms.ImageCmsProfile(PIL.ImageCms.createProfile("sRGB")).tobytes()
    grey.save(folder / "odd.png", icc_profile=lab)
    grey.save(folder / "usual.png", icc_profile=usual)
    turned = PIL.Image.Exif()
    turned[274] = 6
    grey.save(folder / "turned.jpg", exif=turned)
    (note,) = problem_of({"images": ["odd.png"]}).notes
    assert note.startswith("target image 'odd.png' has an ICC colour profile") and "decoded as sRGB" in note
    assert problem_of({"images": ["usual.png"]}).notes == ()
    (note,) = problem_of({"images": ["turned.jpg"]}).notes
    assert "has an Exif orientation" in note
    assert target_of("odd.png") == pytest.approx(target_of("usual.png"))


def test_patterns_name_files_in_the_order_in_which_people_count(folder: Path) -> None:
    for name in ("shot10.png", "shot9.png", "Shot2.png", "shot9.exr", "other.png"):
        (folder / name).touch()
    assert list(matching(["[sS]hot*.png"], folder)) == ["Shot2.png", "shot9.png", "shot10.png"]
    assert list(matching(["other.png", "*.exr"], folder)) == ["other.png", "shot9.exr"]
    (folder / "[1].png").touch()
    assert list(matching(["[1].png"], folder)) == ["[1].png"]  # a file of that very name


def test_patterns_leave_hidden_files_out(folder: Path) -> None:
    """macOS writes ._a.png beside a.png on disks of other systems."""
    for name in ("shot2.png", "._shot2.png", ".shot3.png"):
        (folder / name).touch()
    assert list(matching(["*shot*.png"], folder)) == ["shot2.png"]
    assert list(matching([".*.png"], folder)) == ["._shot2.png", ".shot3.png"]


def test_a_pattern_gives_a_picture_to_each_view(folder: Path) -> None:
    (folder / "photos").mkdir()
    two = scene().replace("<sensor", '<sensor type="perspective" id="left"><film type="hdrfilm"><integer name="width" '
        f'value="{WIDTH}"/><integer name="height" value="{HEIGHT}"/></film></sensor><sensor')  # fmt: skip
    (folder / "room.xml").write_text(two)
    for k, level in ((10, 0.7), (2, 0.3)):
        (folder / "photos" / f"{k}.exr").write_bytes(exr_bytes(np.full((HEIGHT, WIDTH, 3), level, np.float32)))
    views = problem_of({"images": "photos/*.exr"}).views
    assert [(view.name, round(float(view.target.mean()), 3)) for view in views] == [("left", 0.3), ("eye", 0.7)]
    for given, words in {
        "photos/1*.exr": "1 target images for 2 sensors (left, eye)",
        "photos/*.tif": "No file matches the pattern 'photos/*.tif' in ",
        "phot*/*.exr": "wildcards in a folder name",
        "gone/*.exr": "its folder cannot be read (No such file or directory)",
    }.items():
        with pytest.raises(PathreplayError) as told:
            problem_of({"images": given})
        assert words in str(told.value) and "\n" not in str(told.value)


def test_sensors_are_integers_of_numpy_or_decimal_text() -> None:
    """The keys of a table are text."""
    known = mi.load_string(scene())
    assert sensors_of(known, [np.int64(0)]) == sensors_of(known, ["0"]) == {"eye": 0}
    assert shares_of(known, {"eye": 0}, {"0": 2.0}, set()) == {"eye": 1.0}
    assert sensors_of(mi.load_dict({"type": "scene", "1": SENSOR, "b": {**SENSOR, "fov": 50}}), ["1"]) == {"1": 0}
    with pytest.raises(PathreplayError, match="No sensor '1' in the scene"):
        sensors_of(known, ["1"])


# ------------------------------------------------------------------------------
#  Alpha
# ------------------------------------------------------------------------------


def half_transparent(folder: Path, ending: str) -> np.ndarray:
    """A picture of the colour (0.8, 0.5, 0.1), opaque to the left, with alpha 0.25 to the right; its alpha."""
    alpha = np.repeat([[1.0] * 3 + [0.25] * 3], HEIGHT, axis=0).astype(np.float32)[:, :, None]
    colour = np.full((HEIGHT, WIDTH, 3), [0.8, 0.5, 0.1], np.float32)
    if ending == "exr":  # premultiplied
        (folder / "picture.exr").write_bytes(exr_bytes(np.concatenate([colour * alpha, alpha], axis=2)))
    else:
        whole = np.concatenate([encoded(colour), alpha], axis=2) * 65535
        mi.Bitmap(np.round(whole).astype(np.uint16)).write(str(folder / "picture.png"))
    return alpha


@pytest.mark.parametrize("ending", ["exr", "png"])
def test_alpha_is_composited_over_what_the_scene_has_behind(ending: str, folder: Path) -> None:
    alpha = half_transparent(folder, ending)
    expected = np.array([0.8, 0.5, 0.1]) * alpha + (1 - alpha) * SKY
    assert target_of(f"picture.{ending}", alpha="scene") == pytest.approx(expected, abs=1e-4)
    hidden = problem_of(
        {"images": [f"picture.{ending}"], "alpha": "scene"}, integrator={"type": "pathreplay", "hide_emitters": True}
    )
    assert hidden.views[0].target == pytest.approx(np.array([0.8, 0.5, 0.1]) * alpha, abs=1e-4)
    job = {"scene": "room.xml", "parameters": [{"key": "ball.bsdf.reflectance.value"}]}
    target = {"images": [f"picture.{ending}"], "alpha": "scene"}
    integrator = mi.load_dict({"type": "pathreplay", "hide_emitters": True})
    given = build_problem(make_config({**job, "target": target}), Path(), memory=InMemory(integrator=integrator))
    assert (given.views[0].target == hidden.views[0].target).all(), "an object has the options of a table"


def test_the_background_of_a_deterministic_job_is_rendered_by_one_thread(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counts = []

    def counted(scene: mi.Scene, sensor: int) -> np.ndarray:
        counts.append(dr.thread_count())
        return np.zeros((HEIGHT, WIDTH, 3), np.float32)

    monkeypatch.setattr("pathreplay.inverse.dataset.targets.background", counted)
    half_transparent(folder, "exr")
    with spare_thread():
        for deterministic in (False, True):
            problem_of({"images": ["picture.exr"], "alpha": "scene"}, deterministic=deterministic)
    assert counts[0] > counts[1] == 1


@pytest.mark.parametrize("ending", ["exr", "png"])
def test_alpha_is_compared_where_the_film_has_it(ending: str, folder: Path) -> None:
    alpha = half_transparent(folder, ending)
    (folder / "room.xml").write_text(scene("rgba"))
    expected = np.concatenate([np.array([0.8, 0.5, 0.1]) * alpha, alpha], axis=2)
    assert target_of(f"picture.{ending}", alpha="compare") == pytest.approx(expected, abs=1e-4)


def test_a_png_has_straight_colours_and_its_exposure_spares_alpha(folder: Path) -> None:
    premultiplied = np.full((HEIGHT, WIDTH, 4), [0.2, 0.1, 0.05, 0.5], np.float32)
    (folder / "half.png").write_bytes(png_bytes(premultiplied, 2.0))
    assert over_black(read_image(folder / "half.png"), folder / "half.png") == pytest.approx(
        premultiplied * np.float32([2, 2, 2, 1]), abs=0.01
    )


def test_grey_is_not_alpha(folder: Path) -> None:
    (folder / "grey.png").write_bytes(png_bytes(np.full((HEIGHT, WIDTH, 1), 0.2, np.float32)))
    assert target_of("grey.png") == pytest.approx(np.full((HEIGHT, WIDTH, 3), 0.2), abs=0.01)
    (folder / "room.xml").write_text(scene("rgba"))
    with pytest.raises(PathreplayError, match=r"has 1 channel.*renders 4"):
        target_of("grey.png")


def test_a_target_has_the_shadow_of_a_shape_that_has_left_the_scene(folder: Path) -> None:
    """A plate between floor and sun. Mitsuba keeps the bounding sphere that the scene had when it was loaded."""
    plate = '<shape type="cube" id="plate"><transform name="to_world"><translate z="{z}"/></transform></shape>'
    sun = '<emitter type="directional" id="sun"><vector name="direction" x="0" y="0" z="-1"/></emitter>'
    look = '<transform name="to_world"><lookat origin="3, 0, 3" target="0, 0, 0" up="0, 0, 1"/></transform>'
    for name, z in (("low", 1), ("high", 20)):
        made = scene().split("<shape")[0].replace('<float name="fov"', look + '<float name="fov"')
        floor = '<shape type="rectangle" id="floor"/>'
        (folder / f"{name}.xml").write_text(f"{made}{floor}{plate.format(z=z)}{sun}</scene>")
    corners = mi.traverse(mi.load_file("high.xml"))["plate.vertex_positions"]
    job = {
        "scene": "low.xml",
        "parameters": [{"key": "sun.irradiance.value"}],
        "target": {"values": {"plate.vertex_positions": np.array(corners).tolist()}, "spp": 64},
    }
    target = build_problem(make_config(job), Path()).views[0].target
    path = mi.load_dict({"type": "path", "max_depth": 6})
    assert target == pytest.approx(np.array(mi.render(mi.load_file("high.xml"), integrator=path, spp=64)), abs=0.03)


@pytest.mark.parametrize(("film", "way_out"), [("xyz", "rgb"), ("xyza", "rgba")])
def test_films_that_store_xyz_are_refused(film: str, way_out: str, folder: Path) -> None:
    """Targets are RGB images."""
    (folder / "room.xml").write_text(scene(film))
    (folder / "target.exr").write_bytes(exr_bytes(colours()))
    with pytest.raises(PathreplayError, match=f"'eye' has pixel_format = '{film}', .*; use '{way_out}'$"):
        target_of("target.exr")


def test_parameters_of_objects_without_id_are_told(folder: Path) -> None:
    """Their names are addresses in memory, which no other process knows."""
    (folder / "room.xml").write_text(scene().replace(' id="sky"', ""))
    (folder / "target.exr").write_bytes(exr_bytes(colours()))
    keys = [{"key": "*.radiance.value"}]
    (folder / "named.xml").write_text(scene().replace('"sky"', '"object_1"'))
    problem = problem_of({"images": ["target.exr"]}, scene="named.xml", parameters=keys)
    assert [variable.key for variable in problem.variables] == ["object_1.radiance.value"]
    assert not problem.notes
    (note,) = problem_of({"images": ["target.exr"]}, parameters=keys).notes
    assert note.startswith("'*.radiance.value' matches 'radiance.value' of an object without id, ")


def test_alpha_does_not_set_the_exposure() -> None:
    grey = np.full((HEIGHT, WIDTH, 1), 0.01, np.float32)
    with_alpha = np.concatenate([grey, np.ones_like(grey)], axis=2)
    assert exposure_for(levels(with_alpha)) == exposure_for(levels(grey)) == pytest.approx(100)


def test_what_alpha_cannot_be_is_refused_in_one_line(folder: Path) -> None:
    half_transparent(folder, "exr")
    (folder / "opaque.png").write_bytes(png_bytes(colours()))
    sky = [{"key": "sky.radiance.value"}]
    for target, more, words in (
        ({"images": ["picture.exr"], "alpha": "compare"}, {}, "in the film of sensor 'eye'; set its pixel_format"),
        ({"images": ["opaque.png"], "alpha": "scene"}, {}, "has no alpha channel for alpha = 'scene'"),
        ({"images": ["picture.exr"], "alpha": "scene"}, {"parameters": sky}, "'sky.radiance.value' is to be recovered"),
        (
            {"values": {"ball.bsdf.reflectance.value": 0.4}, "alpha": "scene"},
            {},
            "alpha = 'scene' applies to 'images'",
        ),
    ):
        with pytest.raises(PathreplayError) as told:
            problem_of(target, **more)
        assert words in str(told.value) and "\n" not in str(told.value)
    (folder / "room.xml").write_text(scene("rgba"))
    with pytest.raises(PathreplayError, match="makes images opaque, but the film of sensor 'eye' has an alpha"):
        target_of("picture.exr", alpha="scene")
