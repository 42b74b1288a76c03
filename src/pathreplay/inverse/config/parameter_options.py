"""Tables of a job that describe its parameters: values, poses, bounds, regularisation and derived parameters."""

from __future__ import annotations

import difflib
from typing import Annotated, Literal

from pydantic import AfterValidator, Discriminator, Field, Tag, model_validator
from pydantic_core import PydanticCustomError

from pathreplay.errors import shown
from pathreplay.inverse.config.tables import Count, Finite, Positive, Switch, Table


class ImageValue(Table):
    """An image file as the value of a texture."""

    image: str
    """Image file, or 'matplotlib:NAME' for a sample image of matplotlib."""
    fit: Literal["stretch", "crop"] = "stretch"
    """'stretch' resamples the image to the shape of the texture. 'crop' first crops the image to the aspect ratio of
    the texture."""
    raw: Switch = False
    """Use the stored values without decoding them from sRGB."""


Value = Finite | list[Finite] | str | ImageValue
"""Value of a parameter: one number for all entries, a list of numbers (a colour), or the name of a file."""


def _import_path(value: str) -> str:
    module, _, function = value.partition(":")
    if not module or not function or ":" in function:
        raise PydanticCustomError(
            "import_path", "{name} is not an import path; write module:function", {"name": shown(value)}
        )
    return value


ImportPath = Annotated[str, AfterValidator(_import_path)]
"""Name of a function, written as ``module:function``."""
MEMORY = "memory:"
"""Prefix of the names of functions in memory, which take the place of import paths."""

Vector = Annotated[list[Finite], Field(min_length=3, max_length=3)]


PoseKind = Literal["translation", "rotation", "rigid"]
PARTS = {"translation": ("translation",), "rotation": ("rotation",), "rigid": ("translation", "rotation")}
"""Variables of each kind of pose."""

TransformKind = Literal["log", "softplus", "logit"]


class Displacement(Table):
    """Initial displacement of a pose relative to the scene."""

    translation: Vector | None = None
    """Translation in scene units."""
    rotation: Vector | None = None
    """Rotation vector in degrees."""


class TransportStart(Table):
    """Initial height map that casts a given image as its caustic, computed by `pathreplay.caustic_heights`."""

    transport: str
    """Image file, or 'matplotlib:NAME' for a sample image of matplotlib; it is converted to grey."""
    width: Positive
    """Width of the exit surface of a slab, or of a mirror, in scene units."""
    distance: Positive
    """Distance from this surface to the receiver in scene units."""
    eta: Annotated[Finite, Field(gt=1)] | None = None
    """Index of refraction of a slab relative to its surroundings."""
    mirror_angle: Annotated[Finite, Field(ge=0, lt=90)] | None = None
    """Angle between the light and the normal of a mirror in degrees, in place of 'eta'."""
    receiver_width: Positive | None = None
    """Width of the image on the receiver in scene units; default: the width of the surface."""
    source_distance: Positive | None = None
    """Distance from a point light to the entry surface, or to the mirror; default: collimated light."""
    thickness: Annotated[Finite, Field(ge=0)] = 0.0
    """Distance from the entry surface to the exit surface. It has an effect only for a point light."""
    floor: Annotated[Finite, Field(gt=0, lt=1)] = 0.02
    """Fraction of the light that is distributed evenly."""
    fit: Literal["stretch", "crop"] = "stretch"
    """'stretch' resamples the image to the shape of the map. 'crop' first crops the image to the aspect ratio of the
    map."""
    raw: Switch = False
    """Use the stored values without decoding them from sRGB."""


def _kind_of_initial(value: object) -> str:
    if isinstance(value, TransportStart) or (isinstance(value, dict) and "transport" in value):
        return "TransportStart"
    names = list(value) if isinstance(value, dict) else []
    posed = any(difflib.get_close_matches(str(name), Displacement.model_fields, n=1) for name in names)
    return "Displacement" if posed or isinstance(value, Displacement) else "Value"


Initial = Annotated[
    Annotated[Value, Tag("Value")]
    | Annotated[Displacement, Tag("Displacement")]
    | Annotated[TransportStart, Tag("TransportStart")],
    Discriminator(_kind_of_initial),
]
"""Initial value of a parameter. For a pose, this is its displacement relative to the scene. For a height map, it may be
the image of its caustic."""


