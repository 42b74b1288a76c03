"""Ray as a job uses it: a cluster of its own on this machine, which nobody else can reach, or one at an address.

A cluster of its own listens on loopback only, wants a secret token of whoever speaks to it, and keeps its sockets in a
folder that only this user can enter. Left alone, Ray would listen on every interface. One at an address must
have authentication on, since what is sent to it is unpickled, and so are its answers.
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
from typing import Any

import psutil

from pathreplay.distributed.guard import Guard
from pathreplay.errors import PathreplayError, plain_line
from pathreplay.inverse.config.executor_options import RayOptions
from pathreplay.platform.interrupts import undisturbed

OLDEST = (2, 60)
"""Its token authentication is on for clusters that a program starts."""

# Ray's own way to use loopback addresses, made for the firewalls of other systems.
_MANY_MACHINES = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
_MODE, _TOKEN, _ADDRESS = "RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_ADDRESS"
_LONGEST_FOLDER = 20
_SECRET = secrets.token_hex(32)
"""Of all clusters of this process's own: Ray reads it once."""

_KNOCK_S = 5.0
"""Seconds that the head of a cluster has to take a connection."""

_VITAL = ("gcs_server", "raylet")


@dataclass
class Cluster:
    """The cluster that a run is connected to."""

    ray: Any
    own: bool
    """It is of this run alone."""
    processes: list[psutil.Process] = field(default_factory=list)
    """Of our own: those without which nothing is answered any more."""
    _asked: float = -1e9

    def has_others(self) -> bool:
        """Whether it is there for others, too, and answers."""
        return not self.own and self._answers()

    def require_processes(self) -> None:
        """Raise PathreplayError if one of the `processes` does not run any more."""
        for process, name in zip(self.processes, _VITAL, strict=False):
            if not _runs(process):
                raise _lost(f"{name} does not run any more")

    def require(self, pause: float = 0.0) -> None:
        """Raise PathreplayError as `require_processes`, or if the head does not answer; asked after a pause only."""
        self.require_processes()
        if time.monotonic() - self._asked >= pause:
            self._asked = time.monotonic()
            if not self._answers():
                raise _lost(f"head at {self.ray.get_runtime_context().gcs_address} does not answer")

    def _answers(self) -> bool:
        host, _, port = self.ray.get_runtime_context().gcs_address.rpartition(":")
        try:
            socket.create_connection((host.strip("[]"), int(port)), _KNOCK_S).close()
        except OSError:
            return False
        return True


def _lost(why: str) -> PathreplayError:
    return PathreplayError(
        f"ray: the cluster is lost: its {why}; look into Ray's logs and start it again, or use executor = 'local'"
    )


def _runs(process: psutil.Process) -> bool:
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.Error:
        return False


def load_ray() -> Any:
    """The module. Raises PathreplayError where it is not installed, or too old."""
    os.environ.setdefault(_MODE, "token")  # read when it is imported
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # leave devices as they are; it warns otherwise
    try:
        import ray
    except ImportError as error:
        raise PathreplayError(f"executor = 'ray' needs a module ({error}): pip install 'pathreplay[ray]'") from None
    found = tuple(int(part) for part in ray.__version__.split(".")[:2])
    if found < OLDEST:
        raise PathreplayError(
            f"executor = 'ray' needs Ray 2.60 or newer, this is {ray.__version__}: pip install 'pathreplay[ray]'"
        )
    return ray


@contextmanager
def connected(options: RayOptions, cores: int) -> Iterator[Cluster]:
    """Ray, connected within this block to the cluster of the options.

    One of its own gets so many ``cores``. What was connected before, by whoever calls us, is used and left as it is.
    Raises PathreplayError.
    """
    ray = load_ray()
    if ray.is_initialized():
        _require_authentication(ray, "that this process is connected to")
        yield Cluster(ray, own=False)
        return
    address = options.address or os.environ.get(_ADDRESS)
    with contextlib.ExitStack() as stack:
        stack.enter_context(_silent(ray))
        with undisturbed():  # Ray has handlers of its own for signals
            if address is None:
                cluster = _start(ray, stack, cores)
            else:
                _connect(ray, address)
                cluster = Cluster(ray, own=False)
                stack.callback(ray.shutdown)
        yield cluster


def _start(ray: Any, stack: contextlib.ExitStack, cores: int) -> Cluster:
    """A cluster of our own."""
    usual = tempfile.gettempdir()
    # Which only this user may enter; Ray's is open to all. Names of sockets may have 107 characters.
    folder = tempfile.mkdtemp(prefix="pathreplay-", dir=usual if len(usual) <= _LONGEST_FOLDER else "/tmp")
    guard = Guard(Path(folder))
    stack.callback(guard.close)
    before = _sessions()  # what the user has started himself is none of Ray's
    with _private_environment(ray), _apart(ray):
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
        except Exception as error:  # Ray's own are of that kind
            guard.watch(_sessions() - before)
            with contextlib.suppress(Exception):
                ray.shutdown()
            raise PathreplayError(f"executor = 'ray': Ray cannot start here ({_first_line(error)})") from None
    guard.watch(_sessions() - before)
    known = {process.name(): process for process in psutil.Process().children()}
    cluster = Cluster(ray, True, [known[name] for name in _VITAL if name in known])
    stack.callback(ray.shutdown)
    _require_authentication(ray, "of this run")
    if open_to_others := _beyond_loopback():
        raise PathreplayError(
            f"executor = 'ray': Ray {ray.__version__} listens at {open_to_others[0]}, where others reach it; install "
            "another version, or use executor = 'local'"
        )
    return cluster


