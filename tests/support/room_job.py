"""A job on a tiny room, a textured wall and a coloured floor: 0.1 s an iteration."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import numpy as np
import pytest

from pathreplay.jobs import RunResult, make_config, optimize
from pathreplay.report.progress import Progress

# A textured wall and a coloured one under a light, seen by two sensors: small enough for 0.1 s per iteration.
CAMERA = """<sensor type="perspective" id="{name}"><float name="fov" value="55"/>
    <transform name="to_world"><lookat origin="{x},1.5,3" target="0,-0.4,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="12"/><integer name="height" value="10"/>
      <string name="pixel_format" value="rgb"/><rfilter type="box"/></film></sensor>"""


SCENE = f"""<scene version="3.0.0">
  {CAMERA.format(name="left", x=-1)}
  {CAMERA.format(name="right", x=1)}
  <bsdf type="diffuse" id="floor"><rgb name="reflectance" value="0.3,0.5,0.7"/></bsdf>
  <shape type="rectangle" id="wall"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">
    <string name="filename" value="texture.exr"/><boolean name="raw" value="true"/></texture></bsdf></shape>
  <shape type="rectangle" id="ground"><ref id="floor"/>
    <transform name="to_world"><rotate x="1" angle="-90"/><translate y="-1" z="1"/></transform></shape>
  <emitter type="point" id="lamp">
    <point name="position" x="0.3" y="1" z="2"/><rgb name="intensity" value="6"/></emitter>
</scene>"""


TEXTURE = "wall.bsdf.reflectance.data"


JOB = {
    "scene": "room.xml",
    "integrator": {"type": "prb", "max_depth": 3},
    "iterations": 6,
    "spp": 4,
    "eval_spp": 16,
    "learning_rate": 0.1,
    "parameters": [
        {"key": TEXTURE, "initial": 0.5, "lower": 0.0, "upper": 1.0},
        {"key": "floor.reflectance.*", "initial": 0.5, "lower": 0.0, "upper": 1.0},
    ],
    "target": {"scene": "room.xml", "spp": 256, "integrator": {"type": "path", "max_depth": 3}},
}


@pytest.fixture(autouse=True)
def room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    from pathreplay.inverse.images.io import exr_bytes

    monkeypatch.chdir(tmp_path)
    (tmp_path / "room.xml").write_text(SCENE)
    texels = np.array([[0.1, 0.4], [0.6, 0.9]], np.float32)[:, :, None] * np.array([1, 0.8, 0.6], np.float32)
    (tmp_path / "texture.exr").write_bytes(exr_bytes(texels))
    return tmp_path


def run(**changes: object) -> RunResult:
    return optimize(make_config({**JOB, **changes}), progress=False)


def interrupt_at(iteration: int, monkeypatch: pytest.MonkeyPatch, times: int = 1) -> None:
    """Send real SIGINTs to this process at the end of an iteration."""
    calls = []
    advance = Progress.advance

    def hook(self: Progress, loss: float) -> None:
        advance(self, loss)
        calls.append(loss)
        if len(calls) == iteration:
            for _ in range(times):
                os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(Progress, "advance", hook)


CLOUD = {
    "scene": "cloud",
    "scene_parameters": {"resolution": 12, "grid": 6, "views": 1},
    "integrator": {"type": "pathreplay", "max_depth": 4},
    "parameters": [{"key": "*.sigma_t.data", "initial": 1.0, "lower": 0.0}],
    "target": {"values": {"*.sigma_t.data": 2.0}, "spp": 8, "integrator": {"type": "volpath", "max_depth": 4}},
}
