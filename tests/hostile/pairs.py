"""Pairs of keys: every key of a job beside every other one, in jobs that hold as many pairs as they can.

A job begins with a pair that was in none so far, and takes further keys as long as the config goes with them. Where it
is refused, it is tried again with half of the further keys, down to the pair alone: what is refused then is the pair.
"""

from __future__ import annotations

import itertools
import json
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from pydantic import BaseModel

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.schema import Config, make_config

from .assets import png
from .battery import Result
from .case import OPTIMIZE, Action, Case, Recipe
from .of_capture import MODEL, NAMES
from .picture_bytes import exr, pixels
from .room import Room, changed
from .values import pick

Row = dict[str, Mapping[str, Any]]
"""By key, what of the job is set for it: dotted path -> value."""

CAMERA = """<sensor type="perspective" id="{name}">
    <transform name="to_world"><lookat origin="{x},0.5,4" target="0,0,0" up="0,1,0"/></transform>
    <float name="fov" value="45"/>
    <film type="hdrfilm"><integer name="width" value="$res"/><integer name="height" value="6"/>
      <string name="pixel_format" value="rgb"/><rfilter type="box"/></film></sensor>"""
SCENE = f"""<scene version="3.0.0"><default name="res" value="8"/>
  {CAMERA.format(name="left", x=-1)}
  {CAMERA.format(name="right", x=1)}
  <bsdf type="diffuse" id="paint"><texture type="bitmap" name="reflectance">
    <string name="filename" value="texture.png"/><boolean name="raw" value="true"/>
    <string name="format" value="variant"/></texture></bsdf>
  <bsdf type="diffuse" id="clay"><rgb name="reflectance" value="0.4,0.5,0.6"/></bsdf>
  <shape type="ply" id="sheet"><string name="filename" value="sheet.ply"/><ref id="paint"/></shape>
  <shape type="obj" id="tile"><string name="filename" value="tile.obj"/><ref id="clay"/></shape>
  <shape type="sphere" id="ball"><float name="radius" value="0.4"/><ref id="clay"/></shape>
  <emitter type="constant" id="sky"><rgb name="radiance" value="1"/></emitter>
</scene>"""
OWN = """import drjit as dr
def shares(first, share): return first * share.array
def loss(image, target): return dr.abs(image - target)
def penalty(v): return dr.mean(dr.square(v), axis=None)
"""
TEXTURE = "paint.reflectance.data"
BASE: dict[str, Any] = {
    "scene": "pairs.xml",
    "iterations": 2,
    "spp": 4,
    "eval_spp": 2,
    "integrator": {"type": "pathreplay", "max_depth": 3},
    "parameters": {"texture": {"key": TEXTURE, "initial": 0.4}},
}
TARGET = {"target.values": {TEXTURE: 0.7}, "target.spp": 4}
"""Where no key says what else is to be matched."""

# Parameters and stages stand in tables while keys are put together, and are made lists in the end.
_POSE = {"parameters.pose.key": "ball.to_world", "parameters.pose.pose": "rigid"}
_DELTA = {"integrator.attach": "delta"}
_MESH = {"parameters.mesh.key": "tile.vertex_positions", "parameters.mesh.learning_rate": 0.001}
_SHARE = {
    "parameters.share.key": "share",
    "parameters.share.initial": 0.5,
    "parameters.share.shape": [1],
    "derived": [{"key": "clay.reflectance.value", "function": "own:shares", "of": ["share"]}],
}
_STAGES = {"stages.first.iterations": 1, "stages.second.iterations": 1}
_CAPTURE = {"capture.transforms": "photos/transforms.json"}
_MODEL = {"capture.colmap": "sparse/0", "capture.images": "images", "capture.width": 12}


def _of(prefix: str, more: Mapping[str, Any] = {}, **values: list[Any]) -> dict[str, list[Mapping[str, Any]]]:
    """Keys of a table, each with the values it is tried with, and what goes with it."""
    shown = "parameters" if prefix.startswith("parameters.") else prefix
    return {f"{shown}.{key}": [{**more, f"{prefix}.{key}": value} for value in tried] for key, tried in values.items()}


