"""The optimisation job as the user writes it: a TOML or YAML file, checked key by key before anything is rendered."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from math import prod
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Discriminator, Field, Tag, ValidationError, model_validator

from pathreplay.errors import PathreplayError, shown
from pathreplay.inverse.config.capture_options import Capture, Exposure
from pathreplay.inverse.config.definitions import defined
from pathreplay.inverse.config.errors import first_error
from pathreplay.inverse.config.executor_options import ExecutorName, RayOptions
from pathreplay.inverse.config.memory_options import Memory, bytes_of
from pathreplay.inverse.config.noise_options import AUTO, AdaptiveSpp, Spp
from pathreplay.inverse.config.optimizer_options import Optimizer
from pathreplay.inverse.config.parsing import YAML, most_bytes, parsed
from pathreplay.inverse.config.preview_options import Preview
from pathreplay.inverse.config.schedules import Schedule
from pathreplay.inverse.config.stage_options import Stage, begins
from pathreplay.inverse.config.tables import Count, Finite, Positive, Switch, Table, Whole
from pathreplay.platform.files import MISSING, file_problem


class Picture(Table):
    """An image as the value of a texture: file, how it meets the texture's shape, and its colour space."""

    image: str
    """Image file, or 'matplotlib:NAME' for one of matplotlib's samples."""
    fit: Literal["stretch", "crop"] = "stretch"
    """Resample the image to the texture's shape, or crop it first."""
    raw: Switch = False
    """Values are taken as they are, not decoded from sRGB."""


Value = Finite | list[Finite] | str | Picture
"""A parameter's value: one number for every entry, a list such as a colour, or an image file for a texture."""


Argument = Switch | Whole | Finite | str
"""What replaces a ``$name`` in a scene file, or is an argument of a built-in scene."""


def _import_path(value: str) -> str:
    module, _, function = value.partition(":")
    if not module or not function or ":" in function:
        raise ValueError(f"{shown(value)} is no import path; write module:function")
    return value


ImportPath = Annotated[str, AfterValidator(_import_path)]
"""``module:function``."""

Vector = Annotated[list[Finite], Field(min_length=3, max_length=3)]


PoseKind = Literal["translation", "rotation", "rigid"]
PARTS = {"translation": ("translation",), "rotation": ("rotation",), "rigid": ("translation", "rotation")}
"""Variables of each kind of pose."""

TransformKind = Literal["log", "softplus", "logit"]


class Displacement(Table):
    """Where a pose starts, from where the scene has it: scene units, and a rotation vector in degrees."""

    translation: Vector | None = None
    """Shift in scene units."""
    rotation: Vector | None = None
    """Rotation vector in degrees."""


def _kind_of_initial(value: Any) -> str:
    names = list(value) if isinstance(value, dict) else []
    posed = any(difflib.get_close_matches(str(name), Displacement.model_fields, n=1) for name in names)
    return "Displacement" if posed or isinstance(value, Displacement) else "Value"


Initial = Annotated[
    Annotated[Value, Tag("Value")] | Annotated[Displacement, Tag("Displacement")], Discriminator(_kind_of_initial)
]
"""Where a parameter starts: its value or, for a pose, how far from where the scene has it."""


NOT_OF_A_POSE = frozenset(
    "lower upper resolutions refine_at large_steps_lambda parameterization total_variation l2_to_initial "
    "laplacian_weight regularizer shape".split()
)


