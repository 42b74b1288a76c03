"""Passes with edges are recorded by the optimiser, and are those that are traced."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pathreplay.inverse.config.schema import make_config
from pathreplay.inverse.problem.problem import build_problem
from recorded_steps import steps

SCENE = """<scene version="3.0.0">
  <sensor type="perspective" id="camera"><float name="fov" value="40"/>
    <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="12"/><integer name="height" value="12"/>{filter}</film>
  </sensor>
  <shape type="rectangle" id="wall">
    <transform name="to_world"><scale value="4"/><translate z="-2"/></transform>
    <bsdf type="diffuse" id="paint"/>
  </shape>
  <shape type="rectangle" id="lamp">
    <transform name="to_world"><lookat origin="2,2,4" target="0,0,-2" up="0,1,0"/></transform>
    <emitter type="area"><rgb name="radiance" value="5"/></emitter>
  </shape>
  <shape type="disk" id="card"><transform name="to_world"><scale value="0.5"/></transform></shape>
</scene>
"""
POSE = {"key": "card.to_world", "pose": "translation", "initial": {"translation": [0.2, 0.1, 0]}}
JOB = {
    "scene": "scene.xml",
    "parameters": [POSE],
    "target": {"scene": "scene.xml", "spp": 16},
    "spp": 16,
    "iterations": 4,
}
FILTERS = {"image first": "", "with the image": '<rfilter type="box"/>'}


@pytest.mark.slow
@pytest.mark.parametrize("way", FILTERS)
def test_steps_with_edges_that_were_recorded_are_those_that_are_traced(way: str, tmp_path: Path) -> None:
    """`steps` sees that one thing was recorded. Edges are on by themselves; without them the gradient is another."""
    (tmp_path / "scene.xml").write_text(SCENE.format(filter=FILTERS[way]))
    found = {}
    for edges, passes in (("auto", "recorded"), ("all", "traced"), ("none", "traced")):
        config = make_config({**JOB, "integrator": {"type": "pathreplay", "max_depth": 2, "boundary": edges}})
        found[edges, passes] = steps(build_problem(config, tmp_path), config, passes)
    recorded = found["auto", "recorded"]
    np.testing.assert_allclose(recorded, found["all", "traced"], rtol=1e-3)
    without = found["none", "traced"]
    assert (np.abs(recorded - without)[:, 1] > 0.1 * recorded[:, 1]).all()
    # Every step has seeds and values of its own: one that was launched with those of another would show.
    assert (np.abs(np.diff(recorded, axis=0)) / recorded.max(axis=0)).min() > 1e-3
