"""Where edges move one line says, once, what they cost, or that their part of the gradient is missing; only there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import PIL.Image
import pytest

from driven import attached
from pathreplay import PathreplayError
from pathreplay.integrators.edge_notes import edges_note, moves_edges
from pathreplay.inverse.images.io import over_black, read_image, transparent_share
from pathreplay.jobs import make_config, optimize

SKY = mi.Bitmap(np.full((4, 8, 3), 0.5, np.float32))
FILM = {"type": "hdrfilm", "width": 4, "height": 4}


def make_scene(**more: Any) -> Any:
    return mi.load_dict(
        {
            "type": "scene",
            "cam": {"type": "perspective", "film": FILM, "to_world": mi.ScalarTransform4f().translate([0, 0, -4])},
            "cube": {"type": "cube", "bsdf": {"type": "diffuse"}},
            "lamp": {"type": "point", "position": [0, 3, -3]},
            "sky": {"type": "envmap", "bitmap": SKY},
            **more,
        },
        optimize=False,
    )


MOVE = {"cam.to_world", "cam.x_fov", "cube.vertex_positions", "ball.to_world", "glass.to_world", "lamp.position"}
STAY = {"cube.bsdf.reflectance.value", "cube.vertex_normals", "cube.vertex_texcoords", "glass.bsdf.eta", "sky.data",
        "sky.to_world", "lamp.intensity.value"}  # fmt: skip


def test_what_moves_edges() -> None:
    glass = {"type": "sphere", "bsdf": {"type": "roughdielectric"}}
    params = mi.traverse(make_scene(ball={"type": "sphere"}, glass=glass))
    assert {key for key in MOVE | STAY if moves_edges(params, key)} == MOVE
    note = edges_note(["a.to_world", "b.to_world", "c.to_world"])
    assert "'a.to_world' (and 2 more)" in note and "\n" not in note


class Log(mi.Appender):  # type: ignore[misc]
    """Keeps what Mitsuba logs."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []

    def append(self, level: Any, text: str) -> None:
        self.lines.append(text)

    def log_progress(self, *_: Any) -> None:
        pass


@pytest.fixture
def log() -> Any:
    logger, kept = mi.logger(), Log()
    logger.add_appender(kept)
    yield kept
    logger.remove_appender(kept)


@pytest.mark.parametrize("key", ["cube.vertex_positions", "lamp.position", "sky.to_world", "sky.data"])
def test_a_script_is_told_once(key: str, log: Any) -> None:
    scene = make_scene()
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 2, "boundary": "none"})
    params = mi.traverse(scene)
    value = type(params[key])(params[key])
    dr.enable_grad(value)
    params[key] = value
    params.update()
    for seed in (1, 2):
        dr.backward(dr.mean(mi.render(scene, params, integrator=integrator, spp=2, seed=seed), axis=None))
    dr.disable_grad(value)  # or it would move in the kernels of other scenes
    params[key] = value
    params.update()
    told = [line for line in log.lines if "moving edges" in line]
    assert len(told) == (key in MOVE)
    assert all(key in line and "pathreplay check" in line for line in told)


@pytest.mark.usefixtures("without_edge_terms")
@pytest.mark.parametrize("far", [0.0, 2000.0])
def test_a_script_is_told_of_edges_that_are_too_close_to_points(far: float, log: Any) -> None:
    at = mi.ScalarTransform4f().translate([far, 0, 0])
    scene = make_scene(cube={"type": "cube", "to_world": at})
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 2})
    with attached(scene, "cube.vertex_positions"):
        dr.backward(dr.mean(mi.render(scene, mi.traverse(scene), integrator=integrator, spp=1), axis=None))
    told = [line for line in log.lines if "left out, in a scene of size 2:" in line]
    assert len(told) == (far > 0)


@pytest.mark.usefixtures("without_edge_terms")
def test_a_script_is_told_of_the_samples_of_a_sunsky(log: Any) -> None:
    scene = make_scene(sky={"type": "sunsky", "sun_direction": [0.4, 0.7, 0.5]})
    for attach, times in (("none", 0), ("delta", 1)):
        with attached(scene, "sky.sun_direction") as params:
            integrator = mi.load_dict({"type": "pathreplay", "max_depth": 2, "attach": attach})
            dr.backward(dr.mean(mi.render(scene, params, integrator=integrator, spp=1), axis=None))
        assert len([line for line in log.lines if "gradients of a sunsky are wrong" in line]) == times


