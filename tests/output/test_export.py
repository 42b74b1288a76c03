"""`pathreplay export`: what comes out is loaded by Mitsuba alone, and renders to the picture of the run's values."""

from __future__ import annotations

import gc
import json
import shlex
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay import cli
from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.schema import PICTURE, Capture
from pathreplay.inverse.dataset.capture import pinhole_camera, read_capture
from pathreplay.inverse.dataset.undistortion import Lens
from pathreplay.inverse.images.io import exr_bytes, read_image
from pathreplay.jobs import make_config, optimize
from pathreplay.output.export import _cameras, export_run, obj_bytes, write_files
from pathreplay.output.scene_folder import Exported, Source, exported, require_same
from pathreplay.platform.compat import mesh_arrays
from pathreplay.scenes.builtin import BUILTINS
from pathreplay.scenes.caustics import sheet
from pathreplay.scenes.parameters import get_array
from pathreplay.scenes.volume_files import load_volume, save_vol
from room_job import JOB, SCENE


def pictures(scene: mi.Scene, integrator: mi.Integrator, spp: int = 4) -> list[np.ndarray]:
    views = range(len(scene.sensors()))
    return [np.array(mi.render(scene, sensor=i, integrator=integrator, spp=spp, seed=3)) for i in views]


def loaded(folder: Path) -> mi.Scene:
    return mi.load_file(str(folder / "scene.xml"))  # as users do, with all that is optimised then


def same_pictures(found: Exported, folder: Path) -> None:
    """Write what was exported, load it, and compare what is seen in all sensors at the same seed."""
    folder.mkdir()
    write_files(found, folder)
    require_same(found.scene, folder)
    scene = mi.load_file(str(folder / "scene.xml"), optimize=False)
    for ours, theirs in zip(*(pictures(s, scene.integrator()) for s in (found.scene, scene)), strict=True):
        assert ours.mean() > 0.01
        assert alike(ours, theirs) > 0.95 and abs(ours.mean() / theirs.mean() - 1) < 0.01


def alike(image: np.ndarray, other: np.ndarray) -> float:
    """The share of values that are the same but for rounding, which now and then turns a path at a random decision."""
    return float(np.isclose(image, other, rtol=1e-4, atol=2e-5).mean())


