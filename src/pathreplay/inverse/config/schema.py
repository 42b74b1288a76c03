"""The schema of a job: all keys and the rules that relate them, checked before anything is rendered."""

from __future__ import annotations

import difflib
import io
from collections.abc import Mapping, Sequence
from math import prod
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, Field, ValidationError, ValidationInfo, model_validator

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.definitions import defined
from pathreplay.inverse.config.errors import first_error
from pathreplay.inverse.config.executor_options import ExecutorName, RayOptions
from pathreplay.inverse.config.memory_options import Memory, bytes_of
from pathreplay.inverse.config.noise_options import AUTO, AdaptiveSpp, Spp
from pathreplay.inverse.config.optimizer_options import Optimizer
from pathreplay.inverse.config.parameter_options import (
    MEMORY,
    Derivation,
    Displace,
    Displacement,
    ImageValue,
    Parameter,
    TransportStart,
)
from pathreplay.inverse.config.parsing import YAML, most_bytes, parsed
from pathreplay.inverse.config.preview_options import Preview
from pathreplay.inverse.config.schedules import Schedule
from pathreplay.inverse.config.stage_options import Stage, begins
from pathreplay.inverse.config.tables import Argument, Count, Plugin, Positive, Switch, Table, Whole
from pathreplay.inverse.config.target_options import NOTHING, Capture, Exposure, Response, Target
from pathreplay.platform.files import MISSING, file_problem

PIXELWISE = ("l2", "relative-l2", "display-l2")
"""Losses that support pixel batches and Levenberg-Marquardt: the names of the losses in `pixelwise.QUADRATIC`."""
CORNERED = ("l1", "relative-l1", "smape")
"""Losses whose derivative jumps where image and target are equal."""

# Streams of random seeds: iterations, targets and rendered images never share a seed.
ITERATION, TARGET, PICTURE, JUDGEMENT, BATCH = 0, 1, 2, 3, 4


