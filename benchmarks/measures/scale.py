"""Measures what grows with the size of a job: memory of runs with many views or texels, and error of long sums."""

from __future__ import annotations

import os
import re
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from pathreplay.inverse.images.io import exr_bytes
from pathreplay.jobs import iterate, make_config
from pathreplay.platform import memory

from .job import Job, Measure
from .passes import Pass

_NAME = re.compile(r"(\d+) views?, (\d+) x (\d+) texels(?:, memory (.*))?")
ITERATIONS = 3
_VIEW = """<sensor type="perspective" id="v{i}"><float name="fov" value="40"/>
<transform name="to_world"><lookat origin="{x}, 0.1, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
<film type="hdrfilm"><integer name="width" value="{side}"/><integer name="height" value="{side}"/>
<rfilter type="box"/><string name="pixel_format" value="rgb"/></film></sensor>"""
_SCENE = """<scene version="3.0.0">{views}<emitter type="constant"/><shape type="rectangle" id="wall">
<bsdf type="diffuse"><texture type="bitmap" name="reflectance"><string name="filename" value="start.exr"/>
<boolean name="raw" value="true"/></texture></bsdf></shape></scene>"""


def name_of(views: int, texels: int, memory: str = "") -> str:
    """Return the name of a job: number of views, texels along each side of a grey texture, and memory limit."""
    return f"{views} view{'s' if views > 1 else ''}, {texels} x {texels} texels" + (f", memory {memory}" * bool(memory))


def _peak_since() -> float:
    """Return the largest resident size (MiB) since the last call; NaN on systems other than Linux."""
    status, refs = Path("/proc/self/status"), Path("/proc/self/clear_refs")
    if not status.exists():
        return float("nan")
    peak = int(status.read_text().split("VmHWM:")[1].split()[0]) / 1024
    refs.write_text("5")
    return peak


class Watching(threading.Thread):
    """Samples the memory of this process without file pages, some hundred times a second, until `ended` is called."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.most, self._end = 0, threading.Event()

    def run(self) -> None:
        """Sample memory until the end."""
        while not self._end.wait(0.005):
            self.most = max(self.most, memory.taken())

    def ended(self) -> float:
        """Stop sampling, and return the largest sample (MiB)."""
        self._end.set()
        self.join()
        return self.most / 2**20


class WholeRun(Measure):
    """A complete run of `pathreplay optimize`, including previews, checkpoint and report."""

    def __init__(self, job: Job) -> None:
        self.job = job
        found = _NAME.fullmatch(job.scene)
        assert found is not None
        self.views, self.texels, self.memory = int(found[1]), int(found[2]), found[4]
        self.peaks: list[float] = []

    def __call__(self, method: str, seed: int) -> tuple[float, np.ndarray]:
        """Return seconds and the last loss."""
        begun, watching = time.perf_counter(), Watching()
        watching.start()
        with tempfile.TemporaryDirectory(dir=os.environ.get("TMPDIR") or "/var/tmp") as folder:
            session = iterate(make_config(self._written(Path(folder))), output=Path(folder) / "run")
            for state in session:
                self.peaks.append(_peak_since())
                loss = state.loss
            self.peaks += [_peak_since(), watching.ended()]
            return time.perf_counter() - begun, np.array([loss])

    def conclude(self, kept: dict[str, list[np.ndarray]]) -> dict[str, dict[str, Any]]:
        """Return peaks of memory (MiB): until the end of the first step, in each later step, and at the end of the run.

        The last entry is the peak of the whole run without file pages.
        """
        return {name: {"values": tuple(self.peaks)} for name in kept}

    def _written(self, folder: Path) -> dict[str, Any]:
        """Write scene and images, and return the job. The texture gets its size by refinement, not from a file."""
        side = self.job.resolution
        views = "".join(_VIEW.format(i=i, x=0.02 * i - 1, side=side) for i in range(self.views))
        (folder / "scene.xml").write_text(_SCENE.format(views=views))
        (folder / "start.exr").write_bytes(exr_bytes(np.full((16, 16, 1), 0.5, np.float32)))
        (folder / "target.exr").write_bytes(exr_bytes(np.full((side, side, 3), 0.3, np.float32)))
        wall = {"key": "wall.bsdf.reflectance.data", "lower": 0.0, "upper": 1.0, "resolutions": [self.texels]}
        return {
            "scene": str(folder / "scene.xml"),
            "iterations": ITERATIONS,
            "spp": self.job.spp,
            "eval_spp": self.job.spp,
            "integrator": {"type": "pathreplay", **self.job.limits},
            "parameters": [wall],
            "target": {"images": [str(folder / "target.exr")] * self.views},
            **({"memory_limit": self.memory} if self.memory else {}),
        }


class Sum(Pass):
    """Gradient passes under a constant sky, which show the error of the sum over all samples."""

    def conclude(self, kept: dict[str, list[np.ndarray]]) -> dict[str, dict[str, Any]]:
        """Return the largest relative error of a channel. The exact gradient of the mean image is 1/3 per channel."""
        return {name: {"mean": float(np.abs(np.stack(rows) * 3 - 1).max())} for name, rows in kept.items() if rows}
