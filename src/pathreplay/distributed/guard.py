"""Removes all processes and files of a private Ray cluster, however the run's process ends.

The guard is a separate process that outlives the run's process. When the run's process ends, the kernel ends the Ray
processes that the run has started, but not their child processes. Without the guard, the agents of a killed raylet
would run forever. If the raylet is gone, Ray ends the run's process without a message, and the guard prints the reason.
"""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

_PATIENCE_S = 20.0

# Program of the guard. It reads session ids from its standard input until the run's process closes the pipe or ends.
_GUARD = """
import os, shutil, signal, sys, time
for name in ("SIGINT", "SIGTERM", "SIGHUP"):
    signal.signal(getattr(signal, name), signal.SIG_IGN)
words = {word for line in sys.stdin for word in line.split()}
sessions = {int(word) for word in words - {"done"}} - {os.getsid(0)}
if "done" not in words:
    try:
        print("pathreplay: the process ended during its run: it was killed, or Ray ended it because Ray's processes "
              "were gone; resume with: pathreplay optimize --resume RUN_FOLDER", file=sys.stderr, flush=True)
    except OSError:
        pass
def left():
    for name in os.listdir("/proc") if os.path.isdir("/proc") else ():
        try:
            if name.isdigit() and os.getsid(int(name)) in sessions and os.stat("/proc/" + name).st_uid == os.getuid():
                if open(f"/proc/{name}/stat").read().rpartition(")")[2].split()[0] != "Z":
                    yield int(name)
        except OSError:
            pass
for _ in range(50):
    remaining = list(left())
    if not remaining:
        break
    for number in remaining:
        try:
            os.kill(number, signal.SIGKILL)
        except OSError:
            pass
    time.sleep(0.05)
shutil.rmtree(sys.argv[1], ignore_errors=True)
"""


class Guard:
    """Starts a guard. At `close`, or when this process ends, the guard ends all its sessions and removes ``folder``."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", _GUARD, str(folder)],
            stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, start_new_session=True,
            text=True,
        )  # fmt: skip

    def watch(self, sessions: Iterable[int]) -> None:
        """Add process sessions, by id, that belong to Ray."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            print(*sessions, file=self._process.stdin, flush=True)

    def close(self) -> None:
        """End the sessions and remove the folder now, and wait until this is done."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            print("done", file=self._process.stdin)
            self._process.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_PATIENCE_S)
        shutil.rmtree(self._folder, ignore_errors=True)  # the guard may have been killed
