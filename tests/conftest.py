"""Sets the variant that the tests run in, before any of them builds a scene.

Every test runs in the variant that variant.py names; what needs another one, or a Python that has not imported us
yet, starts one of its own with `run_python`. (Setting a second variant runs Mitsuba's Python modules once more: its
stock integrators are then no longer instances of the classes that those modules show.)
"""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

import unoptimised

if unoptimised.is_asked_for():
    unoptimised.keep_apart()
from pathreplay.platform.backend import set_variant  # before mitsuba: points Dr.Jit at a libLLVM

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip
import numpy as np  # isort: skip

from pathreplay import baselines  # isort: skip
from pathreplay.report import report  # isort: skip
from pathreplay.inverse.images.io import png_bytes  # isort: skip
from variant import VARIANT  # isort: skip

#: Files that compute and neither read nor write pictures, which a pool of one thread would wait for for ever.
COMPUTING = {"test_truth_media", "test_pixel_sweep", "test_replay_attached", "test_primal_media", "test_baselines",
             "test_truth_materials", "test_truth_attached", "test_motion_noise", "test_fixed_set", "test_drivers",
             "test_terms", "test_evaluated", "test_step", "test_truth_edges", "test_truth_edges_inner",
             "test_truth_edges_media"}  # fmt: skip
#: Files whose quick tests have Mitsuba read or write EXR files, or that need two threads.
READING = {"test_derived", "test_export", "test_particles_in_use", "test_photographs", "test_picture_files",
           "test_response", "test_stored", "test_views_apart"}  # fmt: skip
#: Far above what any of these takes (a few seconds): a hanging process must not hang the tests.
TIMEOUT_S = 120
#: Files that take longest, begun first, so that of several processes none is left alone with one of them.
LONGEST = ("test_hostile", "test_truth_edges_inner", "test_truth_edges", "test_truth_media", "test_edges_ordinary",
           "test_mitsuba_configs", "test_edges_in_use", "test_truth_edges_media", "test_library", "test_seen_flow",
           "test_particles_in_use", "test_camera_motion", "test_particle_images", "test_truth_materials", "test_check",
           "test_particle_gradients", "test_gauss_newton", "test_primal_media", "test_run_signals",
           "test_pixel_sweep", "test_replay_attached", "test_ordinary_use", "test_truth_attached", "test_baselines",
           "test_inverse_run", "test_motion_noise", "test_variants", "test_inverse_grids", "test_deterministic",
           "test_volume_example")  # fmt: skip


def pytest_configure() -> None:
    """Set the variant before test modules are imported, so that module-level `mi.<Type>` works in them."""
    set_variant(VARIANT)
    baselines.register()
    if unoptimised.is_asked_for() and VARIANT.startswith("llvm"):
        unoptimised.leave_unoptimised()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest files, in their order; the others follow in theirs."""
    rank = {name: i for i, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(rank)))


def pytest_collection_finish() -> None:
    """Let no collection look at what imports have made, half a million objects that stay: it would take .3 s each time.

    Scenes are collected before others are made, some thousand times in all.
    """
    gc.collect()
    gc.freeze()


@pytest.fixture
def wall_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with the scene of `wall_job` in it."""
    from wall_job import SCENE

    monkeypatch.chdir(tmp_path)
    (tmp_path / "room.xml").write_text(SCENE)
    return tmp_path


@pytest.fixture
def opened() -> Iterator[Callable[[Any], Any]]:
    """Opens cases of `truth`, and releases them at the end."""
    from truth import Bench

    benches: list[Bench] = []

    def open_case(case: Any) -> Bench:
        benches.append(Bench(case))
        return benches[-1]

    yield open_case
    for bench in benches:
        bench.release()


@pytest.fixture(autouse=True)
def _variant() -> Iterator[None]:
    """Hold every test to leaving the variant as it found it."""
    yield
    assert mi.variant() == VARIANT, "a test that needs another variant runs in a Python of its own (run_python)"


