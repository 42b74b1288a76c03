"""Hostile scenes: XML that is none, plugins and values that do not fit, names with every special character."""

from __future__ import annotations

from collections.abc import Callable
from xml.sax.saxutils import quoteattr

import numpy as np

from .assets import SCENE
from .case import CHECK, OPTIMIZE, Action, add, recipe
from .room import ODD_FILES, Room
from .values import pick, spoiled

KIND = "scene"
EITHER = (CHECK, OPTIMIZE)


def _either(rng: np.random.Generator) -> Action:
    return Action(argv=pick(rng, EITHER))


@recipe(KIND, fuzz=True)
def spoiled_bytes(room: Room, rng: np.random.Generator) -> Action:
    room.write("ball.xml", spoiled(SCENE.encode(), rng))
    return _either(rng)


NUMBERS = ("nan", "inf", "-1", "0", "1e400", "1e38", "-1e38", "abc", "", "99999999999", "1e-40", "$none", "true")


@recipe(KIND, fuzz=True)
def a_hostile_number_somewhere(room: Room, rng: np.random.Generator) -> Action:
    old = pick(
        rng, ('value="45"', 'value="$res"', 'value="6"', 'value="4"', 'value="1"', '"0,0,4"', '"0,1,0"', '"0,0,0"')
    )
    number = pick(rng, NUMBERS)
    name = old.split('"')[0]
    room.edit("ball.xml", old, f'{name}"{number}"' if name else f'"{number},{number},{number}"')
    return _either(rng)


@recipe(KIND, fuzz=True)
def a_plugin_of_another_type(room: Room, rng: np.random.Generator) -> Action:
    types = ("perspective", "hdrfilm", "box", "independent", "diffuse", "bitmap", "sphere", "ply", "obj", "constant")
    others = (
        *types,
        "pathreplay",
        "pathreplay_particles",
        "dielectric_ad",
        "gridmedium",
        "merge",
        "",
        "../x",
        "nothing",
        "path",
        "aov",
    )
    room.edit("ball.xml", f'type="{pick(rng, types)}"', f'type="{pick(rng, others)}"')
    return _either(rng)


def _edited(name: str, old: str, new: str, *, refused: bool = True) -> None:
    for words in EITHER:

        def spoil(room: Room, rng: np.random.Generator, argv: tuple[str, ...] = words) -> Action:
            room.edit("ball.xml", old, new)
            return Action(argv=argv)

        add(KIND, f"{name} ({words[0]})", spoil, refused=refused)


_edited("a film of zero", 'value="$res"', 'value="0"')
_edited("a film too wide", 'value="$res"', 'value="1000000000"')
_edited("no sensor", 'type="perspective" id="eye"', 'type="nothing"')
_edited("a field of view of zero", 'value="45"', 'value="0"')
_edited("a field of view of 180", 'value="45"', 'value="180"', refused=False)
_edited("a camera that looks at itself", 'origin="0,0,4"', 'origin="0,0,0"', refused=False)
_edited("a camera with its head along the view", 'up="0,1,0"', 'up="0,0,1"', refused=False)
_edited("a NaN in the camera", 'origin="0,0,4"', 'origin="nan,0,4"')
_edited("a light that is NaN", '<rgb name="radiance" value="1"/>', '<rgb name="radiance" value="nan"/>')
_edited("a light of 1e38", '<rgb name="radiance" value="1"/>', '<rgb name="radiance" value="1e38"/>', refused=False)
_edited("a negative light", '<rgb name="radiance" value="1"/>', '<rgb name="radiance" value="-1"/>', refused=False)
_edited("a cycle of references", '<ref id="paint"/></shape>', '<ref id="ball"/></shape>')
_edited("a reference to nothing", '<ref id="paint"/></shape>', '<ref id="point"/></shape>')
_edited("a texture that is not there", "texture.png", "no-texture.png")
_edited("a mesh that is not there", "sheet.ply", "no-sheet.ply")
_edited("a texture with a name of 5000", "texture.png", "t" * 5000)
_edited("a texture with a control character", "texture.png", "a&#9;&#10;b.png")
_edited("a version that is none", 'version="3.0.0"', 'version="many"')
_edited("a version of the future", 'version="3.0.0"', 'version="99.0.0"', refused=False)
_edited("a version of the past", 'version="3.0.0"', 'version="0.1.0"', refused=False)
_edited("too many samples", 'value="4"', 'value="4000000000"', refused=False)
_edited("an unknown option", '<ref id="paint"/></shape>', '<ref id="paint"/><float name="wings" value="2"/></shape>')

