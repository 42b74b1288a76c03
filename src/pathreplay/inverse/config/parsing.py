"""The text of a job, TOML, JSON or YAML, as tables: what is none is told in one line."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any, ClassVar

import yaml

from pathreplay.errors import PathreplayError, shown

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

YAML = (".yaml", ".yml")
"""Endings of files that are YAML; `.json` is JSON, all others are TOML."""

_LONGEST, _LONGEST_YAML = 64 * 2**20, 2**18
"""Bytes: no job is as long, and what is larger is some other file. PyYAML takes seconds for as many."""

_DEEPEST = 64
"""Lists and tables of YAML inside each other: its reader needs several frames for each."""


def most_bytes(path: Path) -> int:
    """The size of a file, beyond which it is no job."""
    return _LONGEST_YAML if path.suffix.lower() in YAML else _LONGEST


def parsed(path: Path, text: str) -> Any:
    """What the text of the file says, by the ending of its name. Raises PathreplayError for what cannot be read."""
    kind, read = _FORMATS.get(path.suffix.lower(), ("TOML", tomllib.loads))
    try:
        return read(text)
    except RecursionError:
        raise PathreplayError(f"Config {path} is nested too deep; write the job as in docs/optimize.md") from None
    except (tomllib.TOMLDecodeError, json.JSONDecodeError, yaml.YAMLError) as error:
        why = _of_yaml(error) if isinstance(error, yaml.YAMLError) else error
        raise PathreplayError(f"Config {path} is not valid {kind}: {why}; mend it there") from None
    except ValueError:
        raise PathreplayError(f"Config {path} has a number of more digits than Python reads; shorten it") from None


def from_toml(text: str) -> dict[str, Any]:
    """The table that a text of TOML is. Raises ValueError or RecursionError."""
    return tomllib.loads(text)


class _Plain(yaml.SafeLoader):
    """YAML 1.2's core, as JSON would have it: `no` is a text, `1e-3` a number, `12:30` no number of seconds.

    A key that is given twice is an error, and so are tags, and anchors: a few lines of them can name a billion things.
    """

    yaml_implicit_resolvers: ClassVar[dict[str, Any]] = {}

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        event = self.peek_event()
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            raise yaml.MarkedYAMLError(None, None, "anchors and aliases are not read; write it out", event.start_mark)
        if getattr(event, "tag", None) is not None:
            raise yaml.MarkedYAMLError(None, None, f"the tag {shown(event.tag)} is not read", event.start_mark)
        if self._depth == _DEEPEST:
            raise RecursionError
        self._depth += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        keys: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode) or key.tag != "tag:yaml.org,2002:str":
                raise yaml.MarkedYAMLError(None, None, "a key is no text; put it in quotes", key.start_mark)
            if key.value in keys:
                said = f"the key {shown(key.value)} is given twice; leave one out"
                raise yaml.MarkedYAMLError(None, None, said, key.start_mark)
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
# PyYAML takes 010 for eight; to YAML 1.2 and to people it is ten, and 0o10 is eight.
_BASES = {"0o": 8, "0x": 16}
_Plain.add_constructor("tag:yaml.org,2002:int", lambda loader, node: int(node.value, _BASES.get(node.value[:2], 10)))


def _of_yaml(error: yaml.YAMLError) -> str:
    """The first thing wrong, and where, as the others say it."""
    mark = getattr(error, "problem_mark", None)
    where = "" if mark is None else f" (line {mark.line + 1}, column {mark.column + 1})"
    return f"{getattr(error, 'problem', None) or error}{where}"


def _yaml(text: str) -> Any:
    return yaml.load(text, _Plain)


_FORMATS: dict[str, tuple[str, Callable[[str], Any]]] = {
    ".json": ("JSON", json.loads),
    **dict.fromkeys(YAML, ("YAML", _yaml)),
}
