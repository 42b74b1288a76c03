"""Compares Mitsuba's inverse rendering tutorials, as plain loops with their settings, with our configs.

    python -m benchmarks.tutorials [NAME ...] [--quick] [--scenes FOLDER]

The command prints a table: final errors of parameter and image, seconds of all iterations (including kernel tracing,
without loading and rendering targets), and lines of code. The scenes are in examples/tutorials. If --scenes gives the
folder `scenes` of mitsuba-tutorials, the meshes, volume and sky of that folder replace ours. --quick runs few
iterations, as a test. Dr.Jit caches compiled kernels on disk: run the command twice for comparable times.

Image errors exclude render noise; they need two renderings of each view and two of its target (by `path` or `volpath`).
Lines of code are counted for the loop without its head, and for the config, without empty lines and comments.
"""

from __future__ import annotations

import argparse
import inspect
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from pathreplay.platform.backend import set_variant

set_variant("llvm_ad_rgb")

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402
from scipy.spatial import cKDTree  # noqa: E402

from pathreplay.inverse.config.schema import Config  # noqa: E402
from pathreplay.inverse.parameters.grids import rmse  # noqa: E402
from pathreplay.inverse.parameters.pose import make_pose  # noqa: E402
from pathreplay.jobs import load_config, make_config, optimize  # noqa: E402
from pathreplay.scenes.loading import load_scene  # noqa: E402
from pathreplay.scenes.parameters import get_array, to_value  # noqa: E402

from .tutorial_loops import LOOPS  # noqa: E402

EXAMPLES = Path(__file__).parent.parent / "examples/tutorials"
JUDGED_SPP = 1024
WAYS = ("plain loop", "pathreplay")
#: Scene parameters with the tutorials' own files, by tutorial.
THEIRS = {
    "volume_optimization": {"volume": "volume.vol", "turn": "-90"},
    "object_pose_estimation": {"body": "meshes/bunny.ply", "scale": "6.5"},
    "shape_optimization": {"mesh": "meshes/ico_10k.ply", "sky": "textures/envmap2.exr"},
}
THEIR_TARGETS = {"shape_optimization": {"mesh": "meshes/suzanne.ply"}}


def job(name: str, scenes: Path | None) -> Config:
    """The config of a tutorial with absolute paths."""
    config = load_config(EXAMPLES / f"{name}.toml").model_dump(exclude_unset=True)
    places = (
        (config, THEIRS),
        (config["target"], {k: {**THEIRS.get(k, {}), **THEIR_TARGETS.get(k, {})} for k in THEIRS}),
    )
    for table, files in places:
        given = dict(table.get("scene_parameters") or {})
        if scenes is not None:
            own = files.get(name, {})
            given |= {k: str(scenes / v) if (scenes / v).is_file() else v for k, v in own.items()}
        table["scene_parameters"] = {k: _absolute(v) for k, v in given.items()}
        table["scene"] = str(EXAMPLES / table["scene"])
    return make_config(config)


def _absolute(value: Any) -> Any:
    return str(EXAMPLES / value) if isinstance(value, str) and value.startswith("assets/") else value


def texts(parameters: dict[str, Any]) -> dict[str, str]:
    return {name: str(value) for name, value in parameters.items()}


def run(name: str, way: str, scenes: Path | None, quick: bool) -> dict[str, Any]:
    """Errors and seconds of one way to run one tutorial."""
    config = job(name, scenes)
    if way == WAYS[0]:
        loop, options = LOOPS[name]
        begin: list[float] = []
        if name == "shape_optimization":
            options = {**options, "target": str((config.target.scene_parameters or {})["mesh"])}
        recovered = loop(
            config.scene, texts(config.scene_parameters), **options, few=2 if quick else None,
            ready=lambda: begin.append(time.perf_counter()),
        )  # fmt: skip
        dr.sync_thread()
        seconds = time.perf_counter() - begin[0]
    else:
        changes: dict[str, Any] = {"eval_spp": 4}
        if quick:
            changes |= {"stages": [{"iterations": 2}], "iterations": 2} if config.stages else {"iterations": 2}
        table = config.model_dump(exclude_unset=True) | changes
        if quick and "resolutions" in table["parameters"][0]:
            table["parameters"][0] |= {"resolutions": [16], "refine_at": []}
        result = optimize(make_config(table), output=Path("runs/tutorials") / name)
        seconds = sum(entry.seconds for entry in result.history)
        keys = [entry.key for entry in config.parameters]
        recovered = {key: result.parameters[key] for key in keys}
    return {"seconds": seconds, **errors(name, config, recovered)}


