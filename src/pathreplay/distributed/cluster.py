"""Connects a job to Ray: to a private cluster on this machine, or to the cluster at an address.

By default, Ray listens on every network interface. A private cluster listens on loopback only, requires a secret token
from every client, and keeps its sockets in a folder that only this user can enter. The cluster at an address must have
authentication enabled, because Ray unpickles requests and answers.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import psutil

from pathreplay.distributed.guard import Guard
from pathreplay.errors import PathreplayError, plain_line
from pathreplay.inverse.config.executor_options import RayOptions
from pathreplay.platform.interrupts import undisturbed

OLDEST = (2, 60)
"""First version of Ray whose token authentication covers clusters that a program starts."""

# If this variable is 0, Ray uses only loopback addresses. The variable exists for systems whose firewalls block Ray.
_MANY_MACHINES = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
_MODE, _TOKEN, _ADDRESS = "RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_ADDRESS"
_LONGEST_FOLDER = 20
_SECRET = secrets.token_hex(32)
"""Token of all private clusters of this process. There is only one, because Ray reads the token only once."""

_KNOCK_S = 5.0
"""Seconds within which the head node of a cluster must accept a connection."""

_VITAL = ("gcs_server", "raylet")


@dataclass
class Cluster:
    """The cluster that a run is connected to."""

    ray: ModuleType
    own: bool
    """Whether the cluster is private to this run."""
    processes: list[psutil.Process] = field(default_factory=list)
    """Processes that a private cluster needs in order to answer requests: GCS server and raylet."""
    _checked: float = -1e9

    def is_shared(self) -> bool:
        """Return whether the cluster also serves other programs, and still responds."""
        return not self.own and self._answers()

    def require_processes(self) -> None:
        """Raise PathreplayError if one of the `processes` has exited."""
        for process, name in zip(self.processes, _VITAL, strict=False):
            if not _runs(process):
                raise _lost(f"{name} has exited")

    def require(self, pause: float = 0.0) -> None:
        """Raise PathreplayError if one of the `processes` has exited, or if the head node does not respond.

        The head node is contacted at most once every ``pause`` seconds.
        """
        self.require_processes()
        if time.monotonic() - self._checked >= pause:
            self._checked = time.monotonic()
            if not self._answers():
                raise _lost(f"head at {self.ray.get_runtime_context().gcs_address} does not respond")

    def _answers(self) -> bool:
        host, _, port = self.ray.get_runtime_context().gcs_address.rpartition(":")
        try:
            socket.create_connection((host.strip("[]"), int(port)), _KNOCK_S).close()
        except OSError:
            return False
        return True


def _lost(why: str) -> PathreplayError:
    return PathreplayError(
        f"ray: the cluster is lost: its {why}; check Ray's logs and restart it, or use executor = 'local'"
    )


def _runs(process: psutil.Process) -> bool:
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.Error:
        return False


def load_ray() -> ModuleType:
    """Import Ray. Raises PathreplayError if it is not installed or too old."""
    os.environ.setdefault(_MODE, "token")  # Ray reads this variable on import
    # With the value 0, actors that reserve no GPU still see all GPUs. Ray warns if the variable is not set.
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    try:
        import ray
    except ImportError as error:
        raise PathreplayError(f"executor = 'ray' needs Ray ({error}); pip install 'pathreplay[ray]'") from None
    version = tuple(int(part) for part in ray.__version__.split(".")[:2])
    if version < OLDEST:
        raise PathreplayError(
            f"executor = 'ray' needs Ray 2.60 or newer, found {ray.__version__}; pip install 'pathreplay[ray]'"
        )
    return ray


@contextmanager
def connected(options: RayOptions, cores: int) -> Iterator[Cluster]:
    """Connect to a Ray cluster within this block.

    If this process is already connected, the existing connection is used and left open. Otherwise the options or the
    environment may name an address. Without an address, a private cluster is started.

    Args:
        options: the job's ``ray`` table.
        cores: CPUs of a private cluster.

    Yields:
        The cluster.

    Raises:
        PathreplayError: Ray is missing, cannot start, cannot be reached, or has no authentication.
    """
    ray = load_ray()
    if ray.is_initialized():
        _require_authentication(ray, "that this process is connected to")
        yield Cluster(ray, own=False)
        return
    address = options.address or os.environ.get(_ADDRESS)
    with contextlib.ExitStack() as stack:
        stack.enter_context(_silent(ray))
        with undisturbed():  # Ray installs its own signal handlers
            if address is None:
                cluster = _start(ray, stack, cores)
            else:
                _connect(ray, address)
                cluster = Cluster(ray, own=False)
                stack.callback(ray.shutdown)
        yield cluster


def _start(ray: ModuleType, stack: contextlib.ExitStack, cores: int) -> Cluster:
    """Start a private cluster, which ends when ``stack`` closes. Raises PathreplayError if Ray cannot start safely."""
    temporary = tempfile.gettempdir()
    # Other users can enter Ray's default folder, but not a folder made by mkdtemp.
    # A socket path has at most 107 characters.
    folder = tempfile.mkdtemp(prefix="pathreplay-", dir=temporary if len(temporary) <= _LONGEST_FOLDER else "/tmp")
    guard = Guard(Path(folder))
    stack.callback(guard.close)
    before = _sessions()  # existing process sessions, which the guard must not end
    with _private_environment(ray), _own_sessions(ray):
        try:
            ray.init(
                address="local",
                num_cpus=cores,
                include_dashboard=False,
                log_to_driver=False,
                logging_level="ERROR",
                _node_ip_address="127.0.0.1",
                _temp_dir=str(Path(folder) / "ray"),
            )
        except Exception as error:  # Ray raises plain `Exception` here
            guard.watch(_sessions() - before)
            with contextlib.suppress(Exception):
                ray.shutdown()
            raise PathreplayError(f"executor = 'ray': Ray cannot start here ({_first_line(error)})") from None
    guard.watch(_sessions() - before)
    children = {process.name(): process for process in psutil.Process().children()}
    cluster = Cluster(ray, True, [children[name] for name in _VITAL if name in children])
    stack.callback(ray.shutdown)
    _require_authentication(ray, "of this run")
    if exposed := _beyond_loopback():
        raise PathreplayError(
            f"executor = 'ray': Ray {ray.__version__} listens at {exposed[0]}, where other machines can reach it; "
            "install another version, or use executor = 'local'"
        )
    return cluster


def _sessions() -> set[int]:
    """Return the ids of the process sessions of our descendants, except our own session; see `_own_sessions`."""
    ids = set()
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(OSError):
            ids.add(os.getsid(process.pid))
    return ids - {os.getsid(0)}


def _connect(ray: ModuleType, address: str) -> None:
    if os.environ.get(_MODE) != "token":
        raise PathreplayError(
            f"ray: {_MODE} = '{os.environ.get(_MODE)}' turns authentication off, and anyone who reaches such a cluster "
            f"can run programs on it; start the cluster with {_MODE}=token, and set it here as well"
        )
    try:
        ray.init(address=address, log_to_driver=False, logging_level="ERROR")
    except (RuntimeError, ValueError, OSError, ray.exceptions.RayError) as error:
        if "Version mismatch" in str(error):  # the text has the versions on its later lines
            raise PathreplayError(
                f"ray: the cluster at '{address}' has other versions ({str(error).strip()}); install the same versions "
                "of Ray and Python there and here"
            ) from None
        raise PathreplayError(
            f"ray: no cluster at '{address}' accepts this program ({_first_line(error)}); run 'ray start' there and on "
            "this machine, with the same token on both (see docs/scale.md)"
        ) from None
    try:
        _require_authentication(ray, f"at '{address}'")
        _require_closed(ray, address)
    except PathreplayError:
        ray.shutdown()
        raise


def _require_authentication(ray: ModuleType, which: str) -> None:
    core = ray._raylet
    if core.get_authentication_mode() != core.AuthenticationMode.TOKEN:
        raise PathreplayError(
            f"ray: the cluster {which} has no authentication, and anyone who reaches it can run programs on it; start "
            f"it with {_MODE}=token"
        )


_KNOCK = """
import sys
from ray._raylet import GcsClient
GcsClient(address=sys.argv[1]).check_alive([], timeout=10)
"""


def _require_closed(ray: ModuleType, address: str) -> None:
    """Raise PathreplayError if the cluster accepts clients without a token."""
    gcs = ray.get_runtime_context().gcs_address
    others = {name: value for name, value in os.environ.items() if name not in (_TOKEN, "RAY_AUTH_TOKEN_PATH")}
    command = [sys.executable, "-c", _KNOCK, gcs]
    knock = subprocess.run(command, env={**others, _MODE: "disabled"}, capture_output=True, check=False)
    if knock.returncode == 0:
        raise PathreplayError(
            f"ray: the cluster at '{address}' accepts clients without a token; start it with {_MODE}=token"
        )


@contextmanager
def _private_environment(ray: ModuleType) -> Iterator[None]:
    """Make Ray start clusters within this block on loopback, with our token, and without usage statistics."""
    settings = {_MANY_MACHINES: "0", _MODE: "token", _TOKEN: _SECRET, "RAY_USAGE_STATS_ENABLED": "0"}
    # Ray ends this process if the head node does not respond for this many seconds. `Cluster.require` raises before.
    settings["RAY_gcs_rpc_server_reconnect_timeout_s"] = str(10**6)
    settings["RAY_worker_niceness"] = "0"  # give the actors the CPU priority of this process
    before = {name: os.environ.get(name) for name in settings}
    constants = ray._private.ray_constants
    many = constants.ENABLE_RAY_CLUSTER
    os.environ.update(settings)
    constants.ENABLE_RAY_CLUSTER = False
    ray._raylet.Config.initialize("")  # make Ray read the settings again (next line: the token)
    ray._raylet.AuthenticationTokenLoader.instance().reset_cache()
    try:
        yield
    finally:
        constants.ENABLE_RAY_CLUSTER = many
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


@contextmanager
def _own_sessions(ray: ModuleType) -> Iterator[None]:
    """Start Ray's processes in separate process sessions within this block (only on Linux).

    A terminal or a batch scheduler sends a signal to all processes of a command. After a signal, this process still
    needs the actors, because it finishes the iteration and writes its results. The kernel still ends Ray's processes
    when this process ends.
    """
    services = ray._private.services
    plain = services.ConsolePopen

    class SessionPopen(plain):  # type: ignore[misc, valid-type]
        def __init__(self, *arguments: Any, **options: object) -> None:
            super().__init__(*arguments, **options, start_new_session=True)

    if sys.platform.startswith("linux"):
        services.ConsolePopen = SessionPopen
    try:
        yield
    finally:
        services.ConsolePopen = plain


@contextmanager
def _silent(ray: ModuleType) -> Iterator[None]:
    """Suppress Ray's messages about its processes within this block, because the run logs its own lines."""
    worker = ray._private.worker
    plain = worker.print_to_stdstream
    worker.print_to_stdstream = lambda *_, **__: None
    try:
        yield
    finally:
        worker.print_to_stdstream = plain


def _beyond_loopback() -> list[str]:
    """Return the addresses other than loopback at which descendants of this process listen."""
    addresses = []
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):
            addresses += [
                f"{connection.laddr.ip}:{connection.laddr.port}"
                for connection in process.net_connections(kind="inet")
                if connection.status == psutil.CONN_LISTEN
                and connection.laddr.ip not in ("127.0.0.1", "::1", "::ffff:127.0.0.1")
            ]
    return addresses


def _first_line(error: BaseException) -> str:
    return plain_line(next((line for line in str(error).splitlines() if line.strip()), type(error).__name__))