def _sessions() -> set[int]:
    """Those that Ray's processes are in: see `_apart`."""
    ours, found = os.getsid(0), set()
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(OSError):
            found.add(os.getsid(process.pid))
    return found - {ours}


def _connect(ray: Any, address: str) -> None:
    if os.environ.get(_MODE) != "token":
        raise PathreplayError(
            f"ray: {_MODE} = '{os.environ.get(_MODE)}' turns authentication off, and who reaches a cluster without it "
            f"can run programs there; start the cluster with {_MODE}=token, and set it here, too"
        )
    try:
        ray.init(address=address, log_to_driver=False, logging_level="ERROR")
    except (RuntimeError, ValueError, OSError, ray.exceptions.RayError) as error:
        raise PathreplayError(
            f"ray: no cluster at '{address}' that lets this program in ({_first_line(error)}); start one there with "
            f"'ray start' on this machine, too, and give both the same token (see docs/scale.md)"
        ) from None
    try:
        _require_authentication(ray, f"at '{address}'")
        _require_closed(ray, address)
    except PathreplayError:
        ray.shutdown()
        raise


def _require_authentication(ray: Any, which: str) -> None:
    core = ray._raylet
    if core.get_authentication_mode() != core.AuthenticationMode.TOKEN:
        raise PathreplayError(
            f"ray: the cluster {which} has no authentication, and who reaches it can run programs there; start it with "
            f"{_MODE}=token"
        )


_KNOCK = """
import sys
from ray._raylet import GcsClient
GcsClient(address=sys.argv[1]).check_alive([], timeout=10)
"""


def _require_closed(ray: Any, address: str) -> None:
    """Raise PathreplayError if the cluster lets somebody in who has no token."""
    gcs = ray.get_runtime_context().gcs_address
    others = {name: value for name, value in os.environ.items() if name not in (_TOKEN, "RAY_AUTH_TOKEN_PATH")}
    command = [sys.executable, "-c", _KNOCK, gcs]
    knock = subprocess.run(command, env={**others, _MODE: "disabled"}, capture_output=True, check=False)
    if knock.returncode == 0:
        raise PathreplayError(
            f"ray: the cluster at '{address}' lets in whoever reaches it, without a token; start it with {_MODE}=token"
        )


@contextmanager
def _private_environment(ray: Any) -> Iterator[None]:
    """Within this block Ray starts a cluster that uses loopback and our token, and tells nobody of it."""
    ours = {_MANY_MACHINES: "0", _MODE: "token", _TOKEN: _SECRET, "RAY_USAGE_STATS_ENABLED": "0"}
    # Seconds of silence of its head after which Ray would end this process; `Cluster.require` notices earlier.
    ours["RAY_gcs_rpc_server_reconnect_timeout_s"] = str(10**6)
    ours["RAY_worker_niceness"] = "0"  # actors are the run, and no less urgent than it would be by itself
    before = {name: os.environ.get(name) for name in ours}
    constants = ray._private.ray_constants
    many = constants.ENABLE_RAY_CLUSTER
    os.environ.update(ours)
    constants.ENABLE_RAY_CLUSTER = False
    ray._raylet.Config.initialize("")  # both may have been read before
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
def _apart(ray: Any) -> Iterator[None]:
    """Within this block Ray's processes are started in sessions of their own, where the kernel ends them with this one.

    A terminal or a scheduler sends its signals to all processes of a job. This one ends a run in peace then, and needs
    its actors for that.
    """
    services = ray._private.services
    plain = services.ConsolePopen

    class Apart(plain):  # type: ignore[misc, valid-type]
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options, start_new_session=True)

    if sys.platform.startswith("linux"):
        services.ConsolePopen = Apart
    try:
        yield
    finally:
        services.ConsolePopen = plain


@contextmanager
def _silent(ray: Any) -> Iterator[None]:
    """Within this block Ray does not print what happens to its processes: we tell it in a line of our own."""
    worker = ray._private.worker
    plain = worker.print_to_stdstream
    worker.print_to_stdstream = lambda *_, **__: None
    try:
        yield
    finally:
        worker.print_to_stdstream = plain


def _beyond_loopback() -> list[str]:
    """Addresses other than loopback at which this process's children, or itself, listen for Ray."""
    found = []
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):
            found += [
                f"{each.laddr.ip}:{each.laddr.port}"
                for each in process.net_connections(kind="inet")
                if each.status == psutil.CONN_LISTEN and each.laddr.ip not in ("127.0.0.1", "::1", "::ffff:127.0.0.1")
            ]
    return found


def _first_line(error: BaseException) -> str:
    return plain_line(next((line for line in str(error).splitlines() if line.strip()), type(error).__name__))
