"""Poses: the formula and its derivative, what they move, how errors are measured, and whole jobs that find them."""

from __future__ import annotations

import html
import json
import weakref
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.schema import load_config
from pathreplay.inverse.dataset import targets
from pathreplay.inverse.parameters.pose import Pose, make_pose, rotation_matrix
from pathreplay.inverse.problem import problem
from pathreplay.jobs import make_config, optimize
from pathreplay.scenes.parameters import get_array
from places import ROOT


@pytest.fixture(autouse=True)
def variant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


# The third and fourth stand on both sides of the border between series and closed form.
ROTATIONS = [(0.0, 0.0, 0.0), (1e-4, 0.0, -2e-4), (0.03, -0.005, 0.005), (0.03, -0.01, 0.01), (0.5, 1.0, -2.0)]


@pytest.mark.parametrize("r", ROTATIONS)
def test_rotation_and_its_derivative(r: tuple[float, float, float]) -> None:
    axis = (0.3, -0.5, 0.8)
    t = mi.Float(0)
    dr.enable_grad(t)
    R = rotation_matrix(mi.Vector3f(*r) + mi.Vector3f(*axis) * t)
    assert get_array(R) == pytest.approx(Rotation.from_rotvec(r).as_matrix(), abs=5e-7)
    dr.forward(t)
    up, down = (Rotation.from_rotvec(np.array(r) + s * np.array(axis)).as_matrix() for s in (1e-5, -1e-5))
    assert get_array(dr.grad(R)) == pytest.approx((up - down) / 2e-5, abs=2e-5)


def moves(pose: Pose, **parts: tuple[float, float, float]) -> dict[str, Any]:
    return {name: mi.Vector3f(*parts.get(part, (0, 0, 0))) for part, name in pose.parts().items()}


def test_a_transform_turns_about_its_pivot_and_stays_itself_at_zero() -> None:
    base = mi.Transform4f().translate([1, 2, 3]).rotate([0, 1, 0], 30).scale([2, 1, 0.5])
    pose = make_pose("thing.to_world", base, "rigid", [4.0, 0.0, 1.0], None)
    still = pose.value(moves(pose))
    assert type(still) is type(base)
    assert get_array(still) == pytest.approx(get_array(base), abs=1e-6)
    turned = pose.value(moves(pose, translation=(0.1, 0.2, 0.3), rotation=(0, 0, np.pi / 2)))
    point = base.inverse() @ mi.Point3f(4, 0, 1)
    assert get_array(turned @ point) == pytest.approx([4.1, 0.2, 1.3], abs=1e-5)
    # One unit along x from the pivot goes to one unit along y.
    beside = base.inverse() @ mi.Point3f(5, 0, 1)
    assert get_array(turned @ beside) == pytest.approx([4.1, 1.2, 1.3], abs=1e-5)
    assert np.array_equal(get_array(turned)[3], [0, 0, 0, 1])


def test_a_mesh_moves_as_a_transform_would_move_it_normals_and_all() -> None:
    scene = mi.load_dict({"type": "scene", "box": {"type": "cube"}}, optimize=False)
    params = mi.traverse(scene)
    key = "box.vertex_positions"
    before = get_array(params[key]).reshape(-1, 3)
    normals = get_array(params["box.vertex_normals"]).reshape(-1, 3)
    pose = make_pose(key, params[key], "rigid", None, None)
    assert pose.pivot == pytest.approx((0, 0, 0), abs=1e-6)
    r, t = (0.3, -0.2, 0.5), (1.0, 2.0, 3.0)
    params[key] = pose.value(moves(pose, rotation=r, translation=t))
    params.update()
    R = Rotation.from_rotvec(r).as_matrix()
    assert get_array(params[key]).reshape(-1, 3) == pytest.approx(before @ R.T + t, abs=1e-5)
    assert get_array(params["box.vertex_normals"]).reshape(-1, 3) == pytest.approx(normals @ R.T, abs=1e-5)


@pytest.mark.parametrize("mesh", [False, True])
def test_errors_are_distance_of_the_origins_and_angle(mesh: bool) -> None:
    rng = np.random.default_rng(3)
    R = Rotation.from_rotvec(np.radians([0.0, 0.06, 0.08])).as_matrix()
    if mesh:
        value: Any = mi.Float(rng.normal(size=30).astype(np.float32))
        points = get_array(value).reshape(-1, 3)
        centre = points.mean(axis=0)
        moved = ((points - centre) @ R.T + centre + [0.03, 0, 0.04]).ravel()
    else:
        value = mi.Transform4f().translate([1, 2, 3]).scale([-2, 1, 0.5])  # a look_at mirrors, too
        moved = get_array(value).astype(np.float64)
        moved[:3, :3] = R @ moved[:3, :3]
        moved[:3, 3] += [0.03, 0, 0.04]
    pose = make_pose("a.vertex_positions" if mesh else "a.to_world", value, "rigid", None, 2.0)
    assert pose.error(moved) is None
    known = Pose(pose.key, pose.kind, pose.base, pose.pivot, pose.distance, get_array(value))
    error = known.error(moved)
    assert error is not None
    assert error.position == pytest.approx(0.05, rel=1e-4)
    assert error.relative == pytest.approx(0.025, rel=1e-4)
    assert error.degrees == pytest.approx(0.1, rel=1e-3)
    assert str(error) == "0.05 (2.5 % of its distance) and 0.1° off"


