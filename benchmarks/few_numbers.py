"""Compares optimizers on few numbers: steps and seconds until the noise of a single iteration limits the result.

    python -m benchmarks.few_numbers [PROBLEM ...] [--quick] [--record FILE]

The scene is a room with textured walls, a glossy ball, a block and two point lights. The noise limit is the excess
ν = ½ tr(H⁻¹Σ) of the loss that the noise Σ of one iteration causes at the minimum, the median over several seeds, which
outliers do not raise. The excess of values v is ½ dᵀHd with d = v - truth. H is the robust Gauss-Newton matrix of many
samples at the truth. The table has, for each seed, the first step with an excess of up to ν, its seconds (without
compiling kernels, which a first run of three steps does), and the mean excess of the last tenth of the steps in units
of ν. Adam's rates are searched with the first seed, among those of RATES times the natural units of the parameters, and
fall to a tenth of them. --record appends each run to a file of JSON lines.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pathreplay.platform.backend import set_variant

set_variant("llvm_ad_rgb")

import mitsuba as mi  # noqa: E402

import pathreplay  # noqa: E402
from pathreplay.inverse.objective.evaluate import Shard  # noqa: E402
from pathreplay.inverse.objective.stages import evaluator_of  # noqa: E402
from pathreplay.inverse.parameters.gauss_newton import GaussNewton  # noqa: E402

SPP, TARGET_SPP, EXACT_SPP, NOISES = 16, 4096, 1024, 8
SEEDS = (0, 1, 2)
RATES = (0.01, 0.03, 0.1)
STEPS = {"levenberg-marquardt": 24, "adam": 300, "l-bfgs-b": 60}
RADIANS = 180 / np.pi
Values = dict[str, np.ndarray]

CAMERA = {
    "camera.to_world": {
        "pose": "rigid",
        "pivot": [0, -0.1, 0],
        "initial": {"translation": [0.1, -0.08, 0.12], "rotation": [3, -4, 2]},
        "learning_rate": 1.0,
        "rotation_learning_rate": RADIANS,
    },
    "camera.x_fov": {"initial": 64.0, "learning_rate": RADIANS},
}
LIGHTS = {
    "near.position": {"initial": [-0.6, 0.85, 1.2], "learning_rate": 1.0},
    "far.position": {"initial": [1.0, 1.0, 0.8], "learning_rate": 1.0},
    "near.intensity.value": {"initial": 3.0, "parameterization": "log", "learning_rate": 1.0},
}
#: Parameters of each problem, with learning rates in natural units.
PROBLEMS: dict[str, dict[str, dict[str, Any]]] = {
    "camera and lens": CAMERA,
    "two lights and a colour": LIGHTS,
    "index of refraction": {"ball.bsdf.eta": {"initial": 1.3, "lower": 1.05, "upper": 2.5, "learning_rate": 1.0}},
    "camera, lens and lights": {**CAMERA, **LIGHTS},
}


def scene(glass: bool, size: int) -> dict[str, Any]:
    """The room; its ball is glossy, or of glass."""
    T, rng = mi.ScalarTransform4f, np.random.default_rng(1)

    def wall(to_world: mi.ScalarTransform4f) -> dict[str, Any]:
        texels = {"type": "bitmap", "raw": True, "data": mi.TensorXf(rng.uniform(0.2, 0.8, (8, 8, 3)))}
        return {"type": "rectangle", "to_world": to_world, "bsdf": {"type": "diffuse", "reflectance": texels}}

    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    plastic = {"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": {"type": "rgb", "value": [0.3, 0.5, 0.2]}}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4 if glass else 3},
        "camera": {
            "type": "perspective",
            "fov": 60,
            "to_world": T().look_at([0.2, 0.3, 2.6], [0, -0.1, 0], [0, 1, 0]),
            "film": film,
        },
        "floor": wall(T().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(4)),
        "back": wall(T().translate([0, 0, -1.5]).scale(4)),
        "left": wall(T().translate([-2, 0, 0]).rotate([0, 1, 0], 90).scale(4)),
        "ball": {
            "type": "sphere",
            "center": [0.5, -0.6, 0.1],
            "radius": 0.4,
            "bsdf": {"type": "dielectric", "int_ior": 1.5} if glass else plastic,
        },
        "block": {
            "type": "cube",
            "to_world": T().translate([-0.6, -0.6, -0.3]).rotate([0, 1, 0], 25).scale([0.3, 0.4, 0.3]),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.6, 0.4, 0.3]}},
        },
        "near": {
            "type": "point",
            "position": [-0.8, 1.0, 1.0],
            "intensity": {"type": "rgb", "value": [4.0, 3.0, 2.0]},
        },
        "far": {"type": "point", "position": [1.2, 0.8, 0.6], "intensity": {"type": "rgb", "value": [2.0, 2.5, 3.0]}},
    }


TRUTH: Values = {
    "camera.to_world:translation": np.zeros(3),
    "camera.to_world:rotation": np.zeros(3),
    "camera.x_fov": np.array([60.0]),
    "near.position": np.array([-0.8, 1.0, 1.0]),
    "far.position": np.array([1.2, 0.8, 0.6]),
    "near.intensity.value": np.array([4.0, 3.0, 2.0]),
    "ball.bsdf.eta": np.array([1.5 / 1.000277]),  # relative to air
}


class Case:
    """A problem with its target, and the noise limit at its solution."""

    def __init__(self, name: str, quick: bool) -> None:
        self.name, self.glass, self.size = name, "index" in name, 16 if quick else 48
        spp = 64 if quick else TARGET_SPP
        target = mi.render(mi.load_dict(scene(self.glass, self.size)), spp=spp, seed=99)
        self.target = np.array(target, np.float32)
        problem = self.problem(1.0, 0)
        self.keys = list(problem.initial)
        self.truth = {key: np.float32(TRUTH[key]).reshape(problem.initial[key].shape) for key in self.keys}
        evaluate = evaluator_of(problem.built, problem.built.integrator, problem.built.config.integrator)

        def model(spp: int, seed: int) -> GaussNewton:
            found = evaluate(self.truth, Shard((0,), spp, (seed,), second_order=True), {}).model
            assert found is not None
            return found

        self.matrix = model(64 if quick else EXACT_SPP, 1000).robust
        noises = [model(SPP, seed).noise for seed in range(2 if quick else NOISES)]
        self.limit = 0.5 * float(np.median([np.trace(np.linalg.solve(self.matrix, noise)) for noise in noises]))

    def problem(self, rate: float, seed: int) -> pathreplay.Problem:
        """The problem with learning rates of ``rate`` natural units."""
        parameters = {}
        for key, options in PROBLEMS[self.name].items():
            rates = {name: rate * value for name, value in options.items() if name.endswith("learning_rate")}
            given = {**options, **rates}
            bounds = (given.pop("lower", None), given.pop("upper", None))
            parameters[key] = pathreplay.Parameter(**given, bounds=bounds)
        view = pathreplay.View(sensor=0, target=self.target)
        return pathreplay.Problem(scene(self.glass, self.size), parameters, views=[view], spp=SPP, seed=seed)

    def excess(self, values: Values) -> float:
        """The excess of the loss at these values, in units of the noise limit."""
        off = np.concatenate([np.ravel(values[key].astype(float) - self.truth[key]) for key in self.keys])
        return 0.5 * float(off @ self.matrix @ off) / self.limit

    def run(self, optimizer: str, steps: int, rate: float, seed: int) -> tuple[list[float], list[float]]:
        """Excess and seconds after each step."""
        problem, begin = self.problem(rate, seed), time.perf_counter()
        excess, seconds = [], []

        def seen(iteration: pathreplay.Iteration) -> None:
            excess.append(self.excess(iteration.values))
            seconds.append(time.perf_counter() - begin)

        decay: dict[str, Any] = {"final_learning_rate_ratio": 0.1} if optimizer == "adam" else {}
        pathreplay.minimize(problem, optimizer, steps=steps, progress=False, callbacks=[seen], **decay)
        return excess, seconds


def reached(excess: Sequence[float]) -> int | None:
    """The first step with an excess of up to one, or None."""
    return next((n + 1 for n, value in enumerate(excess) if value <= 1), None)


def rows(case: Case, optimizer: str, quick: bool, record: Path | None) -> str:
    """Run the seeds, and return a row of the table."""
    steps = 3 if quick else STEPS[optimizer]
    rates = RATES if optimizer == "adam" else (0.03,)
    runs = {}
    case.run(optimizer, 3, rates[0], SEEDS[0])
    for rate in rates[:2] if quick else rates:
        runs[rate] = [case.run(optimizer, steps, rate, SEEDS[0])]
    best = min(runs, key=lambda rate: (reached(runs[rate][0][0]) or steps + 1, runs[rate][0][0][-1]))
    runs[best] += [case.run(optimizer, steps, best, seed) for seed in SEEDS[1 : 1 if quick else None]]
    firsts, times, ends = [], [], []
    for excess, seconds in runs[best]:
        first = reached(excess)
        firsts.append("-" if first is None else str(first))
        times.append("-" if first is None else f"{seconds[first - 1]:.0f}")
        ends.append(f"{np.mean(excess[-max(1, len(excess) // 10) :]):.2g}")
    if record is not None:
        with record.open("a") as file:
            for rate, found in runs.items():
                about = {"problem": case.name, "optimizer": optimizer, "rate": rate, "limit": case.limit}
                file.write(json.dumps({**about, "runs": found}) + "\n")
    entries = sum(value.size for value in case.truth.values())
    method = f"{optimizer}, rate {best:g}" if optimizer == "adam" else optimizer
    cells = case.name, str(entries), method, ", ".join(firsts), ", ".join(times), ", ".join(ends)
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Print the table, row by row."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.few_numbers")
    parser.add_argument("problems", nargs="*", choices=[*PROBLEMS, []], default=[])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--record", type=Path)
    given = parser.parse_args()
    mi.set_log_level(mi.LogLevel.Error)
    titles = "problem", "numbers", "optimizer", "steps to the noise limit", "seconds", "excess at the end"
    print(f"| {' | '.join(titles)} |\n|{' --- |' * len(titles)}")
    for name in given.problems or PROBLEMS:
        case = Case(name, given.quick)
        for optimizer in STEPS:
            print(rows(case, optimizer, given.quick, given.record), flush=True)


if __name__ == "__main__":
    main()