class Parameter(Table):
    """One scene parameter to recover, or several by a glob."""

    key: str
    """Key of mitsuba.traverse(scene), or a glob such as '*.reflectance.value'."""
    lower: Finite | None = None
    """Lowest value, held by projection after each step."""
    upper: Finite | None = None
    """Highest value, held by projection after each step."""
    learning_rate: Positive | None = None
    """Learning rate of this parameter; default: that of the job."""
    initial: Initial | None = None
    """Initial value: a number, a list (a colour), an image or volume file, or an image table; for a pose a
    displacement. Default: the value in the scene."""
    resolutions: Annotated[list[Count], Field(min_length=1)] | None = None
    """Sizes of a grid, coarse to fine: entries along its longest axis."""
    refine_at: list[Count] | None = None
    """Iterations at which each resolution after the first begins."""
    pose: PoseKind | None = None
    """The parameter moves rigidly: it is a to_world, or the vertex_positions of a mesh."""
    pivot: Vector | None = None
    """Point about which a pose turns; default: the origin of the object (of a mesh, the mean of its vertices)."""
    error_scale: Positive | None = None
    """Length with which errors in position are compared."""
    rotation_learning_rate: Positive | None = None
    """Learning rate of the rotation in degrees; default: the learning rate, in radians."""
    large_steps_lambda: Positive | None = None
    """Smoothness λ of Large Steps (Nicolet et al. 2021) for vertex_positions."""
    parameterization: TransformKind | None = None
    """Steps are taken in this function of the value."""
    total_variation: Positive | None = None
    """Weight of the total variation of a texture or volume."""
    l2_to_initial: Positive | None = None
    """Weight of the mean squared difference from the initial value."""
    laplacian_weight: Positive | None = None
    """Weight of the mean squared distance of vertices from the mean of their neighbours."""
    regularizer: ImportPath | None = None
    """Function of the values that is added to the loss, as module:function."""
    shape: Annotated[list[Count], Field(min_length=1, max_length=8)] | None = None
    """Shape of numbers that are no part of the scene, from which others are derived."""

    @property
    def displacement(self) -> Displacement:
        """Of a pose, from where the scene has it."""
        return self.initial if isinstance(self.initial, Displacement) else Displacement()

    @model_validator(mode="after")
    def _of_one_kind(self) -> Parameter:
        posed = {"pivot", "error_scale", "rotation_learning_rate"} & self.model_fields_set
        if self.pose is None:
            if isinstance(self.initial, Displacement):
                posed.add("initial")
            if posed:
                self._refuse(f"'{min(posed)}' belongs to a pose; add pose = 'translation', 'rotation' or 'rigid'")
            return self
        if plain := NOT_OF_A_POSE & self.model_fields_set:
            self._refuse(f"'{min(plain)}' does not go with a pose; displace it with 'initial'")
        if not isinstance(self.initial, Displacement | None):
            self._refuse("'initial' of a pose is a displacement; write { translation = [...], rotation = [...] }")
        parts = PARTS[self.pose]
        wrong = [f"initial.{part}" for part in sorted(self.displacement.model_fields_set) if part not in parts]
        if self.rotation_learning_rate is not None and "rotation" not in parts:
            wrong.append("rotation_learning_rate")
        if wrong:
            self._refuse(f"'{wrong[0]}' is not part of pose = '{self.pose}'; take pose = 'rigid', or leave it out")
        return self

    @model_validator(mode="after")
    def _in_order(self) -> Parameter:
        if self.large_steps_lambda is not None and not (self.lower is None and self.upper is None):
            self._refuse(
                "'large_steps_lambda' does not go with 'lower' and 'upper', which would tear the mesh; leave them out"
            )
        if self.large_steps_lambda is not None and self.parameterization is not None:
            self._refuse(
                "'large_steps_lambda' does not go with 'parameterization': both change the steps; leave one out"
            )
        sizes, begins = self.resolutions or [], self.refine_at or []
        # Without refine_at each stage of the job may have one: see `Config`.
        if self.refine_at is not None and len(begins) != max(0, len(sizes) - 1):
            self._refuse_count()
        if sorted(set(begins)) != begins:
            self._refuse(f"refine_at {begins} does not increase; put it in order")
        if self.parameterization == "log" and self.lower is not None and self.lower < 0:
            self._refuse(
                f"parameterization = 'log' has values above 0 only, and lower = {self.lower:g}; take 'softplus'"
            )
        if self.parameterization == "logit" and (self.lower is None) != (self.upper is None):
            self._refuse(
                "parameterization = 'logit' goes between two bounds; give 'lower' and 'upper', or neither (0 and 1)"
            )
        if self.lower is not None and self.upper is not None and self.upper <= self.lower:
            bounds = f"upper bound {self.upper:g} is not above lower bound {self.lower:g}"
            self._refuse(f"{bounds}; swap or widen them")
        return self

    def _refuse_count(self) -> None:
        self._refuse(
            f"{len(self.resolutions or [])} resolutions and {len(self.refine_at or [])} entries in refine_at; give the "
            "iteration at which each resolution after the first begins"
        )

    def _refuse(self, why: str) -> None:
        raise ValueError(f"parameter '{self.key}': {why}")


