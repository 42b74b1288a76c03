"""A scene loaded with other plugins keeps its names, its values and its included files."""

from __future__ import annotations

import os

import mitsuba as mi
import numpy as np
import pytest

import pathreplay  # noqa: F401 (registers the plugins)
from pathreplay.errors import PathreplayError
from pathreplay.inverse.images.io import exr_bytes
from pathreplay.platform.threads import one_thread, spare_thread
from pathreplay.scenes.substitute import load_dict_with, load_file_with

SMOOTH = {"dielectric": "dielectric_ad"}
SCENE = """<scene version="3.0.0">
    <default name="index" value="1.3"/>
    <include filename="materials.xml"/>
    <integrator type="path" id="path"/>
    <sensor type="perspective" id="eye">
        <transform name="to_world"><lookat origin="0,0,6" target="0,0,0" up="0,1,0"/></transform>
        <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/></film>
    </sensor>
    <bsdf type="dielectric" id="glass"><float name="int_ior" value="$index"/>
        <string name="ext_ior" value="water"/></bsdf>
    <shape type="sphere" id="left"><point name="center" x="-1.5" y="0" z="0"/><ref id="glass"/></shape>
    <shape type="sphere" id="right"><point name="center" x="1.5" y="0" z="0"/><ref id="gem"/></shape>
    <shape type="sphere" id="far"><point name="center" x="0" y="0" z="-5"/>
        <bsdf type="mask"><bsdf type="dielectric"/><float name="opacity" value="0.5"/></bsdf></shape>
    <shape type="sphere" id="dull"><point name="center" x="0" y="2" z="0"/><ref id="paint"/></shape>
    <emitter type="envmap" id="sky"><string name="filename" value="sky.exr"/></emitter>
</scene>"""
MATERIALS = """<scene version="3.0.0">
    <bsdf type="dielectric" id="gem"><string name="int_ior" value="diamond"/></bsdf>
    <bsdf type="plastic" id="paint"/>
</scene>"""


@pytest.fixture
def scene_file(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "materials.xml").write_text(MATERIALS)
    sky = np.random.default_rng(1).random((8, 16, 3), dtype=np.float32)
    (tmp_path / "sky.exr").write_bytes(exr_bytes(sky))
    return tmp_path / "scene.xml"


def test_file_keeps_keys_and_image(scene_file):
    with spare_thread():
        plain = mi.load_file(str(scene_file), optimize=False, index="1.7")
    scene, exchanged = load_file_with(scene_file, SMOOTH, {"index": "1.7"})
    assert [line.split()[0] for line in exchanged] == ["gem", "glass", "unnamed"]
    assert "materials.xml" in exchanged[0] and "scene.xml (line" in exchanged[1]
    params, plain_params = mi.traverse(scene), mi.traverse(plain)
    assert sorted(params.keys()) == sorted(plain_params.keys())
    for key in ("glass.eta", "gem.eta", "far.bsdf.nested_bsdf.eta"):
        assert isinstance(params[key], mi.Float) and params[key][0] == np.float32(plain_params[key])
    with one_thread(True):  # several add the samples of a pixel in the order in which they come
        images = [mi.render(s, spp=4, seed=1).numpy() for s in (scene, plain)]
    assert np.array_equal(*images) and images[0].std() > 0.05


def test_dictionary_keeps_keys():
    description = {
        "type": "scene",
        "glass": {"type": "dielectric", "int_ior": "bk7"},
        "ball": {"type": "sphere", "bsdf": {"type": "ref", "id": "glass"}},
        "other": {"type": "sphere", "bsdf": mi.load_dict({"type": "dielectric"})},
    }
    scene, exchanged = load_dict_with(description, SMOOTH)
    assert len(exchanged) == 1 and exchanged[0].startswith("glass ")
    params = mi.traverse(scene)
    assert isinstance(params["glass.eta"], mi.Float) and isinstance(params["other.bsdf.eta"], float)
    assert description["glass"]["type"] == "dielectric"


def test_nothing_to_exchange(scene_file):
    scene, exchanged = load_file_with(scene_file, {"conductor": "roughconductor"})
    assert exchanged == [] and isinstance(mi.traverse(scene)["glass.eta"], float)


def test_failure_leaves_mitsubas_search_paths_alone(tmp_path):
    (tmp_path / "broken.xml").write_text('<scene version="3.0.0"><bsdf type="dielectric"><float name="no" value="1"/>')
    before = str(mi.file_resolver())
    with pytest.raises(RuntimeError):
        load_file_with(tmp_path / "broken.xml", SMOOTH)
    assert str(mi.file_resolver()) == before


def test_after_a_scene_that_cannot_be_loaded_another_is_rendered():
    """The error keeps its traceback, and the area light of the scene, whose shape was never made, must not stay."""
    description = mi.cornell_box()
    description["sensor"]["film"] |= {"width": 8, "height": 8}
    broken = {**description, "back": {"type": "rectangle", "bsdf": {"type": "diffuse", "nothing": 1.0}}}
    with pytest.raises(RuntimeError, match="unreferenced property") as told:  # keeps the traceback until `del`
        load_dict_with(broken, {})
    assert np.array(mi.render(mi.load_dict(description), spp=16)).mean() > 0.1
    del told


def test_what_mitsuba_would_die_of_or_wait_for_is_told(tmp_path):
    (tmp_path / "deep.xml").write_text('<scene version="3.0.0">' + "<bsdf>" * 50_000 + "</bsdf>" * 50_000 + "</scene>")
    with pytest.raises(PathreplayError, match="nested elements"):
        load_file_with(tmp_path / "deep.xml", SMOOTH)
    os.mkfifo(tmp_path / "sky.exr")
    with pytest.raises(PathreplayError, match="is a pipe"):
        load_dict_with({"type": "scene", "sky": {"type": "envmap", "filename": str(tmp_path / "sky.exr")}}, SMOOTH)
