"""Scenes load by name and by file, keep their names, and say what is wrong in one line."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import pytest

from pathreplay.errors import PathreplayError
from pathreplay.scenes.loading import BUILTINS, load_scene, load_scene_for

XML = """<scene version="3.0.0">
  <default name="res" value="8"/>
  <sensor type="perspective" id="front"><film type="hdrfilm">
    <integer name="width" value="$res"/><integer name="height" value="$res"/></film></sensor>
  <bsdf type="diffuse" id="paint"><rgb name="reflectance" value="0.5"/></bsdf>
  <shape type="sphere" id="one"><ref id="paint"/></shape>
  <shape type="sphere" id="two"><ref id="paint"/></shape>
</scene>"""


CORNELL = {"red.reflectance.value", "green.reflectance.value", "light.emitter.radiance.value"}
KEYS = {
    "cornell-box": CORNELL,
    "cornell-box-photo": CORNELL | {"back.bsdf.reflectance.data"},
    "glass-pane": {"glass.eta", "front_face.bsdf.normalmap.data"},
    "cloud": {"cloud.interior_medium.sigma_t.data"},
    "mirror-camera": {"camera.to_world", "mirror.to_world"},
    "silhouettes": {"body.vertex_positions"},
    "silhouette-in-mirror": {"body.vertex_positions"},
    "shadows": {"body.vertex_positions"},
    "flat-colours": {"camera.to_world"},
    "glass-ball": {"glass.eta", "ball.to_world"},
    "caustic-lens": {"lens.vertex_positions", "lens.vertex_weight"},
    "caustic-mirror": {"mirror.vertex_positions"},
}


@pytest.mark.parametrize("name", sorted(BUILTINS))
def test_builtins_render_with_their_names(name: str) -> None:
    scene = load_scene(name, resolution=8)
    params = mi.traverse(scene)
    assert KEYS[name] <= set(params.keys())
    for sensor in range(len(scene.sensors())):
        size = {"silhouette-in-mirror": (8, 16, 3), "caustic-lens": (8, 8, 1), "caustic-mirror": (8, 8, 1)}.get(
            name, (8, 8, 3)
        )
        assert mi.render(scene, sensor=sensor, spp=4, integrator=mi.load_dict({"type": "volpath"})).shape == size


def test_closeup_sees_every_texel() -> None:
    """The demo can recover the whole picture only if each texel reaches a pixel: paint one, look for it."""
    scene = load_scene("cornell-box-photo", resolution=32, texture=4)
    params = mi.traverse(scene)
    key = "back.bsdf.reflectance.data"
    black = mi.TensorXf(0 * params[key])
    base = None
    for texel in [None, *((r, c) for r in range(4) for c in range(4))]:
        value = black.numpy().copy()
        if texel is not None:
            value[texel] = 1
        params[key] = mi.TensorXf(value)
        params.update()
        image = mi.render(scene, sensor=1, spp=16, integrator=mi.load_dict({"type": "direct"}), seed=1).numpy()
        if texel is None:
            base = image
        else:
            row, column = [int(n) for n in divmod((image - base).mean(axis=2).argmax(), 32)]
            assert (row // 8, column // 8) == texel  # upright, not mirrored, where the image says


def test_xml_keeps_names_and_takes_parameters(tmp_path: Path) -> None:
    (tmp_path / "room.xml").write_text(XML)
    scene = load_scene("room.xml", tmp_path, res=4)
    assert "paint.reflectance.value" in mi.traverse(scene)
    assert tuple(scene.sensors()[0].film().size()) == (4, 4)
    assert scene.sensors()[0].id() == "front"


BAD = {
    "unknown name": ("cornel-box", {}, "did you mean 'cornell-box'"),
    "missing file": ("rom.xml", {}, "did you mean 'room.xml'"),
    "not XML": ("broken.xml", {}, "broken.xml cannot be loaded: Parsing of XML"),
    "unknown plugin": ("plugin.xml", {}, 'Plugin "spher" not found'),
    "not a scene": ("shape.xml", {}, "not a <scene>"),
    "unknown argument": ("cornell-box", {"size": 3}, "has no parameter 'size'; it has: resolution"),
    "bad argument": ("cornell-box", {"resolution": 0}, "'resolution' of scene 'cornell-box' is 0"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_scenes_get_one_line(case: str, tmp_path: Path) -> None:
    (tmp_path / "room.xml").write_text(XML)
    (tmp_path / "broken.xml").write_text("<scene")
    (tmp_path / "plugin.xml").write_text('<scene version="3.0.0"><shape type="spher"/></scene>')
    (tmp_path / "shape.xml").write_text('<shape version="3.0.0" type="sphere"/>')
    spec, arguments, message = BAD[case]
    with pytest.raises(PathreplayError) as caught:
        load_scene(spec, tmp_path, **arguments)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


GLASS = """<scene version="3.0.0">
  <bsdf type="dielectric" id="glass"/><bsdf type="thindielectric" id="thin"/>
  <shape type="sphere" id="one"><ref id="glass"/></shape>
  <shape type="sphere"><bsdf type="dielectric"/></shape>
  <shape type="sphere" id="three"><ref id="thin"/></shape>
</scene>"""


@pytest.mark.parametrize(("wanted", "replaced"), [
    (["glass.eta"], True), (["*.eta"], True), (["thin.eta"], False), (["glass.*"], False), (["nothing.eta"], False),
])  # fmt: skip
def test_glass_is_replaced_only_for_its_index(wanted: list[str], replaced: bool, tmp_path: Path) -> None:
    (tmp_path / "glass.xml").write_text(GLASS)
    scene, notes = load_scene_for("glass.xml", wanted, tmp_path)
    names = [type(shape.bsdf()).__name__ for shape in scene.shapes()]
    assert names.count("DielectricAD") == (2 if replaced else 0)
    assert isinstance(mi.traverse(scene)["glass.eta"], float) != replaced
    assert len(notes) == replaced
    if replaced:
        assert "all 2" in notes[0] and "'dielectric_ad'" in notes[0] and "\n" not in notes[0]


def test_glass_of_a_builtin_is_replaced_too() -> None:
    scene, notes = load_scene_for("glass-pane", ["glass.eta"], resolution=8, texture=4)
    assert "one of them" in notes[0]
    assert mi.traverse(scene)["glass.eta"][0] == pytest.approx(1.5)
