"""The example for clusters on three nodes that are all on this machine: whether it comes to the same bytes.

    python -m benchmarks.ray_nodes [--nodes 3] [--iterations 6]

starts the nodes as processes of their own (`ray start`, own ports, own folders, one core each, a token that only they
know), runs examples/cluster there with an actor on each, and once more in a process of its own, and compares what came
out. Ends with status 1 if that differs. Nodes listen at this machine's address while it runs. Takes about a minute on
two quiet cores. Wants `pip install 'pathreplay[ray]'`.
"""

from __future__ import annotations

import os
import secrets
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from .kills import outcome

CONFIG = Path(__file__).parents[1] / "examples" / "cluster" / "config.toml"
START_S = 60.0
JOINED = """import ray, sys, time
ray.init(address=sys.argv[1], log_to_driver=False, logging_level="error")
while sum(node["Alive"] for node in ray.nodes()) < int(sys.argv[2]):
    time.sleep(0.2)"""
"""Ends when so many nodes are there: of two that start at once, one may take the other's ports, and never come."""


def main(
    nodes: Annotated[int, typer.Option(help="Nodes of the cluster.")] = 3,
    iterations: Annotated[int, typer.Option(help="Of the example, which has 40.")] = 6,
) -> None:
    """Start the nodes, run the example, compare."""
    shorter = [f"-Diterations={iterations}", f"-Dparameters.0.refine_at=[{iterations // 2}]"]
    token = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32), "RAY_USAGE_STATS_ENABLED": "0"}
    environment = {**os.environ, **token}
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        host, port = _address(), _free_port()
        address = f"{host}:{port}"
        head = ["--head", f"--node-ip-address={host}", f"--port={port}", "--include-dashboard=false"]
        for number in range(nodes):
            what = [*head, f"--temp-dir={folder}/ray"] if number == 0 else [f"--address={address}"]
            stack.callback(_stop, _node(what, environment))
            _wait_for(host, port)
            joined = [sys.executable, "-c", JOINED, address, str(number + 1)]
            subprocess.run(joined, env=environment, check=True, timeout=START_S)
        begin = time.perf_counter()
        ray = [f"-Dray.address={address}", f"-Dray.actors={nodes}"]
        _run([*shorter, *ray, "--output", f"{name}/cluster"], environment)
        print(f"by {nodes} actors on {nodes} nodes: {time.perf_counter() - begin:.0f} s", flush=True)
        _run([*shorter, "--executor", "local", "--output", f"{name}/whole"], environment)
        whole, found = (outcome(folder / which) for which in ("whole", "cluster"))
    other = sorted(key for key in {*whole, *found} if whole.get(key) != found.get(key))
    print(f"others in {', '.join(other)}" if other else "the same bytes as in one process")
    raise typer.Exit(1 if other else 0)


def _address() -> str:
    """The address of this machine: Ray's nodes find each other by one that is no loopback."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))  # sends nothing
        return str(probe.getsockname()[0])


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("", 0))
        return int(probe.getsockname()[1])


def _node(what: list[str], environment: dict[str, str]) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "ray.scripts.scripts", "start", *what, "--num-cpus=1", "--block"]
    return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def _wait_for(host: str, port: int) -> None:
    """Until the first node listens; the others need it."""
    end = time.monotonic() + START_S
    while time.monotonic() < end:
        with socket.socket() as probe:
            if probe.connect_ex((host, port)) == 0:
                return
        time.sleep(0.2)
    raise SystemExit(f"no Ray at {host}:{port} after {START_S:.0f} s")


def _stop(node: subprocess.Popen[bytes]) -> None:
    node.terminate()
    try:
        node.wait(30)
    except subprocess.TimeoutExpired:
        node.kill()


def _run(arguments: list[str], environment: dict[str, str]) -> None:
    command = [sys.executable, "-m", "pathreplay.cli", "optimize", str(CONFIG), *arguments]
    subprocess.run(command, env=environment, check=True)


if __name__ == "__main__":
    typer.run(main)
