"""Times new processes from import to third gradient, with or without a kernel cache, for the task `startup`."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import replace
from typing import Any

import numpy as np

from ..drafts import ROOT
from .job import Job, Measure
from .methods import STAGES, STOCK, parts


class Start(Measure):
    """Each method and seed has its own process, which the first call for this method and seed starts."""

    def __init__(self, job: Job) -> None:
        self.job = job
        # Of a warm start, ours and theirs: filled in the rounds that are not kept.
        self.kept = tempfile.TemporaryDirectory()
        self.homes = [tempfile.mkdtemp(dir=self.kept.name) for _ in range(2)]
        self.stages: dict[tuple[str, int], list[float]] = {}

    def __call__(self, method: str, seed: int) -> tuple[float, np.ndarray]:
        """Return the seconds of one stage, which is a part of ``method``."""
        name, stage = parts(method)
        if (name, seed) not in self.stages:
            if self.job.measure == "warm start":
                self.stages[name, seed] = self._start(name, self.homes[name in STOCK])
            else:
                with tempfile.TemporaryDirectory() as home:
                    self.stages[name, seed] = self._start(name, home)
        seconds = self.stages[name, seed][STAGES.index(stage)]
        return seconds, np.array([seconds])

    def conclude(self, kept: dict[str, list[np.ndarray]]) -> dict[str, dict[str, Any]]:
        """Remove the kernel caches; return nothing, because the seconds are the only result."""
        self.kept.cleanup()
        return {}

    def _start(self, name: str, home: str) -> list[float]:
        paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = os.environ | {"HOME": home, "DRJIT_CACHE_DIR": home, "PYTHONPATH": os.pathsep.join(paths)}
        if name not in STOCK:
            environment.pop("DRJIT_LIBLLVM_PATH", None)  # finding it is part of the import
        command = [sys.executable, "-m", "benchmarks.measures.first", replace(self.job, methods=(name,)).encode()]
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
        if done.returncode != 0:
            lines = done.stderr.strip().splitlines()
            raise RuntimeError(lines[-1] if lines else f"ended with status {done.returncode}")
        return json.loads(done.stdout.splitlines()[-1])