#: Each key of a job, and the ways in which it is set. Ray's cluster takes longer to start than such a job: its options
#: are there, and `executor` is what it is by default.
KEYS: dict[str, list[Mapping[str, Any]]] = {
    **{
        key: [{key: value} for value in values]
        for key, values in {
            "scene_parameters": [{"res": 8}],
            "sensors": [["left", "right"], [1, 0]],
            "test_views": [["right"]],
            "variant": ["llvm_ad_rgb"],
            "baseline": [{"type": "pathreplay", "max_depth": 2}, {"type": "prb", "max_depth": 3}],
            "view_weights": [{"left": 2.0}],
            "loss": ["l1", "relative-l2", "l2", "scale-invariant", "ssim", "own:loss"],
            "measure_snr": [True],
            "max_consecutive_nonfinite": [1],
            "view_batch_size": [1],
            "pixel_batch_size": [20],
            "seed": [7],
            "learning_rate": [0.01],
            "final_learning_rate_ratio": [0.5],
            "learning_rate_schedule": ["cosine", "linear", "exponential", "constant"],
            "warmup_steps": [1],
            "checkpoint_every": [1],
            "deterministic": [True],
            "memory_limit": ["8 GB"],
            "executor": ["local"],
            "spp_shards": [2],
            "output": ["out/deep/run"],
        }.items()
    },
    "scene": [{"scene": "pairs.xml"}],
    "iterations": [{"iterations": 2}],
    "debias": [{"debias": True, "loss": "log"}, {"debias": True, "loss": "ssim"}],
    "eval_spp": [{"eval_spp": 3}],
    "spp": [{"spp": 8}, {"spp": "auto"}],
    "integrator": [
        {"integrator.boundary": "all"},
        {"integrator.adjoint": "replay"},
        {"integrator.attach": "none"},
        {"integrator.hide_emitters": True},
        {"integrator.caustics": "particles"},
        {"integrator": {"type": "pathreplay_particles", "max_depth": 3}},
        {"integrator": {"type": "prb", "max_depth": 3}},
    ],
    "derived": [_SHARE],
    "parameters.shape": [_SHARE],
    **_of("exposure", white_balance=[True], reference=["left"], fix_scale=[False], learning_rate=[0.1]),
    **_of("adaptive_spp", {"spp": "auto"}, target_snr=[0.5], min=[4], max=[16]),
    **_of(
        "optimizer",
        beta_1=[0.8],
        beta_2=[0.9],
        epsilon=[1e-6],
        uniform=[True],
        amsgrad=[True],
        iterate_averaging=[False],
    ),
    "optimizer.type": [
        {"optimizer.type": kind} for kind in ("adamw", "sgd", "rmsprop", "l-bfgs-b", "levenberg-marquardt")
    ],
    **_of("optimizer", {"optimizer.type": "adamw"}, weight_decay=[0.1]),
    **_of("optimizer", {"optimizer.type": "sgd"}, momentum=[0.5]),
    **_of("optimizer", {"optimizer.type": "sgd", "optimizer.momentum": 0.5}, nesterov=[True]),
    **_of("optimizer", {"optimizer.type": "rmsprop"}, alpha=[0.9]),
    **_of("optimizer", {"optimizer.type": "l-bfgs-b"}, history_size=[3], tolerance=[1e-3]),
    **_of("optimizer", {"optimizer.type": "levenberg-marquardt"}, damping=[0.1]),
    **_of("preview", share=[0.5], views=[1], frames=[2]),
    **_of("ray", address=["auto"], actors=[1], threads=[1], max_restarts=[1], max_task_retries=[1]),
    **_of("target", images=[["left.exr", "right.exr"], "[lr]*t.exr"], values=[{TEXTURE: 0.6}], spp=[2]),
    **_of("target", masks=[["mask.png", "mask.png"]], scene=["pairs.xml"], scene_parameters=[{"res": 8}]),
    **_of("target", integrator=[{"type": "path", "max_depth": 2}]),
    "target.alpha": [
        {"target.alpha": "black"},
        {"target.alpha": "scene", "target.images": ["alpha.png", "alpha.png"]},
        {"target.alpha": "mask", "target.images": ["alpha.png", "alpha.png"]},
        {"target.alpha": "mask", **_CAPTURE},
    ],
    "capture.transforms": [_CAPTURE],
    "capture.colmap": [_MODEL],
    "capture.images": [_MODEL],
    **_of("capture", _CAPTURE, masks=["photos/masks"], width=[4], test_every=[2], medium=["fog"], near_clip=[0.01]),
    **_of("response", kind=["gamma", "curve"], segments=[4], fix_exponent=[True], learning_rate=[0.1]),
    **_of("parameters.texture", lower=[0.0], upper=[1.0], learning_rate=[0.1]),
    "parameters.initial": [
        {"parameters.texture.initial": 0.3},
        {"parameters.texture.initial": {"image": "texture.png", "fit": "crop", "raw": True}},
        {**_POSE, "parameters.pose.initial": {"translation": [0.1, 0, 0]}},
    ],
    **_of("parameters.texture", total_variation=[0.1], l2_to_initial=[0.1], regularizer=["own:penalty"]),
    **_of("parameters.texture", parameterization=["softplus", "log"], pyramid=[True]),
    **_of("parameters.texture", {"parameters.texture.refine_at": [1]}, resolutions=[[2, 4]]),
    **_of("parameters.texture", {"parameters.texture.resolutions": [2, 4]}, refine_at=[[1]]),
    **_of("parameters.mesh", _MESH, large_steps_lambda=[5.0], laplacian_weight=[0.1]),
    **_of("parameters.pose", _POSE, pose=["rigid", "translation"]),
    **_of("parameters.pose", _POSE, pivot=[[0.0, 0, 0]], error_scale=[1.0], rotation_learning_rate=[1.0]),
    "parameters.key": [
        {"parameters.texture.key": TEXTURE},
        {"parameters.camera.key": "right.x_fov", "parameters.camera.learning_rate": 0.1, **_DELTA},
    ],
    "stages": [_STAGES],
    **_of("stages.second", _STAGES, iterations=[1], downscale=[2], spp=[2], max_depth=[2], sensors=[["left"]]),
    **_of("stages.second", _STAGES, view_batch_size=[1], pixel_batch_size=[10], learning_rate_factor=[0.5]),
    **_of("stages.second", _STAGES, parameters=[[TEXTURE], ["ball.*"], ["*"]]),
}
#: The same with the views of a capture, which take the place of the scene's.
for _key, _path, _names in (
    ("sensors", "sensors", ["shot_0", "shot_1", "shot_2"]),
    ("test_views", "test_views", ["shot_2"]),
    ("view_weights", "view_weights", {"shot_1": 2.0}),
    ("exposure.reference", "exposure.reference", "shot_1"),
    ("stages.second.sensors", "stages.second.sensors", ["shot_1"]),
):
    KEYS[_key].append({**KEYS[_key][0], **_CAPTURE, _path: _names})