FILES: dict[str, Callable[[], bytes]] = {
    "empty": lambda: b"",
    "only a declaration": lambda: b'<?xml version="1.0"?>',
    "no scene but a BSDF": lambda: b'<bsdf version="3.0.0" type="diffuse"/>',
    "no scene but an integrator": lambda: b'<integrator version="3.0.0" type="pathreplay"/>',
    "an unknown root": lambda: b'<kitchen version="3.0.0"/>',
    "an empty scene": lambda: b'<scene version="3.0.0"/>',
    "HTML": lambda: b"<!DOCTYPE html><html><body><p>No scene</html>",
    "nested 50 000 deep": lambda: b'<scene version="3.0.0">' + b"<a>" * 50_000,
    "nested 50 000 deep, well": lambda: (
        b'<scene version="3.0.0">' + b'<bsdf type="twosided">' * 50_000 + b"</bsdf>" * 50_000 + b"</scene>"
    ),
    "twosided 300 deep": lambda: SCENE.encode().replace(
        b"</scene>", b'<bsdf type="twosided">' * 300 + b"</bsdf>" * 300 + b"</scene>"
    ),
    "a billion laughs": lambda: (
        b'<!DOCTYPE s [<!ENTITY a "ha">'
        + b"".join(f'<!ENTITY {chr(98 + i)} "{f"&{chr(97 + i)};" * 10}">'.encode() for i in range(10))
        + b']><scene version="3.0.0"><string name="x" value="&j;"/></scene>'
    ),
    "an entity from a file": lambda: (
        b'<!DOCTYPE s [<!ENTITY f SYSTEM "/etc/passwd">]><scene version="3.0.0"><string name="f" value="&f;"/></scene>'
    ),
    "includes itself": lambda: b'<scene version="3.0.0"><include filename="ball.xml"/></scene>',
    "includes a folder": lambda: b'<scene version="3.0.0"><include filename="."/></scene>',
    "includes what is not there": lambda: b'<scene version="3.0.0"><include filename="no.xml"/></scene>',
    "includes a device": lambda: b'<scene version="3.0.0"><include filename="/dev/zero"/></scene>',
    "an alias of nothing": lambda: b'<scene version="3.0.0"><alias id="a" as="b"/></scene>',
    "UTF-16": lambda: SCENE.encode("utf-16"),
    "bytes that are not UTF-8": lambda: SCENE.replace("clay", "\xff\xfe").encode("latin-1"),
    "NUL": lambda: SCENE.replace("clay", "cl\x00ay").encode(),
    "the same name twice": lambda: SCENE.replace('id="clay"', 'id="paint"').encode(),
    "a default with an endless loop": lambda: SCENE.replace('name="res" value="8"', 'name="res" value="$res"').encode(),
    "an attribute of 1 MB": lambda: SCENE.replace('id="clay"', 'id="' + "c" * 10**6 + '"').encode(),
    "a comment without end": lambda: SCENE.replace("</scene>", "<!-- ").encode(),
    "text between the tags": lambda: SCENE.replace("</scene>", "some words</scene>").encode(),
}
#: These may well be loaded; the others describe no scene that has the job's parameter.
FINE = {"twosided 300 deep", "UTF-16", "bytes that are not UTF-8", "a comment without end", "text between the tags"}
FINE |= {"NUL", "an attribute of 1 MB"}
for _name, _data in FILES.items():

    def _file(room: Room, rng: np.random.Generator, data: Callable[[], bytes] = _data) -> Action:
        room.write("ball.xml", data())
        return _either(rng)

    add(KIND, _name, _file, refused=_name not in FINE)

