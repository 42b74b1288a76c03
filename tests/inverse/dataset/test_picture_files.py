"""Pictures by format: what files say of themselves is heeded, and sizes are looked at before anything is unpacked."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import PIL.Image
import pytest

from hostile.picture_bytes import HUGE, claiming, exr, picture_files, radiance
from pathreplay.errors import PathreplayError
from pathreplay.inverse.images.io import encoded, exr_bytes, read_image
from pathreplay.inverse.problem.problem import build_problem
from pathreplay.jobs import make_config
from pathreplay.scenes.image_files import size_of_picture
from pathreplay.scenes.loading import load_scene
from room_job import SCENE, TEXTURE, room  # noqa: F401 (room: its folder, for every test)

WIDTH, HEIGHT = 12, 10


def picture(channels: int = 3) -> np.ndarray:
    return np.random.default_rng(1).uniform(0.02, 0.9, (HEIGHT, WIDTH, channels)).astype(np.float32)


def pixmap(highest: int, between: bytes = b"\n", channels: int = 3) -> bytes:
    """A PGM or PPM of `picture`, with something between the parts of its head."""
    values = np.rint(encoded(picture(channels)) * highest).astype(">u2" if highest > 255 else np.uint8)
    kind = b"P5" if channels == 1 else b"P6"
    return between.join([kind, b"%d" % WIDTH, b"%d" % HEIGHT, b"%d" % highest]) + b"\n" + values.tobytes()


@pytest.mark.parametrize(
    ("data", "rounding"),
    [
        (pixmap(255), 6e-3),
        (pixmap(255, b"\n# by hand\n#twice\n"), 6e-3),
        (pixmap(65535), 3e-5),
        (pixmap(1000), 2e-3),
        (pixmap(100), 2e-2),
        (pixmap(65535, channels=1), 3e-5),
    ],
)
def test_pixmaps_are_read_as_their_heads_say(data: bytes, rounding: float, tmp_path: Path) -> None:
    path = tmp_path / "a.ppm"
    path.write_bytes(data)
    image = read_image(path)
    assert image.dtype == np.float32 and image == pytest.approx(picture(image.shape[2]), abs=rounding)


def test_bitmaps_with_palettes_have_the_colours_of_the_palette(tmp_path: Path) -> None:
    few = PIL.Image.fromarray((encoded(picture()) * 255).astype(np.uint8)).quantize(16)
    grey = few.convert("L")
    few.save(tmp_path / "few.bmp")
    few.save(tmp_path / "few.png")
    grey.save(tmp_path / "grey.bmp")
    grey.save(tmp_path / "grey.png")
    for name, channels in (("few", 3), ("grey", 1)):
        image = read_image(tmp_path / f"{name}.bmp")
        assert image.shape[2] == channels
        np.testing.assert_allclose(image, read_image(tmp_path / f"{name}.png"), atol=1e-6)


FORMAT = "FORMAT=32-bit_rle_rgbe\n"
UPRIGHT = f"-Y {HEIGHT} +X {WIDTH}"
HEADS: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "usual": (f"{FORMAT}\n{UPRIGHT}", lambda a: a),
    "no format": (f"SOFTWARE=ours\n\n{UPRIGHT}", lambda a: a),
    "exposed twice": (f"EXPOSURE=2\n{FORMAT}EXPOSURE= 4.0\n\n{UPRIGHT}", lambda a: 8 * a),
    "from the bottom": (f"{FORMAT}\n+Y {HEIGHT} +X {WIDTH}", lambda a: a[::-1]),
    "from the right": (f"{FORMAT}\n-Y {HEIGHT} -X {WIDTH}", lambda a: a[:, ::-1]),
    "by columns": (f"{FORMAT}\n+X {WIDTH} -Y {HEIGHT}", lambda a: a.transpose(1, 0, 2)),
    "by columns from the bottom right": (
        f"{FORMAT}\n-X {WIDTH} +Y {HEIGHT}",
        lambda a: a.transpose(1, 0, 2)[::-1, ::-1],
    ),
}


@pytest.mark.parametrize("name", HEADS)
def test_radiance_pictures_are_read_as_their_heads_say(name: str, tmp_path: Path) -> None:
    head, stored = HEADS[name]
    path = tmp_path / "a.hdr"
    path.write_bytes(radiance(stored(picture()), head))
    assert read_image(path) == pytest.approx(picture(), abs=5e-3)
    assert size_of_picture(path) == (WIDTH, HEIGHT)


def test_radiance_pictures_of_xyz_become_rgb(tmp_path: Path) -> None:
    """White, by its coordinates."""
    path = tmp_path / "a.hdr"
    white = np.broadcast_to(np.float32([0.9505, 1.0, 1.089]), (HEIGHT, WIDTH, 3))
    path.write_bytes(radiance(white, f"FORMAT=32-bit_rle_xyze\n\n{UPRIGHT}"))
    assert read_image(path)[3, 4] == pytest.approx(1, abs=0.02)


def job(file: str, where: str = "target") -> Any:
    """A job that takes a picture as a target, as a mask, or as a value."""
    target: dict[str, Any] = {"images": ["good.exr" if where != "target" else file]}
    Path("good.exr").write_bytes(exr_bytes(picture()))
    if where == "mask":
        target["masks"] = [file]
    parameter = {"key": TEXTURE, **({"initial": {"image": file}} if where == "value" else {})}
    return make_config({"scene": "room.xml", "sensors": ["left"], "parameters": [parameter], "target": target})


def test_a_single_layer_is_the_picture(room: Path) -> None:  # noqa: F811
    (room / "a.exr").write_bytes(exr(picture(), "diffuse.R", "diffuse.G", "diffuse.B"))
    assert build_problem(job("a.exr"), room).views[0].target == pytest.approx(picture())


def test_several_layers_are_none(room: Path) -> None:  # noqa: F811
    (room / "a.exr").write_bytes(exr(picture(), *(f"{layer}.{c}" for layer in ("diffuse", "specular") for c in "RGB")))
    with pytest.raises(PathreplayError, match=r"'a\.exr' has 6 channels, but sensor 'left' renders 3"):
        build_problem(job("a.exr"), room)


FILES = picture_files(picture())


@pytest.mark.parametrize("name", FILES)
def test_sizes_are_told_by_heads(name: str, room: Path) -> None:  # noqa: F811
    data = FILES[name]
    for size in ((WIDTH, HEIGHT), HUGE):
        (room / name).write_bytes(claiming(name, data, size))
        assert size_of_picture(room / name) == size
    (room / name).write_bytes(data)
    assert read_image(room / name).shape == (HEIGHT, WIDTH, 3)


@pytest.mark.parametrize("where", ["target", "mask", "value"])
@pytest.mark.parametrize("name", FILES)
def test_what_claims_too_much_is_refused_before_it_is_unpacked(
    name: str,
    where: str,
    room: Path,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (room / name).write_bytes(claiming(name, FILES[name], HUGE))
    if where == "target":
        monkeypatch.setattr("pathreplay.inverse.dataset.targets.read_image", None)  # its size alone is wrong
    with pytest.raises(PathreplayError, match=rf"{re.escape(name)}.* is 65500 x 65400") as told:
        build_problem(job(name, where), room)
    assert "\n" not in str(told.value)


def test_textures_of_the_scene_are_looked_at_too(room: Path) -> None:  # noqa: F811
    (room / "a.png").write_bytes(claiming("a.png", FILES["a.png"], HUGE))
    (room / "odd.xml").write_text(SCENE.replace("texture.exr", "a.png"))
    with pytest.raises(PathreplayError, match=r"a\.png is 65500 x 65400"):
        load_scene("odd.xml")


def test_a_mask_of_another_size_is_told_by_its_head(room: Path) -> None:  # noqa: F811
    mi.Bitmap(np.ones((3, 5, 1), np.float32)).write("small.exr")
    with pytest.raises(PathreplayError, match=r"Mask 'small.exr' is 5 x 3, but sensor 'left' renders 12 x 10"):
        build_problem(job("small.exr", "mask"), room)


@pytest.mark.parametrize("name", FILES)
def test_damaged_heads_are_told_in_one_line(name: str, room: Path) -> None:  # noqa: F811
    for cut in (3, 11, 17, 21):
        (room / name).write_bytes(FILES[name][:cut])
        with pytest.raises(PathreplayError, match=re.escape(name)) as told:
            read_image(room / name)
        assert "\n" not in str(told.value)


def spoiled_tga(how: str) -> bytes:
    """Of runs, with a head or packets that do not fit what follows; Mitsuba writes beyond the end of some of them."""
    data = bytearray(FILES["runs.tga"])
    if how == "other pixels":  # grey
        data[2], data[16] = 11, 8
    elif how == "shorter rows":
        data[12] -= 1
    elif how == "more rows":
        data[14] += 1
    elif how == "a longer packet":
        data[18] |= 127
    elif how == "too wide":
        data[12:16] = struct.pack("<HH", 2**15, 1)
    return bytes(data)


@pytest.mark.parametrize("file", ["a.tga", "a.png"])
@pytest.mark.parametrize("how", ["other pixels", "shorter rows", "more rows", "a longer packet", "too wide"])
def test_packets_that_do_not_fill_a_tga_are_told_in_one_line(how: str, file: str, room: Path) -> None:  # noqa: F811
    """Whatever its ending: Mitsuba knows the format by the last bytes."""
    (room / file).write_bytes(spoiled_tga(how))
    (room / "odd.xml").write_text(SCENE.replace("texture.exr", file))
    for read in (lambda: read_image(room / file), lambda: load_scene("odd.xml")):
        with pytest.raises(PathreplayError, match=rf"{re.escape(file)} is (a damaged TGA|32768 x 1)") as told:
            read()
        assert "\n" not in str(told.value)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_runs_of_a_tga_are_unpacked(channels: int, tmp_path: Path) -> None:
    """Runs and single pixels, over the ends of rows."""
    stored = np.repeat(np.random.default_rng(2).integers(0, 256, (43, channels), np.uint8), 7, 0)[:300]
    stored[100:103] = np.arange(3 * channels).reshape(3, channels)
    path = tmp_path / "a.tga"
    image = PIL.Image.fromarray(np.squeeze(stored.reshape(20, 15, channels)))
    image.save(path, compression="tga_rle")
    assert read_image(path, raw=True).ravel() == pytest.approx(stored.ravel() / 255, abs=1e-6)


@pytest.mark.parametrize("name", sorted(FILES.keys() - {"a.exr"}))
def test_a_picture_of_no_pixels_is_none(name: str, room: Path) -> None:  # noqa: F811
    (room / name).write_bytes(claiming(name, FILES[name], (0, 6)))
    with pytest.raises(PathreplayError, match=rf"{re.escape(name)} is 0 x 6"):
        read_image(room / name)
