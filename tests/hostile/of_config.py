"""Hostile configs: TOML that is none, values of wrong types and sizes, and numbers that overflow on the way."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from .case import Action, add, recipe
from .room import DERIVED, JOB, ODD_FILES, POSED, RENDERED, Room
from .toml_text import Raw, toml
from .values import ESCAPE, TEXTS, VALUES, pick, spoiled

KIND = "config"

# A job in stages.
STAGED: dict[str, Any] = {key: value for key, value in RENDERED.items() if key != "iterations"} | {
    "stages": [{"iterations": 1, "downscale": 2}, {"iterations": 1, "spp": 4}]
}

# Every key of a job, with a job that has the key's table.
KEYS: dict[str, Mapping[str, Any]] = {
    **dict.fromkeys(
        (
            "scene scene_parameters sensors variant integrator integrator.type integrator.max_depth "
            "integrator.rr_depth integrator.hide_emitters integrator.adjoint integrator.jacobian_noise "
            "integrator.sampling integrator.caustics baseline "
            "parameters parameters.0 parameters.0.key parameters.0.lower parameters.0.upper parameters.0.learning_rate "
            "parameters.0.initial parameters.0.initial.image parameters.0.resolutions parameters.0.refine_at "
            "parameters.0.pose target target.images loss spp eval_spp seed learning_rate final_learning_rate_ratio "
            "view_batch_size pixel_batch_size test_views capture capture.transforms capture.colmap exposure "
            "exposure.reference exposure.white_balance exposure.fix_scale view_weights view_weights.eye target.masks "
            "target.alpha learning_rate_schedule warmup_steps "
            " optimizer optimizer.type optimizer.beta_1 optimizer.epsilon "
            "parameters.0.parameterization parameters.0.total_variation parameters.0.l2_to_initial "
            "checkpoint_every unknown "
            "adaptive_spp adaptive_spp.target_snr adaptive_spp.min adaptive_spp.max measure_snr "
            "max_consecutive_nonfinite "
            "preview preview.share preview.views preview.frames parameters.0.laplacian_weight parameters.0.regularizer"
        ).split(),
        JOB,
    ),
    **dict.fromkeys(
        (
            "target.scene target.scene_parameters target.values target.integrator target.integrator.type "
            "target.integrator.max_depth target.spp"
        ).split(),
        RENDERED,
    ),
    **dict.fromkeys(
        (
            "parameters.0.initial parameters.0.initial.translation parameters.0.initial.rotation parameters.0.pivot "
            "parameters.0.error_scale parameters.0.rotation_learning_rate parameters.0.learning_rate"
        ).split(),
        POSED,
    ),
    **dict.fromkeys(
        (
            "derived derived.0 derived.0.key derived.0.function derived.0.of derived.0.of.0 parameters.0.shape "
            "parameters.0.key"
        ).split(),
        DERIVED,
    ),
    **dict.fromkeys(
        (
            "stages stages.0 stages.0.iterations stages.0.downscale stages.0.spp stages.0.max_depth stages.0.sensors "
            "stages.0.view_batch_size stages.0.pixel_batch_size stages.0.parameters stages.0.learning_rate_factor "
            "iterations warmup_steps"
        ).split(),
        STAGED,
    ),
}


@recipe(KIND, fuzz=True)
def a_hostile_value_somewhere(room: Room, rng: np.random.Generator) -> None:
    key = pick(rng, tuple(KEYS))
    room.change(key, pick(rng, VALUES), KEYS[key])


@recipe(KIND, fuzz=True)
def a_hostile_text_somewhere(room: Room, rng: np.random.Generator) -> None:
    key = pick(rng, tuple(KEYS))
    room.change(key, pick(rng, TEXTS), KEYS[key])


@recipe(KIND, fuzz=True)
def spoiled_bytes(room: Room, rng: np.random.Generator) -> None:
    # Few and small numbers, so that what is still a job is a short one.
    room.write("job.toml", spoiled(toml(pick(rng, (JOB, RENDERED, POSED))).encode(), rng))


def _valued(key: str, value: Any, *, job: Mapping[str, Any] = JOB, refused: bool = True) -> None:
    told = repr(value) if len(repr(value)) < 40 else f"{repr(value)[:40]}…"
    add(KIND, f"{key} = {told}", lambda room, rng: room.change(key, value, job), refused=refused)


_valued("spp", True)
_valued("spp", 10**9)
_valued("spp", 2**31)
_valued("eval_spp", 10**9)
_valued("target.spp", 10**9, job=RENDERED)
_valued("spp", Raw("9" * 10_000))
_valued("scene_parameters", {"res": 10**9})
_valued("scene_parameters", {"res": 10**30})
_valued("scene_parameters", {"res": 200_000})
_valued("scene_parameters", {"res": -1})
_valued("scene_parameters", {"base": "elsewhere"})
_valued("scene_parameters", {"path": "elsewhere"})
_valued("scene_parameters", {"spec": "elsewhere"})
_valued("scene_parameters", {"plugins": {}})
_valued("scene_parameters", {"res": {"a": 1}})
_valued("scene_parameters", {"re s\n": 1})
_valued("target.scene_parameters", {"base": "elsewhere"}, job=RENDERED)
_valued("parameters.0.resolutions", [100_000], job=RENDERED)
_valued("parameters.0.resolutions", [10**30], job=RENDERED)
_valued("parameters.0.initial", 1e300)
_valued("parameters.0.initial", 1e39)
_valued("parameters.0", {"key": "paint.reflectance.data", "initial": 1e300})
_valued("parameters.0", {"key": "paint.reflectance.data", "lower": 1e300})
_valued("learning_rate", 1e30, job={**RENDERED, "parameters": [{"key": "paint.reflectance.data"}]})
_valued("parameters.0.initial", ["a"])
_valued("target.integrator.type", "diffuse", job=RENDERED)
_valued("target.integrator.type", "scene", job=RENDERED)
_valued("integrator.type", "hdrfilm")
_valued("integrator", {"type": "path"})
_valued("baseline", {"type": "sphere"})
_valued("integrator.max_depth", Raw("nan"))
_valued("integrator.max_depth", 10**12)
_valued("integrator.max_depth", "6")
_valued("integrator.max_depth", 1.5)
_valued("integrator.type", "prb.dll/../..")
_valued("parameters.0.pivot", [1e38, 1e38, 1e38], job=POSED)
_valued("parameters.0.initial.translation", [1e38, 0, 0], job=POSED)
_valued("parameters.0.initial.rotation", [1e38, 0, 0], job=POSED, refused=False)
_valued("target.values", {"paint.reflectance.data": 1e300}, job=RENDERED)
_valued("target.values", {"*": 0.5}, job=RENDERED, refused=False)
_valued("target.values", {"eye.to_world": 0.5}, job=RENDERED)
_valued("target.values", {"paint.reflectance.data": {"image": "texture.png", "fit": "stretch", "raw": "perhaps"}})
_valued("sensors", [0, 0, 0], refused=False)
_valued("sensors", [10**30])
_valued("sensors", [True])
_valued("variant", "scalar_rgb")
_valued("variant", "llvm_ad_rgb_polarized")
_valued("variant", "cuda_ad_rgb", refused=False)
_valued("output", "runs/\x00")
_valued("output", "n" * 300)
_valued("stages", [], job=STAGED)
_valued("stages", {"iterations": 2}, job=STAGED)
_valued("stages.0", {}, job=STAGED)
_valued("stages.0.iterations", 0, job=STAGED)
_valued("stages.0.downscale", 5, job=STAGED)
_valued("stages.0.downscale", 65536, job=STAGED)
_valued("stages.0.downscale", 2**40, job=STAGED)
_valued("stages.0.spp", 10**9, job=STAGED)
_valued("stages.0.max_depth", 10**12, job=STAGED)
_valued("stages.0.sensors", ["nobody"], job=STAGED)
_valued("stages.0.sensors", [10**30], job=STAGED)
_valued("stages.0.parameters", ["nothing.*"], job=STAGED)
_valued("stages.0.parameters", ["*a" * 40 + "b"], job=STAGED)
_valued("stages.0.learning_rate_factor", 1e30, job=STAGED, refused=False)
_valued("stages.1.learning_rate_factor", -1, job=STAGED)
_valued("stages", [{"iterations": 1, "unknown": ESCAPE}], job=STAGED)
_valued("iterations", 5, job=STAGED)
_valued("measure_snr", True, job={**JOB, "spp": 3})
_valued("adaptive_spp", {"min": 3}, job={**JOB, "spp": "auto"})
_valued("adaptive_spp", {"min": 64, "max": 8}, job={**JOB, "spp": "auto"})
_valued("adaptive_spp", {"max": 2**30}, job={**JOB, "spp": "auto"})
_valued("adaptive_spp", {"target_snr": 1e38, "max": 8}, job={**JOB, "spp": "auto"}, refused=False)
_valued("spp", "automatic")
_valued("preview", {"share": 1.0})
_valued("preview", {"views": 10**6})
_valued("preview", {"share": 0.5, "frames": 1000, "views": 64}, refused=False)
_valued("max_consecutive_nonfinite", 0)
_valued("iterations", 0)
_valued("iterations", Raw("1979-05-27T07:32:00Z"))


# ------------------------------------------------------------------------------
#  What is no TOML, or no reasonable one
# ------------------------------------------------------------------------------

TEXT_FILES: dict[str, bytes] = {
    "empty": b"",
    "only a comment": b"# nothing\n",
    "UTF-16": toml(JOB).encode("utf-16"),
    "Latin-1": 'scene = "Küche.xml"\n'.encode("latin-1"),
    "NUL": b"scene = \x00\n",
    "lists 3000 deep": b"scene = " + b"[" * 3000 + b"]" * 3000,
    "tables 3000 deep": b"scene = " + b"{a=" * 3000 + b"1" + b"}" * 3000,
    "dotted key 3000 deep": b".".join([b"a"] * 3000) + b" = 1",
    "header 3000 deep": b"[" + b".".join([b"a"] * 3000) + b"]",
    "10000 digits": b"spp = " + b"9" * 10_000,
    "the same key twice": b"spp = 1\nspp = 2\n",
    "key of 100 kB": b"k" * 100_000 + b" = 1",
    "quoted key of control characters": b'"\\u001b[2J\\u0000" = 1',
    "line of 100 kB that is no TOML": b"= " * 50_000,
    "a table that is a value": b"spp = 1\n[spp]\na = 1\n",
    "control characters": b'scene = "\x1b[2J"\n',
    "a JSON file": json.dumps(JOB).encode(),
    "XML": b"<scene version='3.0.0'/>",
}
for _name, _data in TEXT_FILES.items():
    add(KIND, _name, lambda room, rng, data=_data: room.write("job.toml", data), refused=True)  # type: ignore[misc]

for _odd in ODD_FILES:
    add(KIND, f"the config is {_odd}", lambda room, rng, odd=_odd: room.odd_file("job.toml", odd), refused=True)  # type: ignore[misc]

JSON_FILES: dict[str, bytes] = {
    "empty": b"",
    "a list": b"[]",
    "deep": b"[" * 100_000,
    "NaN": json.dumps({**JOB, "learning_rate": float("nan")}).encode(),
    "large numbers": json.dumps({**JOB, "spp": 10**400}).encode(),
    "control characters": json.dumps({**JOB, "loss": ESCAPE}).encode(),
}
for _name, _data in JSON_FILES.items():

    def _json(room: Room, rng: np.random.Generator, data: bytes = _data) -> Action:
        room.write("job.json", data)
        return Action(argv=("optimize", "job.json", "--quiet"))

    add(KIND, f"JSON: {_name}", _json, refused=True)


@recipe(KIND, refused=True)
def eighty_megabytes_of_nothing(room: Room, rng: np.random.Generator) -> None:
    room.write("job.toml", b"\n" * (80 * 2**20))


@recipe(KIND)
def a_byte_order_mark(room: Room, rng: np.random.Generator) -> None:
    room.write("job.toml", b"\xef\xbb\xbf" + toml(JOB).encode())


@recipe(KIND, refused=True)
def five_thousand_parameters_of_no_name(room: Room, rng: np.random.Generator) -> None:
    room.change("parameters", [{"key": f"nothing.{i}"} for i in range(5000)])


@recipe(KIND, refused=True)
def the_same_parameter_by_many_globs(room: Room, rng: np.random.Generator) -> None:
    room.change("parameters", [{"key": "*" * (i + 1) + "data"} for i in range(300)])


@recipe(KIND)
def a_glob_that_takes_long(room: Room, rng: np.random.Generator) -> None:
    room.change("parameters.0.key", "*a" * 40 + "b")
