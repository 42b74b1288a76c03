"""Names for tables whose values are known only when they are read."""

from __future__ import annotations

from typing import Any

Json = dict[str, Any]
"""A table of a JSON, TOML or YAML file, or of a schema."""

SceneDict = dict[str, Any]
"""A scene or a plugin, as `mi.load_dict` takes it."""
