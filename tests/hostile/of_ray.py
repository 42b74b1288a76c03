"""Parts of Ray that are killed in the middle of a run, and at its start; nothing where Ray is not installed."""

from __future__ import annotations

import importlib.util
import shlex
import sys

import numpy as np

from .case import Action, add
from .room import Room

KIND = "ray"

# Ends as the run does; with status 77 where a process of Ray stays, 78 where a run that went on did not say why.
KILL = """
import os, signal, subprocess, sys, time
os.environ["RAY_DEFAULT_OBJECT_STORE_MAX_MEMORY_BYTES"] = str(2**28)  # a file, and those of a case are limited
from pathlib import Path
import psutil
names, early = sys.argv[1].split(","), sys.argv[2] == "early"
restarts = names == ["RayActor"]  # Ray starts actors again, and the run goes on
run = [sys.executable, "-m", "pathreplay.cli", "optimize", "job.toml", "--executor", "ray"]
process = subprocess.Popen(run, stderr=subprocess.PIPE if restarts else None, text=True)
me = psutil.Process(process.pid)
tree = lambda *names: [p for p in me.children(recursive=True) if not names or any(name in p.name() for name in names)]
checkpoint = Path("runs/job/checkpoint.safetensors")
ready = (lambda: tree("RayActor")) if early else checkpoint.exists
while not ready() and process.poll() is None:
    time.sleep(0.05)
time.sleep(0.2 if early else 2)
if process.poll() is not None:
    sys.exit(process.returncode)
known = tree()
victims = known if names == ["all"] else [me] if names == ["driver"] else tree(*names)
for victim in victims:
    victim.kill()
if restarts:
    # Without end: the run is stopped once an actor that was started again has finished an iteration.
    while not set(tree("RayActor")) - set(victims) and process.poll() is None:
        time.sleep(0.05)
    started = time.time()
    while checkpoint.stat().st_mtime <= started and process.poll() is None:
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    words = process.communicate()[1]
    sys.stderr.write(words)
    if "was lost and is started again" not in words:
        sys.exit(78)
status = process.wait()
gone, alive = psutil.wait_procs(known, timeout=15)
sys.exit(77 if alive else 1 if names == ["driver"] else status)
"""


def _killed(names: str, when: str) -> None:
    def spoil(room: Room, rng: np.random.Generator) -> Action:
        # Actors may go on without the head, and then the run completes. No other run may complete by itself.
        room.change("iterations", 300 if names == "gcs_server" else 10**6)
        room.write("kill.py", KILL)
        return Action(shell=f"{shlex.quote(sys.executable)} kill.py {names} {when}", writes=("kill.py", "runs"))

    add(KIND, f"{names} killed, {when}", spoil)


if importlib.util.find_spec("ray") is not None:
    for _names in ("all", "gcs_server", "raylet", "RayActor", "DashboardAgent,RuntimeEnvAgent", "driver"):
        _killed(_names, "late")
    for _names in ("all", "RayActor,DashboardAgent,RuntimeEnvAgent", "driver"):
        _killed(_names, "early")