class Derivation(Table):
    """A parameter of the scene, or several by a glob, made from others by a function of the user's."""

    key: str
    """Scene parameter that the function makes, or a glob."""
    function: ImportPath
    """module:function of the value in the scene and of the parameters in 'of'."""
    of: Annotated[list[str], Field(min_length=1)]
    """Parameters of the job, in the order of the function's arguments."""


class Plugin(BaseModel):
    """A Mitsuba plugin by ``type`` with its own options, which Mitsuba checks."""

    model_config = ConfigDict(extra="allow", frozen=True, use_attribute_docstrings=True)

    type: str
    """Name of the plugin; its other options stand beside it."""

    @model_validator(mode="after")
    def _has_edges(self) -> Plugin:
        if self.type != "pathreplay" and (asked := {"boundary", "boundary_spp"} & set(self.model_extra or {})):
            raise ValueError(
                f"'{min(asked)}' is an option of the integrator 'pathreplay', which '{self.type}' does not have; "
                "leave it out"
            )
        return self

    @model_validator(mode="after")
    def _of_32_bits(self) -> Plugin:
        for name, value in (self.model_extra or {}).items():
            if isinstance(value, int) and abs(value) >= 2**31:
                raise ValueError(f"'{name}' of '{self.type}' is {shown(value)}; give a whole number below {2**31}")
        return self


NOTHING = "target: nothing to match; give 'images', or 'values' and/or 'scene' to render"


class Target(Table):
    """What the pictures should look like: image files, one per sensor, or a scene to render."""

    images: list[str] | str | None = None
    """Image files, one per sensor in the order of the sensors, or a pattern."""
    masks: list[str] | str | None = None
    """Mask files, one per sensor: white counts, black does not."""
    alpha: Literal["black", "mask", "scene", "compare"] = "black"
    """What is behind transparent images."""
    scene: str | None = None
    """Scene from which targets are rendered; default: the scene of the job."""
    scene_parameters: dict[str, Argument] | None = None
    """Arguments of the target scene; default: those of the job."""
    values: dict[str, Value] = Field(default_factory=dict)
    """Parameters of the target scene that differ from its file."""
    integrator: Plugin | None = None
    """Integrator of the targets; default: path, or volpath, with the limits of the job's."""
    spp: Count = 512
    """Samples per pixel of the targets."""

    @model_validator(mode="after")
    def _one_source(self) -> Target:
        if self.images is not None:
            extra = sorted(self.model_fields_set - {"images", "masks", "alpha"})
            if extra:
                raise ValueError(f"target: 'images' excludes '{extra[0]}'; give image files or a scene to render")
            if not self.images:
                raise ValueError("target: 'images' is empty; name one image file per sensor")
            if self.masks is not None and self.alpha == "mask":
                raise ValueError("target: 'masks' and alpha = 'mask' are two masks; leave one out")
        elif self.model_fields_set <= {"alpha"}:
            return self  # fit for a capture, which brings pictures
        elif self.alpha != "black":
            raise ValueError(f"target: alpha = '{self.alpha}' is about 'images'; leave it out, or name them")
        elif not self.values and self.scene is None:
            raise ValueError(NOTHING)
        if self.integrator is not None and self.integrator.type == "pathreplay":
            raise ValueError(
                "target: integrator 'pathreplay' would grade itself; render targets with another, such as 'path'"
            )
        return self


PIXELWISE = ("l2", "relative-l2")
"""Losses of which some pixels can be taken: those of `losses.QUADRATIC`."""

# Streams of random numbers: pictures never share a seed with iterations, nor targets with renderings.
ITERATION, TARGET, PICTURE, JUDGEMENT, BATCH = 0, 1, 2, 3, 4


