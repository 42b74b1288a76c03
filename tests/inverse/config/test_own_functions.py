"""Functions of the user's own: whatever they return or do, the job is told so in one line."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.user_functions import Imported, Modules
from pathreplay.jobs import make_config, optimize
from room_job import JOB, TEXTURE, room  # noqa: F401 (room: its folder, for every test)

# In a Python of its own: Dr.Jit would never come back from some of these, deaf to signals.
HOSTILE = """
from pathreplay.platform.backend import set_variant
set_variant("llvm_ad_rgb")
import mitsuba as mi
import numpy as np
from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.user_functions import Imported

loop = [1.0]
loop.append(loop)
deep = 1.0
for _ in range(100_000):
    deep = [deep]
class Endless:
    def __len__(self): return 1
    def __getitem__(self, i): return self
for value in ("much", b"much", "", {}, {"a": 1}, {1.0}, loop, (loop,), deep, None, 1j, Endless(), object(), len, mi,
              [mi.Float(1), "much"], np.array("much"), np.array([{}]), iter([1.0]), range(3)):
    try:
        Imported("Loss", "own:f", lambda: value)(mi.TensorXf)
        print("taken:", repr(value)[:30])
    except PathreplayError as error:
        assert str(error).startswith("Loss 'own:f' returns ") and str(error).endswith("or Dr.Jit arrays"), error
try:
    Imported("Loss", "own:f", lambda: mi.set_variant("scalar_rgb"))(float)
except PathreplayError as error:
    print(error)
print(mi.variant())

def sets_and_fails():
    mi.set_variant("scalar_rgb")
    raise ValueError("no")
try:
    Imported("Loss", "own:f", sets_and_fails)(float)
except PathreplayError as error:
    print(error)
print(mi.variant())
"""
SETS = "Loss 'own:f' sets the variant 'scalar_rgb', but the job runs in 'llvm_ad_rgb'; do not set a variant there"
FAILS = "Loss 'own:f' cannot be computed (no); fix it, or name another"


def test_what_is_no_number_is_refused_by_its_type(run_python: Callable[..., Any]) -> None:
    ended = run_python(HOSTILE)
    assert ended.stdout.splitlines() == [SETS, "llvm_ad_rgb", FAILS, "llvm_ad_rgb"], ended.stdout + ended.stderr


NUMBERS = {
    "a whole number": lambda: 3,
    "NumPy's number": lambda: np.float32(3),
    "a list": lambda: [1.0, 2, np.float64(3)],
    "a tuple of Dr.Jit's": lambda: (mi.Float(1), mi.Float(2)),
    "Dr.Jit's": lambda: mi.Float(1, 2),
    "a colour": lambda: mi.Color3f(1, 2, 3),
    "NumPy's": lambda: np.ones((2, 3)),
}


@pytest.mark.parametrize("name", NUMBERS)
def test_numbers_are_taken_whatever_holds_them(name: str) -> None:
    found = Imported("Loss", "own:f", NUMBERS[name])(mi.TensorXf)
    assert type(found) is mi.TensorXf


def test_a_transform_is_taken() -> None:
    found = Imported("Derivation", "own:f", lambda: mi.Transform4f().translate(1))(lambda value: value)
    assert dr.all(found.matrix[0][3] == 1)


OWN = """
import sys
import drjit as dr
import mitsuba as mi
import numpy as np

calls = []

def leaves(*args):
    sys.exit(7)

def leaves_later(image, target):
    calls.append(1)
    if len(calls) > 4:
        raise SystemExit("no more")
    return dr.square(image - target)

def constant(image, target):
    return mi.Float(0.5)

def number(image, target):
    return 0.5

def numpy(image, target):
    return mi.TensorXf((np.array(image) - np.array(target)) ** 2)

def detached(image, target):
    return dr.detach(dr.square(image - target))

def of_the_target(image, target):
    return dr.square(target)
