"""Scenes whose passes Dr.Jit cannot record: the job goes on with traced passes, and with the same numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pathreplay.inverse.config.schema import make_config
from pathreplay.inverse.problem.problem import build_problem
from recorded_steps import steps

SCENE = """<scene version="3.0.0">
  <sensor type="{sensor}" id="camera">{options}
    <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>
  </sensor>
  <emitter type="constant"/>
  <shape type="sphere" id="ball">
    <bsdf type="diffuse" id="paint"><rgb name="reflectance" value="0.3,0.5,0.7"/></bsdf>
  </shape>
</scene>
"""
LENS = """<float name="fov" value="40"/><float name="aperture_radius" value="0.1"/>
    <float name="focus_distance" value="3"/>"""
SENSORS = {"orthographic": "", "thinlens": LENS}
COLOUR = {
    "parameters": [{"key": "ball.bsdf.reflectance.value", "initial": 0.2}],
    "target": {"values": {"ball.bsdf.reflectance.value": 0.7}, "spp": 16},
}
POSE = {
    "parameters": [{"key": "ball.to_world", "pose": "translation", "initial": {"translation": [0.1, 0, 0]}}],
    "target": {"scene": "scene.xml", "spp": 16},
}


@pytest.mark.parametrize("job", [COLOUR, POSE], ids=["colour", "pose"])
@pytest.mark.parametrize("sensor", SENSORS)
def test_what_cannot_be_recorded_is_traced(sensor: str, job: dict, tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text(SCENE.format(sensor=sensor, options=SENSORS[sensor]))
    interior = {"type": "pathreplay", "boundary": "none"}
    config = make_config({"scene": "scene.xml", "iterations": 4, "spp": 8, "integrator": interior, **job})
    problem = build_problem(config, tmp_path)
    np.testing.assert_allclose(steps(problem, config, "recorded"), steps(problem, config, "traced"), rtol=1e-4)
