"""Type aliases for dictionaries whose values have types that are known only at run time."""

from __future__ import annotations

from typing import Any

Json = dict[str, Any]
"""A table of a JSON, TOML or YAML file, or of a schema."""

SceneDict = dict[str, Any]
"""The description of a scene or a plugin for `mi.load_dict`."""