_TABLES_OF_ONE = {"parameters": "parameters", "stages": "stages.second"}


def missing_keys() -> set[str]:
    """Keys of a job that stand in no pair."""
    return set(_keys_of(Config)) - KEYS.keys()


def _keys_of(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    from pathreplay.inverse.config.schema import _TABLES

    for name in model.model_fields:
        table = _TABLES.get(name) if not prefix else None
        if table is None or name == "derived":
            yield prefix + name
        else:
            yield from _keys_of(table, f"{_TABLES_OF_ONE.get(name, name)}.")


def job_of(row: Row) -> dict[str, Any]:
    """The job with these keys."""
    job: Any = BASE
    for setting in row.values():
        for path, value in setting.items():
            job = changed(job, path.split("."), value)
    if "capture" not in job and not {"images", "values", "scene"} & job.get("target", {}).keys():
        for path, value in TARGET.items():
            job = changed(job, path.split("."), value)
    lists = {name: list(job[name].values()) for name in ("parameters", "stages") if name in job}
    return {**job, **lists}


def furnish(room: Room) -> None:
    """The files that jobs name."""
    room.write("pairs.xml", SCENE)
    room.write("own.py", OWN)
    for name in ("left.exr", "right.exr"):
        room.write(name, exr(pixels(6, 8), "R", "G", "B"))
    room.write("mask.png", png(6, 8, "L"))
    room.write("alpha.png", png(6, 8, "RGBA"))
    for folder in ("photos", "photos/masks"):
        (room / folder).mkdir()
        for k in range(3):
            room.write(f"{folder}/shot_{k}.png{'.png' if folder.endswith('masks') else ''}", png(8, 8))
    place = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]
    frames = [{"file_path": f"shot_{k}.png", "transform_matrix": place} for k in range(3)]
    room.write("photos/transforms.json", json.dumps({"camera_angle_x": 0.7, "frames": frames}))
    shutil.copytree(MODEL / "binary", room / "sparse" / "0")
    (room / "images" / "sub").mkdir(parents=True)
    for name in NAMES:
        room.write(f"images/{name}", png(80, 120))


