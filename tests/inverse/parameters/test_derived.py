"""Parameters that a user's function makes of others: their gradients are those of the chain rule, and jobs work."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import safetensors.numpy

from pathreplay.errors import PathreplayError
from pathreplay.inverse.images.io import exr_bytes
from pathreplay.inverse.objective.evaluate import Evaluator, Shard
from pathreplay.inverse.parameters.regularizers import Laplacian
from pathreplay.inverse.problem.problem import Problem, build_problem, put_values
from pathreplay.jobs import RunResult, make_config, optimize
from pathreplay.output.export import export_run
from pathreplay.scenes.bodies import ball, mesh

# A painted ball without texture coordinates on a coloured floor and before a wall, in the names that Blender gives.
SCENE = """<scene version="3.0.0">
  <sensor type="perspective" id="Camera.001"><float name="fov" value="45"/>
    <transform name="to_world"><lookat origin="0.4,1.2,4" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="14"/><integer name="height" value="12"/>
      <string name="pixel_format" value="rgb"/><rfilter type="box"/></film></sensor>
  <bsdf type="diffuse" id="Floor [1]"><rgb name="reflectance" value="0.3,0.5,0.7"/></bsdf>
  <bsdf type="diffuse" id="Wall"><rgb name="reflectance" value="0.6,0.5,0.2"/></bsdf>
  <bsdf type="diffuse" id="Paper"><texture type="bitmap" name="reflectance"><string name="filename" value="t.exr"/>
    </texture></bsdf>
  <shape type="ply" id="Body"><string name="filename" value="body.ply"/><ref id="Wall"/></shape>
  <shape type="rectangle" id="Ground"><ref id="Floor [1]"/>
    <transform name="to_world"><rotate x="1" angle="-90"/><scale value="3"/><translate y="-1"/></transform></shape>
  <shape type="rectangle" id="Back"><ref id="Paper"/>
    <transform name="to_world"><scale value="2"/><translate z="-1.5"/></transform></shape>
  <emitter type="constant" id="World"><rgb name="radiance" value="1"/></emitter>
</scene>"""

FUNCTIONS = """
import drjit as dr
import mitsuba as mi

def grey(first, share):
    return first * 0 + share.array * share.array

def dark(first, other):
    return 0.5 * other

def bent(first, bend):
    p = dr.unravel(mi.Point3f, first)
    return dr.ravel(mi.Point3f(p.x + bend[0].array * p.y * p.y, p.y + bend[1].array, p.z))

def round_about(first, angle):
    return mi.Transform4f().rotate([0, 1, 0], angle.array) @ first

def stretched(first, small):
    height, width, channels = first.shape
    i = dr.arange(mi.UInt32, height * width * channels)
    row, column = i // (width * channels) * small.shape[0] // height, i // channels % width * small.shape[1] // width
    texel = (row * small.shape[1] + column) * channels + i % channels
    return mi.TensorXf(dr.gather(mi.Float, small.array, texel), first.shape)

def as_list(first, share):
    return [0.1, 0.2]

def tiny(first, share):
    return mi.TensorXf([0, 0, 0], shape=(1, 1, 3))

def broken(first, share):
    raise ValueError("no\\nluck")

def infinite(first, share):
    return first / (share.array * 0)

def width(v):
    return dr.mean(dr.square(v - 0.25), axis=None) * 3

def two(v):
    return v[:2]

def constant(v):
    return mi.Float(3)

def lost(v):
    return dr.sqrt(dr.sum(dr.square(v - dr.detach(v)), axis=None))

def in_place(first, share):
    first *= 0
    share *= share
    return first + share.array

def shallow(v):
    v -= 0.25
    v *= v
    return dr.mean(v, axis=None) * 3

def by_hand(first, share):
    return first * 0 + share.array[0]

def worse(first, share):
    return first * (1 + dr.sqrt(0.001 - dr.square(share.array - 0.61)))

def same(first, other):
    return first * 0 + other.array

def small_only(first, small):
    return mi.TensorXf(dr.tile(small.array, 4), first.shape)

def small_penalty(v):
    return dr.mean(mi.TensorXf(v.array, (2, 2, 3)), axis=None)

