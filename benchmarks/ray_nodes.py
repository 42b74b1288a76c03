"""Tests that the cluster example gives the same bytes on several Ray nodes as in one process.

    python -m benchmarks.ray_nodes [--nodes 3] [--iterations 6]

The command starts all nodes on this machine (`ray start`, with own ports, own folders, one core each, and a common
secret token). It runs examples/cluster with an actor on each node, and once more in one process, and compares the
results. The exit status is 1 if the results differ. The nodes listen at this machine's address during the run. The
command takes about a minute on two quiet cores, and needs `pip install 'pathreplay[ray]'`.
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
"""Waits until a number of nodes have joined. Nodes start one by one: concurrent starts may claim the same ports."""


def main(
    nodes: Annotated[int, typer.Option(help="Number of nodes.")] = 3,
    iterations: Annotated[int, typer.Option(help="Iterations of the example, which has 40 by default.")] = 6,
) -> None:
    """Start the nodes, run the example, and compare the results."""
    shorter = [f"--set=iterations={iterations}", f"--set=parameters.0.refine_at=[{iterations // 2}]"]
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
        ray = [f"--set=ray.address={address}", f"--set=ray.actors={nodes}"]
        _run([*shorter, *ray, "--output", f"{name}/cluster"], environment)
        print(f"by {nodes} actors on {nodes} nodes: {time.perf_counter() - begin:.0f} s", flush=True)
        _run([*shorter, "--executor", "local", "--output", f"{name}/whole"], environment)
        expected, result = (outcome(folder / which) for which in ("whole", "cluster"))
    differing = sorted(key for key in {*expected, *result} if expected.get(key) != result.get(key))
    print(f"different bytes in {', '.join(differing)}" if differing else "the same bytes as in one process")
    raise typer.Exit(1 if differing else 0)


def _address() -> str:
    """Address of this machine other than loopback, which Ray's nodes need to find each other."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))  # sends nothing
        return str(probe.getsockname()[0])


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("", 0))
        return int(probe.getsockname()[1])


def _node(what: list[str], environment: dict[str, str]) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "ray.scripts.scripts", "start", *what, "--num-cpus=1", "--block"]
    return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)


def _wait_for(host: str, port: int) -> None:
    """Wait until the first node listens, which the others connect to."""
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