@pytest.mark.usefixtures("without_edge_terms")
@pytest.mark.parametrize("kind", ["ellipsoids", "linearcurve"])
def test_shapes_without_derivatives_are_told_and_refused(kind: str, tmp_path: Path, log: Any) -> None:
    """Their parameters have flags of Mitsuba, or gradients that are wrong."""
    points = tmp_path / "curve.txt"
    points.write_text("-1 0 0 .2\n0 .5 0 .2\n1 0 0 .2\n")
    rows = mi.TensorXf(np.array([[0, 0, 0, 0.4, 0.3, 0.3, 0, 0, 0, 1]], np.float32))
    shape = {"type": kind, "data": rows} if kind == "ellipsoids" else {"type": kind, "filename": str(points)}
    scene, key = make_scene(it=shape), "it.data" if kind == "ellipsoids" else "it.control_points"
    for moved, told in (("cube.vertex_positions", 0), (key, 1)):
        with attached(scene, moved) as params:
            integrator = mi.load_dict({"type": "pathreplay", "max_depth": 2})
            dr.backward(dr.mean(mi.render(scene, params, integrator=integrator, spp=1), axis=None))
        assert len([line for line in log.lines if "edges of shape 'it' of class" in line]) == told
    with attached(scene, key) as params, pytest.raises(PathreplayError, match="do not follow its parameters"):
        integrator = mi.load_dict({"type": "pathreplay", "max_depth": 2, "boundary": "all"})
        dr.backward(dr.mean(mi.render(scene, params, integrator=integrator, spp=1), axis=None))


def test_a_script_is_told_of_the_tables_of_roughplastic(log: Any) -> None:
    scene = make_scene(cube={"type": "cube", "bsdf": {"type": "roughplastic"}})
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 2})
    for key in ("cube.bsdf.diffuse_reflectance.value", "cube.bsdf.alpha"):
        assert not [line for line in log.lines if "roughplastic" in line]
        with attached(scene, key):
            dr.backward(dr.mean(mi.render(scene, mi.traverse(scene), integrator=integrator, spp=1), axis=None))
    assert len([line for line in log.lines if "gradient of a roughplastic's alpha or eta" in line]) == 1


GLOSS = {"type": "principled", "metallic": 1.0, "sheen": 0.0, "clearcoat": 0.2}


def test_a_script_is_told_of_lobes_that_are_absent(log: Any) -> None:
    """Each parameter where it has gradients, and once."""
    scene = make_scene(cube={"type": "cube", "bsdf": GLOSS}, ball={"type": "sphere", "bsdf": {"type": "principled"}})
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 2})
    told = ["metallic = 1", "sheen = 0"]
    for name, count in {"base_color": 0, "clearcoat": 0, "metallic": 1, "sheen": 2}.items():
        for _ in range(2):
            with attached(scene, f"cube.bsdf.{name}.value"):
                dr.backward(dr.mean(mi.render(scene, mi.traverse(scene), integrator=integrator, spp=1), axis=None))
        lines = [line for line in log.lines if "leaves out a lobe" in line]
        assert len(lines) == count and all(value in line for value, line in zip(told, lines, strict=False))


@pytest.mark.parametrize("plastic", ["plastic", "roughplastic"])
@pytest.mark.parametrize(("colour", "count"), [((0.6, 0.0, 0.0), 0), ((0.0, 0.0, 0.0), 1)])
def test_plastic_leaves_out_a_lobe_whose_whole_colour_is_black(
    plastic: str, colour: tuple[float, ...], count: int, log: Any
) -> None:
    bsdf = {"type": plastic, "diffuse_reflectance": {"type": "rgb", "value": colour}}
    scene = make_scene(cube={"type": "cube", "bsdf": bsdf})
    with attached(scene, "cube.bsdf.diffuse_reflectance.value"):
        integrator = mi.load_dict({"type": "pathreplay", "max_depth": 2})
        dr.backward(dr.mean(mi.render(scene, mi.traverse(scene), integrator=integrator, spp=1), axis=None))
    assert len([line for line in log.lines if "diffuse_reflectance = 0 of" in line]) == count


@pytest.mark.usefixtures("without_edge_terms")
@pytest.mark.parametrize(
    ("bsdf", "sun", "told"),
    [("conductor", 1.0, True), ("conductor", 0.0, False), ("mask", 1.0, False)],
)
def test_a_script_is_told_of_suns_in_mirrors(bsdf: str, sun: float, told: bool, log: Any) -> None:
    sky = {"type": "sunsky", "sun_scale": sun, "sun_direction": [0, 1, -1]}
    material = {"type": bsdf, **({"nested": {"type": "diffuse"}} if bsdf == "mask" else {})}
    scene, key = make_scene(cube={"type": "cube", "bsdf": material}, sky=sky), "cube.vertex_positions"
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 2})
    with attached(scene, key):
        dr.backward(dr.mean(mi.render(scene, mi.traverse(scene), integrator=integrator, spp=1), axis=None))
    lines = [line for line in log.lines if "delta lobes and a sunsky" in line]
    assert len(lines) == told and all("the motion of the edge of the sun's disc, " in line for line in lines)


