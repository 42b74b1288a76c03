"""Bad input to ``pathreplay optimize``: one line that names thing, value and remedy; status 2; nothing written."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pathreplay import cli

SCENE = """<scene version="3.0.0">
  <sensor type="perspective" id="eye">
    <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="6"/><integer name="height" value="4"/>
    <string name="pixel_format" value="rgb"/></film></sensor>
  <bsdf type="diffuse" id="paint"><texture type="bitmap" name="reflectance">
    <string name="filename" value="texture.exr"/><boolean name="raw" value="true"/></texture></bsdf>
  <bsdf type="plastic" id="gloss"/>
  <shape type="sphere" id="ball"><ref id="paint"/></shape>
  <shape type="sphere" id="bubble"><point name="center" x="3" y="0" z="0"/><ref id="gloss"/></shape>
  <emitter type="constant" id="sky"><rgb name="radiance" value="1"/></emitter>
</scene>"""

CONFIG = """scene = "ball.xml"
iterations = 1
spp = 1
eval_spp = 1
integrator = { type = "prb", max_depth = 3 }
parameters = [ { key = "paint.reflectance.data", lower = 0, upper = 1 } ]
target = { images = ["target.exr"] }
"""


@pytest.fixture
def room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a job that works."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ball.xml").write_text(SCENE)
    write_image(tmp_path / "texture.exr", np.full((2, 2, 3), 0.5))
    write_image(tmp_path / "target.exr", np.full((4, 6, 3), 0.5))
    (tmp_path / "job.toml").write_text(CONFIG)
    return tmp_path


def write_image(path: Path, pixels: np.ndarray) -> None:
    from pathreplay.inverse.images.io import exr_bytes

    path.write_bytes(exr_bytes(pixels.astype(np.float32)))


def command(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    """Exit status of the command line as the user would see it."""
    monkeypatch.setattr(sys, "argv", ["pathreplay", "optimize", *arguments])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return int(ended.value.code or 0)


def test_a_good_job_ends_with_0_and_says_where_the_report_is(
    room: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(monkeypatch, "job.toml", "--quiet") == 0
    assert "report: runs/job/report.html" in capsys.readouterr().out
    assert (room / "runs/job/report.html").is_file()


def replace(old: str, new: str) -> Callable[[Path], None]:
    def change(room: Path) -> None:
        text = (room / "job.toml").read_text()
        assert old in text
        (room / "job.toml").write_text(text.replace(old, new))

    return change


def spoil(file: str, value: float) -> Callable[[Path], None]:
    def change(room: Path) -> None:
        pixels = np.full((2, 2, 3) if file == "texture.exr" else (4, 6, 3), 0.5)
        pixels[1, 0, 2] = value
        write_image(room / file, pixels)

    return change


def small_target(room: Path) -> None:
    write_image(room / "target.exr", np.full((3, 5, 3), 0.5))


def pipe(file: str) -> Callable[[Path], None]:
    def change(room: Path) -> None:
        (room / file).unlink()
        os.mkfifo(room / file)

    return change


def film(width: int, height: int) -> Callable[[Path], None]:
    def change(room: Path) -> None:
        text = SCENE.replace('name="width" value="6"', f'name="width" value="{width}"')
        (room / "ball.xml").write_text(text.replace('name="height" value="4"', f'name="height" value="{height}"'))

    return change


def bright_target(room: Path) -> None:
    write_image(room / "target.exr", np.full((4, 6, 3), 3e38))


def without_shapes(room: Path) -> None:
    (room / "ball.xml").write_text(re.sub("<shape.*</shape>", "", SCENE))


def posed(options: str) -> Callable[[Path], None]:
    def change(room: Path) -> None:
        replace(f"{KEY}, lower = 0, upper = 1", f'"eye.to_world", pose = "rigid", {options}')(room)
        replace('"prb"', '"pathreplay"')(room)

    return change


def huge_config(room: Path) -> None:
    with (room / "job.toml").open("wb") as file:
        file.truncate(5 * 10**9)  # sparse: takes no space


IMAGES = '{ images = ["target.exr"] }'
KEY = '"paint.reflectance.data"'
BAD: dict[str, tuple[Callable[[Path], None], list[str]]] = {
    "key does not exist": (replace(KEY, '"paint.reflectance.dat"'), ["reflectance.dat'", "paint.reflectance.data"]),
    "glob matches nothing": (replace(KEY, '"pant.*.data"'), ["pant.*.data"]),
    "key without derivative": (replace(KEY, '"gloss.eta"'), ["gloss.eta", "no replacement"]),
    "a matrix": (replace(KEY, '"ball.to_world"'), ["ball.to_world", "pose"]),
    "a camera with prb": (replace(KEY, '"eye.to_world"'), ["eye.to_world", "only 'pathreplay'"]),
    "key named twice": (
        replace(f"[ {{ key = {KEY}", f'[ {{ key = "paint.*.data" }}, {{ key = {KEY}'),
        ["named twice", "paint.*.data"],
    ),
    "missing target": (replace("target.exr", "targt.exr"), ["targt.exr", "does not exist"]),
    "target is no image": (replace("target.exr", "ball.xml"), ["ball.xml", "has an unsupported format"]),
    "wrong-sized target": (small_target, ["target.exr", "5 x 3", "6 x 4"]),
    "too many targets": (replace('["target.exr"]', '["target.exr", "target.exr"]'), ["2 target images for 1 sensors"]),
    "NaN in the target": (spoil("target.exr", np.nan), ["target.exr", "NaN", "(1, 0, 2)"]),
    "infinity in the target": (spoil("target.exr", np.inf), ["target.exr", "inf", "(1, 0, 2)"]),
    "NaN in the scene": (spoil("texture.exr", np.nan), ["paint.reflectance.data", "nan", "(1, 0, 2)"]),
    "infinity in the scene": (spoil("texture.exr", np.inf), ["paint.reflectance.data", "inf", "(1, 0, 2)"]),
    "upper below lower": (replace("upper = 1", "upper = -1"), ["paint.reflectance.data", "-1", "lower bound 0"]),
    "start beyond a bound": (replace("upper = 1", "upper = 0.25"), ["starts at 0.5", "upper bound 0.25"]),
    "zero spp": (replace("spp = 1\ne", "spp = 0\ne"), ["'spp' is 0", "job.toml"]),
    "no iterations": (replace("iterations = 1", "iterations = 0"), ["'iterations' is 0", "job.toml"]),
    "unknown config key": (replace("spp = 1\ne", "ssp = 1\ne"), ["job.toml", "'ssp'", "'spp'"]),
    "not TOML": (replace("spp = 1\ne", "spp = \ne"), ["job.toml", "not valid TOML"]),
    "unknown variant": (replace("spp = 1\ne", 'variant = "llvm_ad_rbg"\ne'), ["llvm_ad_rbg", "llvm_ad_rgb"]),
    "variant without derivatives": (
        replace("spp = 1\ne", 'variant = "scalar_rgb"\ne'),
        ["scalar_rgb", "no derivatives"],
    ),
    "unknown loss": (replace("spp = 1\ne", 'loss = "l3"\ne'), ["l3", "l2"]),
    "unknown scene": (replace("ball.xml", "bal.xml"), ["bal.xml", "ball.xml"]),
    "unknown integrator": (replace('"prb"', '"prbb"'), ["prbb"]),
    "unknown integrator option": (replace("max_depth", "max_dept"), ["max_dept"]),
    "integrator without gradients": (replace('"prb"', '"path"'), ["'path' computes no gradients", "pathreplay"]),
    "depth beyond the sweep": (
        replace('{ type = "prb", max_depth = 3 }', '{ type = "pathreplay", max_depth = 100000, adjoint = "recorded" }'),
        ["100000", "replay"],
    ),
    "unknown sensor": (replace("spp = 1\ne", 'sensors = ["ear"]\ne'), ["'ear'", "eye"]),
    "missing image of a value": (
        replace('{ images = ["target.exr"] }', '{ values = { "paint.reflectance.data" = "photo.jpg" } }'),
        ["photo.jpg", "does not exist"],
    ),
    # Sizes: told before anything of that size is made.
    "spp beyond 32 bits": (replace("spp = 1\ne", "spp = 200000000\ne"), ["'spp' is 200000000", "up to 178956970"]),
    "eval_spp beyond 32 bits": (
        replace("eval_spp = 1", "eval_spp = 200000000"),
        ["'eval_spp' is 200000000", "6 x 4", "up to 178956970"],
    ),
    "target.spp beyond 32 bits": (
        replace(IMAGES, '{ values = { "sky.radiance.value" = 0.5 }, spp = 200000000 }'),
        ["'target.spp' is 200000000", "up to 178956970"],
    ),
    "film beyond 32 bits": (film(100_000, 100_000), ["100000 x 100000", "a smaller film"]),
    "film beyond the memory": (film(60_000, 60_000), ["60000 x 60000", "GB of memory", "smaller film"]),
    "grid beyond the memory": (
        replace(KEY, KEY + ", resolutions = [10000000]"),
        ["at the resolution 10000000", "up to"],
    ),
    "grid beyond all numbers": (
        replace(KEY, KEY + f", resolutions = [{10**30}]"),
        ["parameters.0.resolutions.0", str(10**30)],
    ),
    "$res beyond all numbers": (
        replace('"ball.xml"', f'"cornell-box-photo"\nscene_parameters = {{ resolution = {10**10} }}'),
        ["cornell-box-photo", str(10**10)],
    ),
    "texture beyond the memory": (
        replace('"ball.xml"', '"cornell-box-photo"\nscene_parameters = { texture = 1000000 }'),
        ["'texture'", "1000000", "GB of memory"],
    ),
    "volume beyond the memory": (
        replace('"ball.xml"', '"cloud"\nscene_parameters = { grid = 10000 }'),
        ["'grid'", "10000", "GB of memory"],
    ),
    # What can only end in infinities.
    "start beyond single precision": (replace(KEY, KEY + ", initial = 1e300"), ["initial", "1e+300", "3.4e+38"]),
    "start whose loss is infinite": (
        replace(f"{KEY}, lower = 0, upper = 1", f"{KEY}, initial = 3e38"),
        ["Initial image of sensor 'eye'"],
    ),
    "learning rate of a parameter": (replace(KEY, KEY + ", learning_rate = 1e30"), ["paint", "1e+30", "learning_rate"]),
    "learning rate of all": (replace("spp = 1\ne", "learning_rate = 1e30\nspp = 1\ne"), ["paint", "1e+30"]),
    "target beyond its square": (bright_target, ["Target of sensor 'eye'", "3e+38"]),
    "no shapes": (without_shapes, ["paint.reflectance.data", "no shapes"]),
    "pivot out of the world": (
        posed("pivot = [1e38, 1e38, 1e38]"),
        ["eye.to_world", "'pivot'", "1e+38"],
    ),
    "start out of the world": (posed("initial = { translation = [0, 1e38, 0] }"), ["'initial.translation'", "1e+38"]),
    "start turned too often": (
        posed("initial = { rotation = [0, 1e38, 0] }"),
        ["eye.to_world", "between -360 and 360"],
    ),
    # Of another type, with what to write instead.
    "spp = true": (replace("spp = 1\ne", "spp = true\ne"), ["'spp' is True", "such as 16"]),
    "spp = 16.0": (replace("spp = 1\ne", "spp = 16.0\ne"), ["'spp' is 16.0", "such as 16"]),
    "initial = true": (replace(KEY, KEY + ", initial = true"), ["initial' is True", "a list of numbers"]),
    "a table for a text": (replace('"ball.xml"', "{ a = 1 }"), ["'scene' is {'a': 1}", "in quotes"]),
    "target by no integrator": (
        replace(IMAGES, '{ values = { "sky.radiance.value" = 0.5 }, integrator = { type = "diffuse" } }'),
        ["'diffuse' is a BSDF", "'path' for targets"],
    ),
    "no integrator": (replace('type = "prb", max_depth = 3', 'type = "diffuse"'), ["'diffuse' is a BSDF"]),
    "baseline is no integrator": (
        replace("spp = 1\ne", 'baseline = { type = "diffuse" }\nspp = 1\ne'),
        ["'diffuse' is a BSDF"],
    ),
    "option beyond 32 bits": (replace("max_depth = 3", "max_depth = 100000000000"), ["'max_depth' of 'prb'", "below"]),
    "names that are ours": (
        replace("spp = 1\ne", "scene_parameters = { base = 1, spec = 1, path = 1, plugins = 1 }\nspp = 1\ne"),
        ["unused parameters", "$base=1"],
    ),
    "name that is Mitsuba's": (replace("spp = 1\ne", "scene_parameters = { config = 1 }\nspp = 1\ne"), ["$config"]),
    "a word as a switch": (
        replace("spp = 1\ne", "spp = 1\ndeterministic = 'yes'\ne"),
        ["'deterministic'", "true or false"],
    ),
    "TOML nested deep": (replace("spp = 1\ne", f"spp = {'[' * 3000}{']' * 3000}\ne"), ["nested too deeply"]),
    "TOML of many digits": (replace("spp = 1\ne", f"spp = {'1' * 10000}\ne"), ["more digits"]),
    "hexadecimal of many digits": (replace("spp = 1\ne", f"spp = 0x{'f' * 10000}\ne"), ["'spp' is", "4300 digits"]),
    # Only regular files are opened.
    "target is a pipe": (pipe("target.exr"), ["target.exr", "is a pipe"]),
    "texture of the scene is a pipe": (pipe("texture.exr"), ["texture.exr", "is a pipe"]),
    "scene is a pipe": (pipe("ball.xml"), ["ball.xml", "is a pipe"]),
    "config is a pipe": (pipe("job.toml"), ["job.toml", "is a pipe"]),
    "target is a device": (replace("target.exr", "/dev/zero"), ["/dev/zero", "is a device"]),
    "target is a folder": (replace("target.exr", "."), ["is a folder"]),
    "scene is a device": (replace("ball.xml", "/dev/zero"), ["/dev/zero", "is a device"]),
    "name too long": (replace("target.exr", "x" * 300), ["File name too long"]),
    "terminal codes in a name": (replace("target.exr", r"\u0000\u001b[31m"), [r"\x00\x1b[31m"]),
    "very long name": (replace("prb", "x" * 100_000), ["Integrator 'xxx", " ... "]),
    "config of 5 GB": (huge_config, ["job.toml", "5000000000 bytes"]),
    "value for an unknown key": (
        replace('{ images = ["target.exr"] }', '{ values = { "pain.reflectance.data" = 0.1 } }'),
        ["pain.reflectance.data", "paint.reflectance.data"],
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_gets_one_line_and_status_2(
    case: str, room: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    change, words = BAD[case]
    change(room)
    monkeypatch.setattr(
        "pathreplay.platform.memory.available", lambda: 2 * 10**9
    )  # what is too large does not depend on us
    files = set(room.rglob("*"))
    assert command(monkeypatch, "job.toml", "--quiet") == 2
    out, err = capsys.readouterr()
    assert out == ""
    line = err.strip()
    assert "\n" not in line and "Traceback" not in line
    assert line.isprintable() and len(line) < 1100
    assert all(word in line for word in words), line
    assert set(room.rglob("*")) == files


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], ["config file", "--resume"]),
        (["jb.toml"], ["No config file jb.toml", "job.toml"]),
        (["job.toml", "--resume", "."], ["omit CONFIG"]),
        (["--resume", "."], ["is not a run folder"]),
        (["job.toml", "--output", "/proc/none/run"], ["/proc/none/run", "--output"]),
    ],
)
def test_bad_arguments_get_one_line_and_status_2(
    arguments: list[str],
    words: list[str],
    room: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert command(monkeypatch, *arguments, "--quiet") == 2
    line = capsys.readouterr().err.strip()
    assert "\n" not in line
    assert all(word in line for word in words), line