"""
JOBS: dict[str, tuple[dict[str, Any], str]] = {
    "loss leaves": ({"loss": "own:leaves"}, "Loss 'own:leaves' cannot be computed (it exits Python: SystemExit(7)); "),
    "loss leaves later": ({"loss": "own:leaves_later"}, "(it exits Python: SystemExit('no more'))"),
    "penalty leaves": (
        {"parameters": [{"key": TEXTURE, "regularizer": "own:leaves"}]},
        "Regularizer 'own:leaves' cannot be computed (it exits Python: SystemExit(7)); ",
    ),
    "derivation leaves": (
        {
            "parameters": [{"key": "share", "shape": [1], "initial": 0.5}],
            "derived": [{"key": TEXTURE, "function": "own:leaves", "of": ["share"]}],
        },
        "Derivation 'own:leaves' cannot be computed (it exits Python: SystemExit(7)); ",
    ),
    **{
        name: ({"loss": f"own:{name}"}, f"Loss 'own:{name}' does not depend on the image")
        for name in ("constant", "number", "numpy", "detached", "of_the_target")
    },
}


@pytest.mark.parametrize("name", JOBS)
def test_a_job_tells_what_its_function_did(name: str, room: Path) -> None:  # noqa: F811
    (room / "own.py").write_text(OWN)
    change, told = JOBS[name]
    job = {**JOB, **change, "output": "run", "target": {**JOB["target"], "spp": 4}}  # type: ignore[dict-item]
    with pytest.raises(PathreplayError) as caught:
        optimize(make_config(job), progress=False)
    assert told in str(caught.value) and "\n" not in str(caught.value)


def test_one_number_may_be_a_float_of_dr_jits(room: Path) -> None:  # noqa: F811
    (room / "own.py").write_text(
        "import drjit as dr\ndef mean(image, target): return dr.mean(dr.square(image - target).array)"
    )
    job = {**JOB, "iterations": 1, "target": {**JOB["target"], "spp": 4}, "deterministic": True}  # type: ignore[dict-item]
    losses = [
        optimize(make_config({**job, "loss": loss}), progress=False).history[0].loss for loss in ("own:mean", "l2")
    ]
    assert losses[0] == pytest.approx(losses[1], rel=1e-5)


def test_what_fails_in_the_first_iteration_leaves_no_folder(room: Path) -> None:  # noqa: F811
    """Nor those that the run folder was put into; others stay."""
    (room / "own.py").write_text(OWN)
    (room / "kept").mkdir()
    for output in ("runs/a/b", "kept/a/b"):
        with pytest.raises(PathreplayError, match="no more"):
            optimize(make_config({**JOB, "loss": "own:leaves_later", "output": output}), progress=False)
        assert not (room / "runs").exists() and list((room / "kept").iterdir()) == []


def folder_of_modules(folder: Path, factor: int) -> Modules:
    """A folder with a package, and a module that imports another one only when it is called."""
    (folder / "tools").mkdir(parents=True)
    (folder / "tools/__init__.py").write_text(f"FACTOR = {factor}\ndef f(x):\n    return FACTOR * x\n")
    (folder / "tools/sub.py").write_text("from . import FACTOR\ndef f(x):\n    return 10 * FACTOR * x\n")
    (folder / "tools/late.py").write_text("def f(x):\n    from .sub import f as inner\n    return inner(x)\n")
    (folder / "calls.py").write_text(
        "def f(x):\n    import helper, tools\n    helper.calls.append(x)\n    return len(helper.calls) * tools.f(x)\n"
    )
    (folder / "helper.py").write_text("calls = []\n")
    return Modules(folder)


def test_packages_and_late_imports_are_found_in_the_folder_of_each_job(tmp_path: Path) -> None:
    before, path = dict(sys.modules), list(sys.path)
    folders = [folder_of_modules(tmp_path / str(k), k) for k in (2, 3)]
    names = ("tools.sub:f", "tools:f", "tools.late:f", "calls:f")
    functions = [[modules.function("Loss", name, "x") for name in names] for modules in folders]
    values = [[function(float, 1.0) for function in own] for own in functions]
    assert values == [[20.0, 2.0, 20.0, 2.0], [30.0, 3.0, 30.0, 3.0]]
    assert functions[0][3](float, 1.0) == 4.0  # the second call of this job's helper
    assert sys.modules == before and sys.path == path


def test_a_package_of_the_folder_hides_a_loaded_one_only_in_the_job(tmp_path: Path) -> None:
    (tmp_path / "json").mkdir()
    (tmp_path / "json/__init__.py").write_text("def loads(x):\n    return 7\n")
    loaded = {name: module for name, module in sys.modules.items() if name.partition(".")[0] == "json"}
    assert "json.decoder" in loaded
    assert Modules(tmp_path).function("Loss", "json:loads", "x")(int, "1") == 7
    assert {name: sys.modules[name] for name in loaded} == loaded
    (tmp_path / "json/__init__.py").write_text("import json.nothing\n")
    with pytest.raises(PathreplayError, match=r"cannot be imported \(No module named 'json.nothing'\)"):
        Modules(tmp_path).function("Loss", "json:loads", "x")
    assert {name: sys.modules[name] for name in loaded} == loaded


def test_installed_packages_within_the_folder_stay_loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A virtual environment may be in the folder of the job."""
    packages = tmp_path / ".venv/packages"
    (packages / "installed_there").mkdir(parents=True)
    (packages / "installed_there/__init__.py").write_text("VALUE = 5\n")
    monkeypatch.syspath_prepend(str(packages))
    (tmp_path / "own.py").write_text("import installed_there\ndef f(x):\n    return installed_there.VALUE\n")
    try:
        assert Modules(tmp_path).function("Loss", "own:f", "x")(int, 1) == 5
        assert "installed_there" in sys.modules and "own" not in sys.modules
    finally:
        sys.modules.pop("installed_there", None)
