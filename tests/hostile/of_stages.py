"""Hostile stages, samples and searches; and jobs in YAML, which can say more than a job should hear."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import yaml

from .case import Action, add, recipe
from .room import JOB, Room
from .values import TEXTS, VALUES, pick, spoiled

KIND = "stages"
_PLAIN = {key: value for key, value in JOB.items() if key != "iterations"}
STAGED = {**_PLAIN, "stages": [{"iterations": 1, "downscale": 2, "spp": 2}, {"iterations": 1, "max_depth": 2}]}
AUTO = {**JOB, "spp": "auto", "adaptive_spp": {"target_snr": 1.0, "min": 2, "max": 4}}
SEARCHED = {**JOB, "optimizer": {"type": "l-bfgs-b", "history_size": 3, "tolerance": 1e-6}}

# Without iterations: as many as are asked for are taken.
KEYS: dict[str, Mapping[str, Any]] = {
    **dict.fromkeys(
        (
            "stages stages.0 stages.0.downscale stages.0.spp stages.0.max_depth stages.0.sensors stages.0.parameters "
            "stages.0.view_batch_size stages.0.pixel_batch_size stages.0.learning_rate_factor stages.1.unknown"
        ).split(),
        STAGED,
    ),
    **dict.fromkeys("measure_snr max_consecutive_nonfinite".split(), JOB),
    **dict.fromkeys("adaptive_spp adaptive_spp.target_snr adaptive_spp.min adaptive_spp.max".split(), AUTO),
    **dict.fromkeys("optimizer.history_size optimizer.tolerance".split(), SEARCHED),
}


@recipe(KIND, fuzz=True)
def a_hostile_value_in_a_stage(room: Room, rng: np.random.Generator) -> None:
    key = pick(rng, tuple(KEYS))
    room.change(key, pick(rng, (*VALUES, *TEXTS)), KEYS[key])


def _refused(key: str, value: Any, job: Mapping[str, Any]) -> None:
    add(KIND, f"{key} = {value!r}", lambda room, rng: room.change(key, value, job), refused=True)


_refused("stages.0.downscale", 5, STAGED)
_refused("stages.0.downscale", 10**9, STAGED)
_refused("stages.0.spp", 10**9, STAGED)
_refused("stages.0.sensors", ["nobody"], STAGED)
_refused("stages.0.sensors", [10**30], STAGED)
_refused("stages.0.parameters", ["[" * 1000], STAGED)
_refused("stages.0.max_depth", 10**10, STAGED)
_refused("stages", [], STAGED)
_refused("stages", {"iterations": 1}, STAGED)
_refused("iterations", 3, STAGED)
_refused("spp", "Auto", AUTO)
_refused("adaptive_spp.max", 2**30, AUTO)
_refused("adaptive_spp.min", 0, AUTO)
_refused("stages", [{"iterations": 1}], SEARCHED)
_refused("optimizer.history_size", 0, SEARCHED)


# ------------------------------------------------------------------------------
#  YAML
# ------------------------------------------------------------------------------


def _yaml(room: Room, data: bytes) -> Action:
    room.write("job.yaml", data)
    return Action(argv=("optimize", "job.yaml", "--quiet"))


@recipe(KIND, fuzz=True)
def spoiled_yaml(room: Room, rng: np.random.Generator) -> Action:
    return _yaml(room, spoiled(yaml.safe_dump(dict(pick(rng, (JOB, STAGED, AUTO)))).encode(), rng))


_LAUGH = "\n".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9) if k else 'lol'}]" for k in range(12))
YAMLS: dict[str, str] = {
    "a billion laughs": _LAUGH,
    "an anchor": "spp: &a 2",
    "a loop": "a: &a [*a]",
    "an object": "spp: !!python/object/apply:os.system ['touch ../outside/precious']",
    "a module": "spp: !!python/module:os",
    "two documents": "--- {}\n--- {}\n",
    "a list": "- a\n",
    "a key that is a list": "? [a]\n: 3\n",
    "3000 deep": "spp: " + "[" * 3000 + "]" * 3000,
    "3000 deep, by lines": "\n".join(" " * k + "a:" for k in range(3000)),
    "10000 digits": "spp: " + "9" * 10_000,
    "a tab": "a:\n\t- b\n",
    "NUL": "spp: \0",
    "a word": "spp: yes",
    "a time": "spp: 12:30:00",
    "a date": "seed: 2001-01-01",
    "nothing": "",
    "no scene": "spp: 2",
}
for _name, _text in YAMLS.items():
    add(KIND, f"YAML: {_name}", lambda room, rng, text=_text: _yaml(room, text.encode()), refused=True)  # type: ignore[misc]