class Config(Table):
    """An optimisation job. docs/optimize.md explains how the keys work together."""

    scene: str
    """Mitsuba XML file, or the name of a built-in scene."""
    scene_parameters: dict[str, Argument] = Field(default_factory=dict)
    """Values of $name placeholders in the scene file, or arguments of the built-in scene."""
    sensors: list[Whole | str] | None = None
    """Sensors of the views, by id or index; default: all."""
    test_views: list[Whole | str] = Field(default_factory=list)
    """Sensors of test views, which are rendered at the start and the end but are not part of the loss."""
    variant: str | None = None
    """Mitsuba variant; default: the best variant that works on this machine."""
    integrator: Plugin = Plugin(type="pathreplay")
    """Integrator that renders and differentiates; default: pathreplay with the options of the scene's integrator."""
    baseline: Plugin | None = None
    """Integrator of a second run, which solves the same problem in the same time for comparison."""
    parameters: Annotated[list[Parameter], Field(min_length=1)]
    """Parameters to recover."""
    derived: list[Derivation] = Field(default_factory=list)
    """Scene parameters that are computed from other parameters."""
    capture: Capture | None = None
    """Images with camera poses; the cameras are added to the scene."""
    exposure: Exposure | None = None
    """Scale factors on the rendered image of each view, which are recovered along with the parameters."""
    response: Response | None = None
    """Response curve of the camera, which is recovered along with the parameters."""
    view_weights: dict[str, Positive] = Field(default_factory=dict)
    """Relative weights of views in the loss, by sensor; default: 1 each."""
    target: Target = Target()
    """Target images."""
    loss: str = "l2"
    """Name of a loss, or module:function."""
    debias: Switch = False
    """Remove, to first order, the bias of a smooth loss due to noise. The loss is also evaluated at the images of two
    halves of the samples."""
    iterations: Count = 200
    """Number of iterations."""
    spp: Spp = 16
    """Samples per pixel of the image and of its derivative, or 'auto'."""
    adaptive_spp: AdaptiveSpp = AdaptiveSpp()
    """Target signal-to-noise ratio and bounds of spp = 'auto'."""
    measure_snr: Switch = False
    """Compute each gradient from two halves of the samples to estimate its signal-to-noise ratio."""
    max_consecutive_nonfinite: Count = 10
    """End the run after this many consecutive iterations in which half of a gradient or more is NaN or infinite."""
    view_batch_size: Count | None = None
    """Number of views per iteration, drawn without repetition; the seed determines the order. Default: all."""
    pixel_batch_size: Count | None = None
    """Number of random pixels per view and iteration; default: all."""
    eval_spp: Count = 128
    """Samples per pixel of the images that are rendered at the start and the end."""
    seed: Annotated[Whole, Field(ge=0, le=10**18)] = 0
    """Seed of all random numbers."""
    learning_rate: Positive = 0.02
    """Learning rate of parameters without one of their own; with Adam, approximately the length of a step."""
    final_learning_rate_ratio: Annotated[Positive, Field(le=1)] = 0.1
    """Ratio of the final to the initial learning rate, for schedules other than constant."""
    learning_rate_schedule: Schedule = "constant"
    """Schedule of the learning rate; default: constant, or exponential if final_learning_rate_ratio is given."""
    warmup_steps: Annotated[Whole, Field(ge=0, le=2**31 - 1)] = 0
    """Iterations over which the learning rate rises linearly from nearly zero."""
    optimizer: Optimizer = Optimizer()
    """Optimiser and its options; default: Adam."""
    stages: Annotated[list[Stage], Field(min_length=1)] | None = None
    """Consecutive stages of the run, which override some of its settings."""
    checkpoint_every: Count = 25
    """Iterations between checkpoints."""
    preview: Preview = Preview()
    """Images that are rendered during the run."""
    deterministic: Switch = False
    """Make runs bitwise reproducible; this uses one thread and needs an LLVM variant."""
    memory_limit: Memory | None = None
    """Memory that each process of the run may use, such as '8 GiB'; default: all available memory."""
    executor: ExecutorName = "local"
    """Where shards are evaluated: in this process, or by Ray actors."""
    spp_shards: Count = 1
    """Number of shards into which the samples of each view are split; useful with fewer views than actors."""
    ray: RayOptions = RayOptions()
    """Options of the Ray cluster and its actors."""
    output: str | None = None
    """Run folder; default: runs/NAME, with the name of the job file."""

    @property
    def brings_pictures(self) -> bool:
        """Whether targets are read from files instead of rendered."""
        return self.capture is not None or self.target.images is not None

    @property
    def most_spp(self) -> int:
        """Largest number of samples per pixel that an iteration may use."""
        most = self.spp if isinstance(self.spp, int) else self.adaptive_spp.max
        return max([most, *(stage.spp for stage in self.stages or [] if stage.spp is not None)])

    @property
    def budget(self) -> int | None:
        """Memory limit in bytes; None means all available memory."""
        return None if self.memory_limit is None else bytes_of(self.memory_limit)

    @property
    def halves_samples(self) -> bool:
        """Whether each gradient is computed from two halves of the samples, which separates signal from noise."""
        return self.measure_snr or self.spp == AUTO

    @property
    def parts(self) -> int:
        """Number of shards per view and iteration: `spp_shards`, or twice `spp_shards` if the noise is measured."""
        return self.spp_shards * (2 if self.halves_samples else 1)

    def _split_samples(self) -> list[tuple[int, int]]:
        """Return the smallest `spp` of the job and the `spp` of its stages, each with its number of shards.

        The samples of a stage with its own `spp` are not split into the halves of spp = "auto".
        """
        first = self.spp if isinstance(self.spp, int) else self.adaptive_spp.min
        fixed = self.spp_shards * (2 if self.measure_snr else 1)
        return [(first, self.parts), *((s.spp, fixed) for s in self.stages or [] if s.spp is not None)]

    def completed_entry(self, entry: Parameter) -> Parameter:
        """Return a copy of a parameter's table in which missing ``learning_rate`` and ``refine_at`` are filled in."""
        refine_at = entry.refine_at or []
        if entry.refine_at is None and entry.resolutions is not None and self.stages is not None:
            refine_at = begins(self.stages)[1 : len(entry.resolutions)]
        rate = entry.learning_rate or self.learning_rate
        return entry.model_copy(update={"refine_at": refine_at, "learning_rate": rate})

    @property
    def loss_name(self) -> str:
        """The name of the loss to show to the user."""
        return self.loss.removeprefix(MEMORY)

    @property
    def _named_loss(self) -> str:
        return "the function in 'loss'" if self.loss.startswith(MEMORY) else f"loss = '{self.loss}'"

    @property
    def target_source(self) -> tuple[str, dict[str, Argument]]:
        """The scene of rendered targets, and its arguments; default: the scene and the arguments of the job."""
        target = self.target
        return (
            self.scene if target.scene is None else target.scene,
            self.scene_parameters if target.scene_parameters is None else target.scene_parameters,
        )

    @model_validator(mode="after")
    def _in_stages(self, info: ValidationInfo) -> Config:
        total = begins(self.stages or [])[-1]
        if self.stages is not None:
            if "iterations" not in self.model_fields_set:
                # The model is frozen, so the value is stored in __dict__. The key still counts as not given, and is not
                # saved.
                self.__dict__["iterations"] = total
            elif self.iterations != total:
                name = _name_of_iterations(info)
                raise ValueError(f"{name} is {self.iterations}, but the stages have {total} in total; remove '{name}'")
        for entry in self.parameters:
            sizes = len(entry.resolutions or [])
            if entry.refine_at is None and sizes > 1 and sizes != len(self.stages or []):
                entry._refuse_count()
        return self

    @model_validator(mode="after")
    def _samples(self) -> Config:
        if self.spp != AUTO and "adaptive_spp" in self.model_fields_set:
            raise ValueError(f"adaptive_spp requires spp = 'auto', but spp is {self.spp}; remove one of them")
        if self.measure_snr and self.spp != AUTO and self.spp % 2:
            raise ValueError(f"measure_snr splits the samples into two halves, but spp is {self.spp}; make it even")
        for stage in self.stages or []:
            if self.measure_snr and stage.spp is not None and stage.spp % 2:
                raise ValueError(
                    f"measure_snr splits the samples into two halves, but a stage has spp = {stage.spp}; make it even"
                )
        for spp, parts in self._split_samples():
            if self.spp_shards > 1 and spp % parts:
                halves = ", each in two halves" if parts > self.spp_shards else ""
                raise ValueError(
                    f"spp = {spp} cannot be split into spp_shards = {self.spp_shards} equal shards{halves}; set spp to "
                    f"a multiple of {parts}"
                )
        return self

    @model_validator(mode="after")
    def _has_pictures(self) -> Config:
        given = self.target.model_fields_set - {"alpha"}
        if self.capture is None and not given:
            raise ValueError(NOTHING if "target" in self.model_fields_set else "key 'target' is missing; add it")
        if self.capture is not None and given:
            raise ValueError(
                f"target: the images come from 'capture'; remove either 'target.{min(given)}' or the capture"
            )
        return self

    @model_validator(mode="after")
    def _scheduled(self, info: ValidationInfo) -> Config:
        if (
            "final_learning_rate_ratio" in self.model_fields_set
            and "learning_rate_schedule" not in self.model_fields_set
        ):
            # The model is frozen, so the value is stored in __dict__. The key still counts as not given, and is not
            # saved.
            self.__dict__["learning_rate_schedule"] = "exponential"
        if self.learning_rate_schedule == "constant" and "final_learning_rate_ratio" in self.model_fields_set:
            raise ValueError(
                "final_learning_rate_ratio has no effect with learning_rate_schedule = 'constant'; remove one of them"
            )
        if self.warmup_steps >= self.iterations:
            name = _name_of_iterations(info)
            raise ValueError(
                f"warmup_steps = {self.warmup_steps} is not less than {name} = {self.iterations}; lower it, or raise "
                f"'{name}'"
            )
        return self

    @model_validator(mode="after")
    def _entries(self, info: ValidationInfo) -> Config:
        for entry in self.parameters:
            if entry.refine_at and entry.refine_at[-1] >= self.iterations:
                name = _name_of_iterations(info)
                entry._refuse(
                    f"refine_at {entry.refine_at[-1]} is not less than {name} = {self.iterations}; refine earlier, or "
                    f"raise '{name}'"
                )
        used = {name for entry in self.derived for name in entry.of}
        for entry in self.parameters:
            if entry.shape is None:
                continue
            if entry.key not in used:
                entry._refuse(
                    "'shape' is given, but nothing is derived from it; name it in 'of' of a [[derived]] table"
                )
            if prod(entry.shape) >= 2**32:
                entry._refuse(
                    f"shape {entry.shape} has {prod(entry.shape)} entries, but arrays hold up to {2**32 - 1}; shrink it"
                )
        return self

    @model_validator(mode="after")
    def _of_photos(self) -> Config:
        if self.exposure is not None and self.loss == "scale-invariant":
            raise ValueError(
                "exposure: loss = 'scale-invariant' already fits a factor to each view; remove 'exposure', or use "
                "another loss"
            )
        if self.response is None:
            return self
        if self.loss not in PIXELWISE:
            raise ValueError(
                f"response: {self._named_loss} is not quadratic in the image; use {' or '.join(PIXELWISE)}, or "
                "remove 'response'"
            )
        if self.optimizer.is_second_order:
            raise ValueError(
                f"response: optimizer type = '{self.optimizer.type}' does not recover it; use 'adam', or remove one of "
                "them"
            )
        if self.pixel_batch_size is not None or any(stage.pixel_batch_size for stage in self.stages or []):
            raise ValueError("response: it needs whole images; remove 'pixel_batch_size' or 'response'")
        return self

    @model_validator(mode="after")
    def _extrapolated(self) -> Config:
        if not self.debias:
            return self
        if self.loss in PIXELWISE:
            raise ValueError(f"debias: the gradient of loss = '{self.loss}' has no bias; remove 'debias'")
        if self.loss in CORNERED:
            raise ValueError(
                f"debias: loss = '{self.loss}' is not smooth where image and target are equal, so that extrapolation "
                "does not remove its bias; remove 'debias', or use a smooth loss such as 'log'"
            )
        for spp, parts in self._split_samples():
            if spp < 2 * parts:
                raise ValueError(
                    f"debias: the loss is evaluated at two halves of the samples; set spp to {2 * parts} or more"
                )
        return self

    @model_validator(mode="after")
    def _in_batches(self) -> Config:
        stages = [stage.pixel_batch_size for stage in self.stages or []]
        if self.pixel_batch_size is None and not any(stages):
            return self
        if self.loss not in PIXELWISE:
            raise ValueError(
                f"pixel_batch_size: {self._named_loss} needs whole images; use {' or '.join(PIXELWISE)}, or remove "
                "'pixel_batch_size'"
            )
        if self.exposure is not None:
            raise ValueError("pixel_batch_size: 'exposure' needs whole images; remove one of them")
        if self.spp == AUTO:
            raise ValueError(
                "pixel_batch_size: spp = 'auto' cannot reduce the noise of pixel sampling; set spp to a number"
            )
        return self

    @model_validator(mode="after")
    def _searched(self) -> Config:
        if not self.optimizer.searches:
            return self
        rates = {"learning_rate_schedule", "final_learning_rate_ratio", "warmup_steps"}
        others = {"stages", "baseline", "view_batch_size", "pixel_batch_size"}
        wrong = sorted((rates | others) & self.model_fields_set)
        if self.spp == AUTO:
            wrong.append("spp = 'auto'")
        wrong += ["refine_at" for entry in self.parameters if len(entry.resolutions or []) > 1]
        if wrong:
            raise ValueError(
                f"optimizer: type = '{self.optimizer.type}' needs the same loss function in all iterations and has no "
                f"learning-rate schedule; remove '{wrong[0]}', or use another type"
            )
        for entry in self.parameters:
            if entry.pyramid:
                raise ValueError(
                    f"optimizer: type = '{self.optimizer.type}' does not step the levels of a pyramid; remove "
                    f"'pyramid' of parameter '{entry.key}', or use 'adam'"
                )
        return self

    @model_validator(mode="after")
    def _of_squares(self) -> Config:
        if not self.optimizer.is_second_order:
            return self
        kind = f"optimizer: type = '{self.optimizer.type}'"
        if self.loss not in PIXELWISE:
            raise ValueError(
                f"{kind} needs a sum of squares, which {self._named_loss} is not; use {' or '.join(PIXELWISE)}, or "
                "type = 'adam'"
            )
        if isinstance(self.spp, int) and self.spp % (2 * self.parts):
            raise ValueError(
                f"{kind} splits the samples into halves, but spp is {self.spp}; set it to a multiple of "
                f"{2 * self.parts}"
            )
        return self

    def seeds(self, stream: int, sensor: int, iteration: int = 0, count: int = 2) -> tuple[int, ...]:
        """Return ``count`` independent 32-bit seeds. Streams (`ITERATION` etc.), sensors and iterations share none."""
        return tuple(np.random.SeedSequence([self.seed, stream, iteration, sensor]).generate_state(count).tolist())


