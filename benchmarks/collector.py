"""Measures the cost of `pathreplay.integrators.lifetimes` around a pass in a process with a million objects.

    python -m benchmarks.collector

The command prints the time of the context manager alone, and the fraction of the time of recorded passes that the
cyclic garbage collector takes. A full collection in each pass would traverse all objects.
"""

from __future__ import annotations

import gc
import statistics
import time

from pathreplay.platform.backend import set_variant

OBJECTS, ROUNDS, PASSES = 10**6, 1000, 20


def main() -> None:
    """Print both measurements."""
    set_variant("llvm_ad_rgb")
    import drjit as dr
    import mitsuba as mi

    from pathreplay.integrators.lifetimes import careful

    scene = mi.load_dict(mi.cornell_box())
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 4})
    params = mi.traverse(scene)
    value = mi.Color3f(params["red.reflectance.value"])

    def gradient(seed: int) -> None:
        dr.enable_grad(value)
        params["red.reflectance.value"] = value
        params.update()
        dr.backward(dr.mean(mi.render(scene, params, integrator=integrator, spp=1, seed=seed), axis=None))

    gradient(0)
    objects = [[k] for k in range(OBJECTS)]
    gc.collect()
    care = []
    for _ in range(ROUNDS):
        begun = time.perf_counter()
        with careful():
            pass
        care.append(time.perf_counter() - begun)
    print(f"care of a pass beside {len(objects)} objects: {1e3 * statistics.median(care):.4f} ms")

    spent, full, began = 0.0, 0, 0.0

    def watch(phase: str, info: dict[str, int]) -> None:
        nonlocal spent, full, began
        if phase == "start":
            began = time.perf_counter()
            return
        spent += time.perf_counter() - began
        full += info["generation"] == 2

    gc.callbacks.append(watch)
    begun = time.perf_counter()
    for seed in range(1, PASSES + 1):
        gradient(seed)
    whole = time.perf_counter() - begun
    gc.callbacks.remove(watch)
    print(
        f"{PASSES} gradient passes: {1e3 * whole / PASSES:.1f} ms each, of which the collector takes "
        f"{1e3 * spent / PASSES:.2f} ms; {full} full collections"
    )


if __name__ == "__main__":
    main()
