"""The fixed set: gradients of small scenes by all drivers, saved, so that a change that should change nothing can tell.

    python tests/support/fixed_set.py [SCENE ...] [--driver NAME ...]    compares with the saved ones, status 1 if any
                                                                 differs
    python tests/support/fixed_set.py --save                     saves those of the code as it is

What is saved was right when it was saved: the truth of gradients is the business of other tests. It holds for one kind
of processor and one version of what computes it: elsewhere numbers are rounded otherwise, and paths take other turns.
"""

from __future__ import annotations

import argparse
import gc
import json
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import safe_open
from safetensors.numpy import save_file

from pathreplay import baselines
from pathreplay.platform.backend import set_variant  # before drjit and mitsuba

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

from fixed_scenes import SCENES, SIZE, Case, Scene  # isort: skip

SAVED = Path(__file__).with_name("fixed_set.safetensors")
VARIANT = "llvm_ad_rgb"
LIMIT = 1e-5
"""Of the relative L1 error of an array: float32 sums in another order stay well below."""
PLUGINS: dict[str, tuple[str, dict[str, Any]]] = {
    "primal": ("pathreplay", {"boundary": "none"}),
    "sweep": ("pathreplay", {"adjoint": "recorded", "boundary": "none"}),
    "replay": ("pathreplay", {"adjoint": "replay", "boundary": "none"}),
    "forward": ("pathreplay", {"boundary": "none"}),
    "pixels": ("pathreplay", {"adjoint": "recorded", "boundary": "none"}),
    "tape": ("naive_ad", {}),
    "tape-forward": ("naive_ad", {}),
    "rb": ("radiative_backprop", {}),
    "listing": ("prb_volume_listing", {}),
}
Arrays = dict[str, np.ndarray]

# ------------------------------ Computing ------------------------------


def numbers(seed: int, shape: Sequence[int], low: float = 0.2) -> np.ndarray:
    """Fixed random numbers between ``low`` and 1, of one sign mostly, so that little cancels."""
    return np.random.default_rng(seed).uniform(low, 1, tuple(shape)).astype(np.float32)


class Opened:
    """A loaded scene, of which any keys may be given leaves whose gradients are looked at."""

    def __init__(self, scene: Scene) -> None:
        gc.collect()  # Dr.Jit traces calls through every scene alive
        self.scene = scene
        self.loaded = mi.load_dict(scene.build(), optimize=False)
        self.params = mi.traverse(self.loaded)
        keys = {key for case in scene.cases for key in case.keys or scene.keys}
        self.still = {key: type(self.params[key])(self.params[key]) for key in keys}

    def put(self, keys: Sequence[str]) -> dict[str, list[Any]]:
        """Leaves with gradients by key: the values themselves, or of a transformation three shifts and an angle."""
        leaves: dict[str, list[Any]] = {}
        for key in keys:
            value = self.still[key]
            if key.endswith("to_world"):
                leaf = [dr.opaque(mi.Float, 0) for _ in range(4)]
                dr.enable_grad(leaf)
                shift = mi.Transform4f().translate(mi.Vector3f(*leaf[:3]))
                self.params[key] = shift @ mi.Transform4f().rotate([0.3, 1, 0.2], leaf[3]) @ mi.Transform4f(value)
            else:
                leaf = [type(value)(value)]
                dr.enable_grad(leaf)
                self.params[key] = leaf[0]
            leaves[key] = leaf
        self.params.update()
        return leaves

    def release(self) -> None:
        """Leave no gradients behind."""
        for key, value in self.still.items():
            self.params[key] = value
        self.params.update()

    def compute(self, case: Case) -> Arrays:
        """The case's image (or tangent of the image) and gradients, by name."""
        plugin, properties = PLUGINS[case.driver]
        properties = {"max_depth": self.scene.depth, "rr_depth": self.scene.rr_depth, **properties, **case.options}
        integrator = mi.load_dict({"type": plugin, **properties})
        try:
            seed = self.scene.seed + case.passes - 1
            for earlier in range(self.scene.seed, seed):
                self._backward(case, integrator, earlier)
            if case.driver == "primal":
                image = integrator.render(self.loaded, sensor=case.sensor, seed=seed, spp=self.scene.spp)
                return {"image": np.array(image)}
            if case.driver.endswith("forward"):
                return {"tangent": self._forward(case, integrator, seed)}
            return self._backward(case, integrator, seed)
        finally:
            self.release()

    def _forward(self, case: Case, integrator: Any, seed: int) -> np.ndarray:
        leaves = self.put(case.keys or self.scene.keys)
        for i, part in enumerate(part for leaf in leaves.values() for part in leaf):
            dr.set_grad(part, type(part)(numbers(100 + i, part.shape)))
        dr.enqueue(dr.ADMode.Forward, leaves)
        dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)
        options = {"sensor": case.sensor, "seed": seed, "spp": self.scene.spp}
        return np.array(integrator.render_forward(self.loaded, self.params, **options))

    def _backward(self, case: Case, integrator: Any, seed: int) -> Arrays:
        keys = case.keys or self.scene.keys
        leaves = self.put(keys)
        found: Arrays = {}
        sensor, spp = self.loaded.sensors()[case.sensor], self.scene.spp
        if case.driver == "pixels":
            assert integrator.supports_pixel_sweep(self.loaded, sensor, spp)
            slope = numbers(1, (SIZE, SIZE, 3))
            loss = mi.TensorXf(-0.2 * slope), mi.TensorXf(slope)
            image = integrator.render_value_and_grad(self.loaded, *loss, sensor, seed, spp)
            found["image"] = np.array(image)
        else:
            film = sensor.film()
            film.prepare([])
            adjoint = mi.TensorXf(numbers(1, (SIZE, SIZE, film.bitmap().channel_count())))
            integrator.render_backward(self.loaded, self.params, adjoint, sensor=sensor, seed=seed, spp=spp)
        dr.enqueue(dr.ADMode.Backward, [self.params[key] for key in keys])
        dr.traverse(dr.ADMode.Backward)
        for key, leaf in leaves.items():
            found[key] = np.concatenate([np.array(dr.grad(part)).ravel() for part in leaf])
        return found