def errors(name: str, config: Config, recovered: dict[str, np.ndarray]) -> dict[str, Any]:
    """Errors of the image, and of the parameter in the tutorial's measure."""
    scene = load_scene(config.scene, **config.scene_parameters)
    truth = load_scene(str(config.target.scene), **(config.target.scene_parameters or {}))
    params, true = mi.traverse(scene), mi.traverse(truth)
    ((key, value),) = recovered.items()
    params[key] = mi.TensorXf(value) if value.ndim > 2 else to_value(params[key], value)
    params.update()
    judge = mi.load_dict((config.target.integrator or config.integrator).model_dump())
    squares = []
    for view in range(len(scene.sensors())):
        a, b, s, t = (
            np.array(mi.render(which, sensor=view, integrator=judge, spp=JUDGED_SPP, seed=seed), np.float64)
            for seed, which in enumerate((scene, scene, truth, truth))
        )
        squares.append(np.mean((a - s) * (b - t)))
    picture = float(np.sqrt(max(np.mean(squares), 0)))
    return {"picture": picture, "parameter": measure(name, key, value, get_array(true[key]), true[key])}


def measure(name: str, key: str, value: np.ndarray, truth: np.ndarray, like: Any) -> str:
    """The error of a parameter, in words."""
    if name == "volume_optimization":
        return f"{rmse(value, truth):.4f} root mean square"
    if name == "object_pose_estimation":
        pose = make_pose(key, like, "rigid", None, None)
        error = type(pose)(pose.key, pose.kind, pose.base, pose.pivot, None, truth).error(value)
        return f"{error.position:.4f}, {error.degrees:.2f}°" if error else ""
    if name == "shape_optimization":
        ours, theirs = value.reshape(-1, 3), truth.reshape(-1, 3)
        there, back = cKDTree(theirs).query(ours)[0], cKDTree(ours).query(theirs)[0]
        return f"{np.sqrt(np.mean(there**2)):.4f} to the truth, {np.sqrt(np.mean(back**2)):.4f} from it"
    return f"{float(np.sum((value - truth) ** 2)):.2e} sum of squares"


def lines(name: str) -> tuple[int, int]:
    """Count the lines of the loop (without head, docstring and the call of ``ready``) and of the config."""
    source = inspect.getsource(LOOPS[name][0]).split('"""', 2)[2].splitlines()
    config = (EXAMPLES / f"{name}.toml").read_text().splitlines()
    plain = [line for line in source if line.strip() not in ("", "ready()")]
    return len(plain), len([line for line in config if line.strip() and not line.strip().startswith("#")])


def main() -> None:
    """Run each tutorial both ways in separate processes, and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(LOOPS))
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--scenes", type=Path, metavar="FOLDER")
    parser.add_argument("--way", choices=WAYS, help=argparse.SUPPRESS)
    given = parser.parse_args()
    names = given.names or list(LOOPS)
    if unknown := set(names) - set(LOOPS):
        parser.error(f"no tutorial {min(unknown)!r}; there are {', '.join(LOOPS)}")
    if given.way:
        print("\n" + json.dumps(run(names[0], given.way, given.scenes, given.quick)))
        return
    if given.scenes is None and not (EXAMPLES / "assets").is_dir():
        subprocess.run([sys.executable, str(EXAMPLES / "make_assets.py")], check=True)
    print("| tutorial | by | parameter | picture | seconds | lines |\n| --- | --- | ---: | ---: | ---: | ---: |")
    for name in names:
        for way, count in zip(WAYS, lines(name), strict=True):
            command = [sys.executable, "-m", "benchmarks.tutorials", name, "--way", way]
            command += ["--quick"] * given.quick + (["--scenes", str(given.scenes)] if given.scenes else [])
            done = subprocess.run(command, capture_output=True, text=True)
            if done.returncode:
                print(done.stderr, file=sys.stderr)
                sys.exit(f"{name} by {way} failed")
            row = json.loads(done.stdout.splitlines()[-1])
            cells = [
                name,
                way,
                row["parameter"],
                f"{row['picture']:.2g}" if row["picture"] else "below noise",
                f"{row['seconds']:.1f}",
                str(count),
            ]
            print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
