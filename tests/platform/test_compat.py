"""The module of what differs between versions of Mitsuba: the installed version, and fakes of its successor."""

from __future__ import annotations

import ast
import enum
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import pathreplay
from pathreplay.inverse.parameters.pose import make_pose
from pathreplay.output.export import obj_bytes
from pathreplay.platform import compat
from pathreplay.transport.facts.facets import is_coarse
from pathreplay.transport.facts.smoothing_groups import mesh_smoothing_groups

SOURCE = Path(pathreplay.__file__).parent
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 3]])


class NextFlags(enum.IntEnum):
    """`RayFlags` of Mitsuba's development branch (b45b0a9)."""

    Minimal = 0
    Shading = 1
    NormalPartials = 2
    Default = 1
    All = 1
    FollowShape = 4
    DetachShape = 8


class FlagsWithoutAll(enum.IntEnum):
    """The same without the deprecated name."""

    Minimal = 0
    Shading = 1
    NormalPartials = 2
    Default = 1
    FollowShape = 4


class NextMesh:
    """The part of `mi.Mesh` of the development branch that is used, which remembers what it is made of."""

    def __init__(self, props: mi.Properties) -> None:
        self.props, self.made = props, {}

    def from_fields(self, **data: Any) -> None:
        self.made = data


def next_params(normal_index: tuple[int, ...] = ()) -> dict[str, Any]:
    """Parameters of a quad whose two triangles share positions, and have texture coordinates of their own."""
    shared = [0, 1, 2, 0, 2, 3]
    return {
        "faces": mi.TensorXu(np.array([[0, 1, 2], [3, 4, 5]], np.uint32)),
        "positions": mi.TensorXf(CORNERS),
        "normals": mi.TensorXf(np.eye(3, dtype=np.float32)[[0, 1, 2, 0]]),
        "texcoords": mi.TensorXf(CORNERS[shared, :2]),
        "position_index": mi.UInt32(shared),
        "normal_index": mi.UInt32(list(normal_index)),
        "bsdf_index": mi.UInt32([]),
    }


@pytest.fixture
def following(monkeypatch: pytest.MonkeyPatch) -> None:
    """Names of the next version, in the place of those of the installed one."""
    monkeypatch.setattr(mi, "RayFlags", NextFlags)
    monkeypatch.setattr(mi, "Mesh", NextMesh)


# ------------------------------ Flags ------------------------------


def test_flags_of_the_installed_version() -> None:
    flags = mi.RayFlags
    assert compat.minimal() == flags.Minimal
    assert compat.shading_frame() == flags.Minimal | flags.ShadingFrame
    assert compat.shading() == flags.All
    assert compat.normal_partials() == flags.All | flags.dNGdUV
    assert compat.follow_shape() == flags.FollowShape


@pytest.mark.parametrize("flags", [NextFlags, FlagsWithoutAll])
def test_flags_of_the_next_version(monkeypatch: pytest.MonkeyPatch, flags: type) -> None:
    monkeypatch.setattr(mi, "RayFlags", flags)
    assert [compat.minimal(), compat.shading_frame(), compat.shading()] == [0, 1, 1]
    assert [compat.normal_partials(), compat.follow_shape()] == [3, 4]


# ------------------------------ Hits ------------------------------


def hit_of(scene: mi.Scene) -> tuple[mi.PreliminaryIntersection3f, mi.Ray3f]:
    ray = mi.Ray3f(mi.Point3f(0.3, 0.2, 5), mi.Vector3f(0.02, 0.01, -1))
    hit = scene.ray_intersect_preliminary(ray)
    assert bool(hit.is_valid()[0])
    return hit, ray


