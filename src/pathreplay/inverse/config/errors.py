"""Convert pydantic's validation errors of a job to one-line messages in terms of the job's file."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from numbers import Real

from pydantic import BaseModel, ValidationError

from pathreplay.errors import shown

# Remedies by pydantic's error type. Messages of other error types already contain the remedy.
_INSTEAD = {
    "int_type": "write an integer such as 16",
    "float_type": "write a number such as 0.5",
    "bool_type": "write true or false",
    "string_type": 'write it in quotes: "..."',
    "list_type": "write a list: [...]",
    "dict_type": "write a table: { ... }",
    "model_type": "write a table: { ... }",
    "table_type": "write a table: { ... }",
    "finite_number": "write a finite number",
    "json_invalid": "fix the syntax there",
}
# Limits of the lengths of lists by pydantic's error type: words for messages, and the name of the limit in the error.
_LIMITS = {"too_short": ("at least", "min_length"), "too_long": ("at most", "max_length")}
# Descriptions of the accepted types, for keys that accept several types.
_KINDS = {
    "initial": "a number, a list of numbers, the name of an image or volume file, or { image = ... }",
    "values": "a number, a list of numbers, the name of an image or volume file, or { image = ... }",
    "scene_parameters": "a number, true, false or a quoted string",
    "sensors": "the names or numbers of sensors: [0, ...]",
    "test_views": "the names or numbers of sensors: [0, ...]",
    "direction": "'normal' or three numbers, such as [0, 0, 1]",
    "reference": "the name or number of a sensor",
    "images": "file names, or a pattern such as 'photos/*.png'",
    "masks": "file names, or a pattern such as 'masks/*.png'",
}

# New names of renamed keys. An old key with several new names had a different meaning in each table.
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

# Names that the library or other programs use, and the names here. They are too different for a comparison of letters.
_SYNONYMS = {
    "bounds": "lower upper",
    "range": "lower upper",
    "lr": "learning_rate",
    "steps": "iterations",
    "epochs": "iterations",
    "views": "sensors",
    "max_depth": "integrator.max_depth",
    "resolution": "scene_parameters.resolution",
}
_WITH_OWN_KEYS = ("target", "parameters", "capture", "optimizer")
"""Tables whose keys are recognised at the top of a job."""


def first_error(
    error: ValidationError, job: type[BaseModel], tables: Mapping[str, type[BaseModel]], names: Mapping[str, str]
) -> str:
    """Describe one error of a job in a single line: location, value and remedy. An unknown key has precedence.

    Args:
        error: pydantic's error for a whole job.
        job: model of the job.
        tables: models of the tables that a job may contain, by key.
        names: other names of keys and of tables of the job.
    """
    details = error.errors()
    # A value of a union type yields one error per alternative. An unknown key is the most informative of these errors.
    first = next((e for e in details if e["type"] == "extra_forbidden"), details[0])
    owner, where = _named(".".join(_path(first["loc"])) or "the job", names)
    if first["type"] == "extra_forbidden":
        key = str(first["loc"][-1])  # which may be one of `_ALTERNATIVES`
        owner, where = _named(".".join([*_path(first["loc"][:-1]), key]), names)
        table = next((tables[str(part)] for part in reversed(first["loc"][:-1]) if part in tables), job)
        new = next((name for name in RENAMED.get(key, "").split() if name in table.model_fields), None)
        if new is not None:
            return f"{owner}unknown key '{where}'; it is called '{new}' now"
        return f"{owner}unknown key '{where}'; {_hint(key, table, job, tables)}"
    if first["type"] == "missing":
        return f"{owner}key '{where}' is missing; add it"
    if first["type"] == "value_error":
        reason = str(first["ctx"]["error"])
        # Messages about tables already name the table. Messages about numbers lack the key, which is added here.
        return f"{owner}'{where}': {reason}" if isinstance(first["input"], Real) else reason
    if first["type"] == "import_path":
        return f"{owner}'{where}': {first['msg']}"
    if first["type"] in _LIMITS:
        limit, name = _LIMITS[first["type"]]
        count = first["ctx"][name]
        entries = "entry" if count == 1 else "entries"
        return f"{owner}'{where}' is {shown(first['input'])}; give {limit} {count} {entries}"
    # If several alternatives failed, describe all types that the key accepts.
    kinds = next((kinds for key, kinds in _KINDS.items() if key in _path(first["loc"])), None)
    if kinds is not None and len(details) > 1:
        return f"{owner}'{where}' is {shown(first['input'])}; write {kinds}"
    instead = _INSTEAD.get(first["type"])
    return f"{owner}'{where}' is {shown(first['input'])}: {first['msg'].lower()}" + (f"; {instead}" if instead else "")


def _named(where: str, names: Mapping[str, str]) -> tuple[str, str]:
    """Return the name of the table that contains a key, with a colon, and the name of the key in this table.

    The name of the table is empty if ``names`` does not contain the table.
    """
    for table, name in names.items():
        if where.startswith(f"{table}."):
            return f"{name}: ", where[len(table) + 1 :]
    return "", names.get(where, where)


def _hint(key: str, table: type[BaseModel], job: type[BaseModel], tables: Mapping[str, type[BaseModel]]) -> str:
    """Name the key that was meant by an unknown key of ``table``, or list the known keys."""
    others = _SYNONYMS.get(key, "").split()
    if meant := [name for name in others if name.partition(".")[0] in table.model_fields]:
        return f"did you mean {' and '.join(repr(name) for name in meant)}?"
    if close := difflib.get_close_matches(key, table.model_fields, n=1, cutoff=0.75):
        return f"did you mean '{close[0]}'?"
    if of_job := next((name for name in [key, *others] if name in job.model_fields), None):
        return f"'{of_job}' is a key of the job, not of '{_name_of(table, tables)}'"
    owner = next((name for name in _WITH_OWN_KEYS if key in tables[name].model_fields), None)
    if owner is not None and table is job:
        return f"it is a key of '{owner}'"
    close = difflib.get_close_matches(key, table.model_fields, n=1, cutoff=0.4)
    return f"did you mean '{close[0]}'?" if close else f"known keys: {', '.join(table.model_fields)}"


def _name_of(table: type[BaseModel], tables: Mapping[str, type[BaseModel]]) -> str:
    """Return the name of a table in messages."""
    return next((name for name, each in tables.items() if each is table), "this table")


_ALTERNATIVES = ("int", "float", "bool", "str", "count", "ImageValue", "Value", "Displacement", "TransportStart")


def _path(loc: tuple[int | str, ...]) -> list[str]:
    """Return the location of an error as keys, without pydantic's names of union alternatives."""
    tried = ("list[", "function-", "constrained-", "nullable[", "literal[")
    return [str(p) for p in loc if p not in _ALTERNATIVES and not str(p).startswith(tried)]