@pytest.fixture(autouse=True, scope="module")
def _own_core(request: pytest.FixtureRequest) -> Iterator[None]:
    """Share the cores among processes that compute side by side: threads that wait for work keep a core from others.

    With kernels as users have them, threads are mostly as users have them, too.
    """
    threads, processes = dr.thread_count(), int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    name = request.module.__name__
    alone = name not in READING if unoptimised.is_asked_for() else name in COMPUTING
    if not alone or processes == 1:
        yield
        return
    dr.set_thread_count(max(1, threads // processes))
    yield
    dr.set_thread_count(threads)


@pytest.fixture(autouse=True)
def _sketched(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out matplotlib's drawing, which takes half of the time of a small job, but where a test is marked drawn."""
    if not request.node.get_closest_marker("drawn"):
        images = {"svg": b"<svg/>", "png": png_bytes(np.zeros((1, 1, 3), np.float32))}
        monkeypatch.setattr(report, "drawn", lambda figure, kind: images[kind])


@pytest.fixture
def without_edge_terms(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the kernels of edges, which take seconds to compile, in tests of messages.

    Messages depend on the scene, and on whether edges move.
    """
    from pathreplay.integrators.boundary_term import Boundary
    from pathreplay.integrators.film.motion import FilmMotion
    from pathreplay.integrators.particles.boundary import ParticleBoundary
    from pathreplay.integrators.term import TermResult

    for term in (Boundary, ParticleBoundary):
        monkeypatch.setattr(term, "backward", lambda self, view, trace, *_: TermResult(moves=self.move(view, trace)))
    monkeypatch.setattr(FilmMotion, "backward", lambda *_: TermResult())


@pytest.fixture
def outputs(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What the kernel of a notebook would send to the browser, one after the other."""
    sent: list[str] = []

    def display(html: str, display_id: bool) -> SimpleNamespace:
        assert display_id is True
        sent.append(html)
        return SimpleNamespace(update=sent.append)

    ipython, shown = ModuleType("IPython"), ModuleType("IPython.display")
    ipython.version_info = 9, 0  # which matplotlib asks for
    ipython.get_ipython = lambda: SimpleNamespace(kernel=object())
    shown.HTML, shown.display = str, display
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    monkeypatch.setitem(sys.modules, "IPython.display", shown)
    return sent


@pytest.fixture
def run_python(tmp_path: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run code in a fresh Python: `run_python(code, env={"NAME": "value" or None}, args=[...])`.

    DRJIT_LIBLLVM_PATH, which this process has set for itself, is not handed on. None in `env` removes a variable. Where
    kernels of tests are not optimised, those of the fresh Python are not, either, and both share one cache. A `bare`
    Python has not loaded a libLLVM before the code runs, and its cache is in `tmp_path`.
    """

    def run(
        code: str, env: dict[str, str | None] | None = None, args: tuple[str, ...] = (), bare: bool = False
    ) -> subprocess.CompletedProcess[str]:
        first = "" if bare else unoptimised.first_line()
        code = first + code
        cache = os.environ["DRJIT_CACHE_DIR"] if first else str(tmp_path)  # that of unoptimised.keep_apart
        environment = dict(os.environ)
        for name, value in {"DRJIT_LIBLLVM_PATH": None, "DRJIT_CACHE_DIR": cache, **(env or {})}.items():
            if value is None:
                environment.pop(name, None)
            else:
                environment[name] = value
        return subprocess.run(
            [sys.executable, "-c", code, *args],
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
            check=False,
        )

    return run


Sections = dict[str, str]
#: Of the processes that ran tests for this one.
MEASURED: list[Sections] = []


def measured() -> Sections:
    """What was measured here: pictures, gradients, the cells that are left out, with the reason, and hostile cases."""
    from measured import EXCLUSIONS, PRIMALS, TOLD
    from measured import table as pictures
    from truth import ROWS, table

    left_out = [f"left out: {name}: {reason}" for name, reason in EXCLUSIONS.items()]
    sections = {
        "pictures against volpath, in standard errors": pictures() if PRIMALS else "",
        "gradients against finite differences": "\n".join([table(), *left_out]) if ROWS else "",
        "hostile cases": "\n".join(TOLD),
    }
    return {title: text for title, text in sections.items() if text}


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Hand what was measured to the process that asked for it."""
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["measured"] = measured()


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any, error: object) -> None:
    """Take it. A process that died has nothing to hand over."""
    MEASURED.append(getattr(node, "workeroutput", {}).get("measured", {}))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print what was measured, of every process by itself."""
    for sections in (measured(), *MEASURED):
        for title, text in sections.items():
            terminalreporter.section(title)
            terminalreporter.write_line(text)
