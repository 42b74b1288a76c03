"""Finds a libLLVM that works with Dr.Jit.

Dr.Jit 1.5 rejects LLVM 14 and older. It accepts 15 and 16, which abort the process at the first minimum or maximum
because they cannot select these instructions for x86. Candidates are therefore tested in subprocesses (0.2-0.3 s each),
in this order: DRJIT_LIBLLVM_PATH, the library that `pip install pathreplay` installs (karellen-llvm-core), and the
system's libraries from new to old.
"""

from __future__ import annotations

import contextlib
import functools
import glob
import importlib.metadata
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from pathreplay.errors import PathreplayError

ENVIRONMENT_VARIABLE = "DRJIT_LIBLLVM_PATH"
#: The user's value of DRJIT_LIBLLVM_PATH. `import pathreplay` may change the variable after this line has read it.
ASKED_FOR = os.environ.get(ENVIRONMENT_VARIABLE, "")
PIP_DISTRIBUTION = "karellen-llvm-core"
OLDEST_USABLE_MAJOR = 17
#: A test takes 0.3 s. A machine under load may need more, and a library that hangs must not block forever.
PROBE_TIMEOUT_S = 60.0

WAY_OUT = (
    f"install one (Linux x86-64: `pip install {PIP_DISTRIBUTION}`; macOS: `brew install llvm`; "
    f"elsewhere your system's LLVM {OLDEST_USABLE_MAJOR} or newer), or let {ENVIRONMENT_VARIABLE} name it"
)


@dataclass(frozen=True)
class LlvmLibrary:
    """A libLLVM and the result of its test.

    `version` is the version that the library reports, such as "23.1.4". If the library crashes before it reports a
    version, `version` is taken from the file name, and may be "". `message` is "" if the library works, otherwise a
    one-line reason.
    """

    path: str
    origin: str
    version: str
    works: bool
    message: str


def pip_library() -> str | None:
    """Return the path of the libLLVM that the wheel karellen-llvm-core installed; None without the wheel.

    The path comes from the wheel's list of files, which is correct in virtual environments and user installs. `pip
    install --target` omits the wheel's lib folder, in which case the result is None.
    """
    try:
        files = importlib.metadata.files(PIP_DISTRIBUTION) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    # Use the file instead of its links, which are created only at the first start of Python after installation.
    paths = (Path(str(f.locate())).resolve() for f in files if re.fullmatch(r"libLLVM\.so\.[\d.]+", f.name))
    return next((str(path) for path in paths if path.is_file()), None)


_SYSTEM_PATTERNS = {
    "linux": (
        os.path.join(sys.prefix, "lib", "libLLVM*.so*"),  # conda environments
        "/usr/lib/*-linux-gnu/libLLVM*.so*",  # Debian, Ubuntu
        "/usr/lib/llvm-*/lib/libLLVM*.so*",  # apt.llvm.org
        "/usr/lib64/libLLVM*.so*",  # Fedora, SUSE
        "/usr/lib64/llvm*/lib*/libLLVM*.so*",
        "/usr/lib/libLLVM*.so*",  # Arch
        "/usr/lib/llvm/*/lib64/libLLVM*.so*",  # Gentoo
        "/usr/local/lib/libLLVM*.so*",
    ),
    "darwin": (
        os.path.join(sys.prefix, "lib", "libLLVM*.dylib"),
        "/opt/homebrew/opt/llvm*/lib/libLLVM*.dylib",
        "/usr/local/opt/llvm*/lib/libLLVM*.dylib",
        "/opt/local/libexec/llvm-*/lib/libLLVM*.dylib",  # MacPorts
    ),
    "win32": (r"C:\Program Files\LLVM\bin\LLVM-C.dll",),
}