def where_wrong(v):
    return dr.mean(dr.square(v), axis=None) if dr.max(v.array)[0] > 0.59 else 0.0

def mounds(first, heights):
    p = dr.unravel(mi.Point3f, first)
    return dr.ravel(mi.Point3f(p.x, p.y + dr.mean(heights.array), p.z))

number = 3
"""

WALL, FLOOR, PAPER = "Wall.reflectance.value", "Floor [1].reflectance.value", "Paper.reflectance.data"
BODY, CAMERA = "Body.vertex_positions", "Camera.001.to_world"


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "room.xml").write_text(SCENE)
    (tmp_path / "own.py").write_text(FUNCTIONS)
    texels = np.linspace(0.1, 0.9, 4 * 4 * 3, dtype=np.float32).reshape(4, 4, 3)
    (tmp_path / "t.exr").write_bytes(exr_bytes(texels))
    vertices, faces = ball(2)
    mesh(0.6 * vertices, faces, {"type": "diffuse"}).write_ply(str(tmp_path / "body.ply"))
    return tmp_path


def config(parameters: list[dict[str, Any]], derived: list[dict[str, Any]], **more: Any) -> dict[str, Any]:
    return {
        "scene": "room.xml",
        "integrator": {"type": "pathreplay", "max_depth": 3, "boundary": "none"},
        "spp": 8,
        "eval_spp": 16,
        "iterations": 4,
        "learning_rate": 0.05,
        "deterministic": True,
        "parameters": parameters,
        "derived": derived,
        "target": {"scene": "room.xml", "spp": 64, "integrator": {"type": "path", "max_depth": 3}},
        **more,
    }


def free(key: str, *shape: int, **more: Any) -> dict[str, Any]:
    return {"key": key, "shape": list(shape), **more}


def made(key: str, function: str, *of: str) -> dict[str, Any]:
    return {"key": key, "function": f"own:{function}", "of": list(of)}


def problem_of(*tables: list[dict[str, Any]], **more: Any) -> Problem:
    return build_problem(make_config(config(*tables, **more)), Path.cwd())


def gradients(problem: Problem, seed: int = 5) -> dict[str, np.ndarray]:
    """Of one evaluation with one thread, at the start."""
    threads = dr.thread_count()
    dr.set_thread_count(1)
    try:
        values = {v.key: np.asarray(v.start) for v in problem.variables}
        return Evaluator(problem, problem.integrator, record=False)(values, Shard((0,), 16, (seed,)), {}).gradients
    finally:
        dr.set_thread_count(threads)


# Of each: free parameter, function and key; the value that it makes, and its Jacobian's product with a gradient of it.
CHAINS: dict[str, tuple[dict[str, Any], dict[str, Any], Callable[[np.ndarray], np.ndarray]]] = {
    "number to colour": (free("share", 1, initial=0.6), made(WALL, "grey", "share"), lambda g: 2 * 0.6 * g.sum()),
    "texture to texture": (
        free("small", 2, 2, 3, initial=0.4),
        made(PAPER, "stretched", "small"),
        lambda g: g.reshape(2, 2, 2, 2, 3).sum(axis=(1, 3)),
    ),
}


@pytest.mark.parametrize("name", CHAINS)
def test_gradients_are_those_of_the_chain_rule(name: str) -> None:
    parameter, derived, chain = CHAINS[name]
    ours = problem_of([parameter], [derived])
    start = ours.derived[0].value({v.key: v.held(v.start) for v in ours.variables})
    plain = problem_of([{"key": derived["key"]}], [])
    values = {derived["key"]: np.array(start).reshape(plain.variables[0].start.shape)}
    problem = problem_of([{"key": derived["key"], "initial": float(values[derived["key"]].flat[0])}], [])
    expected = chain(gradients(problem)[derived["key"]])
    found = gradients(ours)[parameter["key"]]
    assert found == pytest.approx(expected, rel=1e-4) and np.abs(found).max() > 1e-4


def difference(problem: Problem, key: str, entry: int, h: float, spp: int) -> float:
    """Of the loss by an entry of a parameter: central, with the same random numbers, by Mitsuba's path tracer."""
    found = []
    path = mi.load_dict({"type": "path", "max_depth": 3})
    for sign in (1, -1):
        values = {v.key: np.array(v.start) for v in problem.variables}
        values[key].flat[entry] += sign * h
        put_values(problem, values)
        images = [np.array(mi.render(problem.scene, integrator=path, spp=spp, seed=seed)) for seed in (1, 2)]
        target = problem.views[0].target
        # Two renderings, so that the square of their noise is not in it.
        found.append(float(np.mean((images[0].astype(float) - target) * (images[1] - target))))
    put_values(problem, {v.key: v.start for v in problem.variables})
    return (found[0] - found[1]) / (2 * h)


