"""Scenes as people have them, each a function that writes its files into a folder and tells what to recover in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ordinary_files import (
    patch,
    waves,
    write_by_mitsuba,
    write_environment,
    write_obj,
    write_ply,
    write_png,
    write_serialized,
)
from pathreplay.scenes.volume_files import save_vol


@dataclass(frozen=True)
class Use:
    """What somebody does with a scene: check a parameter, then recover it from ``truth``, starting at ``start``."""

    xml: str
    key: str
    truth: Any
    start: Any
    variant: str = "llvm_ad_rgb"
    options: tuple[str, ...] = ("--seeds", "4", "--spp", "32")
    """For `check`, besides the key and the variant."""
    target: str = "path"
    """The integrator that renders the targets."""
    rate: float = 0.05
    """The learning rate: about a quarter of the way from start to truth."""
    views: tuple[tuple[int, int], ...] = ((12, 8),)
    """Width and height of the picture of each sensor."""


Write = Callable[[Path], Use]

CAMERA = """<transform name="to_world"><lookat origin="{origin}" target="0, 0, 0" up="0, 1, 0"/></transform>
  <float name="fov" value="45"/>"""


def film(width: int = 12, height: int = 8, more: str = "") -> str:
    """A small film as most scenes have it."""
    return f"""<film type="hdrfilm"><integer name="width" value="{width}"/><integer name="height" value="{height}"/>
      <string name="pixel_format" value="rgb"/><rfilter type="box"/>{more}</film>
    <sampler type="independent"><integer name="sample_count" value="8"/></sampler>"""


def camera(more: str = "", *, name: str = "camera", origin: str = "0, 0, 4") -> str:
    """A perspective camera that looks at the origin."""
    return f'<sensor type="perspective" id="{name}">{CAMERA.format(origin=origin)}{more or film()}</sensor>'


LAMP = """<shape type="rectangle" id="lamp"><transform name="to_world"><rotate x="1" angle="90"/>
  <translate y="2"/></transform><emitter type="area"><rgb name="radiance" value="6, 5, 4"/></emitter></shape>"""

SKY = '<emitter type="constant" id="World"><rgb name="radiance" value="0.8"/></emitter>'


def scene(*parts: str) -> str:
    """A scene file around its parts."""
    body = "\n".join(f"  {part}" for part in parts)
    return (
        f'<scene version="3.0.0">\n  <integrator type="path"><integer name="max_depth" value="4"/></integrator>\n'
        f"{body}\n</scene>\n"
    )


def from_blender(folder: Path) -> Use:
    """As its exporter writes: names with spaces, brackets, dots and umlauts; twosided with a BSDF within; plain PLY."""
    (folder / "meshes").mkdir()
    write_ply(folder / "meshes" / "Würfel.001.ply", patch())
    write_ply(folder / "meshes" / "Wall (1).ply", patch(2))
    xml = scene(
        camera(name="Camera.001"),
        '<bsdf type="twosided" id="wall (1)"><bsdf type="diffuse" id="wall (1).inner">'
        '<rgb name="reflectance" value="0.7, 0.2, 0.1"/></bsdf></bsdf>',
        '<bsdf type="twosided" id="Grüner Lack [2]+*"><bsdf type="diffuse"><rgb name="reflectance" value="0.2"/></bsdf>'
        "</bsdf>",
        '<shape type="ply" id="elm__Würfel.001"><string name="filename" value="meshes/Würfel.001.ply"/>'
        '<ref id="wall (1)" name="bsdf"/></shape>',
        '<shape type="ply" id="elm__Wall (1)"><string name="filename" value="meshes/Wall (1).ply"/>'
        '<transform name="to_world"><scale value="3"/><translate z="-1"/></transform>'
        '<ref id="Grüner Lack [2]+*"/></shape>',
        SKY,
    )
    return Use(xml, "*wall (1)*.reflectance.value", truth=[0.7, 0.2, 0.1], start=0.5)


def obj_with_everything(folder: Path) -> Use:
    """An OBJ with normals and texture coordinates, an 8-bit texture, a lamp, and a material by nested references."""
    write_obj(folder / "patch.obj", patch(), normals=True, coordinates=True)
    write_png(folder / "paint.png", waves(4, 6))
    xml = scene(
        camera(),
        '<texture type="bitmap" id="picture"><string name="filename" value="paint.png"/>'
        '<string name="format" value="variant"/></texture>',
        '<bsdf type="diffuse" id="painted"><ref name="reflectance" id="picture"/></bsdf>',
        '<bsdf type="twosided" id="both"><ref id="painted"/></bsdf>',
        '<shape type="obj" id="patch"><string name="filename" value="patch.obj"/><ref id="both"/></shape>',
        LAMP,
        SKY,
    )
    # The first object that holds the texture gives it its name.
    return Use(xml, "*.data", truth=0.8, start=0.3)


def plain_obj(folder: Path) -> Use:
    """An OBJ without normals and texture coordinates, flat faces, and a 16-bit picture on a wall behind."""
    write_obj(folder / "patch.obj", patch(3))
    write_png(folder / "height.png", waves(4, 4), bits=16)
    xml = scene(
        camera(),
        '<shape type="obj" id="patch"><string name="filename" value="patch.obj"/>'
        '<boolean name="face_normals" value="true"/>'
        '<bsdf type="diffuse" id="clay"><rgb name="reflectance" value="0.6, 0.4, 0.3"/></bsdf></shape>',
        '<shape type="rectangle" id="wall"><transform name="to_world"><scale value="3"/><translate z="-1"/></transform>'
        '<bsdf type="diffuse" id="wallpaper"><texture name="reflectance" type="bitmap">'
        '<string name="filename" value="height.png"/><boolean name="raw" value="true"/></texture></bsdf></shape>',
        LAMP,
        SKY,
    )
    return Use(xml, "patch.bsdf.reflectance.value", truth=[0.6, 0.4, 0.3], start=0.1)


def principled_ply(folder: Path) -> Use:
    """A PLY with normals and texture coordinates, as text, in a principled material."""
    write_ply(folder / "patch.ply", patch(), normals=True, coordinates=True, text=True)
    xml = scene(
        camera(),
        '<bsdf type="twosided" id="Principled"><bsdf type="principled" id="skin">'
        '<rgb name="base_color" value="0.8, 0.4, 0.2"/>'
        '<float name="roughness" value="0.6"/><float name="metallic" value="0.1"/><float name="specular" value="0.5"/>'
        "</bsdf></bsdf>",
        '<shape type="ply" id="patch"><string name="filename" value="patch.ply"/><ref id="Principled"/></shape>',
        SKY,
    )
    return Use(xml, "*.base_color.value", truth=[0.8, 0.4, 0.2], start=0.3)


def environment(folder: Path) -> Use:
    """A ball of metal and a table under an environment map, which is what is looked for."""
    write_environment(folder / "sky.exr")
    write_environment(folder / "start.exr", 4, 8)
    xml = scene(
        camera(),
        '<emitter type="envmap" id="sky"><string name="filename" value="sky.exr"/></emitter>',
        '<shape type="sphere" id="ball"><bsdf type="roughconductor"><string name="material" value="Al"/>'
        '<float name="alpha" value="0.3"/></bsdf></shape>',
    )
    return Use(xml, "sky.data", truth="sky.exr", start="start.exr")


def three_cameras(folder: Path) -> Use:
    """Three sensors: of different sizes, one with a crop window, one orthographic; their names are Blender's."""
    write_ply(folder / "patch.ply", patch(), coordinates=True)
    window = "".join(
        f'<integer name="crop_{name}" value="{value}"/>'
        for name, value in {"offset_x": 2, "offset_y": 1, "width": 7, "height": 5}.items()
    )
    xml = scene(
        camera(name="Camera"),
        camera(film(16, 12, window), name="Camera.001", origin="1, 1, 4"),
        '<sensor type="orthographic" id="Top view"><transform name="to_world">'
        f'<lookat origin="0, 0, 3" target="0, 0, 0" up="0, 1, 0"/></transform>{film(6, 6)}</sensor>',
        '<shape type="ply" id="patch"><string name="filename" value="patch.ply"/><bsdf type="plastic" id="toy">'
        '<rgb name="diffuse_reflectance" value="0.1, 0.3, 0.6"/></bsdf></shape>',
        SKY,
    )
    return Use(
        xml, "patch.bsdf.diffuse_reflectance.value", truth=[0.1, 0.3, 0.6], start=0.5,
        options=("--seeds", "4", "--spp", "32", "--sensor", "1"),
        views=((12, 8), (7, 5), (6, 6)),
    )  # fmt: skip


