"""Parse a job from TOML, JSON or YAML into dictionaries. Syntax errors become one-line messages."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Hashable
from functools import partial
from pathlib import Path
from typing import ClassVar

import yaml

from pathreplay.errors import PathreplayError, shown
from pathreplay.types import Json

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

YAML = (".yaml", ".yml")
"""Suffixes of YAML files. The suffix `.json` selects JSON, and any other suffix TOML."""

_LONGEST, _LONGEST_YAML = 64 * 2**20, 2**18
"""Maximum size in bytes of a TOML or JSON file, and of a YAML file. PyYAML takes seconds for 2**18 bytes."""

_DEEPEST = 64
"""Maximum nesting depth of YAML. PyYAML uses several stack frames per level."""


def most_bytes(path: Path) -> int:
    """Return the largest size in bytes that a job in this file may have."""
    return _LONGEST_YAML if path.suffix.lower() in YAML else _LONGEST


def parsed(path: Path, text: str) -> object:
    """Parse the text of a file in the format of its suffix. Raises PathreplayError for syntax errors."""
    kind, read = _FORMATS.get(path.suffix.lower(), ("TOML", tomllib.loads))
    try:
        return read(text)
    except RecursionError:
        raise PathreplayError(f"Config {path} is nested too deeply; write the job as in docs/optimize.md") from None
    except (tomllib.TOMLDecodeError, json.JSONDecodeError, yaml.YAMLError) as error:
        why = _of_yaml(error) if isinstance(error, yaml.YAMLError) else error
        raise PathreplayError(f"Config {path} is not valid {kind}: {why}; fix the syntax there") from None
    except ValueError:
        raise PathreplayError(f"Config {path} has a number with more digits than Python reads; shorten it") from None


def from_toml(text: str) -> Json:
    """Parse TOML. Raises ValueError or RecursionError."""
    return tomllib.loads(text)


class _Plain(yaml.SafeLoader):
    """Loader of the YAML 1.2 core schema: `no` is a string, `1e-3` a number, and `12:30` a string.

    Duplicate keys, tags and anchors are errors. Anchors could expand a few lines to billions of nodes.
    """

    yaml_implicit_resolvers: ClassVar[dict[str, list[object]]] = {}

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        event = self.peek_event()
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            raise yaml.MarkedYAMLError(
                None, None, "anchors and aliases are not supported; write the value out", event.start_mark
            )
        if getattr(event, "tag", None) is not None:
            raise yaml.MarkedYAMLError(None, None, f"the tag {shown(event.tag)} is not supported", event.start_mark)
        if self._depth == _DEEPEST:
            raise RecursionError
        self._depth += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, object]:
        keys: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode) or key.tag != "tag:yaml.org,2002:str":
                raise yaml.MarkedYAMLError(None, None, "a key is not a string; put it in quotes", key.start_mark)
            if key.value in keys:
                problem = f"the key {shown(key.value)} is given twice; remove one"
                raise yaml.MarkedYAMLError(None, None, problem, key.start_mark)
            keys.add(key.value)
        return super().construct_mapping(node, deep)


for _tag, _pattern, _first in (
    ("bool", r"(?:true|True|TRUE|false|False|FALSE)$", "tTfF"),
    ("int", r"(?:[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+)$", "-+0123456789"),
    ("float", r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?$", "-+.0123456789"),
    ("float", r"(?:[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$", "-+."),
    ("null", r"(?:~|null|Null|NULL|)$", ["~", "n", "N", ""]),
):
    _Plain.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(_pattern), list(_first))
# PyYAML reads 010 as octal 8; in YAML 1.2 it is decimal 10, and 0o10 is octal 8.
_BASES = {"0o": 8, "0x": 16}
_Plain.add_constructor("tag:yaml.org,2002:int", lambda loader, node: int(node.value, _BASES.get(node.value[:2], 10)))


def _of_yaml(error: yaml.YAMLError) -> str:
    """Format the error and its position as the TOML and JSON parsers do."""
    mark = getattr(error, "problem_mark", None)
    where = "" if mark is None else f" (line {mark.line + 1}, column {mark.column + 1})"
    return f"{getattr(error, 'problem', None) or error}{where}"


_FORMATS: dict[str, tuple[str, Callable[[str], object]]] = {
    ".json": ("JSON", json.loads),
    **dict.fromkeys(YAML, ("YAML", partial(yaml.load, Loader=_Plain))),
}