# A painted sheet of light fills the view, so that nothing in it has an edge.
SCENE = """<scene version="3.0.0">
  <sensor type="perspective" id="eye"><float name="fov" value="45"/>
    <transform name="to_world"><lookat origin="0.5,0.3,3" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="12"/><integer name="height" value="10"/>
      <string name="pixel_format" value="rgb"/><rfilter type="box"/></film></sensor>
  <shape type="rectangle" id="sheet"><transform name="to_world"><scale value="4"/></transform>
    <emitter type="area"><texture type="bitmap" name="radiance">
      <string name="filename" value="paint.exr"/><boolean name="raw" value="true"/></texture></emitter></shape>
</scene>"""
# With a ball of glass behind the camera.
WITH_GLASS = SCENE.replace(
    "</scene>",
    """<bsdf type="{glass}" id="glass"/>
  <shape type="sphere" id="ball"><point name="center" x="0" y="0" z="20"/><ref id="glass"/></shape></scene>""",
)

EYE = {
    "key": "eye.to_world",
    "pose": "rigid",
    "initial": {"translation": [0.05, -0.08, 0.06], "rotation": [1, -1, 2]},
    "pivot": [0, 0, 0],
    "error_scale": 3.05,
}
JOB = {
    "scene": "sheet.xml",
    "integrator": {"type": "pathreplay", "max_depth": 2, "boundary": "none"},  # paint shows it
    "iterations": 4,
    "spp": 8,
    "eval_spp": 16,
    "parameters": [EYE],
    "target": {"scene": "sheet.xml", "spp": 256, "integrator": {"type": "path", "max_depth": 2}},
}


@pytest.fixture
def sheet(tmp_path: Path, variant: None) -> None:
    from pathreplay.inverse.images.io import exr_bytes

    (tmp_path / "sheet.xml").write_text(SCENE)
    for glass in ("dielectric", "dielectric_ad"):
        (tmp_path / f"{glass}.xml").write_text(WITH_GLASS.replace("{glass}", glass))
    x, y = np.meshgrid(np.linspace(-1, 1, 32), np.linspace(-1, 1, 32))
    paint = [0.5 + 0.2 * np.cos((9 + k) * x + 2 * k) * np.sin((11 - k) * y + k) for k in range(3)]
    (tmp_path / "paint.exr").write_bytes(exr_bytes(np.stack(paint, axis=2).astype(np.float32)))


def run(**changes: Any) -> Any:
    return optimize(make_config({**JOB, **changes}), progress=False)


@pytest.mark.usefixtures("sheet")
def test_a_camera_finds_its_place_and_the_report_tells() -> None:
    result = run(iterations=80, final_learning_rate_ratio=0.02)
    error = result.poses["eye.to_world"]
    assert error.relative < 0.01 and error.degrees < 0.5  # from 5 % and 2.4 degrees
    assert "% of its distance" in result.describe() and "° off" in result.describe()
    table = json.loads((result.folder / "parameters.json").read_text())["eye.to_world"]
    assert table["error"]["relative"] == pytest.approx(error.relative)
    assert table["error_at_start"]["relative"] > 0.03
    assert table["start"]["rotation"] == pytest.approx([1, -1, 2])
    assert np.array(table["value"]) == pytest.approx(result.parameters["eye.to_world"])
    assert np.array(table["truth"]) == pytest.approx(np.array(table["value"]), abs=0.05)
    text = html_text(result)
    assert "recovered, translation" in text and str(error) in text


@pytest.mark.usefixtures("sheet")
def test_a_pose_goes_on_where_it_was_stopped() -> None:
    # A constant rate: lengthening a run would stretch its decay.
    whole = run(final_learning_rate_ratio=1.0)
    half = run(final_learning_rate_ratio=1.0, iterations=2)
    config = half.folder / "config.json"
    config.write_text(config.read_text().replace('"iterations": 2', '"iterations": 4'))
    resumed = optimize(resume=half.folder, progress=False)
    assert resumed.iterations == 4
    for key, value in whole.parameters.items():
        assert resumed.parameters[key] == pytest.approx(value, abs=1e-4)
    assert resumed.poses["eye.to_world"].position == pytest.approx(whole.poses["eye.to_world"].position, rel=1e-2)


@pytest.mark.usefixtures("sheet")
def test_only_the_named_part_moves() -> None:
    result = run(parameters=[{"key": "eye.to_world", "pose": "translation"}], learning_rate=0.1)
    assert set(result.parameters) == {"eye.to_world", "eye.to_world:translation"}
    base = mi.Transform4f().look_at(origin=[0.5, 0.3, 3], target=[0, 0, 0], up=[0, 1, 0])
    assert result.parameters["eye.to_world"][:3, :3] == pytest.approx(get_array(base)[:3, :3], abs=1e-6)
    assert np.abs(result.parameters["eye.to_world:translation"]).min() > 0