def spectral_room(folder: Path) -> Use:
    """Spectra by wavelength and colours by name, in a spectral variant."""
    write_ply(folder / "patch.ply", patch(3))
    xml = scene(
        camera(),
        '<shape type="ply" id="patch"><string name="filename" value="patch.ply"/><bsdf type="diffuse" id="leaf">'
        '<rgb name="reflectance" value="0.2, 0.6, 0.1"/></bsdf></shape>',
        '<shape type="rectangle" id="lamp"><transform name="to_world"><rotate x="1" angle="90"/><translate y="2"/>'
        '</transform><emitter type="area" id="tube"><spectrum name="radiance" value="400:2, 550:6, 700:4"/>'
        "</emitter></shape>",
        '<emitter type="constant" id="sky"><spectrum name="radiance" value="0.5"/></emitter>',
    )
    return Use(xml, "lamp.emitter.radiance.values", truth=5.0, start=1.0, variant="llvm_ad_spectral", rate=1.0)


def mono_room(folder: Path) -> Use:
    """A grey world with an 8-bit colour texture, in a mono variant."""
    write_obj(folder / "patch.obj", patch(3), coordinates=True)
    write_png(folder / "paint.png", waves(4, 4))
    xml = scene(
        camera(film().replace('value="rgb"', 'value="luminance"')),
        '<shape type="obj" id="patch"><string name="filename" value="patch.obj"/><bsdf type="diffuse" id="paint">'
        '<texture type="bitmap" name="reflectance"><string name="filename" value="paint.png"/>'
        '<string name="format" value="variant"/></texture></bsdf></shape>',
        SKY,
    )
    return Use(xml, "patch.bsdf.reflectance.data", truth=0.7, start=0.2, variant="llvm_ad_mono")