def _name_of_iterations(info: ValidationInfo) -> str:
    """Return the name of the key ``iterations`` in messages."""
    return str((info.context or {}).get("iterations", "iterations"))


# Models of nested tables, by their key in the file or by their name in pydantic's error locations.
_TABLES: dict[str, type[BaseModel]] = {
    "parameters": Parameter,
    "derived": Derivation,
    "target": Target,
    "ImageValue": ImageValue,
    "Displacement": Displacement,
    "TransportStart": TransportStart,
    "displace": Displace,
    "optimizer": Optimizer,
    "preview": Preview,
    "capture": Capture,
    "adaptive_spp": AdaptiveSpp,
    "stages": Stage,
    "exposure": Exposure,
    "response": Response,
    "ray": RayOptions,
}


def load_config(path: str | Path, changes: Sequence[str] = ()) -> Config:
    """Read a job from a TOML, YAML or JSON file.

    Args:
        path: the file; its suffix selects the format.
        changes: overrides ``KEY=VALUE``, applied before the checks (see `defined`).

    Returns:
        The checked job.

    Raises:
        PathreplayError: the file cannot be read, a key is unknown (the message suggests the nearest one), or a value is
            invalid.
    """
    return read_config(Path(path), changes)[0]


def read_config(path: Path, changes: Sequence[str] = ()) -> tuple[Config, bytes]:
    """Read a job as `load_config` does. Returns the job and the content of its file, without the changes."""
    content = _content(path)
    return make_config(_table(path, content, changes), str(path)), content