NOT_OF_A_POSE = frozenset(
    "lower upper resolutions refine_at pyramid large_steps_lambda parameterization total_variation l2_to_initial "
    "laplacian_weight regularizer shape".split()
)


class Parameter(Table):
    """A scene parameter to recover, or several that match a glob."""

    key: str
    """Key of mitsuba.traverse(scene), or a glob such as '*.reflectance.value'."""
    lower: Finite | None = None
    """Lower bound, enforced by projection after each step. If a BSDF omits a lobe at the smallest value, for example at
    sheen = 0 of 'principled', values stay 0.001 above it."""
    upper: Finite | None = None
    """Upper bound, enforced by projection after each step. If a BSDF omits a lobe at the largest value, for example at
    metallic = 1 of 'principled', values stay 0.001 below it."""
    learning_rate: Positive | None = None
    """Learning rate of this parameter; default: the learning rate of the job."""
    initial: Initial | None = None
    """Initial value: a number, a list (a colour), an image or volume file, or an image table; for a pose, a
    displacement; for a height map, also the image of its caustic. Default: the value in the scene."""
    resolutions: Annotated[list[Count], Field(min_length=1)] | None = None
    """Resolutions of a texture or volume, coarse to fine, as the number of entries along its longest axis."""
    refine_at: list[Count] | None = None
    """Iterations at which the second and each later resolution begin; default: the first iterations of the stages, if
    there are as many stages as resolutions."""
    pyramid: Switch = False
    """Optimise the levels of a Laplacian pyramid instead of the entries of a texture or volume."""
    pose: PoseKind | None = None
    """Optimise a rigid motion of the parameter, which is a to_world transform or the vertex_positions of a mesh."""
    pivot: Vector | None = None
    """Centre of rotation of a pose; default: the origin of the object (for a mesh, the mean of its vertices)."""
    error_scale: Positive | None = None
    """Reference length; the report also gives the position error of a pose as a fraction of this length."""
    rotation_learning_rate: Positive | None = None
    """Learning rate of the rotation in degrees. Default: the value of learning_rate, in radians."""
    large_steps_lambda: Positive | None = None
    """Smoothness λ of Large Steps (Nicolet et al. 2021), for vertex_positions."""
    parameterization: TransformKind | None = None
    """Function that maps the value to the variable in which the optimiser takes its steps."""
    total_variation: Positive | None = None
    """Weight of the total variation of a texture or volume."""
    l2_to_initial: Positive | None = None
    """Weight of the mean squared difference from the initial value."""
    laplacian_weight: Positive | None = None
    """Weight of the mean squared distance between each vertex and the mean of its neighbours."""
    regularizer: ImportPath | None = None
    """Function of the values that is added to the loss, as module:function."""
    shape: Annotated[list[Count], Field(min_length=1, max_length=8)] | None = None
    """Shape of a parameter that is not part of the scene. Scene parameters are derived from it."""

    @property
    def displacement(self) -> Displacement:
        """Initial displacement of a pose relative to the scene. It is empty if the job gives no displacement."""
        return self.initial if isinstance(self.initial, Displacement) else Displacement()

    @model_validator(mode="after")
    def _of_one_kind(self) -> Parameter:
        posed = {"pivot", "error_scale", "rotation_learning_rate"} & self.model_fields_set
        if self.pose is None:
            if isinstance(self.initial, Displacement):
                posed.add("initial")
            if posed:
                self._refuse(f"'{min(posed)}' applies to a pose only; add pose = 'translation', 'rotation' or 'rigid'")
            return self
        if plain := NOT_OF_A_POSE & self.model_fields_set:
            self._refuse(f"'{min(plain)}' does not apply to a pose; remove it, or set 'initial' to displace the pose")
        if not isinstance(self.initial, Displacement | None):
            self._refuse("'initial' of a pose is a displacement; write { translation = [...], rotation = [...] }")
        parts = PARTS[self.pose]
        wrong = [f"initial.{part}" for part in sorted(self.displacement.model_fields_set) if part not in parts]
        if self.rotation_learning_rate is not None and "rotation" not in parts:
            wrong.append("rotation_learning_rate")
        if wrong:
            self._refuse(f"'{wrong[0]}' is not part of pose = '{self.pose}'; set pose = 'rigid', or remove it")
        return self

    @model_validator(mode="after")
    def _in_order(self) -> Parameter:
        if self.large_steps_lambda is not None and not (self.lower is None and self.upper is None):
            self._refuse(
                "'large_steps_lambda' excludes 'lower' and 'upper', because clamped vertices tear the mesh; remove them"
            )
        if self.large_steps_lambda is not None and self.parameterization is not None:
            self._refuse(
                "'large_steps_lambda' and 'parameterization' exclude each other: both define the coordinates of the "
                "steps; remove one"
            )
        sizes, begins = self.resolutions or [], self.refine_at or []
        # If refine_at is missing, `Config.completed_entry` may derive it from the stages of the job.
        if self.refine_at is not None and len(begins) != max(0, len(sizes) - 1):
            self._refuse_count()
        if sorted(set(begins)) != begins:
            self._refuse(f"refine_at {begins} is not increasing; sort it and remove duplicates")
        if self.parameterization == "log" and self.lower is not None and self.lower < 0:
            self._refuse(
                f"parameterization = 'log' only represents values above 0, but lower = {self.lower:g}; use 'softplus'"
            )
        if self.parameterization == "logit" and (self.lower is None) != (self.upper is None):
            self._refuse(
                "parameterization = 'logit' needs two bounds; give both 'lower' and 'upper', or neither (0 and 1)"
            )
        if self.lower is not None and self.upper is not None and self.upper <= self.lower:
            bounds = f"upper bound {self.upper:g} is not above lower bound {self.lower:g}"
            self._refuse(f"{bounds}; swap them or widen the range")
        return self

    def _refuse_count(self) -> None:
        self._refuse(
            f"{len(self.resolutions or [])} resolutions and {len(self.refine_at or [])} entries in refine_at; give one "
            "iteration for each resolution after the first"
        )

    def _refuse(self, why: str) -> None:
        raise ValueError(f"parameter '{self.key}': {why}")


