"""The rooms of the source: who may use whom, where differentiation is called, and how large things are."""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from types import FrameType

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import pathreplay
from driven import FLOOR, KEYS, attached, backward, foggy, weights, world
from pathreplay.scenes.parameters import get_array
from profiled import calls_noted

SOURCE = Path(pathreplay.__file__).parent
#: The files at the top, but for `cli.py`, `torch.py` and `jax.py`.
FILES = "files"
BASE = {"platform", FILES}
#: Each room, and the rooms that it may use; `inverse` is a house of rooms. Nobody
#: uses `cli` or `bridges` (`torch.py` and `jax.py`).
ALLOWED: dict[str, set[str]] = {
    "cli": {"inverse.config", "jobs", "testing", "report", "output", "scenes", *BASE},
    "output": {
        "inverse.config",
        "inverse.images",
        "inverse.parameters",
        "inverse.dataset",
        "runs",
        "integrators",
        "scenes",
        *BASE,
    },
    "library": {"inverse", "distributed", "runs", "report", "integrators", "scenes", *BASE},
    "bridges": {"scenes", *BASE},
    "jobs": {"library", "inverse", "distributed", "runs", "report", "scenes", *BASE},
    "report": {"inverse", "runs", "scenes", *BASE},
    "runs": {"inverse", "integrators", *BASE},
    "distributed": {"inverse", "scenes", *BASE},
    "inverse.loop": {
        "inverse.optim",
        "inverse.objective",
        "inverse.problem",
        "inverse.dataset",
        "inverse.parameters",
        "inverse.images",
        "inverse.config",
        "scenes",
        *BASE,
    },
    "inverse.optim": {"inverse.parameters", "inverse.config", *BASE},
    "inverse.objective": {
        "inverse.problem",
        "inverse.dataset",
        "inverse.parameters",
        "inverse.losses",
        "inverse.images",
        "inverse.config",
        "integrators",
        "samplers",
        "scenes",
        *BASE,
    },
    "inverse.problem": {
        "inverse.dataset",
        "inverse.parameters",
        "inverse.losses",
        "inverse.images",
        "inverse.config",
        "integrators",
        "scenes",
        *BASE,
    },
    "inverse.dataset": {"inverse.parameters", "inverse.images", "inverse.config", "integrators", "scenes", *BASE},
    "inverse.parameters": {
        "inverse.losses",
        "inverse.images",
        "inverse.caustics",
        "inverse.config",
        "integrators",
        "scenes",
        *BASE,
    },
    "inverse.caustics": set(BASE),
    "inverse.losses": {"inverse.images", "inverse.config", "scenes", *BASE},
    "inverse.images": {"scenes", *BASE},
    "inverse.config": {"scenes", *BASE},
    "inverse": set(),
    "testing": {"integrators", "scenes", *BASE},
    "integrators": {"particles", "boundary", "adjoint", "transport", "samplers", "scenes", *BASE},
    "boundary": {"adjoint", "transport", "samplers", *BASE},
    "particles": {"adjoint", "transport", "samplers", *BASE},
    "adjoint": {"transport", "samplers", *BASE},
    "transport": {"samplers", *BASE},
    "samplers": set(),
    "scenes": set(BASE),
    "plugins": set(BASE),
    "platform": {FILES},
    FILES: {"platform"},
}
HOUSE = "inverse"
MOST_MODULES = 16
#: Each driver, and the file of its own.
DRIVERS = {
    "sweep": "adjoint/sweep.py",
    "replay": "adjoint/replay.py",
    "replay_attached": "adjoint/replay_attached.py",
    "pixel_sweep": "adjoint/pixel_sweep.py",
    "emission_only": "adjoint/emission_only.py",
    "forward": "adjoint/forward.py",
    "primal": "adjoint/primal.py",
    "tape": "integrators/baselines/naive.py",
    "radiative": "integrators/baselines/radiative.py",
    "listing": "integrators/baselines/listing.py",
}
DRIVER_LINES, FUNCTION_LINES = 120, 80


def module_of(path: Path) -> str:
    parts = ["pathreplay", *path.relative_to(SOURCE).with_suffix("").parts]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


