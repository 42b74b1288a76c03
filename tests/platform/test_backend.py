"""Finding a libLLVM, setting variants, registering plugins, and the doctor."""

from __future__ import annotations

import logging
import os
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import pytest

import pathreplay
from pathreplay import doctor
from pathreplay.errors import PathreplayError
from pathreplay.platform import backend, llvm
from pathreplay.platform import registration as plugins
from pathreplay.platform.llvm import LlvmLibrary

GOOD = os.environ.get("DRJIT_LIBLLVM_PATH", "")
#: A Python of its own says which plugins load in it and which libLLVM it has.
LOAD = """
print(mi.variant(), type(mi.load_dict({"type": "pathreplay"})).__name__, dr.detail.llvm_version()[0])
"""


@pytest.fixture
def bogus(tmp_path: Path) -> str:
    path = tmp_path / "libLLVM.so.99.1"
    path.write_text("not a library")
    return str(path)


# ------------------------------------------------------------------------------------------------------- candidates


@pytest.mark.parametrize(
    ("path", "version"),
    [
        ("/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1", (19, 1)),
        ("/usr/lib/x86_64-linux-gnu/libLLVM-15.so.1", (15,)),
        ("/usr/lib/x86_64-linux-gnu/libLLVM-14.0.6.so.1", (14, 0, 6)),
        ("/usr/lib/llvm-18/lib/libLLVM.so.1", (18,)),
        ("/usr/lib/llvm-18/lib/libLLVM.so", (18,)),
        ("/opt/homebrew/Cellar/llvm@20/20.1.8/lib/libLLVM.dylib", (20, 1, 8)),
        ("/opt/homebrew/opt/llvm@20/lib/libLLVM.dylib", (20,)),
        ("/somewhere/libLLVM.so", ()),
    ],
)
def test_version_in_path(path: str, version: tuple[int, ...]) -> None:
    assert llvm.version_in_path(path) == version


def test_candidates_come_in_the_promised_order_each_file_once(monkeypatch: pytest.MonkeyPatch, bogus: str) -> None:
    monkeypatch.setattr(llvm, "ASKED_FOR", bogus)
    monkeypatch.setattr(llvm, "pip_library", lambda: "/venv/lib/libLLVM.so.23.1")
    monkeypatch.setattr(llvm, "system_libraries", lambda: ["/usr/lib/libLLVM.so.20.1", "/venv/lib/libLLVM.so.23.1"])
    assert list(llvm.candidates()) == [
        (bogus, "DRJIT_LIBLLVM_PATH"),
        ("/venv/lib/libLLVM.so.23.1", "pip"),
        ("/usr/lib/libLLVM.so.20.1", "system"),
    ]


