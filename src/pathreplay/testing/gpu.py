"""Gradient checks and timings on a machine with a GPU, written to one file: `pathreplay doctor --gpu`.

Each check or timing is an item, and runs in its own process, because running out of device memory may crash the
process. If an item fails, the file contains its error message, and the remaining items still run.
"""

from __future__ import annotations

import json
import math
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from importlib.metadata import version
from pathlib import Path

from pathreplay import __version__
from pathreplay.platform import backend, interrupts
from pathreplay.platform.atomic_files import require_writable, write_whole
from pathreplay.platform.device import device_of
from pathreplay.types import Json

TIMEOUT_S = 300
"""Timeout per item in seconds: far more than any item takes on a CPU."""
ROUNDS = 7
WALLS = "red.reflectance.value"

# For each check: scene, arguments of the scene, and parameter.
TRUTHS: dict[str, tuple[str, dict[str, int], str]] = {
    "colour of a wall": ("cornell-box", {"resolution": 32}, WALLS),
    "texture": ("cornell-box-photo", {"resolution": 32, "texture": 16}, "back.bsdf.reflectance.data"),
    "index of glass": ("glass-pane", {"resolution": 24}, "glass.eta"),
    "density": ("cloud", {"resolution": 16, "grid": 8, "views": 1}, "cloud.interior_medium.sigma_t.data"),
}
# For each timing: integrator with its options, side of the image in pixels, samples per pixel, depth.
TIMINGS: dict[str, tuple[Json, int, int, int]] = {
    f"{name}, {side} x {side}, depth {depth}": ({"type": kind, **more}, side, 16, depth)
    for side in (128, 512)
    for depth in (8, 64)
    for name, kind, more in (
        ("prb", "prb", {}),
        ("recorded", "pathreplay", {"adjoint": "recorded"}),
        ("replay", "pathreplay", {"adjoint": "replay"}),
    )
}
# Timings at large depths. adjoint = 'auto' chooses between the two methods, recorded paths and replay.
TIMINGS |= {
    f"{adjoint}, 512 x 512, depth {depth}": ({"type": "pathreplay", "adjoint": adjoint}, 512, 16, depth)
    for adjoint, depth in (("recorded", 256), ("recorded", 448), ("replay", 448), ("replay", 2048))
}


@dataclass(frozen=True)
class Item:
    """The result of one item: measured facts, or an error message."""

    name: str
    facts: Json
    error: str = ""


def examine(
    variant: str | None, output: Path, names: Sequence[str] = (), tell: Callable[[str], None] = print
) -> tuple[str, list[str]]:
    """Run all items, or those in ``names``, and write the results to ``output``.

    Returns a summary line, and the names of the items that failed.
    ``variant`` None means cuda_ad_rgb. Raises PathreplayError if the variant does not run on this machine, or the file
    cannot be written.
    """
    require_writable(output, "--output")
    with interrupts.undisturbed():
        chosen = backend.set_variant(variant or "cuda_ad_rgb")
    results = []
    for name in names or (*(f"truth: {n}" for n in TRUTHS), *(f"time: {n}" for n in TIMINGS)):
        results.append(_in_process(chosen, name))
        tell(f"{name}: {results[-1].error or _summary(results[-1].facts)}")
    report = {
        "pathreplay": __version__,
        "mitsuba": version("mitsuba"),
        "drjit": version("drjit"),
        "python": platform.python_version(),
        "system": platform.platform(),
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "variant": chosen,
        "device": asdict(device_of(chosen)),
        "items": [asdict(item) for item in results],
    }
    write_whole(output, json.dumps(report, indent=1).encode() + b"\n", "--output")
    wrong = [item.name for item in results if item.error or item.facts.get("verdict") == "fail"]
    return f"{output}: {len(results)} items, {len(wrong)} failed" + (f" ({'; '.join(wrong)})" if wrong else ""), wrong


def _summary(facts: Json) -> str:
    if "verdict" in facts:
        return f"{facts['verdict']} (z = {facts['z']:+.1f})"
    return f"{facts['seconds']:.4f} s"


def _in_process(variant: str, name: str) -> Item:
    command = [sys.executable, "-m", "pathreplay.testing.gpu", variant, name]
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return Item(name, {}, f"no result within {TIMEOUT_S} s")
    lines = [line for line in done.stdout.splitlines() if '{"facts"' in line]
    if done.returncode or not lines:
        last = [line for line in done.stderr.splitlines() if line.strip()] or [f"ended with status {done.returncode}"]
        return Item(name, {}, last[-1].strip()[:300])
    return Item(name, json.loads(lines[-1][lines[-1].index('{"facts"') :])["facts"])


def truth(name: str) -> Json:
    """Compare a gradient with finite differences."""
    from pathreplay.scenes.loading import load_scene_for
    from pathreplay.testing.gradient import check_gradient

    scene, arguments, key = TRUTHS[name]
    loaded, _ = load_scene_for(scene, [key], **arguments)
    check = check_gradient(loaded, key, seeds=8, spp=64, fd_spp=256)
    facts = {key: getattr(check, key) for key in ("verdict", "gradient", "gradient_se", "reference", "reference_se")}
    return facts | {"z": check.z if math.isfinite(check.z) else 0.0}


def timing(name: str) -> Json:
    """Time gradient passes: return the seconds of the first pass, and the median and minimum of the later passes."""
    import drjit as dr
    import mitsuba as mi

    from pathreplay.integrators.film.image import picture_shape
    from pathreplay.scenes.loading import load_scene

    options, side, spp, depth = TIMINGS[name]
    scene = load_scene("cornell-box", resolution=side)
    params = mi.traverse(scene)
    dr.enable_grad(params[WALLS])
    params.update()
    integrator = mi.load_dict({**options, "max_depth": depth, "rr_depth": 5})
    shape = picture_shape(scene.sensors()[0])
    taken = []
    for seed in range(ROUNDS + 1):
        begin = time.perf_counter()
        integrator.render_backward(scene, params, dr.ones(mi.TensorXf, shape), seed=seed, spp=spp)
        dr.eval(dr.grad(params[WALLS]))
        dr.sync_thread()
        taken.append(time.perf_counter() - begin)
    return {"first": taken[0], "seconds": statistics.median(taken[1:]), "fastest": min(taken[1:])}


def main(variant: str, name: str) -> None:
    """Run one item in this process and print its facts to stdout as a line of JSON."""
    backend.set_variant(variant)
    kind, _, what = name.partition(": ")
    facts = truth(what) if kind == "truth" else timing(what)
    print(json.dumps({"facts": facts}), flush=True)
    # Skip the shutdown of the process. An error of the GPU driver during shutdown would count as a failure of the item.
    os._exit(0)


if __name__ == "__main__":
    main(*sys.argv[1:])