class Config(Table):
    """One optimisation job. Every key is explained in docs/optimize.md."""

    scene: str
    """Mitsuba XML file, or the name of a built-in scene."""
    scene_parameters: dict[str, Argument] = Field(default_factory=dict)
    """Values of $name in the scene file, or arguments of the built-in."""
    sensors: list[Whole | str] | None = None
    """Sensors of the views, by id or number; default: all."""
    test_views: list[Whole | str] = Field(default_factory=list)
    """Sensors that are held out: rendered at the start and the end, never learned from."""
    variant: str | None = None
    """Mitsuba variant; default: the best one that works on this machine."""
    integrator: Plugin = Plugin(type="pathreplay")
    """Integrator that renders and differentiates; default: pathreplay, with the options of the scene's own."""
    baseline: Plugin | None = None
    """Integrator that solves the same problem in the same time, for comparison."""
    parameters: Annotated[list[Parameter], Field(min_length=1)]
    """Parameters that are recovered."""
    derived: list[Derivation] = Field(default_factory=list)
    """Scene parameters that functions make of others."""
    capture: Capture | None = None
    """Images with their cameras, which join the scene."""
    exposure: Exposure | None = None
    """Factors on the image of each view, which are recovered, too."""
    view_weights: dict[str, Positive] = Field(default_factory=dict)
    """How much views count beside the others, by sensor."""
    target: Target = Target()
    """What the images should look like."""
    loss: str = "l2"
    """Loss by name, or module:function."""
    iterations: Count = 200
    """Number of iterations."""
    spp: Spp = 16
    """Samples per pixel of the image and of its derivative, or 'auto'."""
    adaptive_spp: AdaptiveSpp = AdaptiveSpp()
    """Bounds of spp = 'auto'."""
    measure_snr: Switch = False
    """Compute gradients in two halves, which separate signal from noise."""
    max_consecutive_nonfinite: Count = 10
    """Iterations after which a gradient that is NaN or infinite ends the run."""
    view_batch_size: Count | None = None
    """Views in an iteration, drawn by the seed; default: all."""
    pixel_batch_size: Count | None = None
    """Pixels of each view in an iteration, drawn by the seed; default: all."""
    eval_spp: Count = 128
    """Samples per pixel of the images at the start and the end."""
    seed: Annotated[Whole, Field(ge=0, le=10**18)] = 0
    """Decides all random numbers."""
    learning_rate: Positive = 0.02
    """Learning rate of parameters without one of their own: about the length of a step of Adam."""
    final_learning_rate_ratio: Annotated[Positive, Field(le=1)] = 0.1
    """Learning rate at the end over that at the start."""
    learning_rate_schedule: Schedule = "constant"
    """Schedule of the learning rate; default: constant, or exponential with a ratio."""
    warmup_steps: Annotated[Whole, Field(ge=0, le=2**31 - 1)] = 0
    """Iterations in which the learning rate grows from nearly zero."""
    optimizer: Optimizer = Optimizer()
    """Optimiser and its options; default: Adam."""
    stages: Annotated[list[Stage], Field(min_length=1)] | None = None
    """Stages of the run, in which some settings differ."""
    checkpoint_every: Count = 25
    """Iterations between checkpoints."""
    preview: Preview = Preview()
    """Images that are rendered during the run."""
    deterministic: Switch = False
    """Give the same bits every time, on one thread of an LLVM variant."""
    memory_limit: Memory | None = None
    """Memory that the run may take, such as '8 GiB'; default: what there is."""
    executor: ExecutorName = "local"
    """Where shards are evaluated: in this process, or by actors of Ray."""
    spp_shards: Count = 1
    """Shards of each view by samples, where there are fewer views than actors."""
    ray: RayOptions = RayOptions()
    """The cluster and its actors."""
    output: str | None = None
    """Run folder; default: runs/NAME of the job."""

    @property
    def brings_pictures(self) -> bool:
        """Whether targets are files, and not rendered."""
        return self.capture is not None or self.target.images is not None

    @property
    def most_spp(self) -> int:
        """Samples per pixel that an iteration may have."""
        most = self.spp if isinstance(self.spp, int) else self.adaptive_spp.max
        return max([most, *(stage.spp for stage in self.stages or [] if stage.spp is not None)])

    @property
    def budget(self) -> int | None:
        """Bytes that the run may take; None: what there is."""
        return None if self.memory_limit is None else bytes_of(self.memory_limit)

    @property
    def halves_samples(self) -> bool:
        """Whether iterations take their samples in two halves, which tell signal from noise."""
        return self.measure_snr or self.spp == AUTO

    @property
    def parts(self) -> int:
        """Shards of a view in an iteration: ranges of its samples, each in two halves where noise is measured."""
        return self.spp_shards * (2 if self.halves_samples else 1)

    def refine_at(self, entry: Parameter) -> list[int]:
        """The iterations at which the resolutions of a parameter after the first begin."""
        if entry.refine_at is None and entry.resolutions is not None and self.stages is not None:
            return begins(self.stages)[1 : len(entry.resolutions)]
        return entry.refine_at or []

    @model_validator(mode="after")
    def _in_stages(self) -> Config:
        total = begins(self.stages or [])[-1]
        if self.stages is not None:
            if "iterations" not in self.model_fields_set:
                self.__dict__["iterations"] = total  # frozen, and not to be written down as if it had been given
            elif self.iterations != total:
                raise ValueError(
                    f"iterations is {self.iterations}, and the stages have {total}; leave 'iterations' out"
                )
        for entry in self.parameters:
            sizes = len(entry.resolutions or [])
            if entry.refine_at is None and sizes > 1 and sizes != len(self.stages or []):
                entry._refuse_count()
        return self

    @model_validator(mode="after")
    def _samples(self) -> Config:
        if self.spp != AUTO and "adaptive_spp" in self.model_fields_set:
            raise ValueError(f"adaptive_spp goes with spp = 'auto', and spp is {self.spp}; leave one out")
        if self.measure_snr and self.spp != AUTO and self.spp % 2:
            raise ValueError(f"measure_snr takes two halves of the samples, and spp is {self.spp}; make it even")
        for stage in self.stages or []:
            if self.measure_snr and stage.spp is not None and stage.spp % 2:
                raise ValueError(
                    f"measure_snr takes two halves of the samples, and a stage has spp = {stage.spp}; make it even"
                )
        for spp in (self.adaptive_spp.min if self.spp == AUTO else self.spp, *(s.spp for s in self.stages or [])):
            if spp is not None and self.spp_shards > 1 and spp % self.parts:
                halves = ", in two halves each" if self.halves_samples else ""
                raise ValueError(
                    f"spp_shards = {self.spp_shards} does not divide the {spp} samples per pixel{halves}; take "
                    f"a multiple of {self.parts} for spp"
                )
        return self

    @model_validator(mode="after")
    def _has_pictures(self) -> Config:
        given = self.target.model_fields_set - {"alpha"}
        if self.capture is None and not given:
            raise ValueError(NOTHING if "target" in self.model_fields_set else "key 'target' is missing; add it")
        if self.capture is not None and given:
            raise ValueError(f"target: 'capture' brings the pictures; leave '{min(given)}' out, or the capture")
        return self

    @model_validator(mode="after")
    def _scheduled(self) -> Config:
        if (
            "final_learning_rate_ratio" in self.model_fields_set
            and "learning_rate_schedule" not in self.model_fields_set
        ):
            self.__dict__["learning_rate_schedule"] = "exponential"  # not to be written down as if it had been given
        if self.learning_rate_schedule == "constant" and "final_learning_rate_ratio" in self.model_fields_set:
            raise ValueError(
                "final_learning_rate_ratio does not go with learning_rate_schedule = 'constant'; leave one out"
            )
        if self.warmup_steps >= self.iterations:
            raise ValueError(
                f"warmup_steps = {self.warmup_steps} is not before the end of the {self.iterations} iterations; "
                "shorten it, or raise 'iterations'"
            )
        return self

    @model_validator(mode="after")
    def _refined_in_time(self) -> Config:
        for entry in self.parameters:
            if entry.refine_at and entry.refine_at[-1] >= self.iterations:
                entry._refuse(
                    f"refine_at {entry.refine_at[-1]} is not before the end of the {self.iterations} iterations; "
                    "refine earlier, or raise 'iterations'"
                )
        return self

    @model_validator(mode="after")
    def _derived(self) -> Config:
        used = {name for entry in self.derived for name in entry.of}
        for entry in self.parameters:
            if entry.shape is None:
                continue
            if entry.key not in used:
                entry._refuse("'shape' is of numbers that others are derived from; name it in 'of' of a [[derived]]")
            if prod(entry.shape) >= 2**32:
                entry._refuse(f"shape {entry.shape} has {prod(entry.shape)} numbers, and arrays up to {2**32 - 1}")
        return self

    @model_validator(mode="after")
    def _one_factor(self) -> Config:
        if self.exposure is not None and self.loss == "scale-invariant":
            raise ValueError(
                "exposure: loss = 'scale-invariant' has a factor of its own for each view; leave 'exposure' out, or "
                "take another loss"
            )
        return self

    @model_validator(mode="after")
    def _in_batches(self) -> Config:
        stages = [stage.pixel_batch_size for stage in self.stages or []]
        if self.pixel_batch_size is None and not any(stages):
            return self
        if self.loss not in PIXELWISE:
            raise ValueError(
                f"pixel_batch_size: loss = '{self.loss}' wants whole pictures; take {' or '.join(PIXELWISE)}, or "
                "leave 'pixel_batch_size' out"
            )
        if self.exposure is not None:
            raise ValueError("pixel_batch_size: 'exposure' wants whole pictures; leave one of them out")
        if self.spp == AUTO:
            raise ValueError(
                "pixel_batch_size: spp = 'auto' cannot lessen the noise of choosing pixels; give a number of samples"
            )
        return self

    @model_validator(mode="after")
    def _searched(self) -> Config:
        if not self.optimizer.searches:
            return self
        rates = {"learning_rate_schedule", "final_learning_rate_ratio", "warmup_steps"} & self.model_fields_set
        wrong = sorted(rates | ({"stages", "baseline", "view_batch_size", "pixel_batch_size"} & self.model_fields_set))
        if self.spp == AUTO:
            wrong.append("spp = 'auto'")
        wrong += ["refine_at" for entry in self.parameters if len(entry.resolutions or []) > 1]
        if wrong:
            raise ValueError(
                f"optimizer: type = '{self.optimizer.type}' compares losses of one function, and has no schedule; "
                f"leave '{wrong[0]}' out, or take another type"
            )
        return self

    def seeds(self, stream: int, sensor: int, iteration: int = 0, count: int = 2) -> tuple[int, ...]:
        """Independent 32-bit seeds, two by default; none is used for another stream, sensor or iteration."""
        return tuple(np.random.SeedSequence([self.seed, stream, iteration, sensor]).generate_state(count).tolist())


