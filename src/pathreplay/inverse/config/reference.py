"""Reference of all keys of a job as Markdown, generated from the schema."""

from __future__ import annotations

import json
from collections.abc import Iterator

from pathreplay.inverse.config.schema import Config
from pathreplay.types import Json

HEAD = """# Keys of a job

This page lists all keys of a job file. It is the output of `pathreplay schema --markdown`.
[Jobs](optimize.md) explains how the keys work together.
"""
_TITLES = {
    "Parameter": "[[parameters]]",
    "Displacement": "initial = { ... } for a pose",
    "TransportStart": "initial = { transport = ... }",
    "ImageValue": "{ image = ... }",
    "Derivation": "[[derived]]",
    "Displace": "displace = { ... }",
    "Target": "[target]",
    "Capture": "[capture]",
    "Exposure": "[exposure]",
    "Response": "[response]",
    "Optimizer": "[optimizer]",
    "Plugin": "[integrator], [baseline], [target] integrator",
    "Stage": "[[stages]]",
    "AdaptiveSpp": "[adaptive_spp]",
    "Preview": "[preview]",
    "RayOptions": "[ray]",
}
_NAMES = {
    "integer": "integer",
    "number": "number",
    "string": "string",
    "boolean": "true or false",
    "object": "table",
}


def reference() -> str:
    """Return the reference as a Markdown page."""
    schema = Config.model_json_schema()
    tables = [_table("The job", schema)]
    tables += [_table(f"`{title}`", schema["$defs"][name]) for name, title in _TITLES.items()]
    return "\n".join([HEAD, *tables])


def _table(title: str, of: Json) -> str:
    needed = of.get("required", [])
    lines = [f"## {title}", "", "| key | type | default | meaning |", "| --- | --- | --- | --- |"]
    for key, about in of["properties"].items():
        default = "required" if key in needed else _default(about)
        meaning = about["description"].replace("|", "\\|").replace("\n", " ")
        lines.append(f"| `{key}` | {_kind(about)} | {default} | {meaning} |")
    return "\n".join([*lines, ""])


def _default(about: Json) -> str:
    value = about.get("default")
    return "" if value is None or isinstance(value, (dict, list)) else f"`{json.dumps(value)}`"


def _kind(about: Json) -> str:
    """Describe the types of a key's values. The description does not contain the range of the values."""
    return " or ".join(dict.fromkeys(_kinds(about)))


def _kinds(about: Json) -> Iterator[str]:
    for one in about.get("anyOf") or about.get("oneOf") or []:
        yield from _kinds(one)
    if "$ref" in about:
        name = about["$ref"].rpartition("/")[2]
        yield "table" if name in _TITLES else name
    elif "enum" in about or "const" in about:
        values = about.get("enum", [about.get("const")])
        yield ", ".join(f"`{json.dumps(value)}`" for value in values)
    elif about.get("type") == "array":
        yield f"list of {_kind(about.get('items', {})) or 'values'}"
    elif about.get("type", "null") != "null":
        yield _NAMES[about["type"]]