TREES = {path: ast.parse(path.read_text()) for path in sorted(SOURCE.rglob("*.py"))}
MODULES = {module_of(path): path for path in TREES}


def room_of(path: Path) -> str:
    first, *rest = path.relative_to(SOURCE).parts
    if first == HOUSE and len(rest) > 1:
        return f"{first}.{rest[0]}"
    return first if rest else {"cli.py": "cli", "torch.py": "bridges", "jax.py": "bridges"}.get(first, FILES)


def allowed(one: str, other: str) -> bool:
    """Whether a room may use another: it, or the house that it is in, is in the list."""
    return other in ALLOWED[one] or other.split(".")[0] in ALLOWED[one]


def imports(path: Path) -> Iterator[tuple[str, int]]:
    """Our modules that a file imports, wherever in it (functions, TYPE_CHECKING), and the line."""
    package = module_of(path).split(".")
    package = package if path.stem == "__init__" else package[:-1]
    for node in ast.walk(TREES[path]):
        named: list[str] = []
        if isinstance(node, ast.Import):
            named = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            whole = ".".join([*base, *([node.module] if node.module else [])])
            of_package = [f"{whole}.{alias.name}" for alias in node.names]
            named = [name if name in MODULES else whole for name in of_package]
        for name in named:
            if name in MODULES and name != module_of(path):
                yield name, node.lineno


def arrows() -> Iterator[tuple[str, str, str]]:
    """From which room to which other room, and where."""
    for path in TREES:
        for module, line in imports(path):
            one, other = room_of(path), room_of(MODULES[module])
            if one != other:
                yield one, other, f"{path.relative_to(SOURCE)}:{line} imports {module}"


def test_every_room_has_its_place() -> None:
    assert {room_of(path) for path in TREES} == set(ALLOWED)


def test_no_arrow_points_back_up() -> None:
    found = [where for one, other, where in arrows() if not allowed(one, other)]
    assert not found, "\n".join(found)


def test_what_is_allowed_has_no_circle() -> None:
    # The files at the top are the lowest, and the package itself, one of them, sets up the platform.
    below = {room: {other for other in ALLOWED if allowed(room, other)} - {room} for room in ALLOWED}
    below[FILES] = set()
    order = list(TopologicalSorter(below).static_order())
    wanted = [
        FILES,
        "transport",
        "adjoint",
        "boundary",
        "integrators",
        "inverse.problem",
        "inverse.loop",
        "library",
        "jobs",
    ]
    assert sorted(wanted, key=order.index) == wanted
    assert not {"cli", "bridges"} & set().union(*ALLOWED.values())


def test_baselines_are_there_for_comparison_only() -> None:
    named = [
        f"{path.relative_to(SOURCE)}:{line}"
        for path in TREES
        for module, line in imports(path)
        if "baselines" in module and "baselines" not in path.parts
    ]
    assert not named


def test_folders_are_not_halls() -> None:
    folders = Counter(path.parent for path in TREES if path.stem != "__init__")
    assert not [str(folder) for folder, count in folders.items() if count > MOST_MODULES]


def test_no_circle_between_modules() -> None:
    graph = {module_of(path): {module for module, _ in imports(path)} for path in TREES}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_only_entrances_name_modules_of_other_rooms_in_strings() -> None:
    """What is imported by name at run time has no arrow in the graph."""
    rooms = {module: room_of(path) for module, path in MODULES.items() if module != "pathreplay"}  # also a plugin
    found = {
        str(path.relative_to(SOURCE))
        for path, tree in TREES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and rooms.get(node.value, room_of(path)) != room_of(path)
    }
    assert found == {"__init__.py", "platform/registration.py"}


# ------------------------------ One request ------------------------------


def room_of_call(frame: FrameType | None) -> str | None:
    """The room of the nearest function of ours, from a frame outwards."""
    while frame is not None:
        path = Path(frame.f_code.co_filename)
        if path in TREES:
            return room_of(path)
        frame = frame.f_back
    return None