def forest(folder: Path) -> Use:
    """A group of shapes that stands in the scene three times; the film is as Mitsuba has it by default."""
    write_ply(folder / "patch.ply", patch(3))
    places = "".join(
        f'<shape type="instance"><ref id="tree"/><transform name="to_world"><scale value="0.5"/>'
        f'<translate x="{x}" y="{y}"/></transform></shape>'
        for x, y in ((-1, 0.5), (1, 0.5), (0, -0.7))
    )
    xml = scene(
        camera('<film type="hdrfilm"><integer name="width" value="12"/><integer name="height" value="8"/></film>'),
        '<bsdf type="diffuse" id="leaves"><rgb name="reflectance" value="0.3, 0.6, 0.2"/></bsdf>',
        '<shape type="shapegroup" id="tree"><shape type="ply"><string name="filename" value="patch.ply"/>'
        '<ref id="leaves"/></shape><shape type="sphere"><float name="radius" value="0.4"/><ref id="leaves"/></shape>'
        "</shape>",
        places,
        SKY,
    )
    return Use(xml, "*.reflectance.value", truth=[0.3, 0.6, 0.2], start=0.6)


def smoke(folder: Path) -> Use:
    """A volume from a file, scattering light in a cube without a surface of its own."""
    z, y, x = np.meshgrid(*3 * [np.linspace(0, 1, 4)], indexing="ij")
    save_vol(folder / "smoke.vol", (1.0 + np.sin(3 * x) * np.cos(2 * y + z))[..., None])
    xml = scene(
        camera(),
        '<shape type="cube" id="smoke"><bsdf type="null"/><medium type="heterogeneous" name="interior">'
        '<volume type="gridvolume" name="sigma_t"><string name="filename" value="smoke.vol"/>'
        '<transform name="to_world"><scale value="2"/><translate x="-1" y="-1" z="-1"/></transform></volume>'
        '<float name="albedo" value="0.8"/></medium></shape>',
        SKY,
        '<emitter type="directional" id="sun"><vector name="direction" x="0" y="-1" z="-1"/>'
        '<rgb name="irradiance" value="2"/></emitter>',
    ).replace('type="path"', 'type="volpath"')
    return Use(
        xml, "smoke.interior_medium.sigma_t.data", truth=2.5, start=0.3, target="volpath",
        options=("--seeds", "8", "--spp", "128", "--fd-spp", "512"),
    )  # fmt: skip


def from_mitsuba(folder: Path) -> Use:
    """A serialized mesh and a PLY by Mitsuba's own writer, smooth glass before a wall, a point light."""
    write_serialized(folder / "patch.serialized", patch())
    write_by_mitsuba(folder / "cube.ply")
    xml = scene(
        camera(),
        '<shape type="serialized" id="patch"><string name="filename" value="patch.serialized"/>'
        '<bsdf type="roughplastic" id="lacquer"><rgb name="diffuse_reflectance" value="0.5, 0.1, 0.1"/></bsdf></shape>',
        '<shape type="ply" id="box"><string name="filename" value="cube.ply"/><transform name="to_world">'
        '<scale value="0.3"/><translate x="0.8" y="0.5" z="0.8"/></transform><bsdf type="dielectric" id="glass"/>'
        "</shape>",
        '<emitter type="point" id="bulb"><point name="position" x="1" y="2" z="3"/>'
        '<rgb name="intensity" value="8"/></emitter>',
        SKY,
    )
    return Use(xml, "patch.bsdf.diffuse_reflectance.value", truth=[0.5, 0.1, 0.1], start=0.6)


SCENES: tuple[Write, ...] = (
    from_blender,
    obj_with_everything,
    plain_obj,
    principled_ply,
    environment,
    three_cameras,
    spectral_room,
    mono_room,
    forest,
    smoke,
    from_mitsuba,
)
