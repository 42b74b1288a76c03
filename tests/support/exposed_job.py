"""A job on images of one wall at several exposures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pathreplay.inverse.images.io import exr_bytes

KEY = "wall.bsdf.reflectance.value"


SUN = """<emitter type="directional"><vector name="direction" value="0,0,-1"/>
    <rgb name="irradiance" value="3.14159265"/></emitter>"""


LEVELS = (0.8, 0.4, 0.2, 0.6)
"""Of the pictures: reflectance times exposure."""


def scene(light: str = SUN, filter: str = "box", film: str = "rgb") -> str:
    eye = f"""<sensor type="perspective" id="eye-%d"><float name="fov" value="%d"/>
      <transform name="to_world"><lookat origin="0.2,0,%g" target="0,0,0" up="0,1,0"/></transform>
      <film type="hdrfilm"><integer name="width" value="6"/><integer name="height" value="4"/>
      <string name="pixel_format" value="{film}"/><rfilter type="{filter}"/></film></sensor>"""
    eyes = "".join(eye % (k, 30 + k, 1.2 + 0.02 * k) for k in range(4))
    return f"""<scene version="3.0.0">{eyes}<shape type="rectangle" id="wall"><transform name="to_world">
      <scale value="9"/></transform><bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></shape>
      {light}</scene>"""


JOB: dict[str, Any] = {
    "scene": "room.xml",
    "integrator": {"type": "pathreplay", "max_depth": 2},
    "iterations": 150,
    "spp": 1,
    "eval_spp": 4,
    "learning_rate": 0.08,
    "final_learning_rate_ratio": 0.01,
    "test_views": ["eye-3"],
    "exposure": {},
    "target": {"images": [f"{k}.exr" for k in range(4)]},
    "parameters": [{"key": KEY, "lower": 0.0, "upper": 1.0}],
}


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "room.xml").write_text(scene())
    for k, level in enumerate(LEVELS):
        (tmp_path / f"{k}.exr").write_bytes(exr_bytes(np.full((4, 6, 3), level, np.float32)))
    return tmp_path