def computed(scene: Scene, drivers: Sequence[str] = ()) -> Iterator[tuple[Case, Arrays]]:
    """The arrays of every case of a scene, or of those by some drivers."""
    chosen = [case for case in scene.cases if not drivers or case.driver in drivers]
    opened = Opened(scene) if chosen else None
    for case in chosen:
        yield case, opened.compute(case)


# ------------------------------ Comparing ------------------------------


def relative(found: np.ndarray, saved: np.ndarray) -> float:
    """Relative L1 error, Σ|found - saved| / Σ|saved|; infinite where the shapes differ."""
    if found.shape != saved.shape:
        return np.inf
    return float(np.abs(found.astype(np.float64) - saved).sum() / np.abs(saved, dtype=np.float64).sum())


def machine() -> dict[str, str]:
    """What decides how numbers are rounded."""
    lines = Path("/proc/cpuinfo").read_text().split("\n\n")[0].splitlines() if Path("/proc/cpuinfo").exists() else []
    facts = dict((part.strip() for part in line.split(":", 1)) for line in lines if ":" in line)
    vectors = sorted(flag for flag in facts.get("flags", "").split() if flag.startswith(("avx", "fma", "sse", "f16c")))
    return {
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
        "LLVM": ".".join(map(str, dr.detail.llvm_version())),
        "processor": " ".join(facts.get(name, "?") for name in ("vendor_id", "cpu family", "model")),
        "instructions": " ".join(vectors),
    }


def incomparable() -> str:
    """Why the saved numbers say nothing here, in one line; empty where they do."""
    with safe_open(SAVED, framework="numpy") as file:
        saved = json.loads(file.metadata()["machine"])
    others = [f"{name} is {here}, not {saved[name]}" for name, here in machine().items() if here != saved[name]]
    return f"saved elsewhere, where numbers are rounded otherwise: {'; '.join(others)}" if others else ""


def compared(scene: Scene, drivers: Sequence[str] = ()) -> Iterator[tuple[str, float]]:
    """For every case of a scene its line of the table and its largest error; infinite where an array is missing."""
    with safe_open(SAVED, framework="numpy") as file:
        names = list(file.keys())
        for case, arrays in computed(scene, drivers):
            start = f"{scene.name}/{case.name}/"
            saved = {name.removeprefix(start): file.get_tensor(name) for name in names if name.startswith(start)}
            errors = {key: relative(arrays[key], saved[key]) for key in saved.keys() & arrays.keys()}
            errors |= {key: np.inf for key in saved.keys() ^ arrays.keys()}
            worst = max(errors, key=lambda key: errors[key] if errors[key] == errors[key] else np.inf)
            yield f"{scene.name:8s} {case.name:36s} {errors[worst]:8.1e}  {worst}", errors[worst]


def differs(error: float) -> bool:
    """Whether an error is too large, or not a number."""
    return not error < LIMIT


# ------------------------------ Command line ------------------------------


def save() -> None:
    """Save all arrays; none of them may be zero, or not finite."""
    arrays: Arrays = {}
    for scene in SCENES:
        for case, found in computed(scene):
            for key, values in found.items():
                name = f"{scene.name}/{case.name}/{key}"
                assert np.isfinite(values).all(), f"{name} is not finite"
                assert np.abs(values).sum() > 0, f"{name} is zero"
                arrays[name] = np.ascontiguousarray(values, np.float32)
    save_file(arrays, SAVED, metadata={"machine": json.dumps(machine())})


def main() -> int:
    """The command line above; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="*", help="parts of names of scenes")
    parser.add_argument("--driver", action="append", choices=PLUGINS, default=[], help="again for several")
    parser.add_argument("--save", action="store_true")
    options = parser.parse_args()
    set_variant(VARIANT)
    baselines.register()
    mi.set_log_level(mi.LogLevel.Error)
    if options.save:
        save()
        return 0
    if reason := incomparable():
        print(reason)
        return 2
    begin, errors = time.perf_counter(), [0.0]
    for scene in SCENES:
        if options.scenes and not any(part in scene.name for part in options.scenes):
            continue
        for line, error in compared(scene, options.driver):
            print(line, "<-- DIFFERS" if differs(error) else "", flush=True)
            errors.append(error)
    wrong = sum(map(differs, errors))
    print(f"{len(errors) - 1} cases, {wrong} differ, largest {max(errors):.1e}, {time.perf_counter() - begin:.0f} s")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