def version_in_path(path: str) -> tuple[int, ...]:
    """Return the LLVM version in a path as a tuple, which is empty if the path contains no version.

    Examples: libLLVM.so.19.1 -> (19, 1); libLLVM-15.so.1 -> (15,); .../llvm@20/20.1.8/lib/libLLVM.dylib -> (20, 1, 8).
    A single digit after .so is ignored: it is the version of the library's interface, not the version of LLVM.
    """
    name = os.path.basename(path)
    for text, pattern in (
        (name, r"^libLLVM-(\d+(?:\.\d+)*)"),
        (name, r"^libLLVM\.so\.(\d+(?:\.\d+)+|\d\d+)"),
        (name, r"^libLLVM\.(\d+(?:\.\d+)*)\.dylib"),
        (path, r"llvm[^/]*/(\d+(?:\.\d+)+)/"),
        (path, r"llvm[-@]?(\d+(?:\.\d+)*)/"),
    ):
        if match := re.search(pattern, text):
            return tuple(map(int, match[1].split(".")))
    return ()


def _known_to_linker() -> list[str]:
    """Return the libLLVM files that ldconfig lists, which may be in folders specific to this system."""
    for program in ("ldconfig", "/sbin/ldconfig", "/usr/sbin/ldconfig") if sys.platform == "linux" else ():
        with contextlib.suppress(OSError, subprocess.TimeoutExpired):
            listing = subprocess.run([program, "-p"], capture_output=True, text=True, timeout=10).stdout
            return re.findall(r"^\s*libLLVM\S* .*=> (\S+)$", listing, re.MULTILINE)
    return []


def system_libraries() -> list[str]:
    """Return the system's libLLVM files, from new to old, each file once."""
    paths = [path for pattern in _SYSTEM_PATTERNS.get(sys.platform, ()) for path in glob.glob(pattern)]
    files = {os.path.realpath(path) for path in _known_to_linker() + paths if os.path.isfile(path)}
    return sorted(files, key=lambda path: (version_in_path(path), path), reverse=True)


def candidates() -> Iterator[tuple[str, str]]:
    """Yield (path, origin) of each libLLVM to test, in order of preference, each file once."""
    pip = pip_library() or ""
    # A parent process may have set DRJIT_LIBLLVM_PATH to the wheel's library. The origin of the library is then "pip".
    named = ((ASKED_FOR, "pip" if ASKED_FOR == pip else ENVIRONMENT_VARIABLE), (pip, "pip"))
    seen = {""}
    for path, origin in (*named, *((path, "system") for path in system_libraries())):
        file = path and os.path.realpath(path)
        if file not in seen:
            seen.add(file)
            yield path, origin


#: First lines of the code of every test. The lines copy sys.path from the parent process, disable core dumps (because a
#: crash is a valid result), and load libraries.
_BEGIN = """
import ctypes, json, sys
task = json.loads(sys.argv[1])
sys.path[:] = task["sys_path"]
try:
    import resource
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
except ImportError:
    pass
for path in task["preload"]:
    ctypes.CDLL(path)
"""
_PROBE = """
import drjit as dr
if not dr.has_backend(dr.JitBackend.LLVM):
    raise SystemExit("refused by Dr.Jit")
print(".".join(str(number) for number in dr.detail.llvm_version()), flush=True)
from drjit.llvm.ad import Float
x = Float([1.0, 2.0, 3.0] * 7)  # more lanes than a vector register, so that full and partial packets run
dr.enable_grad(x)
y = dr.minimum(x, 2.0) * dr.maximum(x, 1.5)
dr.backward(dr.sum(y))
gradient = dr.grad(x)
dr.eval(y, gradient)
if [y[i] for i in range(3)] != [1.5, 4.0, 6.0] or [gradient[i] for i in range(3)] != [1.5, 4.0, 2.0]:
    raise SystemExit(f"wrong result: {y}, gradient {gradient}")
"""