def case_of(row: Row, number: int) -> Case:
    """The job as a case of its own kind."""

    def spoil(room: Room, rng: np.random.Generator) -> Action:
        furnish(room)
        room.job(job_of(row))
        return Action(argv=OPTIMIZE, writes=("out", "out/deep") if "output" in row else ())

    name = " + ".join(f"{key} {json.dumps(list(setting.values())[-1])}" for key, setting in row.items())
    return Case(0, number, Recipe("pairs", name, spoil))


def refusal(row: Row) -> str:
    """What the config has against a row: one line, or "". Any other error is raised."""
    job = job_of(row)
    names = json.dumps([job.get(key) for key in ("sensors", "test_views", "view_weights", "exposure", "stages")])
    if "capture" in job and re.search(r'"(left|right)"|\d\]', names):
        return "the views of a capture are its own"
    try:
        make_config(job)
    except PathreplayError as error:
        return str(error)
    return ""


class Cover:
    """Which pairs were in a job that ran, and which are refused, each with the line that says so."""

    def __init__(self, attempt: Callable[[Case], Result], seed: int = 0) -> None:
        self._attempt, self._rng = attempt, np.random.default_rng(seed)
        self.ran: set[frozenset[str]] = set()
        self.refused: dict[frozenset[str], str] = {}
        self.results: list[Result] = []
        pairs = [frozenset(pair) for pair in itertools.combinations(KEYS, 2)]
        self.left = [pairs[i] for i in self._rng.permutation(len(pairs))]

    def run(self) -> None:
        """Until no pair is left."""
        while self.left:
            self._begin(self.left.pop())
            self.left = [pair for pair in self.left if pair not in self.ran]

    def _begin(self, pair: frozenset[str]) -> None:
        """Jobs with this pair, in one way or another, until one runs; else it is refused."""
        one, other = sorted(pair)
        why = ""
        for settings in itertools.product(KEYS[one], KEYS[other]):
            row = dict(zip((one, other), settings, strict=True))
            why = refusal(row) or self._shrink(row, self._more(row))
            if not why:
                return
        self.refused[pair] = why

    def _more(self, row: Row) -> Row:
        """Further keys that the config takes, by how many new pairs they bring."""
        wanted = {frozenset(pair) for pair in self.left}
        more: Row = {}
        order = [list(KEYS)[i] for i in self._rng.permutation(len(KEYS))]
        order.sort(key=lambda key: -sum(key in pair for pair in wanted))
        for key in order:
            taken = {**row, **more}
            mates = [frozenset({key, each}) for each in taken]
            if key in taken or not wanted.intersection(mates) or any(pair in self.refused for pair in mates):
                continue
            setting = pick(self._rng, tuple(KEYS[key]))
            if not _overrules(taken, setting) and not refusal({**taken, key: setting}):
                more[key] = setting
        return more

    def _shrink(self, row: Row, more: Row) -> str:
        """Run the row with more keys, or with half of them, and so on; why the row alone is refused, or ""."""
        while True:
            result = self._attempt(case_of({**row, **more}, len(self.results)))
            self.results.append(result)
            if result.verdict.outcome != "refused":
                self.ran |= {frozenset(pair) for pair in itertools.combinations({**row, **more}, 2)}
                return ""
            if not more:
                return result.ended.stderr.strip()
            kept = [key for key in more if self._rng.random() < 0.5]
            more = {key: more[key] for key in kept}


def _overrules(row: Row, setting: Mapping[str, Any]) -> bool:
    """Whether a setting takes back what another key of the row has set."""
    before = {path: value for each in row.values() for path, value in each.items()}
    return any(
        (path in before and before[path] != value)
        or any(old.startswith(f"{path}.") or path.startswith(f"{old}.") for old in before)
        for path, value in setting.items()
    )