MOTIONS = {
    "camera": (free("angle", 1, initial=4.0), made(CAMERA, "round_about", "angle"), 0, 0.2),
    "mesh": (free("bend", 2, initial=[0.1, 0.3]), made(BODY, "bent", "bend"), 1, 0.02),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MOTIONS)
def test_motions_are_differentiated_through_the_function(name: str) -> None:
    parameter, derived, entry, h = MOTIONS[name]
    edges = {"type": "pathreplay", "max_depth": 3, "boundary": "all"}
    problem = problem_of([parameter], [derived], integrator=edges)
    expected = difference(problem, parameter["key"], entry, h, 4096)
    found = [gradients(problem, seed)[parameter["key"]].flat[entry] for seed in range(48)]
    error = float(np.std(found) / np.sqrt(len(found)))
    assert abs(np.mean(found) - expected) < 4 * error + 0.02 * abs(expected)
    assert error < 0.1 * abs(expected)


def run(*tables: list[dict[str, Any]], **more: Any) -> RunResult:
    return optimize(make_config(config(*tables, **more)), progress=False)


def test_three_colours_are_one_and_a_rival_agrees() -> None:
    target = {"scene": "room.xml", "values": {WALL: 0.49, FLOOR: 0.49}, "spp": 256}
    result = run(
        [free("share", 1, initial=0.3)],
        [made("*.reflectance.value", "grey", "share")],
        target=target, iterations=60, learning_rate=0.03, baseline={"type": "prb", "max_depth": 3},
    )  # fmt: skip
    assert result.parameters["share"] == pytest.approx([0.7], abs=0.01)
    assert result.parameters[WALL] == pytest.approx(np.full(3, 0.49), abs=0.015)
    assert set(result.errors) == {WALL, FLOOR}
    assert result.history[-1].errors[WALL] < 0.02 < result.history[0].errors[WALL]
    page = (Path(result.folder) / "report.html").read_text()
    assert all(f">{name}<" in page for name in ("share", WALL, FLOOR))


def test_one_follows_another_that_is_recovered() -> None:
    result = run([{"key": FLOOR, "initial": 0.5}], [made(WALL, "dark", FLOOR)])
    assert result.parameters[WALL] == pytest.approx(0.5 * result.parameters[FLOOR])


def test_a_grid_is_refined_below_its_function() -> None:
    small = free("small", 4, 4, 3, initial=0.4, resolutions=[1, 2, 4], refine_at=[1, 2], lower=0.0, upper=1.0)
    result = run([small], [made(PAPER, "stretched", "small")])
    assert result.parameters["small"].shape == (4, 4, 3)
    assert result.parameters[PAPER] == pytest.approx(result.parameters["small"])


def test_runs_that_go_on_and_recorded_ones_end_where_others_do() -> None:
    tables = [free("bend", 2), free("share", 1, initial=0.6)], [made(BODY, "bent", "bend"), made(WALL, "grey", "share")]
    even = {"learning_rate_schedule": "constant"}
    whole = run(*tables, output="whole", **even)
    run(*tables, output="part", iterations=2, **even)
    job = Path("part/config.json")
    job.write_text(job.read_text().replace('"iterations": 2', '"iterations": 4'))
    rest = optimize(resume="part", progress=False)
    for key, value in whole.parameters.items():
        assert np.array_equal(value, rest.parameters[key]), key
    recorded = run(*tables, output="recorded", deterministic=False, **even)
    for key, value in whole.parameters.items():
        assert recorded.parameters[key] == pytest.approx(value, abs=1e-4), key