def test_system_libraries_run_from_new_to_old(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("libLLVM-15.so.1", "libLLVM.so.19.1", "libLLVM-9.so.1"):
        (tmp_path / name).touch()
    (tmp_path / "libLLVM.so").symlink_to(tmp_path / "libLLVM.so.19.1")
    monkeypatch.setattr(llvm, "_SYSTEM_PATTERNS", {llvm.sys.platform: (str(tmp_path / "libLLVM*.so*"),)})
    monkeypatch.setattr(llvm, "_known_to_linker", list)
    names = [Path(path).name for path in llvm.system_libraries()]
    assert names == ["libLLVM.so.19.1", "libLLVM-15.so.1", "libLLVM-9.so.1"]


# ------------------------------------------------------------------------------------------------------------ trials


def test_the_library_in_use_passes_its_trial() -> None:
    library = llvm.probe(GOOD)
    assert library.works, library.message
    assert library.version == ".".join(str(number) for number in backend.loaded_version())


def test_a_file_that_is_no_library_fails_its_trial_with_a_reason(bogus: str) -> None:
    library = llvm.probe(bogus)
    assert not library.works
    assert bogus in library.message and "\n" not in library.message


def test_a_library_is_tried_once_whoever_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[str] = []
    monkeypatch.setattr(llvm, "run_trial", lambda code, task, environment: ("", tried.append("once") or "fails"))
    path = str(tmp_path / "libLLVM.so")
    assert [llvm.probe(path, origin).origin for origin in ("", "system")] == ["", "system"]
    assert tried == ["once"]


@pytest.mark.parametrize("path", llvm.system_libraries())
def test_a_library_of_the_system_is_the_version_that_its_name_says_or_fails_with_a_reason(
    path: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = llvm.version_in_path(os.path.realpath(path))
    if said and said[0] < llvm.OLDEST_USABLE_MAJOR:
        monkeypatch.setattr(llvm, "PROBE_TIMEOUT_S", 5.0)  # some hang, with or without more time
    library = llvm.probe(path)
    if not library.works:
        assert "\n" not in library.message
    elif said:
        assert int(library.version.split(".")[0]) == said[0] >= llvm.OLDEST_USABLE_MAJOR


def test_a_crash_is_told_in_one_line() -> None:
    _, message = llvm.run_trial(
        "import os, sys; print('LLVM ERROR: Cannot select: 0x55d7: f32 = fminimum 0x1', file=sys.stderr); os.abort()",
        {},
        os.environ,
    )
    assert message == "kills the process with SIGABRT (LLVM ERROR: Cannot select: f32 = fminimum)"


def test_find_llvm_passes_over_what_fails(monkeypatch: pytest.MonkeyPatch, bogus: str) -> None:
    monkeypatch.setattr(llvm, "candidates", lambda: iter([(bogus, "DRJIT_LIBLLVM_PATH"), (GOOD, "pip")]))
    assert llvm.find_llvm().path == GOOD


def test_find_llvm_names_what_it_tried_and_the_way_out(monkeypatch: pytest.MonkeyPatch, bogus: str) -> None:
    monkeypatch.setattr(llvm, "candidates", lambda: iter([(bogus, "system")]))
    with pytest.raises(PathreplayError, match=r"no libLLVM .*libLLVM\.so\.99\.1.*pip install karellen-llvm-core"):
        llvm.find_llvm()


# ---------------------------------------------------------------------------------------------------------- variants


@pytest.mark.parametrize(
    ("active", "expected"),
    [(None, "{default}"), ("llvm_ad_spectral", "llvm_ad_spectral"), ("scalar_rgb", "{default}")],
    ids=["none", "kept", "replaced"],
)
def test_set_variant_keeps_what_can_differentiate_and_replaces_what_cannot(run_python, active, expected) -> None:
    code = f"""
import pathreplay, drjit as dr, mitsuba as mi
from pathreplay.platform.backend import set_variant
if {active!r}:
    mi.set_variant({active!r})
default = "cuda_ad_rgb" if dr.has_backend(dr.JitBackend.CUDA) else "llvm_ad_rgb"
assert set_variant() == mi.variant() == {expected!r}.format(default=default), mi.variant()
"""
    done = run_python(code, env={"DRJIT_LIBLLVM_PATH": GOOD}, bare=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("llvm_ad_rbg", "there is no variant 'llvm_ad_rbg': did you mean llvm_ad_rgb"),
        ("gpu", "there is no variant 'gpu': use one of"),
        ("scalar_rgb", "scalar_rgb has no derivatives"),
        ("llvm_ad_mono_polarized", "polarised, which pathreplay does not support: use llvm_ad_mono"),
    ],
)
def test_set_variant_refuses_clearly(name: str, message: str) -> None:
    with pytest.raises(PathreplayError, match=message):
        backend.set_variant(name)
    assert mi.variant() == "llvm_ad_rgb"


def test_reload_is_refused_while_there_are_variables_to_lose(bogus: str) -> None:
    keep = mi.Float([1.0, 2.0])
    before = os.environ.get("DRJIT_LIBLLVM_PATH")
    assert not backend.reload_llvm(bogus)
    assert os.environ.get("DRJIT_LIBLLVM_PATH") == before
    assert list(keep) == [1.0, 2.0]


# ----------------------------------------------------------------------------------------------- importing pathreplay

needs_pip_llvm = pytest.mark.skipif(llvm.pip_library() is None, reason="karellen-llvm-core is not installed")


@needs_pip_llvm
@pytest.mark.parametrize(
    "lines",
    [
        "import pathreplay, mitsuba as mi, drjit as dr; mi.set_variant('llvm_ad_rgb')",
        "import pathreplay, mitsuba as mi, drjit as dr; mi.set_variant('scalar_rgb'); mi.set_variant('llvm_ad_mono')",
    ],
)
def test_plugins_load_in_every_later_variant(run_python, lines: str) -> None:
    done = run_python(f"{lines}\n{LOAD}", bare=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[1:] == ["PathReplayIntegrator", "23"]
    assert done.stderr == ""


def test_plugins_load_when_the_variant_was_set_first(run_python) -> None:
    lines = "import mitsuba as mi, drjit as dr; mi.set_variant('llvm_ad_rgb'); import pathreplay"
    done = run_python(f"{lines}\n{LOAD}", env={"DRJIT_LIBLLVM_PATH": GOOD}, bare=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[:2] == ["llvm_ad_rgb", "PathReplayIntegrator"]


def test_importing_sets_no_variant(run_python) -> None:
    done = run_python("import pathreplay, mitsuba as mi; print(mi.variant())", bare=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "None\n", "")


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"])
def test_plugins_and_stand_ins_have_the_same_names(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    registered = {}
    for kind in ("integrator", "bsdf", "medium"):
        monkeypatch.setattr(mi, f"register_{kind}", lambda name, make, kind=kind: registered.update({name: kind}))
    plugins.register(variant)
    assert registered == {name: kind for name, (kind, *_) in plugins.PLUGINS.items()}


@pytest.mark.parametrize("failure", ["ImportError('no mitsuba here')", "RuntimeError('broken')"])
def test_importing_without_mitsuba_raises_nothing_and_the_doctor_tells(run_python, failure: str) -> None:
    code = f"""
import sys
class Broken:
    def find_spec(self, name, path=None, target=None):
        if name == "mitsuba":
            raise {failure}
sys.meta_path.insert(0, Broken())
import pathreplay
from pathreplay.platform.backend import set_variant
from pathreplay.doctor import examine
report = examine()
report.print()
assert not report.works
try:
    set_variant()
except pathreplay.PathreplayError as error:
    print(error)
"""
    done = run_python(code, bare=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("pip install 'mitsuba>=3.9.1,<3.10'") == 2
    assert "pathreplay does not run here" in done.stdout


@needs_pip_llvm
def test_a_library_that_cannot_be_loaded_is_replaced_with_a_warning(run_python, bogus: str) -> None:
    code = f"import pathreplay, mitsuba as mi, drjit as dr; mi.set_variant('llvm_ad_rgb')\n{LOAD}"
    done = run_python(code, env={"DRJIT_LIBLLVM_PATH": bogus}, bare=True)
    assert done.returncode == 0, done.stderr
    assert f"DRJIT_LIBLLVM_PATH={bogus}" in done.stderr


def test_a_known_abort_is_announced_before_it_happens(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(backend, "loaded_version", lambda: (15, 0, 6))
    with caplog.at_level(logging.WARNING, logger="pathreplay"):
        backend.warn_of_bad_llvm()
    assert "libLLVM 15.0.6" in caplog.text and "DRJIT_LIBLLVM_PATH" in caplog.text


OLD = next((path for path in llvm.system_libraries() if llvm.version_in_path(path)[:1] in ((15,), (16,))), None)


@needs_pip_llvm
@pytest.mark.skipif(OLD is None, reason="no LLVM 15 or 16 on this machine to be rescued from")
def test_dr_jit_gives_up_a_library_that_would_abort_it(run_python) -> None:
    """Mitsuba comes first, Dr.Jit takes LLVM 15, and pathreplay has it changed before anything is computed."""
    code = f"""
import mitsuba as mi, drjit as dr
before = dr.detail.llvm_version()[0]
import pathreplay
mi.set_variant("llvm_ad_rgb")
print(before, dr.minimum(mi.Float([1, 2, 3]), mi.Float([3, 2, 1])))
image = mi.render(mi.load_dict(mi.cornell_box()), spp=1)
assert 0.05 < dr.mean(image.array)[0] < 0.5
{LOAD}"""
    done = run_python(code, env={"DRJIT_LIBLLVM_PATH": OLD}, bare=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split("\n")[0] == f"{llvm.version_in_path(str(OLD))[0]} [1, 2, 1]"
    assert done.stdout.split()[-1] == "23"


# ------------------------------------------------------------------------------------------------------------ doctor


@pytest.fixture(scope="module")
def report() -> doctor.DoctorReport:
    return doctor.examine()


def test_the_doctor_finds_that_this_machine_works(report: doctor.DoctorReport) -> None:
    assert report.works
    assert report.mitsuba == mi.__version__
    verdicts = {variant.name: variant for variant in report.variants}
    assert verdicts["llvm_ad_rgb"].works, verdicts["llvm_ad_rgb"].message
    assert not any("polarized" in name or "scalar" in name for name in verdicts)


def test_every_back_end_that_fails_has_a_way_out(report: doctor.DoctorReport) -> None:
    remedies = "\n".join(report.remedies).lower()
    for name in {variant.name.split("_")[0] for variant in report.variants if not variant.works}:
        assert name in remedies


def test_the_doctor_without_any_libllvm_says_how_to_get_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(llvm, "candidates", lambda: iter([]))
    monkeypatch.setattr(llvm, "run_trial", lambda *_: ("", "no GPU"))
    report = doctor.examine()
    assert not report.works
    assert any("pip install karellen-llvm-core" in remedy for remedy in report.remedies)


def test_the_report_never_wraps_a_path(report: doctor.DoctorReport, capsys: pytest.CaptureFixture[str]) -> None:
    path = "/a/[long]/" + "x" * 300 + "/libLLVM.so.23.1"
    replace(report, libraries=(LlvmLibrary(path, "pip", "23.1.4", True, ""),)).print()
    lines = capsys.readouterr().out.splitlines()
    assert any(path in line for line in lines) and f"  pathreplay {pathreplay.__version__}," in lines[1]
