"""Text of the files of a job: the scene, and the job itself with comments for whoever edits it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from xml.sax.saxutils import quoteattr

from pathreplay.jobs.photographs.plan import EVAL_SPP, StagePlan
from pathreplay.jobs.photographs.region import Box

DENSITY, RADIANCE, SKY = "box.interior_medium.sigma_t.data", "box.interior_medium.radiance.data", "sky.data"


@dataclass(frozen=True)
class Choices:
    """Choices about a job: whether it recovers a sky and refines poses, near clipping distance, and bounds."""

    has_sky: bool
    refine_poses: bool
    near_clip: float
    brightest: float
    """Upper bound of the radiance."""
    densest: float
    """Upper bound of the density."""


def field_scene(box: Box, has_sky: bool) -> str:
    """Return the scene of a density grid that emits light: a box with a medium, and a sky if there is one."""
    low, size = box.low, box.size.tolist()
    half, middle = [s / 2 for s in size], box.centre.tolist()

    def grid(name: str, file: str) -> str:
        return (
            f'      <volume type="gridvolume" name="{name}">\n'
            f'        <string name="filename" value="{file}"/>\n'
            '        <boolean name="raw" value="true"/>\n'
            '        <transform name="to_world">\n'
            f"          <scale {_xyz(size)}/>\n"
            f"          <translate {_xyz(low)}/>\n"
            "        </transform>\n"
            "      </volume>\n"
        )

    return (
        "<!-- A medium that absorbs and emits light, in the region that the cameras see. -->\n"
        '<scene version="3.0.0">\n'
        '  <integrator type="pathreplay">\n'
        '    <integer name="max_depth" value="1"/>\n'
        '    <boolean name="null_branching" value="false"/>\n'
        "  </integrator>\n"
        '  <shape type="cube" id="box">\n'
        '    <transform name="to_world">\n'
        f"      <scale {_xyz(half)}/>\n"
        f"      <translate {_xyz(middle)}/>\n"
        "    </transform>\n"
        '    <bsdf type="null"/>\n'
        '    <medium type="gridmedium" name="interior" id="field">\n'
        '      <float name="albedo" value="0"/>\n'
        + grid("sigma_t", "start/density.vol")
        + grid("radiance", "start/radiance.vol")
        + "    </medium>\n"
        "  </shape>\n" + (_sky() if has_sky else "") + "</scene>\n"
    )


def mesh_scene(file: str, kind: str, texture: bool) -> str:
    """Return the scene of a given mesh with a recovered reflectance, under a recovered sky.

    The reflectance is a bitmap if ``texture`` is True, and a colour per vertex otherwise.
    """
    reflectance = (
        '      <texture type="bitmap" name="reflectance">\n'
        '        <string name="filename" value="start/texture.exr"/>\n'
        '        <boolean name="raw" value="true"/>\n'
        "      </texture>\n"
        if texture
        else '      <texture type="mesh_attribute" name="reflectance">\n'
        '        <string name="name" value="vertex_color"/>\n'
        "      </texture>\n"
    )
    return (
        "<!-- A given mesh with a reflectance, under a sky. -->\n"
        '<scene version="3.0.0">\n'
        '  <integrator type="pathreplay">\n'
        '    <integer name="max_depth" value="3"/>\n'
        "  </integrator>\n"
        f'  <shape type="{kind}" id="mesh">\n'
        f'    <string name="filename" value={quoteattr(file)}/>\n'
        '    <bsdf type="twosided">\n'
        '    <bsdf type="diffuse">\n' + reflectance + "    </bsdf>\n    </bsdf>\n  </shape>\n" + _sky() + "</scene>\n"
    )


def _sky() -> str:
    return '  <emitter type="envmap" id="sky">\n    <string name="filename" value="start/sky.exr"/>\n  </emitter>\n'


def _xyz(values: Iterable[float]) -> str:
    return " ".join(f'{axis}="{value:.9g}"' for axis, value in zip("xyz", values, strict=True))


def job_text(
    source: str, job: str, stages: Sequence[StagePlan], choices: Choices, test_every: int, mesh_key: str | None = None
) -> str:
    """Return the text of a job, whose path is ``job``.

    ``mesh_key`` is the key of a given mesh's reflectance, or None for a density grid.
    """
    tables = [_head(source, job, choices.near_clip, test_every, mesh_key is None), _EXPOSURE]
    tables += _field(stages, choices) if mesh_key is None else [_colour(mesh_key)]
    if choices.has_sky:
        tables.append(_SKY)
    tables.append(_commented(_RESPONSE))
    tables.append(_POSES if choices.refine_poses else _commented(_POSES))
    for stage in stages:
        text = f"[[stages]]\niterations = {stage.iterations}\ndownscale = {stage.downscale}\n"
        text += f"view_batch_size = {stage.views}\nspp = {stage.spp}\n"
        if names := _moving(stage.first, choices, mesh_key):
            text += f"parameters = [{', '.join(f'{name!r}' for name in names)}]\n".replace("'", '"')
        tables.append(text)
    return "\n".join(tables)


def _moving(first: bool, choices: Choices, mesh_key: str | None) -> list[str]:
    """Return the parameters that a stage optimises, or an empty list for all parameters.

    The ``first`` stage does not optimise exposures and poses.
    """
    if not first:
        return []
    return [*([DENSITY, RADIANCE] if mesh_key is None else [mesh_key]), *([SKY] if choices.has_sky else [])]


def _head(source: str, job: str, near_clip: float, test_every: int, in_medium: bool) -> str:
    medium = 'medium = "field"                     # cameras may be inside the box\n' if in_medium else ""
    return f"""\
