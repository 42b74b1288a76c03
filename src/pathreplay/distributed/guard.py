"""Sees to it that nothing of a cluster of our own stays, however this process ends: a process that outlives it.

Ray's processes are ended by the kernel with the one that started them, but not what those have started: agents of a
raylet that was killed stay for ever. And Ray ends a process without a word whose raylet is gone: the guard says it.
"""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

_PATIENCE_S = 20.0

# It reads the numbers of sessions until this process closes the pipe or is gone.
_GUARD = """
import os, shutil, signal, sys, time
for name in ("SIGINT", "SIGTERM", "SIGHUP"):
    signal.signal(getattr(signal, name), signal.SIG_IGN)
said = {word for line in sys.stdin for word in line.split()}
sessions = {int(word) for word in said - {"done"}} - {os.getsid(0)}
if "done" not in said:
    try:
        print("pathreplay: the process has ended in the middle of its run: it was killed, or Ray has ended it, whose "
              "processes are gone; go on with: pathreplay optimize --resume RUN_FOLDER", file=sys.stderr, flush=True)
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
    found = list(left())
    if not found:
        break
    for number in found:
        try:
            os.kill(number, signal.SIGKILL)
        except OSError:
            pass
    time.sleep(0.05)
shutil.rmtree(sys.argv[1], ignore_errors=True)
"""


class Guard:
    """Removes ``folder`` when this process ends, or at `close`; before that it ends what is left of the sessions."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", _GUARD, str(folder)],
            stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, start_new_session=True,
            text=True,
        )  # fmt: skip

    def watch(self, sessions: Iterable[int]) -> None:
        """Tell it of sessions that are Ray's."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            print(*sessions, file=self._process.stdin, flush=True)

    def close(self) -> None:
        """Let it do its work now, and wait for it."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            print("done", file=self._process.stdin)
            self._process.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_PATIENCE_S)
        shutil.rmtree(self._folder, ignore_errors=True)  # it may have been killed
