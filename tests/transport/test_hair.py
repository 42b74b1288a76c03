"""Hair by its pigments: Mitsuba holds None as its absorption then, which nobody may read."""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi
import pytest

from pathreplay.errors import PathreplayError
from pathreplay.jobs import make_config, optimize
from pathreplay.output.export import export_run
from pathreplay.scenes.loading import load_scene
from pathreplay.testing.command import check_all

SCENE = """<scene version="3.0.0">
  <sensor type="perspective" id="eye">
    <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="6"/><integer name="height" value="6"/>
      <string name="pixel_format" value="rgb"/><rfilter type="box"/></film></sensor>
  <shape type="sphere" id="ball"><bsdf type="hair"><float name="eumelanin" value="0.3"/></bsdf></shape>
  <emitter type="constant" id="sky"/>
</scene>"""
KEY = "ball.bsdf.eumelanin"


@pytest.fixture(autouse=True)
def room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("hair.xml").write_text(SCENE)


@pytest.mark.slow  # a quick test optimises them
def test_its_pigments_can_be_checked() -> None:
    (result,) = check_all(load_scene("hair.xml"), [KEY], seeds=2, spp=4, max_depth=2)
    assert result.key == KEY and result.gradient < 0


def test_a_pass_without_gradients_is_told_what_is_wrong() -> None:
    scene = load_scene("hair.xml")
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 2})
    with pytest.raises(PathreplayError, match="sensor 'eye', and none has gradients"):
        integrator.render_backward(scene, None, dr.ones(mi.TensorXf, (6, 6, 3)), spp=1)


@pytest.mark.parametrize("edges", ["none", pytest.param("all", marks=pytest.mark.slow)])
def test_its_pigments_can_be_optimised_and_exported(edges: str) -> None:
    pose = {"key": "ball.to_world", "pose": "translation", "initial": {"translation": [0.1, 0, 0]}}
    parameters = [{"key": KEY, "initial": 0.5}, *([pose] if edges == "all" else [])]
    job = {
        "scene": "hair.xml", "parameters": parameters, "iterations": 2, "spp": 2, "eval_spp": 2, "output": "run",
        "integrator": {"type": "pathreplay", "max_depth": 2, "boundary": edges},
        "target": {"values": {KEY: 0.3}, "spp": 4},
    }  # fmt: skip
    optimize(make_config(job), progress=False)
    assert export_run(Path("run")).startswith("run/export/scene.xml")
