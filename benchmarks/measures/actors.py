"""Times iterations of a job with many views, in this process and with Ray actors of one thread each."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from pathreplay.jobs import iterate, make_config

from .job import Job, Measure

PROCESS = "this process"
COMPILING = {"surfaces": 6, "cloud": 1}
"""Number of first iterations that are not timed: kernels are traced and recorded, again on actors that change views."""

SENSOR = """<sensor type="perspective"><float name="fov" value="40"/><transform name="to_world">
  <rotate y="1" angle="{angle}"/><lookat origin="0,2,4" target="0,0,0" up="0,1,0"/></transform>
  <film type="hdrfilm"><integer name="width" value="{size}"/><integer name="height" value="{size}"/>
  <string name="pixel_format" value="rgb"/><rfilter type="box"/></film></sensor>"""
ROOM = """<scene version="3.0.0">{sensors}
<shape type="rectangle" id="floor"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="2"/></transform>
  <bsdf type="diffuse"><texture type="checkerboard" name="reflectance"/></bsdf></shape>
<shape type="sphere" id="ball"><transform name="to_world"><scale value="0.6"/><translate y="0.6"/></transform>
  <bsdf type="roughconductor"><float name="alpha" value="0.2"/></bsdf></shape>
<emitter type="constant"/></scene>"""


def many(actors: int) -> str:
    """Return the name of the method that uses this number of actors."""
    return f"{actors} {'actor' if actors == 1 else 'actors'}"


def name_of(scene: str, views: int) -> str:
    """Return the name of a job: `surfaces` recovers a floor with recorded passes, `cloud` a density without them."""
    return f"{scene}, {views} views"


class Iterations(Measure):
    """Run the job once with a method in each round. The first iterations compile and record, and are not counted."""

    ITERATIONS = 20

    def __init__(self, job: Job) -> None:
        self.scene, views = job.scene.split(", ")
        self.views, self.job = int(views.removesuffix(" views")), job
        self.seconds: dict[str, list[float]] = {}

    def __call__(self, method: str, seed: int) -> tuple[float, np.ndarray]:
        """Return the median of the seconds of an iteration, and the last loss."""
        seconds, loss = self._run({} if method == PROCESS else _ray(int(method.split()[0])))
        counted = seconds[COMPILING[self.scene] :]
        self.seconds.setdefault(method, []).extend(counted)
        return float(np.median(counted)), np.array([loss])

    def conclude(self, kept: dict[str, list[np.ndarray]]) -> dict[str, dict[str, Any]]:
        """Return the seconds of all counted iterations, by method."""
        return {name: {"values": tuple(self.seconds[name])} for name in kept}

    def _run(self, executor: dict[str, Any]) -> tuple[list[float], float]:
        with tempfile.TemporaryDirectory() as folder:
            with iterate(make_config({**self._described(Path(folder)), **executor, "output": f"{folder}/run"})) as run:
                states = [(state.entry.seconds, state.loss) for state in run]
        return [seconds for seconds, _ in states], states[-1][1]

    def _described(self, folder: Path) -> dict[str, Any]:
        size = self.job.resolution
        common = {"iterations": self.ITERATIONS, "spp": self.job.spp, "eval_spp": 1, "preview": {"share": 0}}
        if self.scene == "cloud":
            density = {"*.sigma_t.data": 2.0}
            return {
                **common,
                "scene": "cloud",
                "scene_parameters": {"views": self.views, "resolution": size, "grid": 16},
                "parameters": [{"key": "*.sigma_t.data", "initial": 1.0, "lower": 0.0}],
                "target": {"values": density, "spp": 4, "integrator": {"type": "volpath", "max_depth": 6}},
            }
        sensors = "\n".join(SENSOR.format(angle=360 * n / self.views, size=size) for n in range(self.views))
        room = folder / "room.xml"
        room.write_text(ROOM.format(sensors=sensors), encoding="utf-8")
        floor = {"key": "floor.bsdf.reflectance.color?.value", "initial": 0.5, "lower": 0.0, "upper": 1.0}
        return {**common, "scene": str(room), "parameters": [floor], "target": {"scene": str(room), "spp": 4}}


def _ray(actors: int) -> dict[str, Any]:
    return {"executor": "ray", "ray": {"actors": actors, "threads": 1}}