def read_table(path: Path, changes: Sequence[str] = ()) -> Any:
    """Read a job as `load_config` does, without checking it. Raises PathreplayError if the file cannot be read."""
    return _table(path, _content(path), changes)


def _content(path: Path) -> bytes:
    """Return the content of the file of a job. Raises PathreplayError if the file cannot be read."""
    problem = file_problem(path, most_bytes(path))
    if problem == MISSING:
        siblings = path.parent.glob("*") if path.parent.is_dir() else []
        near = [str(p) for p in siblings if p.suffix in (".toml", *YAML)]
        close = difflib.get_close_matches(str(path), near, n=1, cutoff=0.3)
        hint = f"did you mean {close[0]}?" if close else "give the path of a TOML or YAML file"
        raise PathreplayError(f"No config file {path}; {hint}")
    if problem:
        raise PathreplayError(f"Config {path} {problem}; give the path of a TOML or YAML file")
    try:
        return path.read_bytes()
    except OSError as error:
        raise PathreplayError(f"Config {path} cannot be read ({error}); give a UTF-8 text file") from None


def _table(path: Path, content: bytes, changes: Sequence[str]) -> object:
    """Parse the content of the file of a job. Raises PathreplayError if the content is not valid."""
    try:
        text = io.StringIO(content.decode("utf-8"), newline=None).read()
    except UnicodeDecodeError as error:
        raise PathreplayError(f"Config {path} cannot be read ({error}); give a UTF-8 text file") from None
    return defined(parsed(path, text), changes)


def make_config(values: object, name: str = "config", names: Mapping[str, str] | None = None) -> Config:
    """Make a job from a dictionary, with the checks and messages of `load_config`, which also refuse other objects.

    Messages call the job ``name``. ``names`` are the names in messages of keys that the caller calls differently, such
    as 'steps' for 'iterations', and of tables, such as "Parameter 'a'" for 'parameters.0'.
    """
    try:
        return Config.model_validate(values, context=names)
    except ValidationError as error:
        raise PathreplayError(f"{name}: {first_error(error, Config, _TABLES, names or {})}") from None