class Displace(Table):
    """Displacement of the vertices of a mesh by height maps."""

    direction: Literal["normal"] | Vector = "normal"
    """Direction of positive heights: the normal at each vertex of the mesh in the scene, or a vector."""
    coordinates: Literal["uv", "xy", "xz", "yx", "yz", "zx", "zy"] = "uv"
    """Coordinates of a vertex on the height maps: its texture coordinates, or two axes of the scene. With two axes, the
    maps cover the bounding box of the mesh."""
    interpolation: Literal["linear", "cubic"] = "linear"
    """Interpolation of the height maps: linear, or by cubic B-splines, whose slopes and curvatures are continuous."""
    weights: str | Annotated[list[str], Field(min_length=1)] | None = None
    """Attribute of the mesh, such as 'vertex_weight', that contains one number per vertex. The height at each vertex is
    multiplied by this number. With several height maps, a list of one attribute per map. Default: 1 everywhere."""


class Derivation(Table):
    """A scene parameter, or several that match a glob, computed from other parameters."""

    key: str
    """Scene parameter that is computed, or a glob."""
    function: ImportPath | None = None
    """Function as module:function; its arguments are the value in the scene and the parameters in 'of'."""
    displace: Displace | None = None
    """Displacement of the vertex_positions of a mesh by the height maps in 'of', in place of a function."""
    of: Annotated[list[str], Field(min_length=1)]
    """Parameters of the job, in the order of the function's arguments."""

    @model_validator(mode="after")
    def _of_one_kind(self) -> Derivation:
        if (self.function is None) == (self.displace is None):
            given = "neither 'function' nor 'displace'" if self.function is None else "both 'function' and 'displace'"
            raise ValueError(f"derived '{self.key}': it has {given}; give one of them")
        if self.displace is not None:
            weights = self.displace.weights
            maps = len(weights) if isinstance(weights, list) else 1
            if len(self.of) != maps:
                raise ValueError(
                    f"derived '{self.key}': 'of' names {len(self.of)} height maps, but displace.weights names {maps} "
                    "attributes; give a list in 'weights' that has one attribute for each map"
                )
        return self
