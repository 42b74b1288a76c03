"""A job on a single wall: the smallest scene that has a colour to recover."""

from __future__ import annotations

from typing import Any

JOB: dict[str, Any] = {
    "scene": "room.xml",
    "integrator": {"type": "prb", "max_depth": 2},
    "iterations": 8,
    "spp": 4,
    "eval_spp": 4,
    "deterministic": True,
    "parameters": [{"key": "wall.bsdf.reflectance.value", "initial": [0.2, 0.5, 0.7]}],
    "target": {"values": {"wall.bsdf.reflectance.value": [0.6, 0.5, 0.1]}, "spp": 16},
}


SCENE = """<scene version="3.0.0">
  <sensor type="perspective"><transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="6"/><integer name="height" value="4"/>
      <string name="pixel_format" value="rgb"/></film></sensor>
  <shape type="rectangle" id="wall"><transform name="to_world"><scale value="3"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></shape>
  <emitter type="point"><point name="position" x="0.3" y="1" z="2"/><rgb name="intensity" value="6"/></emitter>
</scene>"""
