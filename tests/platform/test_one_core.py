"""A process that may use one core only: files are read and written there as everywhere, nothing waits for ever."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from pathreplay.inverse.images.io import exr_bytes

pytestmark = pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="only Linux lets a process choose cores")

SCENE = """<scene version="3.0.0">
  <sensor type="perspective" id="eye">
    <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="6"/><integer name="height" value="4"/>
    <string name="pixel_format" value="rgb"/></film></sensor>
  <bsdf type="diffuse" id="paint"><texture type="bitmap" name="reflectance">
    <string name="filename" value="texture.exr"/><boolean name="raw" value="true"/></texture></bsdf>
  <shape type="sphere" id="ball"><ref id="paint"/></shape>
  <emitter type="envmap" id="sky"><string name="filename" value="sky.exr"/></emitter>
</scene>"""
CONFIG = """scene = "ball.xml"
iterations = 2
spp = 1
eval_spp = 1
checkpoint_every = 1
integrator = { type = "prb", max_depth = 3 }
parameters = [ { key = "paint.reflectance.data", initial = "texture.exr" } ]
target = { images = ["target.exr"] }
"""
# The first core that this process may use: sets of cores are inherited, and 0 need not be in ours.
ON_ONE_CORE = """
import os, sys
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
import drjit
from pathreplay import cli
sys.argv = ["pathreplay", *sys.argv[1:]]
try:
    cli.main()
finally:
    assert drjit.thread_count() == 1
"""


@pytest.fixture
def room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ball.xml").write_text(SCENE)
    (tmp_path / "job.toml").write_text(CONFIG)
    for name, shape in (("texture", (40, 30, 3)), ("sky", (8, 16, 3)), ("target", (4, 6, 3))):
        (tmp_path / f"{name}.exr").write_bytes(exr_bytes(np.full(shape, 0.5, np.float32)))
    return tmp_path


@pytest.mark.slow
def test_a_whole_job_and_its_resumption_end(room: Path, run_python) -> None:
    done = run_python(ON_ONE_CORE, args=("optimize", "job.toml", "--quiet"))
    assert done.returncode == 0, done.stderr
    assert (room / "runs/job/report.html").is_file()
    config = room / "runs/job/config.toml"
    config.write_text(config.read_text().replace("iterations = 2", "iterations = 3"))
    resumed = run_python(ON_ONE_CORE, args=("optimize", "--resume", "runs/job", "--quiet"))
    assert resumed.returncode == 0, resumed.stderr
    assert len((room / "runs/job/history.jsonl").read_text().splitlines()) == 3


def test_a_check_of_a_scene_with_pictures_ends(room: Path, run_python) -> None:
    done = run_python(ON_ONE_CORE, args=("check", "ball.xml", "--param", "sky.scale", "--seeds", "2", "--spp", "1"))
    assert done.returncode in (0, 1), done.stderr
    assert "1 checked" in done.stdout


SURFACE = """
import os
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
from pathreplay.platform.backend import set_variant
set_variant("llvm_ad_rgb")
from pathlib import Path
import numpy as np
from pathreplay.inverse.images.io import exr_bytes
from pathreplay.output import surface_scene
Path("sky.exr").write_bytes(exr_bytes(np.full((128, 256, 3), 0.5, np.float32)))
density = np.zeros((8, 8, 8), np.float32)
density[2:6, 2:6, 2:6] = 50
mesh = surface_scene.emitting_mesh(density, np.ones((8, 8, 8, 3), np.float32), np.zeros(3), np.ones(3))
mesh.write_ply("surface.ply")
Path("scene.xml").write_text(surface_scene.surface_xml([], True))
print(surface_scene._error(Path("scene.xml"), []))
"""


def test_the_scene_of_a_surface_with_a_sky_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run_python) -> None:
    """The sky of an exported surface is an EXR file of several blocks, which Mitsuba's pool of threads reads."""
    monkeypatch.chdir(tmp_path)
    done = run_python(SURFACE)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["0.0"]