@pytest.mark.usefixtures("sheet")
def test_stock_glass_is_replaced_when_its_index_is_asked_for() -> None:
    target = {**JOB["target"], "scene": "dielectric.xml"}  # type: ignore[dict-item]
    result = run(scene="dielectric.xml", target=target, parameters=[{"key": "glass.eta", "initial": 1.3}], iterations=1)
    assert "replaced 'dielectric' by 'dielectric_ad'" in html_text(result)
    # The truth is that of the stock plugin in the target scene: bk7 in air. Nobody sees the ball, so nothing moves.
    assert result.errors["glass.eta"] == pytest.approx(1.5046 / 1.000277 - 1.3, abs=1e-3)


def html_text(result: Any) -> str:
    return html.unescape(result.report.read_text())


@pytest.mark.usefixtures("sheet")
def test_the_target_scene_is_gone_when_iterations_begin(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[weakref.ref[Any]] = []
    load = targets.load_scene_with_floats

    def watched(*arguments: Any, **options: Any) -> Any:
        scene = load(*arguments, **options)
        glass = [shape.bsdf() for shape in scene.shapes() if shape.id() == "ball"]
        seen.append(weakref.ref(glass[0]))  # an object of Python, unlike the scene
        return scene

    monkeypatch.setattr(targets, "load_scene_with_floats", watched)
    target = {**JOB["target"], "scene": "dielectric_ad.xml"}  # type: ignore[dict-item]
    problem.build_problem(make_config({**JOB, "target": target}), Path.cwd())
    assert len(seen) == 1 and seen[0]() is None


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "unknown pose": ({"pose": "affine"}, "'parameters.0.pose' is 'affine'"),
    "pose on a colour": (
        {"key": "sheet.bsdf.reflectance.value", "initial": None, "pivot": None},
        "'sheet.bsdf.reflectance.value' is a Float and has no pose",
    ),
    "no pose for a matrix": (
        {"pose": None, "initial": None, "pivot": None, "error_scale": None},
        "'eye.to_world' is a matrix",
    ),
    "two numbers": ({"initial": {"translation": [1, 2]}}, "'parameters.0.initial.translation' is [1, 2]"),
    "unknown part": ({"initial": {"rotatin": [1, 2, 3]}}, "did you mean 'rotation'?"),
    "NaN": ({"pivot": [0, float("nan"), 0]}, "'parameters.0.pivot.1' is nan"),
    "start of what does not move": ({"pose": "translation"}, "'initial.rotation' is not part of pose = 'translation'"),
    "rate of what does not move": (
        {"pose": "translation", "initial": None, "rotation_learning_rate": 1},
        "'rotation_learning_rate' is not part of pose = 'translation'",
    ),
    "bound on a pose": ({"lower": 0}, "'lower' does not apply to a pose"),
    "start without a pose": ({"pose": None}, "applies to a pose only"),
    "no distance": ({"error_scale": 0}, "'parameters.0.error_scale' is 0"),
}


@pytest.mark.parametrize("case", BAD)
@pytest.mark.usefixtures("sheet")
def test_bad_poses_get_one_line(case: str) -> None:
    change, message = BAD[case]
    # None takes the entry out.
    entry = {key: value for key, value in {**EYE, **change}.items() if value is not None}
    with pytest.raises(PathreplayError) as caught:
        run(parameters=[entry])
    assert message in str(caught.value) and "\n" not in str(caught.value)
    assert not Path("runs").exists()


@pytest.mark.usefixtures("sheet")
def test_other_integrators_move_no_camera() -> None:
    with pytest.raises(PathreplayError, match="only 'pathreplay' differentiates cameras"):
        run(integrator={"type": "prb", "max_depth": 2})


@pytest.mark.usefixtures("sheet")
def test_a_matrix_takes_no_value_in_the_target() -> None:
    target = {**JOB["target"], "values": {"eye.to_world": [1, 2, 3, 4]}}  # type: ignore[dict-item]
    with pytest.raises(PathreplayError, match=r"'eye\.to_world' is a matrix and takes no value"):
        run(target=target)


EXAMPLES = ROOT / "examples"


@pytest.mark.slow
def test_the_glass_pane_ends_at_its_index() -> None:
    # By one thread: the order in which threads add alone moves where the index ends between 0.0003 and 0.002.
    config = load_config(EXAMPLES / "glass-pane/config.toml").model_copy(update={"deterministic": True})
    result = optimize(config, progress=False)
    assert result.errors["glass.eta"] < 0.002
    assert result.errors["front_face.bsdf.normalmap.data"] < 0.02


@pytest.mark.slow
def test_the_mirror_and_the_camera_end_in_their_places() -> None:
    result = optimize(EXAMPLES / "mirror-camera/config.toml", progress=False)
    for error in result.poses.values():
        assert error.relative is not None and error.relative < 1e-3