@pytest.mark.parametrize(("shape", "area"), [("cube", 4.0), ("sheet", 1.0)])
def test_both_forms_find_the_same_triangle_and_its_motion(
    shape: str, area: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A triangle from Mitsuba's tangents, and from its corners: on a cube (with texture coordinates) and without."""
    sheet = compat.new_mesh(CORNERS, FACES, mi.Properties(), flat=True)
    scene = mi.load_dict({"type": "scene", "body": {"type": "cube"} if shape == "cube" else sheet}, optimize=False)
    params = mi.traverse(scene)
    θ = mi.Float(0)
    dr.enable_grad(θ)
    params["body.vertex_positions"] = params["body.vertex_positions"] * (1 + θ)
    params.update()
    hit, ray = hit_of(scene)
    by_tangents = compat.triangle_point(hit, ray, mi.Bool(True))
    monkeypatch.setattr(mi, "RayFlags", renamed(mi.RayFlags))
    by_corners = compat.triangle_point(hit, ray, mi.Bool(True))
    dr.forward(θ)
    np.testing.assert_allclose(np.array(by_corners[1]), np.array(by_tangents[1]), atol=1e-6)
    for si, A in (by_tangents, by_corners):
        np.testing.assert_allclose(np.array(dr.norm(A)), area, rtol=1e-6)
        np.testing.assert_allclose(np.array(dr.grad(A)), 2 * np.array(A), atol=1e-6)  # areas grow with its square
        np.testing.assert_allclose(np.array(dr.grad(si.p)), np.array(si.p), atol=1e-6)


def renamed(flags: Any) -> type[enum.IntEnum]:
    """The installed flags by their new names."""
    names = {"Minimal": flags.Minimal, "Default": flags.All, "NormalPartials": flags.dNGdUV}
    return enum.IntEnum(
        "Renamed", {name: int(flag) for name, flag in (names | {"FollowShape": flags.FollowShape}).items()}
    )


# ------------------------------ Meshes ------------------------------


def test_arrays_of_the_installed_version() -> None:
    """Those of Mitsuba's own cube: six faces of four vertices each."""
    arrays = compat.mesh_arrays(mi.traverse(mi.load_dict({"type": "cube"})))
    assert arrays is not None
    assert arrays.faces.shape == (12, 3) and arrays.positions.shape == arrays.normals.shape == (24, 3)
    assert arrays.texcoords.shape == (24, 2)
    assert np.ptp(arrays.positions[arrays.faces], axis=(0, 1)).tolist() == [2, 2, 2]
    outward = np.einsum("fcd,fcd->fc", arrays.positions[arrays.faces], arrays.normals[arrays.faces])
    np.testing.assert_allclose(outward, 1, rtol=1e-6)
    assert compat.mesh_arrays(mi.traverse(mi.load_dict({"type": "rectangle"}))) is None


@pytest.mark.parametrize(
    ("normal_index", "normals"), [((), [0, 1, 2, 0, 2, 0]), ((0, 0, 0, 1, 1, 1), [0, 0, 0, 1, 1, 1])]
)
def test_arrays_of_the_next_version(normal_index: tuple[int, ...], normals: list[int]) -> None:
    """Vertices refer to positions, and to normals by a map of their own or that of positions."""
    arrays = compat.mesh_arrays(next_params(normal_index))
    assert arrays is not None
    assert arrays.faces.tolist() == [[0, 1, 2], [3, 4, 5]]
    np.testing.assert_array_equal(arrays.positions, CORNERS[[0, 1, 2, 0, 2, 3]])
    np.testing.assert_array_equal(arrays.normals, np.eye(3)[normals])
    np.testing.assert_array_equal(arrays.texcoords, arrays.positions[:, :2])


def test_no_map_is_the_identity() -> None:
    params = {"faces": mi.TensorXu(FACES.astype(np.uint32)), "positions": mi.TensorXf(CORNERS)}
    for table in (params, params | {"position_index": mi.UInt32([])}):
        arrays = compat.mesh_arrays(table)
        assert arrays is not None and len(arrays.normals) == len(arrays.texcoords) == 0
        np.testing.assert_array_equal(arrays.positions, CORNERS)
        found = compat.faces_of_positions({f"a.b.{key}": value for key, value in table.items()}, "a.b.positions")
        assert found is not None and found.tolist() == FACES.tolist()


def test_faces_of_positions_are_those_of_the_parameter() -> None:
    """Large Steps and the report index the rows of the parameter: a seam has two vertices, and one position."""
    following = {f"body.{key}": value for key, value in next_params().items()}
    found = compat.faces_of_positions(following, "body.positions")
    assert found is not None and found.tolist() == FACES.tolist()
    assert compat.faces_of_positions(following, "body.normals") is None
    assert compat.faces_of_positions({}, "body.positions") is None
    flat = {"body.faces": mi.UInt32(FACES.ravel()), "body.vertex_positions": mi.Float(CORNERS.ravel())}
    found = compat.faces_of_positions(flat, "body.vertex_positions")
    assert found is not None and found.tolist() == FACES.tolist()


def test_a_pose_moves_both_forms_alike() -> None:
    moves = {"k.positions:translation": mi.Vector3f(1, 2, 3), "k.positions:rotation": mi.Vector3f(0.1, 0.2, 0.3)}
    tensor = make_pose("k.positions", mi.TensorXf(CORNERS), "rigid", None, None).value(moves)
    flat = make_pose("k.vertex_positions", mi.Float(CORNERS.ravel()), "rigid", None, None).value(
        {key.replace("positions", "vertex_positions"): value for key, value in moves.items()}
    )
    assert isinstance(tensor, mi.TensorXf) and tensor.shape == (4, 3) and isinstance(flat, mi.Float)
    np.testing.assert_allclose(np.array(tensor), np.array(flat).reshape(4, 3), rtol=1e-6)
    assert not np.allclose(np.array(tensor), CORNERS)


def test_a_mesh_is_made_by_fields_in_the_next_version(following: None) -> None:
    props = mi.Properties()
    mesh: Any = compat.new_mesh(CORNERS.astype(np.float64), FACES, props, flat=True)
    assert mesh.props["face_normals"] is True and sorted(mesh.made) == ["faces", "positions"]
    assert isinstance(mesh.made["faces"], mi.TensorXu) and np.array(mesh.made["faces"]).tolist() == FACES.tolist()
    np.testing.assert_array_equal(np.array(mesh.made["positions"]), CORNERS)
    assert compat.positions_name() == "positions"


@pytest.mark.parametrize("flat", [False, True])
def test_a_mesh_of_the_installed_version(flat: bool) -> None:
    mesh = compat.new_mesh(CORNERS.astype(np.float64), FACES, mi.Properties(), flat)
    arrays = compat.mesh_arrays(mi.traverse(mesh))
    assert arrays is not None and arrays.faces.tolist() == FACES.tolist()
    np.testing.assert_array_equal(arrays.positions, CORNERS)
    assert compat.has_normals(mesh) is not flat and len(arrays.normals) == (0 if flat else 4)


class Fake:
    """A mesh of the next version as `mi.traverse` sees it."""

    def has_normals(self) -> bool:
        return True

    def has_face_normals(self) -> bool:
        return False

    def is_emitter(self) -> bool:
        return False

    def id(self) -> str:
        return "fake"


@pytest.mark.parametrize(
    ("use", "expected"),
    [
        (lambda mesh: mesh_smoothing_groups(mesh).tolist(), [0, 1]),
        (is_coarse, True),
        (lambda mesh: obj_bytes(mesh).decode().splitlines()[-1], "f 4/4/4 5/5/5 6/6/6"),
        (compat.has_normals, True),
    ],
)
def test_users_of_arrays_take_the_next_version(
    use: Callable[[Any], object], expected: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A quad whose triangles meet at positions, and share no vertex, as at a seam; its normals are far off."""
    monkeypatch.setattr(mi, "traverse", lambda mesh: next_params())
    assert use(Fake()) == expected


@pytest.mark.parametrize("name", ["vertex_positions", "positions", "faces", "face_colour", "normals", "position_index"])
def test_data_of_meshes_are_known(name: str) -> None:
    assert compat.is_mesh_data(name)
    assert not compat.is_mesh_data("to_world") and not compat.is_mesh_data("bsdf.reflectance.value")


# ------------------------------ The only place ------------------------------


def names_of(tree: ast.AST) -> set[str]:
    """Attributes, and strings other than docstrings (also of attributes), that a module uses."""
    documents = {
        id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }
    texts = {
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in documents
    }
    return texts | {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}


def test_no_other_module_names_what_differs() -> None:
    flags = {"RayFlags", "ShadingFrame", "dNGdUV", "dNSdUV", "dPdUV", "NormalPartials"}
    data = {"faces", "vertex_positions", "vertex_normals", "vertex_texcoords", "position_index", "normal_index"}
    methods = {"has_vertex_normals", "has_vertex_texcoords", "has_texcoords", "recompute_vertex_normals", "from_fields"}
    silhouettes = {"sample_silhouette", "invert_silhouette_sample", "primitive_silhouette_projection"}
    for path in sorted(SOURCE.rglob("*.py")):
        if path.name == "compat.py":
            continue
        text = path.read_text()
        used = names_of(tree := ast.parse(text))
        found = {word for name in used for word in (flags | data | methods | silhouettes) if word == name}
        found |= {name for name in used if any(word in name for word in data - {"faces"})}
        # `faces` is also a field of our own dataclasses.
        assert found <= {"faces"}, (path, found)
        assert "faces" not in text or "'faces'" not in ast.unparse(tree), path
