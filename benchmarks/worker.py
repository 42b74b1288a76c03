"""Runs one job in this process and writes what happens to stdout, one JSON object a line.

Started by `runner.py` as `python -m benchmarks.worker JOB`. A method that raises is reported and left out of the
following rounds; one that kills the process is known by the line that said it was about to run.
"""

from __future__ import annotations

import gc
import json
import os
import platform
import resource
import sys
import time
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pathreplay import __version__, backend

from .job import METHODS, Job, Machine
from .spread import spread

PIXEL_CHANNELS = 3


def _say(event: str, **facts: Any) -> None:
    print(json.dumps({"event": event} | facts), flush=True)


def processor_name() -> str:
    """The processor's own name where the system tells it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _machine(variant: str) -> Machine:
    import drjit as dr

    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return Machine(
        processor=processor_name(),
        processors=usable,
        threads=dr.thread_count(),
        system=f"{platform.system()} {platform.machine()}",
        python=platform.python_version(),
        mitsuba=version("mitsuba"),
        drjit=version("drjit"),
        pathreplay=__version__,
        libllvm=".".join(map(str, backend.loaded_version())),
        variant=variant,
    )


def peak_mib() -> float:
    """Largest resident size that this process has had, MiB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # KiB; bytes on macOS
    return peak / (1024 if sys.platform != "darwin" else 1024**2)


class Pass:
    """A scene, ready for gradients: each call times one gradient pass of the weighted image, or one primal pass."""

    def __init__(self, job: Job) -> None:
        import drjit as dr
        import mitsuba as mi
        import numpy as np

        from pathreplay.check.objective import smooth_weights

        from . import counting
        from .scenes import SCENES

        self.job = job
        self.counter: Any = counting.register()
        self.scene = mi.load_dict(SCENES[job.scene](job.resolution), optimize=False)
        self.params = mi.traverse(self.scene)
        for key in job.parameters:
            dr.enable_grad(self.params[key])
        self.params.update()
        shape = (job.resolution, job.resolution, PIXEL_CHANNELS)
        even = dr.full(mi.TensorXf, 1 / (shape[0] * shape[1] * shape[2]), shape)
        wave = smooth_weights(shape, alpha=False).astype(np.float32)
        self.adjoint = even if job.weights == "even" else mi.TensorXf(wave)
        self.grid = getattr(self.params[job.parameters[0]], "shape", ()) if len(job.parameters) == 1 else ()
        self.integrators: dict[str, Any] = {}

    def __call__(self, method: str, seed: int) -> tuple[float, Any]:
        """Seconds, and the gradients of all parameters (or image, or event count) as one flat array.

        Raises what the method raises.
        """
        import drjit as dr
        import mitsuba as mi
        import numpy as np

        if method not in self.integrators:
            depths = {"max_depth": self.job.max_depth, "rr_depth": self.job.rr_depth}
            self.integrators[method] = mi.load_dict(METHODS[method] | depths)
        for key in self.job.parameters:
            dr.clear_grad(self.params[key])
        self.counter.count = dr.zeros(mi.UInt32, 1)
        gc.collect()  # not in the middle of the measurement
        dr.sync_thread()
        start = time.perf_counter()
        if self.job.update:
            for key in self.job.parameters:
                self.params.set_dirty(key)
            self.params.update()
        if self.job.measure != "gradient":
            results = [self.integrators[method].render(self.scene, seed=seed, spp=self.job.spp)]
        else:
            self.integrators[method].render_backward(self.scene, self.params, self.adjoint, seed=seed, spp=self.job.spp)
            results = [dr.grad(self.params[key]) for key in self.job.parameters]
        dr.eval(results)  # so far the kernel has only been recorded
        dr.sync_thread()
        seconds = time.perf_counter() - start
        if self.job.measure == "events":
            return seconds, np.array(self.counter.count) / (self.job.resolution**2 * self.job.spp)
        flat = [np.ravel(np.array(getattr(result, "matrix", result))) for result in results]
        return seconds, np.concatenate(flat)


def run(job: Job) -> None:
    """Run a job; events are `machine`, `start`, `sample`, `error`, `errors` (see `spread`), `peak`."""
    variant = backend.set_variant(None)

    import drjit as dr
    import numpy as np

    from pathreplay.scenes import one_line

    if job.threads:
        dr.set_thread_count(job.threads)
    _say("machine", **asdict(_machine(variant)))
    one_pass = Pass(job)
    kept: dict[str, list[Any]] = {name: [] for name in job.methods}
    for k in range(-job.warm_up, job.rounds):
        if k == 0 or (k > 0 and job.restart and k % job.restart == 0):
            one_pass.integrators.clear()
        for method in list(kept):
            _say("start", method=method)
            try:
                seconds, result = one_pass(method, seed=k % 2**32)
            except Exception as error:
                _say("error", method=method, message=one_line(error)[:200])
                del kept[method]
                continue
            finite = bool(np.isfinite(result).all())
            _say("sample", method=method, seed=k, seconds=seconds, finite=finite, kept=k >= 0)
            if k >= 0:
                kept[method].append(result)
    reference = kept.get(job.reference or "")
    for method, rows in kept.items():
        if len(rows) > 1 and np.isfinite(rows).all():
            _say("errors", method=method, **spread(rows, reference, one_pass.grid))
    _say("peak", mib=peak_mib())


if __name__ == "__main__":
    arguments = json.loads(sys.argv[1])
    run(Job(**arguments | {name: tuple(arguments[name]) for name in ("parameters", "methods")}))
