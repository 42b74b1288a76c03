"""One process from its start to its second gradient: prints the seconds of each stage as one JSON list.

Started by `startup_pass.py` as `python -m benchmarks.first JOB METHOD`. For Mitsuba's own methods pathreplay is not
imported: they are measured as their users have them.
"""

from __future__ import annotations

import itertools
import json
import sys
import time

BEGIN = time.perf_counter()


def _set_variant(ours: bool) -> None:
    if ours:
        from pathreplay import backend

        backend.set_variant(None)
    else:
        import mitsuba as mi

        mi.set_variant("llvm_ad_rgb")


def main(job: dict, plugin: dict, ours: bool) -> list[float]:
    """Seconds of: import and variant; scene, integrator and first gradient; second gradient, with another seed."""
    _set_variant(ours)
    imported = time.perf_counter()

    import drjit as dr
    import mitsuba as mi

    from benchmarks.scenes import SCENES

    scene = mi.load_dict(SCENES[job["scene"]](job["resolution"]), optimize=False)
    params = mi.traverse(scene)
    key = job["parameters"][0]
    dr.enable_grad(params[key])
    params.update()
    integrator = mi.load_dict(plugin | {"max_depth": job["max_depth"], "rr_depth": job["rr_depth"]})
    adjoint = dr.full(mi.TensorXf, 1.0, (job["resolution"], job["resolution"], 3))
    marks = [BEGIN, imported]
    for seed in (0, 1):
        integrator.render_backward(scene, params, adjoint, seed=seed, spp=job["spp"])
        dr.eval(dr.grad(params[key]))
        dr.sync_thread()
        marks.append(time.perf_counter())
    return [later - earlier for earlier, later in itertools.pairwise(marks)]


if __name__ == "__main__":
    print(json.dumps(main(json.loads(sys.argv[1]), json.loads(sys.argv[2]), sys.argv[3] == "ours")))
