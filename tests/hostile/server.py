"""A process that has imported everything and forks for each case, so that a case costs no start of Python.

It reads one request a line (JSON) and answers with one line: how the process ended, how long it took and how much
memory it had. No Mitsuba variant is set before the fork, so that nothing of Dr.Jit is shared. LLVM leaves kernels
unoptimised: what is tested is how a case ends, and a check of 14 parameters takes 16 s instead of 33.
"""

from __future__ import annotations

import importlib
import json
import os
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

MEMORY_LIMIT_MB = 4096
POLL_S = 0.02

#: Of this process before it imports anything, for processes that start anew.
ENVIRONMENT = dict(os.environ)

#: What most cases import, two seconds of work. No name of theirs is used here.
IMPORTED = ("pathreplay.cli", "pathreplay.jobs.job", "pathreplay.testing.command")


def serve() -> None:
    """Answer requests until standard input ends."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever imports print does not belong among the answers
    import unoptimised  # on the path of this process; `judge` imports this module elsewhere

    unoptimised.keep_apart()
    for module in IMPORTED:
        importlib.import_module(module)
    if "DRJIT_LIBLLVM_PATH" in os.environ:
        unoptimised.leave_unoptimised()

    for line in sys.stdin:
        request = json.loads(line)
        begin = time.perf_counter()
        process = os.fork()
        if process == 0:
            _end_with(partial(_child, request))
        ended = _watch(process, request["timeout"])
        print(json.dumps(ended | {"seconds": time.perf_counter() - begin}), file=answers, flush=True)


def _end_with(work: Callable[[], None]) -> NoReturn:
    """Do the work and end the process as Python would: status, traceback, flushed output.

    Python's own end is left out: libraries wait in it for threads that a fork does not have. The cases that have a
    process of their own go through it.
    """
    status = 0
    try:
        work()
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
        status = 1
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(status)


def _watch(process: int, timeout: float) -> dict[str, Any]:
    """Wait for the end of a process; kill its group when it takes too long or too much."""
    end, why = time.monotonic() + timeout, ""
    while True:
        done, status, usage = os.wait4(process, os.WNOHANG)
        if done:
            break
        if time.monotonic() > end:
            why = "timeout"
        elif _peak_mb(process) > MEMORY_LIMIT_MB:
            why = "memory"
        if why:
            _kill_group(process)
            _, status, usage = os.wait4(process, 0)
            break
        time.sleep(POLL_S)
    _kill_group(process)  # what it may have left running
    return {"status": os.waitstatus_to_exitcode(status), "killed": why, "peak_mb": usage.ru_maxrss // 1024}


def _kill_group(process: int) -> None:
    try:
        os.killpg(process, signal.SIGKILL)
    except ProcessLookupError:
        pass


def _peak_mb(process: int) -> int:
    """Largest memory so far of a process; those that it started are not looked at."""
    try:
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) // 1024 for line in lines if line.startswith("VmHWM")), 0)


def _child(request: dict[str, Any]) -> None:
    """Do what is asked for, with standard streams in files."""
    os.setsid()
    os.chdir(request["folder"])
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**30, 2**30))
    for descriptor, path in ((0, os.devnull), (1, request["stdout"]), (2, request["stderr"])):
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o600)
        os.dup2(file, descriptor)
        os.close(file)
    sys.stdin = open(0, closefd=False)
    if request["shell"]:
        os.execvpe("bash", ["bash", "-c", request["shell"]], ENVIRONMENT)
    if request["script"]:
        _run_script(request["script"])
        return
    from pathreplay.cli import main

    sys.argv = ["pathreplay", *request["argv"]]
    main()


def _run_script(code: str) -> None:
    """Run a user's script; an error that it is meant to see ends it with status 2, any other with a traceback."""
    from pathreplay.errors import PathreplayError

    try:
        exec(compile(code, "script", "exec"), {"__name__": "script"})
    except PathreplayError as error:
        print(f"pathreplay: error: {error}", file=sys.stderr)
        sys.exit(2)
    except Exception as error:
        if not _told_by_mitsuba(error):
            raise
        # Mitsuba wraps what a plugin raises and adds where; then the last line is the plugin's. Else all is Mitsuba's.
        lines = str(error).strip().splitlines()
        told = lines[-1] if "Traceback" in str(error) else " ".join(lines)
        print("pathreplay: error: " + ascii(told)[:1000], file=sys.stderr)
        sys.exit(2)


def _told_by_mitsuba(error: Exception) -> bool:
    """Whether an error is one of ours in Mitsuba's wrapping, or one with which Mitsuba refuses a property."""
    import pathreplay

    text, frames = str(error), traceback.extract_tb(error.__traceback__)
    package = str(Path(pathreplay.__file__).parent)
    ours = any(frame.filename.startswith(package) for frame in frames) or "Traceback" in text
    refused = isinstance(error, RuntimeError) and (not ours or 'roperty "' in text.strip().splitlines()[-1])
    return refused or "PathreplayError: " in text


if __name__ == "__main__":
    serve()