@contextmanager
def followed() -> Iterator[set[tuple[str, str]]]:
    """All calls from room to other room within the block."""
    calls: set[tuple[str, str]] = set()

    def note(frame: FrameType) -> None:
        if Path(frame.f_code.co_filename) in TREES:
            one, other = room_of_call(frame.f_back), room_of_call(frame)
            if one is not None and other is not None and one != other:
                calls.add((one, other))

    with calls_noted(note):
        yield calls


def through_surfaces(integrator: mi.Integrator) -> np.ndarray:
    return backward(world(), integrator, FLOOR)


def through_media(integrator: mi.Integrator) -> np.ndarray:
    """The second of two passes, which knows what the first one has learned."""
    scene = foggy()
    with attached(scene, KEYS[0]) as params:
        for seed in (1, 2):
            integrator.render_backward(scene, params, weights(scene), seed=seed, spp=4)
        return get_array(dr.grad(params[KEYS[0]]))


def of_pixels(integrator: mi.Integrator) -> np.ndarray:
    scene = world()
    with attached(scene, FLOOR) as params:
        integrator.render_value_and_grad(scene, weights(scene), weights(scene), seed=1, spp=4)
        return get_array(dr.grad(params[FLOOR]))


@pytest.mark.parametrize(
    ("request_of", "handed_down"),
    [
        (through_surfaces, set()),
        (through_media, {("transport", "adjoint")}),
        (of_pixels, {("adjoint", "integrators"), ("samplers", "integrators")}),
    ],
    ids=["surfaces", "media", "pixels"],
)
def test_a_gradient_request_goes_down_and_up_again(
    request_of: Callable[[mi.Integrator], np.ndarray], handed_down: set[tuple[str, str]]
) -> None:
    """All calls from room to room go down, so that whoever follows one meets each room once.

    But for functions that a room has handed down with a pass: the baseline (`TraceConfig.baseline`), which guesses
    radiance in media, and the camera and the samples of a pixel sweep.
    """
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 3})
    with followed() as calls:
        gradient = request_of(integrator)
    assert np.abs(gradient).max() > 0
    assert {("integrators", "adjoint"), ("adjoint", "transport")} <= calls
    assert {(one, other) for one, other in calls if not allowed(one, other)} == handed_down


# ------------------------------ Sizes ------------------------------


def functions(node: ast.AST, path: Path) -> Iterator[tuple[str, int]]:
    """Place and lines of every function below a node."""
    for child in ast.walk(node):
        if isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef)):
            assert child.end_lineno is not None
            place = f"{path.relative_to(SOURCE)}:{child.lineno} {child.name}"
            yield place, child.end_lineno - child.lineno + 1


def test_functions_are_short() -> None:
    sizes = [found for path, tree in TREES.items() for found in functions(tree, path)]
    assert not [place for place, lines in sizes if lines > FUNCTION_LINES]


@pytest.mark.parametrize("name", DRIVERS)
def test_a_drivers_own_file_is_short(name: str) -> None:
    path = SOURCE / DRIVERS[name]
    assert name in {node.name for node in TREES[path].body if isinstance(node, ast.FunctionDef)}
    assert len(path.read_text().splitlines()) < DRIVER_LINES


# ------------------------------ Differentiation ------------------------------


def differentiates(node: ast.AST) -> bool:
    """Whether it calls one of Dr.Jit's functions that propagate derivatives."""
    called = node.func if isinstance(node, ast.Call) else None
    if not (isinstance(called, ast.Attribute) and isinstance(called.value, ast.Name) and called.value.id == "dr"):
        return False
    return called.attr in ("enqueue", "traverse") or called.attr.startswith(("backward", "forward"))


def test_differentiation_is_called_in_one_place() -> None:
    """Within the rooms of light transport; the film does it to what Mitsuba differentiates."""
    places = {
        str(path.relative_to(SOURCE))
        for path, tree in TREES.items()
        if room_of(path) in ("transport", "adjoint", "boundary", "integrators", "plugins")
        for node in ast.walk(tree)
        if differentiates(node)
    }
    assert places == {"adjoint/autodiff.py", "integrators/film/image.py"}
