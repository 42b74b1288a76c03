"""Scenes as modelling programs write them: meshes that lack coordinates or normals, and names of every kind."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import safetensors.numpy

from pathreplay.errors import PathreplayError
from pathreplay.inverse.images.io import exr_bytes
from pathreplay.jobs import RunResult, make_config, optimize
from pathreplay.platform.files import LONGEST, file_names
from pathreplay.scenes import parameters
from pathreplay.scenes.loading import load_scene
from pathreplay.testing import check_gradient

OBJ = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n{}f 1 2 3\nf 1 3 4\n"
PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
element face 2
property list uchar int vertex_indices
end_header
0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3
"""
MESHES = {"obj": OBJ.format(""), "ply": PLY}
SCENE = """<scene version="3.0.0">
  <sensor type="perspective" id="{camera}"><float name="fov" value="30"/>
    <transform name="to_world"><lookat origin="0.5,0.5,3" target="0.5,0.5,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film></sensor>
  {paints}
  {shapes}
  <emitter type="constant" id="sky"/>
</scene>"""


def mesh(kind: str, flat: bool, paint: str) -> str:
    return f"""<shape type="{kind}" id="quad"><string name="filename" value="quad.{kind}"/>
        <boolean name="face_normals" value="{str(flat).lower()}"/><ref id="{paint}"/></shape>"""


def paint(name: str) -> str:
    return f'<bsdf type="diffuse" id="{name}"><rgb name="reflectance" value="0.3,0.5,0.7"/></bsdf>'


def texture(name: str) -> str:
    return f"""<bsdf type="diffuse" id="{name}"><texture type="bitmap" name="reflectance">
        <string name="filename" value="t.exr"/><boolean name="raw" value="true"/></texture></bsdf>"""


def job(keys: list[str], **more: Any) -> RunResult:
    return optimize(
        make_config(
            {
                "scene": "scene.xml",
                "iterations": 3,
                "spp": 4,
                "eval_spp": 4,
                "parameters": [{"key": key, "initial": 0.6} for key in keys],
                "target": {"scene": "scene.xml", "spp": 8, "integrator": {"type": "path", "max_depth": 3}},
                **more,
            }
        ),
        progress=False,
    )


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    for kind, text in MESHES.items():
        (tmp_path / f"quad.{kind}").write_text(text)
    (tmp_path / "t.exr").write_bytes(exr_bytes(np.full((2, 2, 3), 0.4, np.float32)))
    return tmp_path


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("kind", MESHES)
def test_meshes_without_texture_coordinates_or_normals(kind: str, flat: bool, folder: Path) -> None:
    text = SCENE.format(camera="cam", paints=paint("paint"), shapes=mesh(kind, flat, "paint"))
    (folder / "scene.xml").write_text(text)
    result = job(["paint.reflectance.value"])
    assert result.errors["paint.reflectance.value"] < 0.2  # it moves towards the truth
    scene = load_scene("scene.xml", folder)
    params = mi.traverse(scene)
    assert len(params["quad.vertex_texcoords"]) == 0
    check = check_gradient(scene, "paint.reflectance.value", seeds=4, spp=8)
    assert check.passed, check
    with pytest.raises(PathreplayError, match=r"'quad\.vertex_texcoords' is empty: its \w+ has no such values"):
        check_gradient(scene, "quad.vertex_texcoords")
    assert "quad.vertex_texcoords" not in parameters.resolve_differentiable(params, "quad.vertex_*")


def test_empty_arrays_go_everywhere() -> None:
    for empty in (mi.Float(), mi.TensorXf(np.zeros((0, 2, 3), np.float32)), mi.Color3f(dr.zeros(mi.Float, 0))):
        array = parameters.get_array(empty)
        assert array.size == 0
        assert parameters.get_array(parameters.to_value(empty, array)).shape == array.shape
        assert parameters.get_array(parameters.displaced(empty, array, mi.Float(1))).shape == array.shape
        assert parameters.is_empty(empty)
    assert not parameters.is_empty(mi.Float(1)) and not parameters.is_empty(mi.Transform4f())


AWKWARD = ["wall (1)", "wall [1]", "wall+{2}", "a*b", "a?", "a?b", "wall.001", "Wände", "a|^b"]


def test_every_name_can_be_optimised(folder: Path) -> None:
    shapes = "".join(f'<shape type="rectangle"><ref id="{name}"/></shape>' for name in AWKWARD)
    (folder / "scene.xml").write_text(SCENE.format(camera="cam", paints="".join(map(paint, AWKWARD)), shapes=shapes))
    keys = [f"{name}.reflectance.value" for name in AWKWARD]
    result = job(keys, integrator={"type": "prb", "max_depth": 3})
    assert list(result.parameters) == keys
    params = mi.traverse(load_scene("scene.xml", folder))
    assert parameters.resolve_keys(params, "wall [1].*") == ["wall [1].reflectance.value"]
    assert parameters.resolve_keys(params, "wall [(]1).*") == ["wall (1).reflectance.value"]
    # One key is the beginning of another: only the named one is kept.
    parameters.keep_only(params, ["a?.reflectance.value"])
    assert list(params.keys()) == ["a?.reflectance.value"]


def test_long_and_similar_names_get_files_of_their_own(folder: Path) -> None:
    long = "x" * 300
    names = [long, long + "y", "wall (1)", "wall [1]", "Wall_(1)"]
    shapes = "".join(f'<shape type="rectangle"><ref id="{name}"/></shape>' for name in names)
    (folder / "scene.xml").write_text(
        SCENE.format(camera="c" * 300, paints="".join(map(texture, names)), shapes=shapes)
    )
    result = job([f"{name}.reflectance.data" for name in names], sensors=["c" * 300])
    files = [path.name for path in (result.folder / "images").iterdir()]
    assert len({name.casefold() for name in files}) == len(files)
    assert sum(name.startswith("texture-result-") for name in files) == len(names)
    assert max(len(name) for name in files) < 200
    saved = safetensors.numpy.load_file(result.folder / "parameters.safetensors")
    assert set(saved) == {f"{name}.reflectance.data" for name in names}
    more = result.folder / "config.json"
    more.write_text(more.read_text().replace('"iterations": 3', '"iterations": 4'))
    assert optimize(resume=result.folder, progress=False).iterations == 4


def test_file_names_are_short_and_distinct() -> None:
    assert file_names(["wall.data", "Tür"]) == {"wall.data": "wall.data", "Tür": "Tür"}
    given = ["a b", "a_b", "A_B", "ä" * 400, "ä" * 401, "../../x", "a/b"]
    made = file_names(given)
    assert list(made) == given
    assert len({name.casefold() for name in made.values()}) == len(given)
    assert all(len(name.encode()) <= LONGEST + 9 and "/" not in name for name in made.values())