for _odd in ODD_FILES:
    for _file_name in ("ball.xml", "texture.png", "sheet.ply"):

        def _odd_file(room: Room, rng: np.random.Generator, odd: str = _odd, name: str = _file_name) -> Action:
            room.odd_file(name, odd)
            return _either(rng)

        add(KIND, f"{_file_name} is {_odd}", _odd_file, refused=True)


# ------------------------------------------------------------------------------
#  Names
# ------------------------------------------------------------------------------

NAMES = (
    "wall (1)",
    "a+b*c?",
    "[abc]",
    "{0}",
    "^$|\\",
    "../../outside/evil",
    "/outside",
    "con",
    "n" * 300,
    "ä ö ü 🙂",
    " ",
    "a.b.c",
    "%s",
    "'\"<>&",
    "paint.reflectance",
    "value:first",
    "-rf",
    "*",
    "eye",
)
for _name in NAMES:

    def _named(room: Room, rng: np.random.Generator, name: str = _name) -> None:
        xml = quoteattr(name)
        room.edit("ball.xml", 'id="paint"', f"id={xml}")
        while '<ref id="paint"/>' in (room / "ball.xml").read_text():
            room.edit("ball.xml", '<ref id="paint"/>', f"<ref id={xml}/>")
        room.change("parameters.0.key", "*.reflectance.data")

    add(KIND, f"a material named {_name[:20]!r}", _named)


@recipe(KIND)
def sensors_with_hostile_names(room: Room, rng: np.random.Generator) -> None:
    room.edit("ball.xml", 'id="eye"', f"id={quoteattr(pick(rng, NAMES))}")


@recipe(KIND)
def two_sensors_of_one_name(room: Room, rng: np.random.Generator) -> None:
    sensor = SCENE.split("<bsdf")[0].split("/>", 1)[1]
    room.into_scene(sensor)
    room.change("target.images", ["target.exr", "target.exr"])


# ------------------------------------------------------------------------------
#  Things in the scene
# ------------------------------------------------------------------------------