def test_stages_hold_and_move_them() -> None:
    tables = [free("bend", 2), free("share", 1, initial=0.6)], [made(BODY, "bent", "bend"), made(WALL, "grey", "share")]
    job = config(*tables, stages=[{"iterations": 2, "parameters": ["share"], "downscale": 2}])
    job.pop("iterations")
    with pytest.raises(PathreplayError, match="no stage optimises 'bend'"):
        optimize(make_config(job), progress=False)
    job["stages"].append({"iterations": 2, "parameters": ["bend"]})
    result = optimize(make_config(job), progress=False)
    norms = [set(entry.gradient_norms) for entry in result.history]
    assert norms == [{"share"}] * 2 + [{"bend"}] * 2


def test_exports_render_to_the_same_picture() -> None:
    tables = (
        [free("bend", 2, initial=[0.2, 0.1]), free("angle", 1, initial=3.0), free("small", 2, 2, 3, initial=0.4)],
        [made(BODY, "bent", "bend"), made(CAMERA, "round_about", "angle"), made(PAPER, "stretched", "small")],
    )
    result = run(*tables)
    export_run(Path(result.folder))
    out = Path(result.folder) / "export"
    assert set(json.loads((out / "values.json").read_text())) >= {"bend", "angle", "small"}
    saved = safetensors.numpy.load_file(str(Path(result.folder) / "parameters.safetensors"))
    assert {"bend", "angle", "small", BODY, CAMERA, PAPER} <= set(saved)
    problem = problem_of(*tables)
    put_values(problem, {v.key: saved[v.key] for v in problem.variables})
    path = mi.load_dict({"type": "path", "max_depth": 3})
    here = np.array(mi.render(problem.scene, integrator=path, spp=64, seed=3))
    there = np.array(mi.render(mi.load_file(str(out / "scene.xml")), integrator=path, spp=64, seed=3))
    assert there == pytest.approx(here, abs=2e-4)