SMALL: dict[str, dict[str, int]] = {
    "cornell-box-photo": {"texture": 6}, "glass-pane": {"texture": 6}, "cloud": {"grid": 6, "views": 2},
    "caustic-lens": {"columns": 6, "rows": 6}, "caustic-mirror": {"columns": 6, "rows": 6},
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", BUILTINS)
def test_every_built_in_scene_comes_out_as_it_is(name: str, tmp_path: Path) -> None:
    scene = BUILTINS[name](resolution=12, **SMALL.get(name, {}))
    same_pictures(exported(Source(scene, {}, {}, {}), {}), tmp_path / "out")


def test_a_made_mesh_of_metal_comes_out(tmp_path: Path) -> None:
    scene = BUILTINS["caustic-mirror"](resolution=12, **SMALL["caustic-mirror"])
    scene["mirror"] = sheet(6, 6, 1.0, {"type": "conductor", "material": "Cu", "specular_reflectance": 0.9})
    same_pictures(exported(Source(scene, {}, {}, {}), {}), tmp_path / "out")


#: Kinds of recovered values: a scene dictionary's own, and the values that a run may end with.
CHANGED: dict[str, tuple[str, dict[str, Any]]] = {
    "texture and colours": (
        "cornell-box-photo",
        {
            "back.bsdf.reflectance.data": np.linspace(0, 1, 5 * 7 * 3).reshape(5, 7, 3),  # of another size
            "red.reflectance.value": np.array([0.1, 0.7, 0.2]),
            "light.emitter.radiance.value": np.array([3.0, 9.0, 20.0]),
        },
    ),
    "vertices of a cube": (
        "cornell-box",
        {"small-box.vertex_positions": np.linspace(-0.7, 0.7, 72) ** 3},
    ),
    "poses": (
        "mirror-camera",
        {
            "camera.to_world": np.array([[-0.8, 0, -0.6, 0.5], [0, 1, 0, 0.3], [0.6, 0, -0.8, 1.5], [0, 0, 0, 1]]),
            "mirror.to_world": np.diag([1.1, 0.9, 1.0, 1.0]),
        },
    ),
    "a grid of another size": (
        "cloud",
        {"cloud.interior_medium.sigma_t.data": np.linspace(0, 4, 3 * 4 * 5).reshape(3, 4, 5, 1)},
    ),
    "a field of view": ("flat-colours", {"camera.x_fov": np.array([61.0])}),
    "a smooth mesh that came in made": (
        "silhouettes",
        {"body.bsdf.reflectance.value": np.array([0.5]), "sky.radiance.value": np.array([0.7, 0.6, 0.5])},
    ),
}


@pytest.mark.parametrize("case", CHANGED)
def test_values_come_out_with_the_scene(case: str, tmp_path: Path) -> None:
    name, values = CHANGED[case]
    scene = BUILTINS[name](resolution=8, **SMALL.get(name, {}))
    found = exported(Source(scene, {}, {}, {}), {key: np.float32(value) for key, value in values.items()})
    before = mi.load_dict(scene, optimize=False)
    changed = pictures(found.scene, mi.load_dict({"type": "volpath", "max_depth": 4}))
    plain = pictures(before, mi.load_dict({"type": "volpath", "max_depth": 4}))
    assert any(alike(a, b) < 0.9 for a, b in zip(changed, plain, strict=True))
    same_pictures(found, tmp_path / "out")


@pytest.mark.parametrize("source", ["a file", "a grid"])
def test_a_grid_in_the_box_of_its_file_comes_out_in_that_box(source: str, tmp_path: Path) -> None:
    box = (-1.0, -0.5, -1.0), (1.0, 0.75, 1.0)
    save_vol(tmp_path / "cloud.vol", np.linspace(0, 4, 27, dtype=np.float32).reshape(3, 3, 3), box)
    file = str(tmp_path / "cloud.vol")
    scene = BUILTINS["cloud"](resolution=8, grid=4, views=1)
    values = {"filename": file} if source == "a file" else {"grid": mi.VolumeGrid(file)}
    scene["cloud"]["interior"]["sigma_t"] = {"type": "gridvolume", "use_grid_bbox": True, **values}
    key = "cloud.interior_medium.sigma_t.data"
    found = exported(Source(scene, {}, {}, {}), {key: np.full((3, 3, 3, 1), 2, np.float32)})
    same_pictures(found, tmp_path / "out")
    assert load_volume(tmp_path / f"out/volumes/{key}.vol").bounds() == box


def with_picture(picture: dict[str, Any]) -> dict[str, Any]:
    """A box whose back is painted with a bitmap."""
    scene = BUILTINS["cornell-box"](resolution=8)
    scene["back"]["bsdf"] = {"type": "diffuse", "reflectance": {"type": "bitmap", **picture}}
    return scene


def test_a_dictionary_with_a_tensor_comes_out_and_stays_whole(tmp_path: Path) -> None:
    """`mi.load_dict` moves tensors out of the dictionary that it loads."""
    texels = np.linspace(0.1, 0.9, 4 * 5 * 3, dtype=np.float32).reshape(4, 5, 3)
    scene = with_picture({"raw": True, "data": mi.TensorXf(texels)})
    found = exported(Source(scene, {}, {}, {}), {"red.reflectance.value": np.float32([0.2, 0.3, 0.8])})
    same_pictures(found, tmp_path / "out")
    np.testing.assert_array_equal(scene["back"]["bsdf"]["reflectance"]["data"], texels)


BYTES = np.random.default_rng(0).integers(0, 255, (4, 5, 3), np.uint8)


@pytest.mark.parametrize("kind", ["sRGB", "raw", "linear"])
def test_a_bitmap_of_bytes_comes_out_as_it_is(kind: str, tmp_path: Path) -> None:
    bitmap = mi.Bitmap(BYTES)
    bitmap.set_srgb_gamma(kind != "linear")
    found = exported(Source(with_picture({"bitmap": bitmap, "raw": kind == "raw"}), {}, {}, {}), {})
    same_pictures(found, tmp_path / "out")
    texels = mi.traverse(loaded(tmp_path / "out"))["back.bsdf.reflectance.data"]
    np.testing.assert_array_equal(np.array(texels), BYTES)


@pytest.mark.parametrize("source", ["a file", "a bitmap"])
def test_a_recovered_texture_of_bytes_comes_out_in_floats(source: str, tmp_path: Path) -> None:
    mi.Bitmap(BYTES).write(str(tmp_path / "bytes.png"))
    picture = {"filename": str(tmp_path / "bytes.png")} if source == "a file" else {"bitmap": mi.Bitmap(BYTES)}
    key, texels = "back.bsdf.reflectance.data", np.linspace(0.1, 0.9, 60, dtype=np.float32).reshape(4, 5, 3)
    same_pictures(exported(Source(with_picture(picture), {}, {}, {}), {key: texels}), tmp_path / "out")
    np.testing.assert_allclose(np.array(mi.traverse(loaded(tmp_path / "out"))[key]), texels, rtol=1e-6)


def test_integers_and_floats_of_the_same_values_are_told_apart(tmp_path: Path) -> None:
    found = exported(Source(with_picture({"bitmap": mi.Bitmap(BYTES)}), {}, {}, {}), {})
    (tmp_path / "out").mkdir()
    write_files(found, tmp_path / "out")
    floats = with_picture({"raw": True, "data": mi.TensorXf(BYTES.astype(np.float32))})
    with pytest.raises(PathreplayError, match=r"'back\.bsdf\.reflectance\.data' of Bitmap.* is missing or different"):
        require_same(mi.load_dict(floats, optimize=False), tmp_path / "out")


def test_the_index_of_glass_comes_out_as_that_of_mitsubas_plugin(tmp_path: Path) -> None:
    source = Source(BUILTINS["glass-ball"](resolution=8), {}, {"dielectric": "dielectric_ad"}, {})
    found = exported(source, {"glass.eta": np.float32([1.31])})
    same_pictures(found, tmp_path / "out")
    assert b'type="dielectric"' in found.files["scene.xml"] and b"1.309" in found.files["scene.xml"]


def test_the_index_of_a_made_mesh_of_glass_comes_out(tmp_path: Path) -> None:
    scene = BUILTINS["caustic-lens"](resolution=8, **SMALL["caustic-lens"])
    found = exported(Source(scene, {}, {"dielectric": "dielectric_ad"}, {}), {"lens.bsdf.eta": np.float32([1.31])})
    same_pictures(found, tmp_path / "out")
    assert b"1.309" in found.files["scene.xml"]


TURNED = mi.ScalarTransform4f().translate([0, 0.2, 0.5]).rotate([1, 0, 0], 50)
#: Parts of a scene, and the value of a parameter.
PARTS: dict[str, tuple[dict[str, Any], str, Any]] = {
    **{
        plugin: ({"ball": {"type": "sphere", "bsdf": {"type": plugin, "int_ior": "bk7"}}}, "ball.bsdf.eta", [1.31])
        for plugin in ("dielectric_ad", "thindielectric", "roughdielectric", "roughplastic")
    },
    "metal": (
        {"ball": {"type": "sphere", "bsdf": {"type": "roughconductor", "material": "Au"}}},
        "ball.bsdf.eta.value",
        [0.3, 0.9, 1.4],
    ),
    "disk": (
        {"ball": {"type": "disk", "flip_normals": True, "emitter": {"type": "area"}}},
        "ball.to_world",
        np.array(TURNED.matrix) @ np.diag([1, 1, -1, 1]),
    ),
}


@pytest.mark.parametrize("case", PARTS)
def test_values_come_out_with_their_parts(case: str, tmp_path: Path) -> None:
    parts, key, value = PARTS[case]
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    eye = {"type": "perspective", "to_world": mi.ScalarTransform4f().translate([0, 0, -4]), "film": film}
    scene = {"type": "scene", "eye": eye, "sky": {"type": "constant"}, "integrator": {"type": "path"}, **parts}
    same_pictures(exported(Source(scene, {}, {}, {}), {key: np.float32(value)}), tmp_path / "out")


MANY = """<scene version="3.0.0"><default name="res" value="8"/>
<integrator type="prb"><integer name="max_depth" value="4"/></integrator>
<sensor type="perspective" id="eye"><float name="fov" value="40"/>
  <transform name="to_world"><lookat origin="0.3,1,5" target="0,0,0" up="0,1,0"/></transform>
  <film type="hdrfilm"><integer name="width" value="$res"/><integer name="height" value="$res"/>
    <rfilter type="box"/></film></sensor>
<bsdf type="twosided" id="satin"><bsdf type="roughplastic">
  <rgb name="diffuse_reflectance" value="0.2 0.3 0.4"/><float name="alpha" value="0.1"/></bsdf></bsdf>
<shape type="sphere" id="ball"><point name="center" value="0.1,0.2,0.3"/><float name="radius" value="0.5"/>
  <ref id="satin"/></shape>
<shape type="sphere"><point name="center" value="-1,0.2,0.3"/><boolean name="flip_normals" value="true"/>
  <bsdf type="twosided"><bsdf type="diffuse"><spectrum name="reflectance" value="0.5"/></bsdf></bsdf></shape>
<shape type="rectangle"><bsdf type="diffuse"><spectrum name="reflectance" value="400:0.1, 500:0.5, 700:0.8"/></bsdf>
  <transform name="to_world"><scale value="3"/><rotate y="1" angle="20"/><translate z="-2"/></transform></shape>
<shape type="ply" id="wedge"><string name="filename" value="meshes/wedge.ply"/>
  <boolean name="face_normals" value="true"/>
  <transform name="to_world"><rotate x="1" angle="33"/><translate y="-1"/></transform>
  <bsdf type="twosided"><bsdf type="conductor"><string name="material" value="Au"/></bsdf></bsdf></shape>
<shape type="shapegroup" id="group"><shape type="cube" id="brick"><transform name="to_world"><scale value="0.3"/>
  </transform><bsdf type="diffuse"><texture name="reflectance" type="checkerboard"><rgb name="color0" value="1 0.5 0"/>
  <transform name="to_uv"><scale x="3"/></transform></texture></bsdf></shape></shape>
<shape type="instance" id="first"><ref id="group"/><transform name="to_world"><translate x="1"/></transform></shape>
<shape type="instance" id="second"><ref id="group"/><transform name="to_world"><rotate y="1" angle="30"/>
  <translate x="1" y="1"/></transform></shape>
<emitter type="constant"><rgb name="radiance" value="0.3"/></emitter>
<emitter type="point" id="lamp"><point name="position" value="2,3,2"/><rgb name="intensity" value="20"/></emitter>
</scene>"""


@pytest.fixture
def many(tmp_path: Path) -> Path:
    """An XML scene of many kinds of things, with a mesh of its own."""
    (tmp_path / "scene/meshes").mkdir(parents=True)
    mesh = mi.load_dict({"type": "cube", "to_world": mi.ScalarTransform4f().scale([0.5, 0.2, 0.4])})
    mesh.write_ply(str(tmp_path / "scene/meshes/wedge.ply"))
    (tmp_path / "scene/many.xml").write_text(MANY)
    return tmp_path / "scene/many.xml"


def test_a_scene_from_xml_comes_out_with_its_files_names_and_numbers(many: Path, tmp_path: Path) -> None:
    values = {
        "ball.to_world": np.float32([[0.4, 0, 0, 0.4], [0, 0.3, 0, 0.1], [0, 0, 0.5, 0.2], [0, 0, 0, 1]]),
        "satin.brdf_0.alpha": np.float32([0.3]),
        "first.to_world": np.float32([[1, 0, 0, 0.7], [0, 1, 0, 0.1], [0, 0, 1, 0.2], [0, 0, 0, 1]]),
        "lamp.position": np.float32([1, 3, 2]),
    }
    found = exported(Source(many, {"res": "12"}, {}, {}), values)
    same_pictures(found, tmp_path / "out")
    assert found.notes == ("'path' renders the exported scene instead of 'prb', a differentiable integrator",)
    keys = set(mi.traverse(mi.load_file(str(tmp_path / "out/scene.xml"), optimize=False)).keys())
    assert set(values) <= keys and "wedge.vertex_positions" in keys
    assert (tmp_path / "out/files/wedge.ply").read_bytes() == (many.parent / "meshes/wedge.ply").read_bytes()


def test_vertices_of_a_mesh_from_a_file_come_out(many: Path, tmp_path: Path) -> None:
    moved = get_array(mi.traverse(mi.load_file(str(many), optimize=False))["wedge.vertex_positions"]) * 1.3
    found = exported(Source(many, {}, {}, {}), {"wedge.vertex_positions": moved})
    same_pictures(found, tmp_path / "out")
    assert "meshes/wedge.ply" in found.files and not found.copies


def test_a_file_with_the_name_of_a_written_mesh_is_copied(many: Path, tmp_path: Path) -> None:
    other = '<shape type="ply" id="other"><string name="filename" value="meshes/wedge.ply"/></shape>'
    many.write_text(MANY.replace("</scene>", f"{other}</scene>"))
    moved = get_array(mi.traverse(mi.load_file(str(many), optimize=False))["wedge.vertex_positions"]) * 1.3
    found = exported(Source(many, {}, {}, {}), {"wedge.vertex_positions": moved})
    assert "meshes/wedge.ply" in found.files and list(found.copies) == ["files/wedge.ply"]
    same_pictures(found, tmp_path / "out")


def test_flipped_texture_coordinates_are_flipped_once(many: Path, tmp_path: Path) -> None:
    flip = '<boolean name="flip_tex_coords" value="true"/><boolean name="face_normals" value="true"/>'
    many.write_text(MANY.replace('<boolean name="face_normals" value="true"/>', flip))
    moved = get_array(mi.traverse(mi.load_file(str(many), optimize=False))["wedge.vertex_positions"]) * 1.3
    same_pictures(exported(Source(many, {}, {}, {}), {"wedge.vertex_positions": moved}), tmp_path / "out")


def test_a_position_replaces_the_transform_of_a_point_light(many: Path, tmp_path: Path) -> None:
    place = '<transform name="to_world"><translate x="2" y="3" z="2"/></transform>'
    many.write_text(MANY.replace('<point name="position" value="2,3,2"/>', place))
    same_pictures(exported(Source(many, {}, {}, {}), {"lamp.position": np.float32([1, 3, 2])}), tmp_path / "out")


def test_a_direction_of_the_sun_of_another_length_comes_out(tmp_path: Path) -> None:
    scene = BUILTINS["flat-colours"](resolution=4) | {"sky": {"type": "sunsky", "sun_direction": [0.0, 1.0, 1.0]}}
    found = exported(Source(scene, {}, {}, {}), {"sky.sun_direction": np.float32([0.1, 0.9, 0.8])})
    (tmp_path / "out").mkdir()
    write_files(found, tmp_path / "out")
    require_same(found.scene, tmp_path / "out")


def brightest(scene: mi.Scene) -> np.ndarray:
    """Of many directions, the one in which the environment is brightest."""
    u, v = np.meshgrid(*2 * [(np.arange(500, dtype=np.float32) + 0.5) / 500])
    directions = mi.warp.square_to_uniform_sphere(mi.Point2f(u.ravel(), v.ravel()))
    si = dr.zeros(mi.SurfaceInteraction3f, u.size)
    si.wi = -directions
    return np.array(directions)[:, np.array(scene.environment().eval(si)).sum(0).argmax()]


def test_the_sun_comes_out_where_a_recovered_rotation_has_turned_it(tmp_path: Path) -> None:
    old = mi.ScalarTransform4f().rotate([0, 0, 1], 20).rotate([1, 0, 0], -60)
    turned = np.array((mi.ScalarTransform4f().rotate([0, 1, 0], 33) @ old).matrix, np.float32)
    sky = {"type": "sunsky", "to_world": old, "sun_direction": [0.4, 0.8, 0.4]}
    scene = BUILTINS["flat-colours"](resolution=4) | {"sky": sky}
    run = mi.load_dict(scene, optimize=False)
    params = mi.traverse(run)
    params["sky.to_world"] = mi.Transform4f(turned)
    params.update()
    found = exported(Source(scene, {}, {}, {}), {"sky.to_world": turned})
    same_pictures(found, tmp_path / "out")
    looked = mi.load_file(str(tmp_path / "out/scene.xml"), optimize=False)
    np.testing.assert_allclose(*(brightest(each) for each in (run, looked)))
    stale = exported(Source(scene | {"sky": {**sky, "to_world": mi.ScalarTransform4f(turned)}}, {}, {}, {}), {})
    (tmp_path / "stale").mkdir()
    write_files(stale, tmp_path / "stale")
    with pytest.raises(PathreplayError, match=r"'sky\.sun_direction' of .* is missing or different"):
        require_same(found.scene, tmp_path / "stale")


def test_names_of_copied_files_are_unique(tmp_path: Path) -> None:
    mesh = mi.load_dict({"type": "cube"})
    places = "a/box-2.ply", "b/box.ply", "c/box.ply"
    for place in places:
        (tmp_path / place).parent.mkdir()
        mesh.write_ply(str(tmp_path / place))
    scene = {place[0]: {"type": "ply", "filename": str(tmp_path / place)} for place in places}
    found = exported(Source({"type": "scene", **scene}, {}, {}, {}), {})
    assert sorted(path.parent.name for path in found.copies.values()) == list("abc")


def test_what_nobody_knows_the_making_of_is_told(tmp_path: Path) -> None:
    scene = mi.cornell_box()
    scene["floor"]["bsdf"] = mi.load_dict({"type": "roughplastic"})
    with pytest.raises(
        PathreplayError, match=r"'bsdf' of rectangle .* is an existing RoughPlastic .*cannot be exported; describe"
    ):
        exported(Source(scene, {}, {}, {}), {})


def test_a_value_that_does_not_come_back_is_told(tmp_path: Path) -> None:
    found = exported(Source(BUILTINS["flat-colours"](resolution=4), {}, {}, {}), {})
    (tmp_path / "out").mkdir()
    write_files(found, tmp_path / "out")
    params = mi.traverse(found.scene)
    params["red.emitter.radiance.value"] = mi.Color3f(0.5, 0.2, 0.1)
    params.update()
    with pytest.raises(PathreplayError, match=r"'red\.emitter\.radiance\.value' of SRGB.* is missing or different"):
        require_same(found.scene, tmp_path / "out")


@pytest.mark.parametrize(
    ("wanted", "plain"),
    [
        ({"type": "pathreplay"}, {"type": "path", "max_depth": 6}),
        ({"type": "pathreplay", "max_depth": 3, "boundary": "all"}, {"type": "path", "max_depth": 3}),
        ({"type": "direct_projective", "sppi": 0}, {"type": "path", "max_depth": 2}),
        (
            {"type": "pathreplay_particles", "max_depth": 4, "boundary": "none"},
            {"type": "ptracer", "max_depth": 4},
        ),
        ({"type": "pathreplay_particles"}, {"type": "ptracer", "max_depth": 6}),
        ({"type": "direct", "emitter_samples": 2}, {"type": "direct", "emitter_samples": 2}),
        (None, {"type": "path", "max_depth": 8}),
    ],
)
def test_integrators_for_gradients_have_one_for_pictures_in_their_place(wanted: Any, plain: dict[str, Any]) -> None:
    """With the depth that they have, where none is said: `path` would go on for ever."""
    found = exported(Source(BUILTINS["cornell-box"](resolution=4), {}, {}, {}), {}, wanted)
    (element,) = ElementTree.fromstring(found.files["scene.xml"]).iter("integrator")
    options = {each.get("name"): int(str(each.get("value"))) for each in element}
    assert {"type": element.get("type"), **options} == plain
    assert bool(found.notes) == (wanted is not None and wanted["type"] != "direct")


@pytest.mark.parametrize("where", ["the job", "the scene"])
def test_caustics_that_mitsuba_leaves_out_are_told_with_the_options_that_render_them(where: str) -> None:
    integrator = {"type": "pathreplay", "max_depth": 4, "hide_emitters": True, "caustics": "particles"}
    scene = BUILTINS["cornell-box"](resolution=4)
    if where == "the scene":
        scene["integrator"] = integrator
    _, note = exported(Source(scene, {}, {}, {}), {}, integrator if where == "the job" else None).notes
    flags = "--integrator pathreplay -I caustics=particles -I max_depth=4 -I hide_emitters=true"
    assert "'path' renders no caustics of lights without extent" in note and f"`{flags}`" in note


FOGGY = """<scene version="3.0.0">
<integrator type="pathreplay"><integer name="max_depth" value="4"/></integrator>
<shape type="cube" id="box"><bsdf type="null"/><medium type="homogeneous" name="interior" id="field">
  <float name="sigma_t" value="1"/><rgb name="albedo" value="0.2"/></medium></shape>
<emitter type="constant" id="sky"><rgb name="radiance" value="1"/></emitter>
</scene>"""


def test_cameras_inside_a_medium_come_out_inside_it(tmp_path: Path) -> None:
    """As `[capture] medium` puts them: the fog of thickness 2 or so hides most of the sky."""
    (tmp_path / "fog.xml").write_text(FOGGY)
    lens = Lens(8, 8, 9.0, 9.0, 4.0, 4.0)
    camera = pinhole_camera(lens, np.eye(4), (8, 8), 0.01)
    cameras = {name: {**camera, "id": name} for name in ("left", "right")}
    key = "box.interior_medium.sigma_t.value.value"
    source = Source(tmp_path / "fog.xml", {}, {}, cameras, medium="field")
    found = exported(source, {key: np.float32([2.0])})
    same_pictures(found, tmp_path / "out")
    assert all(image.mean() < 0.5 for image in pictures(loaded(tmp_path / "out"), found.scene.integrator()))
    gc.collect()
    with pytest.raises(PathreplayError, match=r"capture\.medium 'mist' is the id of no medium of the scene"):
        exported(replace(source, medium="mist"), {})


SPECTRAL = """
import sys
from pathlib import Path
import mitsuba as mi, numpy as np
from pathreplay.platform.backend import set_variant
set_variant("llvm_ad_spectral")
from pathreplay.errors import PathreplayError
from pathreplay.output.export import write_files
from pathreplay.output.scene_folder import Source, exported, require_same

def scene(texture):
    shape = {"type": "ply", "filename": sys.argv[1], "bsdf": {"type": "diffuse", "reflectance": texture}}
    return Source({"type": "scene", "m": shape}, {}, {}, {})

painted = scene({"type": "mesh_attribute", "name": "vertex_color"})
for key, count in (("m.vertex_rough", 24), ("m.vertex_positions", 72)):
    found = exported(painted, {key: np.linspace(0.1, 0.9, count, dtype=np.float32)})
    before = np.array(mi.traverse(found.scene)["m.vertex_color"])
    folder = Path(sys.argv[2]) / key
    folder.mkdir()
    write_files(found, folder)
    require_same(found.scene, folder)
    assert list(found.files) == ["meshes/m.ply", "scene.xml"] and abs(before).max() > 1
textured = scene({"type": "bitmap", "bitmap": mi.Bitmap(np.full((2, 2, 3), 99, np.uint8))})
for source, values in ((painted, {"m.vertex_color": np.full(72, 0.5)}), (textured, {})):
    try:
        exported(source, values)
    except PathreplayError as error:
        print(error)

meshes = []
def full_disk(mesh, stream):
    meshes.append(mesh)
    raise OSError("no space left")
mi.Mesh.write_ply = full_disk
try:
    exported(painted, {"m.vertex_rough": np.full(24, 0.5)})
except OSError:
    assert (np.array(mi.traverse(meshes[0])["vertex_color"]) == before).all()
"""


def test_spectra_of_colours_that_were_not_recovered_come_out_as_the_colours_of_the_file(tmp_path: Path) -> None:
    mesh = mi.load_dict({"type": "cube"})
    mesh.add_attribute("vertex_color", 3, np.linspace(0.1, 0.9, 72, dtype=np.float32))
    mesh.add_attribute("vertex_rough", 1, np.full(24, 0.5, np.float32))
    mesh.write_ply(str(tmp_path / "m.ply"))
    command = [sys.executable, "-c", SPECTRAL, str(tmp_path / "m.ply"), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    colours, texture = done.stdout.splitlines()
    assert colours.startswith("Attribute 'm.vertex_color' consists of smooth spectra")
    assert colours.endswith("recover it in an rgb variant") and texture.endswith("give it as a file")


# ------------------------------ A run ------------------------------


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a scene from XML and of a run of two iterations."""
    folder = tmp_path_factory.mktemp("job")
    (folder / "room.xml").write_text(SCENE)
    texels = np.array([[0.1, 0.4], [0.6, 0.9]], np.float32)[:, :, None] * np.array([1, 0.8, 0.6], np.float32)
    (folder / "texture.exr").write_bytes(exr_bytes(texels))
    pose = {"key": "right.to_world", "pose": "rigid", "initial": {"translation": [0.1, 0.0, 0.0]}}
    changes = {"iterations": 2, "parameters": [*JOB["parameters"], pose], "scene": str(folder / "room.xml")}
    changes["integrator"] = {"type": "pathreplay", "max_depth": 3, "boundary": "none"}
    changes["target"] = {**JOB["target"], "scene": str(folder / "room.xml")}
    optimize(make_config({**JOB, **changes}), output=folder / "run", progress=False)
    return folder


@pytest.fixture
def run(finished: Path, tmp_path: Path) -> Path:
    """A copy of the run."""
    return Path(shutil.copytree(finished / "run", tmp_path / "run"))


def test_a_run_comes_out_as_its_result_pictures(run: Path, tmp_path: Path) -> None:
    told = export_run(run)
    folder = run / "export"
    assert told.splitlines()[0].startswith(f"{folder}/scene.xml: render it with `pathreplay render ")
    gc.collect()
    scene = loaded(folder)
    result = [read_image(run / f"images/result-{view}.exr") for view in ("left", "right")]
    ours = mi.load_dict({"type": "pathreplay", "max_depth": 3})
    config = make_config(json.loads((run / "config.json").read_text()))
    for view, expected in enumerate(result):
        image = mi.render(scene, sensor=view, integrator=ours, spp=16, seed=config.seeds(PICTURE, view)[0])
        assert alike(np.array(image), expected) > 0.95
    assert "PathIntegrator" in str(scene.integrator()) and "max_depth = 3" in str(scene.integrator())
    key = "wall.bsdf.reflectance.data"
    texels = read_image(folder / f"textures/{key}.exr")
    assert (folder / f"textures/{key}.png").is_file() and texels.shape == (2, 2, 3)
    numbers = json.loads((folder / "values.json").read_text())
    assert len(numbers["floor.reflectance.value"]) == 3 and np.shape(numbers["right.to_world"]) == (4, 4)
    found = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    assert found == {
        "scene.xml", "values.json", "transforms.json", f"textures/{key}.exr", f"textures/{key}.png"
    }  # fmt: skip


def test_the_command_that_is_advised_renders_what_came_out(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, command, _ = export_run(run, tmp_path / "with a space").splitlines()[0].split("`")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [*shlex.split(command), "--spp", "1", "--quiet"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code in (0, None)
    assert read_image(tmp_path / "scene.exr").shape == (10, 12, 3)


def test_the_cameras_of_a_run_can_be_read_as_a_capture(run: Path) -> None:
    export_run(run)
    for view in ("left", "right"):
        (run / f"export/{view}.exr").write_bytes((run / f"images/result-{view}.exr").read_bytes())
    shots = read_capture(Capture(transforms="transforms.json"), run / "export", lambda path: (12, 10))
    scene = loaded(run / "export")
    for sensor in scene.sensors():
        camera = mi.load_dict(shots[sensor.id()].camera)
        ours, theirs = (mi.traverse(each) for each in (sensor, camera))
        for key in ("to_world", "x_fov"):
            np.testing.assert_allclose(get_array(theirs[key]), get_array(ours[key]), atol=1e-5)


def test_a_cropped_camera_is_written_with_the_size_and_centre_of_its_crop() -> None:
    crop = {"crop_width": 24, "crop_height": 20, "crop_offset_x": 12, "crop_offset_y": 4}
    film = {"type": "hdrfilm", "width": 48, "height": 32}
    camera = {"type": "perspective", "principal_point_offset_x": 0.1}
    sensors = {"whole": {**camera, "film": film}, "part": {**camera, "film": film | crop}}
    whole, part = _cameras(mi.load_dict({"type": "scene", **sensors}))["frames"]
    assert [part[key] for key in ("w", "h", "fl_x", "fl_y")] == [24, 20, whole["fl_x"], whole["fl_y"]]
    assert [part["cx"], part["cy"]] == pytest.approx([0.4 * 48 - 12, 12])


@pytest.mark.parametrize("in_python", [False, True])
def test_a_run_without_a_result_is_resumed_where_it_was_started(in_python: bool, run: Path, tmp_path: Path) -> None:
    folder = run.rename(tmp_path / "a run")
    (folder / "parameters.safetensors").unlink()
    origin = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps({**origin, "in_python": in_python}))
    command = f"pathreplay optimize --resume '{folder}'"
    if in_python:
        command = f"pathreplay.minimize(problem, output='{folder}', resume=True)"
    with pytest.raises(PathreplayError) as told:
        export_run(folder)
    assert str(told.value).endswith(f"resume with: {command}")


@pytest.mark.parametrize("trouble", ["no run", "no result", "a result that is none", "no scene", "a full folder"])
def test_what_cannot_be_exported_is_told_and_leaves_nothing(trouble: str, run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    line = {
        "no run": "is not a run folder",
        "no result": "has no result yet",
        "a result that is none": "cannot be read",
        "no scene": "no longer exists; restore it",
        "a full folder": "exists already; give -o a new folder",
    }[trouble]
    if trouble == "no result":
        (run / "parameters.safetensors").unlink()
    elif trouble == "a result that is none":
        (run / "parameters.safetensors").write_bytes(b"none")
    elif trouble == "no scene":
        config = run / "config.json"
        config.write_text(config.read_text().replace("room.xml", "gone.xml"))
    elif trouble == "a full folder":
        folder.mkdir()
        (folder / "mine").write_text("")
    before = sorted(path for path in tmp_path.rglob("*"))
    with pytest.raises(PathreplayError, match=line):
        export_run(tmp_path if trouble == "no run" else run, folder)
    assert sorted(path for path in tmp_path.rglob("*")) == before


@pytest.mark.slow
def test_a_volume_and_a_mesh_of_runs_come_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    grid = "cloud.interior_medium.sigma_t.data"
    jobs = {
        "cloud": ({"grid": 4, "views": 1}, {"key": grid, "initial": 1.0, "resolutions": [3]}, "volpath"),
        "silhouettes": ({"views": 1}, {"key": "body.vertex_positions", "large_steps_lambda": 5.0}, "path"),
    }
    for name, (arguments, parameter, plain) in jobs.items():
        job = {
            "scene": name, "scene_parameters": {"resolution": 8, **arguments}, "parameters": [parameter], "spp": 4,
            "iterations": 1, "eval_spp": 4, "integrator": {"type": "pathreplay", "max_depth": 4, "boundary": "none"},
            "target": {"scene": name, "scene_parameters": {"resolution": 8, **arguments}, "spp": 4},
        }  # fmt: skip
        job["target"]["integrator"] = {"type": plain, "max_depth": 4}
        folder = optimize(make_config(job), output=name, progress=False).folder
        export_run(folder, tmp_path / f"out-{name}")
    assert load_volume(tmp_path / f"out-cloud/volumes/{grid}.vol").data.shape == (3, 3, 3, 1)
    sizes = {
        mi.load_dict({"type": ending, "filename": str(tmp_path / f"out-silhouettes/meshes/body.{ending}")}).face_count()
        for ending in ("ply", "obj")
    }
    assert sizes == {2048}


def test_obj_files_have_the_data_of_the_mesh(tmp_path: Path) -> None:
    mesh = mi.load_dict({"type": "cube"})
    (tmp_path / "cube.obj").write_bytes(obj_bytes(mesh))
    again = mi.load_dict({"type": "obj", "filename": str(tmp_path / "cube.obj")})

    def rows(shape: mi.Shape) -> np.ndarray:
        """Position, texture coordinates and normal of each vertex, sorted."""
        data = mesh_arrays(mi.traverse(shape))
        assert data is not None
        table = np.concatenate([data.positions, data.texcoords, data.normals], axis=1).round(5) + 0.0
        return table[np.lexsort(table.T)]

    np.testing.assert_allclose(rows(again), rows(mesh), atol=1e-5)