# Models of nested tables, by the name under which they appear in the file or in what pydantic tries.
_TABLES: dict[str, type[BaseModel]] = {
    "parameters": Parameter,
    "derived": Derivation,
    "target": Target,
    "Picture": Picture,
    "Displacement": Displacement,
    "optimizer": Optimizer,
    "preview": Preview,
    "capture": Capture,
    "adaptive_spp": AdaptiveSpp,
    "stages": Stage,
    "exposure": Exposure,
    "ray": RayOptions,
}


def load_config(path: Path, changes: Sequence[str] = ()) -> Config:
    """Read a job from a TOML or YAML file (or the JSON that a run folder may hold); for ``changes`` see `defined`.

    Raises PathreplayError for an unreadable file, an unknown key (names the nearest), a value out of its range.
    """
    problem = file_problem(path, most_bytes(path))
    if problem == MISSING:
        found = path.parent.glob("*") if path.parent.is_dir() else []
        near = [str(p) for p in found if p.suffix in (".toml", *YAML)]
        close = difflib.get_close_matches(str(path), near, n=1, cutoff=0.3)
        hint = f"did you mean {close[0]}?" if close else "give the path of a TOML or YAML file"
        raise PathreplayError(f"No config file {path}; {hint}")
    if problem:
        raise PathreplayError(f"Config {path} {problem}; give the path of a TOML or YAML file")
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise PathreplayError(f"Config {path} cannot be read ({error}); give a text file in UTF-8") from None
    return _checked(str(path), defined(parsed(path, text), changes))


def make_config(values: dict[str, Any], name: str = "config") -> Config:
    """A job from a dictionary, with the same checks and messages as a file; ``name`` is what messages call it."""
    return _checked(name, values)


def _checked(name: str, job: Any) -> Config:
    try:
        return Config.model_validate(job)
    except ValidationError as error:
        raise PathreplayError(f"{name}: {first_error(error, Config, _TABLES)}") from None