WIDE = '<integer name="width" value="8"/><integer name="height" value="6"/>'
PAINTED = '<shape type="sphere"><bsdf type="{bsdf}">{inner}</bsdf></shape>'
PIECES = {
    "a singular transform": '<shape type="sphere"><transform name="to_world"><scale value="0"/></transform></shape>',
    "a transform of NaN": '<shape type="sphere"><transform name="to_world"><scale value="nan"/></transform></shape>',
    "a sphere of radius zero": '<shape type="sphere"><float name="radius" value="0"/></shape>',
    "a sphere of negative radius": '<shape type="sphere"><float name="radius" value="-1"/></shape>',
    "a sphere of 1e38": '<shape type="sphere"><float name="radius" value="1e38"/></shape>',
    "an instance of nothing": '<shape type="instance"/>',
    "a shapegroup of nothing": '<shape type="shapegroup" id="g"/><shape type="instance"><ref id="g"/></shape>',
    "a shapegroup in a shapegroup": (
        '<shape type="shapegroup" id="g"><shape type="shapegroup"><shape type="sphere"/></shape></shape>'
    ),
    "a crop window outside": (
        f'<sensor type="perspective"><film type="hdrfilm">{WIDE}<integer name="crop_offset_x" value="100"/>'
        '<integer name="crop_width" value="5"/><integer name="crop_height" value="5"/></film></sensor>'
    ),
    "near behind far": (
        '<sensor type="perspective"><float name="near_clip" value="9"/><float name="far_clip" value="1"/></sensor>'
    ),
    "an environment of nothing": '<emitter type="envmap"/>',
    "two environments": '<emitter type="constant"/>',
    "an environment that is a PLY": '<emitter type="envmap"><string name="filename" value="sheet.ply"/></emitter>',
    "a spectrum that is malformed": (
        '<shape type="sphere"><bsdf type="diffuse"><spectrum name="reflectance" value="400:1, x"/></bsdf></shape>'
    ),
    "a colour of four": PAINTED.format(bsdf="diffuse", inner='<rgb name="reflectance" value="1,2,3,4"/>'),
    "a colour of NaN": '<shape type="sphere"><bsdf type="diffuse"><rgb name="reflectance" value="nan"/></bsdf></shape>',
    "roughness of -1": PAINTED.format(bsdf="roughconductor", inner='<float name="alpha" value="-1"/>'),
    "an unknown metal": PAINTED.format(bsdf="conductor", inner='<string name="material" value="Xx"/>'),
    "an index of zero": '<shape type="sphere"><bsdf type="dielectric"><float name="int_ior" value="0"/></bsdf></shape>',
    "our glass with an index of NaN": (
        '<shape type="sphere"><bsdf type="dielectric_ad"><float name="int_ior" value="nan"/></bsdf></shape>'
    ),
    "our glass with a name for an index": (
        '<shape type="sphere"><bsdf type="dielectric_ad"><string name="int_ior" value="cheese"/></bsdf></shape>'
    ),
    "our medium with a density below zero": (
        '<shape type="sphere"><bsdf type="null"/><medium type="gridmedium" name="interior">'
        '<float name="sigma_t" value="-1"/></medium></shape>'
    ),
    "our medium with a scale of NaN": (
        '<shape type="sphere"><bsdf type="null"/><medium type="gridmedium" name="interior">'
        '<float name="scale" value="nan"/></medium></shape>'
    ),
    "a homogeneous medium below zero": (
        '<shape type="sphere"><bsdf type="null"/><medium type="homogeneous" name="interior">'
        '<float name="sigma_t" value="-5"/></medium></shape>'
    ),
    "our integrator with too deep a sweep": (
        '<integrator type="pathreplay"><integer name="max_depth" value="99999999"/>'
        '<string name="adjoint" value="recorded"/></integrator>'
    ),
    "our integrator of no depth": '<integrator type="pathreplay"><integer name="max_depth" value="-7"/></integrator>',
    "our integrator of a text": '<integrator type="pathreplay"><string name="max_depth" value="6"/></integrator>',
    "our integrator of a fraction": '<integrator type="pathreplay"><float name="max_depth" value="1.5"/></integrator>',
    "two integrators": '<integrator type="path"/><integrator type="prb"/>',
    "a number without a name": '<float value="3"/>',
    "a python expression": '<float name="x" value="__import__(\'os\')"/>',
    "a thousand lights for light paths": '<integrator type="pathreplay_particles"/>' + '<emitter type="point"/>' * 1000,
    "light paths without a light": '<integrator type="pathreplay_particles"/>',
    "a thousand lights": '<emitter type="point"/>' * 1000,
}
for _name, _xml in PIECES.items():

    def _piece(room: Room, rng: np.random.Generator, xml: str = _xml) -> Action:
        room.into_scene(xml)
        return _either(rng)

    add(KIND, _name, _piece)


@recipe(KIND)
def no_shapes(room: Room, rng: np.random.Generator) -> Action:
    head, _ = SCENE.split('<bsdf type="diffuse" id="paint">')
    room.write("ball.xml", head + '<emitter type="constant" id="sky"/></scene>')
    room.change("parameters.0", {"key": "sky.radiance.value", "initial": 0.4})
    return Action(argv=pick(rng, (OPTIMIZE, ("check", "ball.xml", "--param", "*", "--seeds", "2", "--spp", "1"))))


@recipe(KIND)
def no_lights(room: Room, rng: np.random.Generator) -> Action:
    room.write("ball.xml", SCENE.split("<emitter")[0] + "</scene>")
    return _either(rng)