def test_a_mesh_without_faces_is_refused() -> None:
    corners = mi.Mesh("nothing", 3, 0)
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 2})
    with pytest.raises(PathreplayError, match="mesh 'nothing' has no faces, and cannot be traced: remove it"):
        integrator.render(make_scene(nothing=corners), spp=1)


@pytest.mark.usefixtures("without_edge_terms")
def test_a_script_is_told_of_the_normals_of_curves(log: Any, tmp_path: Path) -> None:
    (tmp_path / "tube.txt").write_text("\n".join(f"{x / 2} {(x % 3) / 4} 0 0.2" for x in range(5)))
    tube = {"type": "bsplinecurve", "filename": str(tmp_path / "tube.txt")}
    scene = make_scene(tube=tube, cube={"type": "cube", "bsdf": {"type": "diffuse"}})
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 2})
    for key, count in (("cube.bsdf.reflectance.value", 0), ("tube.control_points", 1)):
        with attached(scene, key):
            dr.backward(dr.mean(mi.render(scene, mi.traverse(scene), integrator=integrator, spp=1), axis=None))
        assert len([line for line in log.lines if "derivative of their normals" in line]) == count


XML = """<scene version="3.0.0">
  <sensor type="perspective" id="cam"><transform name="to_world"><translate z="-4"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/>
    <string name="pixel_format" value="rgb"/></film></sensor>
  <shape type="cube" id="head"><bsdf type="diffuse" id="skin"><rgb name="reflectance" value="0.5"/></bsdf></shape>
  <emitter type="constant"/>
</scene>"""
MOVED = {"key": "head.vertex_positions", "pose": "translation", "initial": {"translation": [0.1, 0, 0]}}
PAINTED = {"key": "head.bsdf.reflectance.value"}


def run(parameter: dict[str, Any], integrator: dict[str, Any] | None = None, **target: Any) -> Any:
    config = {
        "scene": "scene.xml", "iterations": 3, "spp": 2, "eval_spp": 2, "parameters": [parameter],
        "integrator": {"type": "pathreplay", "max_depth": 2, **(integrator or {})},
        "target": target or {"scene": "scene.xml", "spp": 2},
    }  # fmt: skip
    return optimize(make_config(config), progress=False)


@pytest.mark.parametrize(("integrator", "parameter", "told"), [
    ({"type": "pathreplay", "boundary": "none"}, MOVED, True), ({"type": "prb"}, MOVED, True),
    ({"type": "pathreplay"}, PAINTED, False),
])  # fmt: skip
def test_a_job_is_told_in_its_report_and_not_in_the_log_too(
    integrator: dict[str, Any], parameter: dict[str, Any], told: bool, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, log: Any, capfd: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.xml").write_text(XML)
    html = run(parameter, integrator).report.read_text()
    assert html.count("moving edges") == html.count("docs/boundary.md") == told
    assert not [line for line in log.lines if "edges" in line]


def picture(folder: Path, alpha: int) -> None:
    pixels = np.full((8, 8, 4), 255, np.uint8)
    pixels[:, :4, 3] = alpha
    PIL.Image.fromarray(pixels).save(folder / "target.png")


def test_a_transparent_target_is_seen_over_black_and_that_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.xml").write_text(XML)
    picture(tmp_path, 51)
    result = run(PAINTED, images=["target.png"])
    assert "&#39;target.png&#39; is transparent in 50.0% of its pixels" in result.report.read_text()
    target = read_image(result.folder / "images/target-cam.exr")
    assert target[:, :4] == pytest.approx(51 / 255, abs=1e-3) and target[:, 4:] == pytest.approx(1)
    picture(tmp_path, 255)
    assert "is transparent in" not in run(PAINTED, images=["target.png"]).report.read_text()


def test_colours_of_exr_files_are_over_black_already() -> None:
    image = np.full((1, 2, 4), 0.5, np.float32)
    assert np.array_equal(over_black(image, Path("a.EXR")), image)
    assert over_black(image, Path("a.png"))[0, 0] == pytest.approx([0.25, 0.25, 0.25, 0.5])
    assert transparent_share(image) == 1 and transparent_share(image[..., :3]) == 0
