"""Times one process from its start to its third gradient, and prints the seconds of each stage as one JSON list.

`start.py` runs `python -m benchmarks.measures.first JOB`, where JOB has one method, an integrator. For an integrator of
Mitsuba, the process imports only what this integrator needs, and in particular not pathreplay. The integrator is
thereby measured as its users run it.
"""

from __future__ import annotations

import itertools
import json
import sys
import time

from benchmarks.measures.methods import METHODS, STOCK

BEGIN = time.perf_counter()


def _set_variant(ours: bool) -> None:
    if ours:
        from pathreplay.platform import backend

        backend.set_variant(None)
    else:
        import mitsuba as mi

        mi.set_variant("llvm_ad_rgb")


def main(text: str) -> list[float]:
    """Return the seconds of four stages.

    The stages are import and variant; scene and first gradient; second gradient; a gradient with half the samples.
    """
    (method,) = json.loads(text)["methods"]
    _set_variant(method not in STOCK)
    imported = time.perf_counter()

    import drjit as dr
    import mitsuba as mi

    from benchmarks.measures.job import Job
    from benchmarks.scenes import SCENES

    mi.set_log_level(mi.LogLevel.Error)  # warnings would precede the list
    job = Job.decode(text)
    scene = mi.load_dict(SCENES[job.scene](job.resolution), optimize=False)
    params = mi.traverse(scene)
    (key,) = job.parameters
    dr.enable_grad(params[key])
    params.update()
    integrator = mi.load_dict(METHODS[method] | job.limits)
    adjoint = dr.full(mi.TensorXf, 1.0, (job.resolution, job.resolution, 3))
    marks = [BEGIN, imported]
    for seed, spp in ((0, job.spp), (1, job.spp), (2, job.spp // 2)):
        integrator.render_backward(scene, params, adjoint, seed=seed, spp=spp)
        dr.eval(dr.grad(params[key]))
        dr.sync_thread()
        marks.append(time.perf_counter())
    return [later - earlier for earlier, later in itertools.pairwise(marks)]


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1])))