# Recovers a scene from photographs. Written by: pathreplay from-photos {source}
# Edit it and run it again: pathreplay optimize {job}
# docs/do/photographs.md explains the choices, docs/optimize.md all keys.

scene = "scene.xml"
loss = "display-l2"                  # squared differences as a display shows them
eval_spp = {EVAL_SPP}
learning_rate = 0.02
final_learning_rate_ratio = 0.1

[capture]
transforms = "transforms.json"       # images without lens distortion, written by the command
{medium}near_clip = {near_clip:.4g}                    # no fog in front of the lens
test_every = {test_every}                       # test views are compared at the end
"""


_EXPOSURE = """\
[exposure]
white_balance = true                 # one factor per photo and colour; their geometric mean is 1
learning_rate = 0.01
"""


def _field(stages: Sequence[StagePlan], choices: Choices) -> list[str]:
    sizes = ", ".join(str(stage.resolution) for stage in stages)
    return [
        f"""\
[[parameters]]
key = "{DENSITY}"
parameterization = "log"
upper = {choices.densest:.3g}                         # opaque; denser voxels only cost time
resolutions = [{sizes}]
learning_rate = 0.1
""",
        f"""\
[[parameters]]
key = "{RADIANCE}"
parameterization = "logit"           # between the bounds, so that no voxel becomes a light
lower = 0.0
upper = {choices.brightest:.3g}
resolutions = [{sizes}]
learning_rate = 0.1
total_variation = 0.01               # smoother surfaces
""",
    ]


def _colour(key: str) -> str:
    return f"""\
[[parameters]]
key = "{key}"
lower = 0.0
upper = 1.0
"""


_SKY = f"""\
[[parameters]]
key = "{SKY}"
parameterization = "log"
pyramid = true
learning_rate = 0.01
"""

_POSES = """\
[[parameters]]
key = "view_*.to_world"              # the poses of the photographs
pose = "rigid"
learning_rate = 0.001                # scene units
rotation_learning_rate = 0.02        # degrees
"""


_RESPONSE = """\
[response]                           # a response of the camera other than sRGB
kind = "curve"
fix_exponent = true
learning_rate = 0.02
"""


def _commented(text: str) -> str:
    return "".join(f"# {line}\n" for line in text.splitlines())
