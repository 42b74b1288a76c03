"""What is wrong with a job, as one line: pydantic's errors, as somebody would say them who knows the file."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from numbers import Real

from pydantic import BaseModel, ValidationError

from pathreplay.errors import shown

# What to write instead, by pydantic's type of error; the other messages say it themselves.
_INSTEAD = {
    "int_type": "write a whole number such as 16",
    "float_type": "write a number such as 0.5",
    "bool_type": "write true or false",
    "string_type": 'write it in quotes: "..."',
    "list_type": "write a list: [...]",
    "dict_type": "write a table: { ... }",
    "model_type": "write a table: { ... }",
    "table_type": "write a table: { ... }",
    "finite_number": "write a finite number",
    "json_invalid": "mend it there",
}
# The last key of a value that may be of several kinds -> what all of them are.
_KINDS = {
    "initial": "a number, a list of numbers, the name of an image or volume file, or { image = ... }",
    "values": "a number, a list of numbers, the name of an image or volume file, or { image = ... }",
    "scene_parameters": "a number, true, false or a text in quotes",
    "sensors": "the names or numbers of sensors: [0, ...]",
    "test_views": "the names or numbers of sensors: [0, ...]",
    "reference": "the name or number of a sensor",
    "images": "file names, or a pattern such as 'photos/*.png'",
    "masks": "file names, or a pattern such as 'masks/*.png'",
}

# Keys of 0.1.0's first edition -> what they are called now, in one table or another.
RENAMED = {
    "rival": "baseline",
    "learning_rate_decay": "final_learning_rate_ratio",
    "warm_up": "warmup_steps",
    "smooth": "large_steps_lambda",
    "transform": "parameterization",
    "prior": "l2_to_initial",
    "penalty": "regularizer",
    "laplacian": "laplacian_weight",
    "start": "initial",
    "distance": "error_scale",
    "auto_spp": "adaptive_spp",
    "ratio": "target_snr",
    "lowest": "min",
    "highest": "max",
    "signal_to_noise": "measure_snr",
    "non_finite_in_a_row": "max_consecutive_nonfinite",
    "views_per_step": "view_batch_size",
    "pixels_per_step": "pixel_batch_size",
    "picture_spp": "eval_spp",
    "hold_out_every": "test_every",
    "held_out": "test_views",
    "sample_ranges": "spp_shards",
    "free": "fix_scale",
    "memory": "memory_limit history_size",
}


def first_error(error: ValidationError, job: type[BaseModel], tables: Mapping[str, type[BaseModel]]) -> str:
    """The first thing wrong, as one line: where it is, what it is, what would be right.

    ``tables`` are the models of the tables within a ``job``, by the key that leads to them.
    """
    details = error.errors()
    # A value that may be a number, list, name or table fails once per alternative: an unknown key says the most.
    first = next((e for e in details if e["type"] == "extra_forbidden"), details[0])
    where = ".".join(_path(first["loc"])) or "the job"
    if first["type"] == "extra_forbidden":
        key = str(first["loc"][-1])
        table = next((tables[str(part)] for part in reversed(first["loc"][:-1]) if part in tables), job)
        if (new := _renamed(key, table)) is not None:
            return f"unknown key '{where}'; it is called '{new}' now"
        close = difflib.get_close_matches(key, table.model_fields, n=1, cutoff=0.4)
        hint = f"did you mean '{close[0]}'?" if close else f"known keys: {', '.join(table.model_fields)}"
        return f"unknown key '{where}'; {hint}"
    if first["type"] == "missing":
        return f"key '{where}' is missing; add it"
    if first["type"] == "value_error":
        reason = str(first["ctx"]["error"])
        # Ours name the table that they are about; a number's does not.
        return f"'{where}': {reason}" if isinstance(first["input"], Real) else reason
    # The value as it was written: alternatives are judged by their parts.
    kinds = next((kinds for key, kinds in _KINDS.items() if key in _path(first["loc"])), None)
    if kinds is not None and len(details) > 1:
        return f"'{where}' is {shown(first['input'])}; write {kinds}"
    instead = _INSTEAD.get(first["type"])
    return f"'{where}' is {shown(first['input'])}: {first['msg'].lower()}" + (f"; {instead}" if instead else "")


def _renamed(key: str, table: type[BaseModel]) -> str | None:
    """What a key of a table was renamed to."""
    return next((name for name in RENAMED.get(key, "").split() if name in table.model_fields), None)


_ALTERNATIVES = ("int", "float", "bool", "str", "count", "Picture", "Value", "Displacement")


def _path(loc: tuple[int | str, ...]) -> list[str]:
    """Where an error is, as a user would say it: without the names of the alternatives that were tried."""
    tried = ("list[", "function-", "constrained-", "nullable[")
    return [str(p) for p in loc if p not in _ALTERNATIVES and not str(p).startswith(tried)]