def unlinked_siblings(path: str) -> list[str]:
    """Return the run-time libraries that the wheel's libLLVM needs but cannot find yet.

    At the first start of Python after installation, the wheel creates the links libc++.so.1 -> libc++.so.1.0 and two
    more. The links are missing if the folder is not writable. Loading the files before libLLVM then has the same
    effect as the links, because the loader matches the names that are stored in the files.
    """
    folder = Path(path).parent / "x86_64-unknown-linux-gnu"
    files = [folder / name for name in ("libunwind.so.1.0", "libc++abi.so.1.0", "libc++.so.1.0")]
    linked = (folder / "libc++.so.1").exists()
    return [] if linked or not all(file.is_file() for file in files) else [str(file) for file in files]


def _reason(returncode: int, stderr: str) -> str:
    """Return a one-line reason for the failure of a test, from exit status and standard error of the subprocess."""
    # Ignore Dr.Jit's message that the kernel cache is disabled: `probe` disables the cache on purpose.
    messages = [line.strip() for line in stderr.splitlines() if line.strip() and "kernel cache" not in line]
    lines = [re.sub(r"^\w+\(\): ", "", line) for line in messages] or [""]
    crash = returncode < 0 and returncode != -signal.SIGTERM
    usual = lines[-1] if "Traceback" in stderr else lines[0]
    detail = next((line for line in lines if crash and line.startswith("LLVM ERROR")), usual)
    detail = re.sub(r"0x[0-9a-f]+(: |, )?", "", detail).strip(" ,")
    detail = detail if len(detail) <= 200 else detail[:200] + " ..."
    if crash:
        name = {known.value: known.name for known in signal.Signals}.get(-returncode, f"signal {-returncode}")
        return f"kills the process with {name}" + (f" ({detail})" if detail else "")
    return detail or f"the trial ended with exit status {returncode}"


def run_trial(code: str, task: Mapping[str, object], environment: Mapping[str, str]) -> tuple[str, str]:
    """Run `code` in a Python subprocess that defines `task` and has loaded the libraries in `task["preload"]`.

    Returns the standard output, and a one-line reason if the subprocess failed ("" otherwise). Raises nothing.
    """
    if not sys.executable:
        return "", "cannot be tested: sys.executable is not set"
    try:
        done = subprocess.run(
            [sys.executable, "-c", _BEGIN + code, json.dumps({"sys_path": sys.path, "preload": [], **task})],
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=PROBE_TIMEOUT_S,
        )
    except subprocess.TimeoutExpired:
        return "", f"gave no answer within {PROBE_TIMEOUT_S:g} s"
    except OSError as error:
        return "", f"cannot be tested: {error}"
    return done.stdout, "" if done.returncode == 0 else _reason(done.returncode, done.stderr)


def probe(path: str, origin: str = "") -> LlvmLibrary:
    """Test one libLLVM in a subprocess, by comparing minimum, maximum and a gradient with known values.

    An empty `path` tests the library that Dr.Jit chooses itself. The result is cached for the lifetime of this process.
    Raises nothing: failures are reported in `works` and `message`.
    """
    version, message = _tested(path)
    return LlvmLibrary(path, origin, version, not message, message)


@functools.cache
def _tested(path: str) -> tuple[str, str]:
    """Test one libLLVM. Return its version, and the reason why it does not work ("" if it works)."""
    version = ".".join(map(str, version_in_path(os.path.realpath(path))))
    # A cached kernel would bypass the compiler under test.
    environment = os.environ | {ENVIRONMENT_VARIABLE: path, "DRJIT_CACHE_DIR": os.devnull}
    stdout, message = run_trial(_PROBE, {"preload": unlinked_siblings(path)}, environment)
    return stdout.strip() or version, message


def find_llvm() -> LlvmLibrary:
    """Return the first candidate that works. Raises PathreplayError if no candidate works."""
    failed = []
    for path, origin in candidates():
        if (library := probe(path, origin)).works:
            return library
        failed.append(library)
    looked_at = "; ".join(f"{library.path}: {library.message}" for library in failed) or "none found"
    raise PathreplayError(f"no libLLVM that Dr.Jit can use ({looked_at}): {WAY_OUT}")
