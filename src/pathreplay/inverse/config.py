"""The optimisation job as the user writes it: a TOML file, checked key by key before anything is rendered."""

from __future__ import annotations

import difflib
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from pathreplay.errors import PathreplayError
from pathreplay.inverse.pose import PARTS, PoseKind

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Count = Annotated[int, Field(ge=1)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Picture(_Table):
    """An image as the value of a texture: file, how it meets the texture's shape, and its colour space."""

    image: str
    fit: Literal["stretch", "crop"] = "stretch"
    raw: bool = False


Value = Finite | list[Finite] | str | Picture
"""A parameter's value: one number for every entry, a list such as a colour, or an image file for a texture."""


Vector = Annotated[list[Finite], Field(min_length=3, max_length=3)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class Displacement(_Table):
    """Where a pose starts, from where the scene has it: scene units, and a rotation vector in degrees."""

    translation: Vector | None = None
    rotation: Vector | None = None


class Parameter(_Table):
    """One scene parameter to recover, or several by a glob."""

    key: str
    lower: Finite | None = None
    upper: Finite | None = None
    learning_rate: Positive | None = None
    initial: Value | None = None
    resolutions: Annotated[list[Count], Field(min_length=1)] | None = None
    refine_at: list[Count] | None = None
    pose: PoseKind | None = None
    start: Displacement | None = None
    pivot: Vector | None = None
    distance: Positive | None = None
    rotation_learning_rate: Positive | None = None

    @model_validator(mode="after")
    def _of_one_kind(self) -> Parameter:
        posed = {"start", "pivot", "distance", "rotation_learning_rate"} & self.model_fields_set
        if self.pose is None:
            if posed:
                raise ValueError(
                    f"parameter '{self.key}': '{min(posed)}' belongs to a pose; "
                    "add pose = 'translation', 'rotation' or 'rigid'"
                )
            return self
        if plain := {"lower", "upper", "initial", "resolutions", "refine_at"} & self.model_fields_set:
            raise ValueError(
                f"parameter '{self.key}': '{min(plain)}' does not go with a pose; displace its start with 'start'"
            )
        parts = PARTS[self.pose]
        given = [] if self.start is None else sorted(self.start.model_fields_set)
        wrong = [f"start.{part}" for part in given if part not in parts]
        if self.rotation_learning_rate is not None and "rotation" not in parts:
            wrong.append("rotation_learning_rate")
        if wrong:
            raise ValueError(
                f"parameter '{self.key}': '{wrong[0]}' is not part of pose = '{self.pose}'; take pose = 'rigid', or "
                "leave it out"
            )
        return self

    @model_validator(mode="after")
    def _coarse_to_fine(self) -> Parameter:
        sizes, begins = self.resolutions or [], self.refine_at or []
        if len(begins) != max(0, len(sizes) - 1):
            raise ValueError(
                f"parameter '{self.key}': {len(sizes)} resolutions and {len(begins)} entries in refine_at; give the "
                "iteration at which each resolution after the first begins"
            )
        if sorted(set(begins)) != begins:
            raise ValueError(f"parameter '{self.key}': refine_at {begins} does not increase; put it in order")
        return self

    @model_validator(mode="after")
    def _ordered(self) -> Parameter:
        if self.lower is not None and self.upper is not None and self.upper <= self.lower:
            raise ValueError(
                f"parameter '{self.key}': upper bound {self.upper:g} is not above lower bound {self.lower:g}; "
                "swap or widen them"
            )
        return self


class Plugin(BaseModel):
    """A Mitsuba plugin by ``type`` with its own options, which Mitsuba checks."""

    model_config = ConfigDict(extra="allow", frozen=True)

    type: str

    def as_dict(self) -> dict[str, Any]:
        return self.model_dump()


class Target(_Table):
    """What the pictures should look like: image files, one per sensor, or a scene to render."""

    images: list[str] | None = None
    scene: str | None = None
    scene_parameters: dict[str, Any] | None = None
    values: dict[str, Value] = Field(default_factory=dict)
    integrator: Plugin = Plugin(type="path", max_depth=6)  # type: ignore[call-arg]
    spp: Count = 512

    @model_validator(mode="after")
    def _one_source(self) -> Target:
        if self.images is not None:
            extra = sorted(self.model_fields_set - {"images"})
            if extra:
                raise ValueError(f"target: 'images' excludes '{extra[0]}'; give image files or a scene to render")
            if not self.images:
                raise ValueError("target: 'images' is empty; name one image file per sensor")
        elif not self.values and self.scene is None:
            raise ValueError("target: nothing to match; give 'images', or 'values' and/or 'scene' to render")
        if self.integrator.type == "pathreplay":
            raise ValueError(
                "target: integrator 'pathreplay' would grade itself; render targets with another, such as 'path'"
            )
        return self


class Config(_Table):
    """One optimisation job. Every key is explained in docs/optimize.md."""

    scene: str
    scene_parameters: dict[str, Any] = Field(default_factory=dict)
    sensors: list[int | str] | None = None
    variant: str | None = None
    integrator: Plugin = Plugin(type="pathreplay")
    rival: Plugin | None = None
    parameters: Annotated[list[Parameter], Field(min_length=1)]
    target: Target
    loss: str = "l2"
    iterations: Count = 200
    spp: Count = 16
    picture_spp: Count = 128
    seed: Annotated[int, Field(ge=0)] = 0
    learning_rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 0.02
    learning_rate_decay: Annotated[float, Field(gt=0, le=1)] = 0.1
    checkpoint_every: Count = 25
    deterministic: bool = False
    output: str | None = None

    @model_validator(mode="after")
    def _refined_in_time(self) -> Config:
        for entry in self.parameters:
            if entry.refine_at and entry.refine_at[-1] >= self.iterations:
                raise ValueError(
                    f"parameter '{entry.key}': refine_at {entry.refine_at[-1]} is not before the end of the "
                    f"{self.iterations} iterations; refine earlier, or raise 'iterations'"
                )
        return self


def load_config(path: Path) -> Config:
    """Read a job from a TOML file (or from the JSON that a run folder may hold).

    Raises:
        PathreplayError: missing or unreadable file, unknown key (names the nearest), value out of its range.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise PathreplayError(_no_file(path)) from None
    except (OSError, UnicodeDecodeError) as error:
        raise PathreplayError(f"Config {path} cannot be read: {error}") from None
    try:
        if path.suffix == ".json":
            return Config.model_validate_json(text)
        return Config.model_validate(tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        raise PathreplayError(f"Config {path} is not valid TOML: {error}") from None
    except ValidationError as error:
        raise PathreplayError(f"{path}: {_first(error)}") from None


def make_config(values: dict[str, Any]) -> Config:
    """A job from a dictionary, with the same checks and messages as a file."""
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        raise PathreplayError(f"config: {_first(error)}") from None


def _no_file(path: Path) -> str:
    near = [str(p) for p in path.parent.glob("*.toml")] if path.parent.is_dir() else []
    close = difflib.get_close_matches(str(path), near, n=1, cutoff=0.3)
    return f"No config file {path}" + (f"; did you mean {close[0]}?" if close else "; give the path of a TOML file")


# Model of each nested table, by the name under which it appears in the file: the source of key suggestions.
_TABLES: dict[str, type[BaseModel]] = {"parameters": Parameter, "target": Target}


def _first(error: ValidationError) -> str:
    """The first thing wrong, as one line: where it is, what it is, what would be right."""
    details = error.errors()
    # A value that may be a number, list, name or table fails once per alternative: an unknown key says the most.
    first = next((e for e in details if e["type"] == "extra_forbidden"), details[0])
    where = ".".join(str(part) for part in first["loc"] if not str(part).startswith(("list[", "function-")))
    if first["type"] == "extra_forbidden":
        key = str(first["loc"][-1])
        table = Config if len(first["loc"]) == 1 else _TABLES.get(str(first["loc"][0]), Config)
        if len(first["loc"]) > 1:
            inner: dict[str, type[BaseModel]] = {"Picture": Picture, "start": Displacement}
            table = inner.get(str(first["loc"][-2]), table)
        close = difflib.get_close_matches(key, table.model_fields, n=1, cutoff=0.4)
        hint = f"did you mean '{close[0]}'?" if close else f"known keys: {', '.join(table.model_fields)}"
        return f"unknown key '{where}'; {hint}"
    if first["type"] == "missing":
        return f"key '{where}' is missing; add it"
    if first["type"] == "value_error":
        return str(first["ctx"]["error"])
    return f"'{where}' is {first['input']!r}: {first['msg'].lower()}"