SHARE = free("share", 1)
# Of each: what is recovered, what is derived, and what the message says.
REFUSED: dict[str, tuple[dict[str, Any], dict[str, Any] | None, str]] = {
    "unused": (SHARE, None, "'shape' is given, but nothing is derived from it; name it in 'of'"),
    "of the scene": (free(WALL, 3), made(FLOOR, "dark", WALL), "is part of the scene; remove 'shape'"),
    "both": ({"key": WALL}, made(WALL, "dark", WALL), f"'{WALL}' is named twice, by '{WALL}' and '{WALL}'"),
    "nothing": (
        {"key": FLOOR},
        made(WALL, "dark", "flor"),
        f"'flor', which is not a parameter of the job ({FLOOR}); add [[parameters]] with this key and a 'shape'",
    ),
    "a reserved name": (
        free("exposure", 1),
        made(WALL, "grey", "exposure"),
        "has a reserved name; rename it",
    ),
    "a chain": ({"key": FLOOR}, made(WALL, "dark", WALL), f"'{WALL}', which is derived itself; name the parameters"),
    "not recovered": ({"key": PAPER}, made(WALL, "dark", FLOOR), "which the job does not recover; add [[parameters]]"),
    "by hand": (
        SHARE,
        made(WALL, "by_hand", "share"),
        "that does not depend on 'share'; compute it with Dr.Jit",
    ),
    "one resolution": (
        free("small", 4, 4, 3, resolutions=[2, 4], refine_at=[1]),
        made(PAPER, "small_only", "small"),
        "cannot be computed",
    ),
    "one resolution of a penalty": (
        free("small", 4, 4, 3, resolutions=[2, 4], refine_at=[1], regularizer="own:small_penalty"),
        made(PAPER, "stretched", "small"),
        "Regularizer 'own:small_penalty' cannot be computed",
    ),
    "no such key": (SHARE, made("Wal.reflectance.value", "grey", "share"), f"nearest: {WALL}"),
    "no such function": (SHARE, made(WALL, "gray", "share"), "cannot be imported"),
    "no function": (SHARE, made(WALL, "number", "share"), "is not a function of values, but 3; name another"),
    "no path": (
        SHARE,
        {**made(WALL, "grey", "share"), "function": "grey"},
        "'grey' is not an import path; write module:function",
    ),
    "fails": (SHARE, made(WALL, "broken", "share"), "Derivation 'own:broken' cannot be computed (no luck); fix it"),
    "another kind": (SHARE, made(WALL, "as_list", "share"), "cannot be computed"),
    "another shape": (
        SHARE,
        made(PAPER, "tiny", "share"),
        "returns the shape (1, 1, 3) for 'Paper.reflectance.data'; return the shape (4, 4, 3)",
    ),
    "infinite": (SHARE, made(WALL, "infinite", "share"), "returns NaN or infinite values"),
    "too many": (
        free("share", 10**5, 10**5, 10),
        made(WALL, "grey", "share"),
        "has 100000000000 entries, but arrays hold up to",
    ),
    "a pose": ({**SHARE, "pose": "rigid"}, made(WALL, "grey", "share"), "'shape' does not apply to a pose"),
    "smooth": (
        {**SHARE, "large_steps_lambda": 2.0},
        made(WALL, "grey", "share"),
        "is not the vertex_positions of a mesh; remove 'large_steps_lambda'",
    ),
    "no mesh": (
        {"key": WALL, "laplacian_weight": 1.0},
        None,
        "is not the vertex_positions of a mesh; remove 'laplacian_weight'",
    ),
    "two numbers": (
        {"key": WALL, "regularizer": "own:two"},
        None,
        "Regularizer 'own:two' returns 2 numbers",
    ),
    "no slope": ({"key": WALL, "regularizer": "own:lost"}, None, "it or its gradient is not finite"),
    "no module": ({"key": WALL, "regularizer": "elsewhere:f"}, None, "Regularizer 'elsewhere:f' cannot be imported"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_is_told_in_one_line(name: str) -> None:
    parameter, derived, told = REFUSED[name]
    with pytest.raises(PathreplayError) as caught:
        problem_of([parameter], [] if derived is None else [derived])
    line = str(caught.value)
    assert told in line and "\n" not in line, line


def test_a_name_is_given_once() -> None:
    with pytest.raises(PathreplayError, match="'share' is named twice; remove one"):
        problem_of([SHARE, SHARE], [made(WALL, "grey", "share")])


def test_a_camera_that_is_derived_takes_no_batches_of_pixels() -> None:
    with pytest.raises(PathreplayError, match=r"its camera moves; freeze 'Camera\.001\.to_world'"):
        run([free("angle", 1)], [made(CAMERA, "round_about", "angle")], pixel_batch_size=20)


def test_a_penalty_of_ones_own_pulls() -> None:
    entry = {"key": WALL, "regularizer": "own:width"}
    result = run([entry], [])
    start = np.float32([0.6, 0.5, 0.2])
    assert result.history[0].penalty == pytest.approx(3 * float(np.mean((start - 0.25) ** 2)), rel=1e-5)


def test_a_laplacian_takes_bumps_out() -> None:
    params = mi.traverse(mi.load_file("room.xml"))
    before, faces = np.array(params[BODY]), np.array(params["Body.faces"])

    def roughness(positions: np.ndarray) -> float:
        return Laplacian(1.0, before, faces)(positions)[0]

    free_run = run([{"key": BODY, "learning_rate": 0.02}], [], iterations=8)
    held = run([{"key": BODY, "learning_rate": 0.02, "laplacian_weight": 100.0}], [], iterations=8)
    assert roughness(held.parameters[BODY]) < 0.5 * roughness(free_run.parameters[BODY])
    assert held.history[0].penalty == pytest.approx(100 * roughness(before), rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_spectral"])
def test_other_variants_make_and_recover_them(variant: str) -> None:
    target = {"scene": "room.xml", "values": {FLOOR: 0.49, WALL: 0.49}, "spp": 256}
    tables = [free("share", 1, initial=0.5)], [made("*.reflectance.value", "grey", "share")]
    Path("job.json").write_text(
        json.dumps(
            config(*tables, target=target, iterations=30, final_learning_rate_ratio=0.1, variant=variant, output="run")
        )
    )
    command = [sys.executable, "-m", "pathreplay.cli", "optimize", "job.json", "--quiet"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    found = safetensors.numpy.load_file("run/parameters.safetensors")
    assert found["share"] == pytest.approx([0.7], abs=0.02)


def test_functions_may_change_what_they_are_given() -> None:
    found = run([free("share", 1, initial=0.6)], [made(WALL, "in_place", "share")]).parameters
    same = run([free("share", 1, initial=0.6)], [made(WALL, "grey", "share")]).parameters
    assert found["share"] == pytest.approx(same["share"], rel=1e-5) and abs(found["share"][0] - 0.6) > 0.05
    pulled = [run([{"key": WALL, "regularizer": f"own:{name}"}], []) for name in ("shallow", "width")]
    assert pulled[0].parameters[WALL] == pytest.approx(pulled[1].parameters[WALL], rel=1e-5)
    assert pulled[0].history[0].gradient_norms == pytest.approx(pulled[1].history[0].gradient_norms)


def test_a_value_that_becomes_infinite_on_the_way_names_its_function() -> None:
    with pytest.raises(PathreplayError, match="Derivation 'own:worse' returns NaN or infinite values for 'Body"):
        run(
            [free("share", 1, initial=0.6, l2_to_initial=1e-9)],
            [made(BODY, "worse", "share")],
            iterations=20,
            learning_rate=0.2,
        )


def test_a_penalty_may_be_nothing_where_nothing_is_wrong() -> None:
    result = run([{"key": WALL, "regularizer": "own:where_wrong", "learning_rate": 0.1}], [], iterations=6)
    assert result.history[0].penalty > 0 == result.history[-1].penalty


def test_glass_is_exchanged_whatever_free_numbers_are_called() -> None:
    glass = '<shape type="sphere" id="Ball"><bsdf type="dielectric" id="Glass"/></shape></scene>'
    Path("room.xml").write_text(SCENE.replace("</scene>", glass))
    problem = problem_of([free("eta", 1, initial=1.4)], [made("Ball.bsdf.eta", "same", "eta")])
    assert problem.derived[0].key == "Ball.bsdf.eta"


def test_stages_name_what_is_derived_and_exports_have_all_numbers() -> None:
    tables = (
        [free("heights", 3, 7, 1, initial=0.1), free("body", 20), free("share", 1, initial=0.6)],
        [made(BODY, "mounds", "heights"), made(PAPER, "bright", "body"), made(WALL, "grey", "share")],
    )
    with Path("own.py").open("a") as file:
        file.write("\ndef bright(first, body):\n    return first + dr.mean(body.array)\n")
    job = config(*tables, stages=[{"iterations": 1, "parameters": [BODY, WALL]}, {"iterations": 1}])
    job.pop("iterations")
    result = optimize(make_config(job), progress=False)
    assert set(result.history[0].gradient_norms) == {"heights", "share"}
    export_run(Path(result.folder))
    out = Path(result.folder) / "export"
    for name in ("heights", "body"):
        assert np.array_equal(np.load(out / f"values/{name}.npy"), result.parameters[name])
    assert {path.name for path in (out / "meshes").iterdir()} == {"Body.ply", "Body.obj"}
    assert "3 parameters of" in (Path(result.folder) / "report.html").read_text().replace("<b>", "")


def test_modules_see_themselves_and_their_neighbours_and_are_run_once() -> None:
    before = set(sys.modules)
    Path("near.py").write_text("HALF = 0.5\n")
    Path("own.py").write_text(
        "from __future__ import annotations\nfrom dataclasses import dataclass\nfrom pathlib import Path\nimport near\n"
        "with Path('runs.txt').open('a') as file:\n    file.write('x')\n"
        "@dataclass\nclass Factor:\n    value: float\n"
        "def grey(first, share):\n    return first * 0 + share.array * Factor(near.HALF).value\n"
        "def tame(v):\n    return 0.0\n"
    )
    problem_of([free("share", 1, regularizer="own:tame")], [made("*.reflectance.value", "grey", "share")])
    assert Path("runs.txt").read_text() == "x"
    assert not {"own", "near"} & (set(sys.modules) - before)
    Path("own.py").write_text("import sys\nsys.exit(0)\n")
    with pytest.raises(PathreplayError, match="cannot be imported"):
        problem_of([free("share", 1)], [made(WALL, "grey", "share")])
