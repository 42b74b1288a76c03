"""Parts of Ray that are killed in the middle of a run, and at its start; nothing where Ray is not installed."""

from __future__ import annotations

import importlib.util
import shlex
import sys

import numpy as np

from .case import Action, add
from .room import Room

KIND = "ray"

# Exits with the run's status, with 77 if a process of Ray stays, or with 78 if the restart of an actor was not logged.
KILL = """
import os, signal, subprocess, sys, time
os.environ["RAY_DEFAULT_OBJECT_STORE_MAX_MEMORY_BYTES"] = str(2**28)  # a file, and those of a case are limited
from pathlib import Path
import psutil
names, early = sys.argv[1].split(","), sys.argv[2] == "early"
restarts = names == ["RayActor"]  # Ray restarts actors, and the run continues
command = [sys.executable, "-m", "pathreplay.cli", "optimize", "job.toml", "--executor", "ray"]
process = subprocess.Popen(command, stderr=subprocess.PIPE if restarts else None, text=True)
me = psutil.Process(process.pid)
run = Path("runs/job")
checkpoint = run / "checkpoint.safetensors"

def tree(*names):
    found = []
    for child in me.children(recursive=True):
        try:
            if not names or any(name in child.name() for name in names):
                found.append(child)
        except psutil.NoSuchProcess:  # it has just ended
            pass
    return found

def saved():
    return checkpoint.stat().st_mtime if checkpoint.exists() else 0.0

def wait(until):
    while not until() and process.poll() is None:
        time.sleep(0.05)

wait(lambda: tree("RayActor") if early else saved())
start = saved()  # written before the first iteration; the next one shows that the run is under way
wait(lambda: early or saved() > start)
time.sleep(0.2 if early else 2)
if process.poll() is not None:
    sys.exit(process.returncode)
known = tree()
victims = known if names == ["all"] else [me] if names == ["driver"] else tree(*names)
for victim in victims:
    victim.kill()
if restarts:
    # Stop the run once it has saved an iteration of the restarted actor.
    wait(lambda: set(tree("RayActor")) - set(victims))
    restarted = time.time()
    wait(lambda: saved() > restarted)
    process.send_signal(signal.SIGTERM)
    words = process.communicate()[1]
    sys.stderr.write(words)
    if "was lost and is being restarted" not in words:
        sys.exit(78)
status = process.wait()
gone, alive = psutil.wait_procs(known, timeout=15)
if status not in (0, 2) and run.exists():
    # The process was ended by force, perhaps while it wrote a file. Resuming must be possible and removes the rest.
    from pathreplay.runs.run_folder import open_run_folder
    open_run_folder(run)
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
