"""An HTTP server for one run. It serves the page of the run and its images, and accepts a request to stop the run.

All paths begin with a token that only the user who started the server knows. The Host header of each request is checked
against DNS rebinding. In this attack, the host name of another web page is made to resolve to this machine, so that a
browser lets the page send requests to this server.
"""

from __future__ import annotations

import contextlib
import io
import ipaddress
import secrets
import socket
import sys
import threading
import time
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias
from urllib.parse import unquote, urlsplit

from pathreplay.errors import PathreplayError
from pathreplay.report.live_page import FOLDER
from pathreplay.report.pages.document import document, policy
from pathreplay.report.watch import run_files

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

Request: TypeAlias = "socket.socket | tuple[bytes, socket.socket]"

# Seconds within which a client must send its request. The same number is the timeout for sending the answer.
PATIENCE = 30
# Maximum number of concurrent connections, which is enough for several browsers. Further connections are closed.
MOST = 32


class RunServer(ThreadingHTTPServer):
    """Serves a run until `shutdown` is called. ``address`` is the URL of the server, which contains a token."""

    daemon_threads = True
    request_queue_size = MOST

    def __init__(self, run: Path, host: str, port: int, token: str | None = None) -> None:
        """Raises PathreplayError if the server cannot listen at the address."""
        self.run = run
        self.room = threading.BoundedSemaphore(MOST)
        self.token = token or secrets.token_urlsafe(18)
        try:
            info = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
            self.address_family = info[0]
            super().__init__(info[4], Handler)  # type: ignore[arg-type]
        except (OSError, OverflowError, UnicodeError) as error:
            why = getattr(error, "strerror", None) or error
            raise PathreplayError(
                f"Cannot listen on {host}, port {port} ({why}); give another --port or --host"
            ) from None
        self.names = {"localhost", host.lower(), socket.gethostname().lower(), socket.getfqdn().lower()}
        everywhere = host in ("", "0.0.0.0", "::")
        shown = socket.gethostname() if everywhere else f"[{host}]" if ":" in host else host
        self.address = f"http://{shown}:{self.server_address[1]}/{self.token}/"

    def process_request(self, request: Request, client_address: object) -> None:
        """Answer a request in a new thread, or close the connection if there are too many connections."""
        if not self.room.acquire(blocking=False):
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request: Request, client_address: object) -> None:
        """Answer a request, and then release the slot of the connection."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.room.release()

    def handle_error(self, request: Request, client_address: object) -> None:
        """Ignore clients that disconnect; report other errors."""
        if not isinstance(sys.exc_info()[1], (ConnectionError, TimeoutError)):
            super().handle_error(request, client_address)

    def knows(self, host: str) -> bool:
        """Return whether a Host header is a numeric address or a name of this machine.

        The server refuses requests with any other Host header.
        """
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        with contextlib.suppress(ValueError):
            ipaddress.ip_address(name)
            return True
        return name in self.names


class _Within(io.RawIOBase):
    """Reads from a client, and raises TimeoutError after a deadline, even if bytes keep arriving slowly."""

    def __init__(self, connection: socket.socket, seconds: float) -> None:
        self.connection, self.end = connection, time.monotonic() + seconds

    def readable(self) -> bool:
        """Return True, as `io.BufferedReader` requires."""
        return True

    def readinto(self, buffer: WriteableBuffer) -> int:
        """Read bytes from the client into ``buffer``. Raises TimeoutError after the deadline."""
        if (left := self.end - time.monotonic()) <= 0:
            raise TimeoutError
        self.connection.settimeout(left)
        try:
            return self.connection.recv_into(buffer)
        finally:
            self.connection.settimeout(PATIENCE)


class Handler(BaseHTTPRequestHandler):
    """Answers one request per connection. Data after the request is never read."""

    server: RunServer
    timeout = PATIENCE
    protocol_version = "HTTP/1.0"
    server_version, sys_version = "pathreplay", ""

    def setup(self) -> None:
        super().setup()
        self.rfile = io.BufferedReader(_Within(self.connection, PATIENCE))

    def do_GET(self) -> None:
        """Serve the page or one of its images."""
        place = self._place()
        if place is None:
            return
        if place == "":
            self._page()
        elif place.startswith(f"{FOLDER}/") and (image := run_files.picture(self.server.run, place[len(FOLDER) + 1 :])):
            self._answer(200, *image)
        else:
            self._answer(404, "text/plain", b"not found\n")

    def do_POST(self) -> None:
        """Ask the run to stop."""
        place = self._place()
        if place is None:
            return
        if place != "stop" or not self._from_our_page():
            self._answer(404 if place != "stop" else 403, "text/plain", b"not found\n")
            return
        try:
            run_files.ask_to_stop(self.server.run)
        except PathreplayError as error:
            self._answer(500, "text/plain", f"{error}\n".encode())
        else:
            self._answer(200, "text/plain", b"stopping\n")

    def _from_our_page(self) -> bool:
        """Return whether the Origin header, if there is one, names this server."""
        origin = self.headers.get("Origin")
        with contextlib.suppress(ValueError):  # the Origin header is not a URL
            return origin is None or urlsplit(origin).netloc == self.headers.get("Host")
        return False

    def _place(self) -> str | None:
        """Return the part of the requested path after the token.

        If the request must be refused, send an error to the client, and return None.
        """
        if not self.server.knows(self.headers.get("Host", "")):
            self._answer(403, "text/plain", b"unknown host name\n")
            return None
        try:
            path = urlsplit(self.path).path
        except ValueError:
            self._answer(404, "text/plain", b"invalid address\n")
            return None
        token, slash, place = unquote(path).lstrip("/").partition("/")
        if not secrets.compare_digest(token.encode("utf-8", "replace"), self.server.token.encode()):
            self._answer(403, "text/plain", b"use the full address that pathreplay watch printed\n")
            return None
        if not slash:  # without the slash, a browser would resolve relative addresses wrongly
            self._answer(404, "text/plain", b"the address must end with a /\n")
            return None
        return place

    def _page(self) -> None:
        run = self.server.run
        if (report := run_files.report(run)) is not None:
            self._answer(200, "text/html; charset=utf-8", report)
            return
        try:
            page = run_files.page(run)
        except PathreplayError as error:
            self._answer(500, "text/plain; charset=utf-8", f"{error}\n".encode())
            return
        held = run_files.holder(run)
        gone = () if held else ("The process of this run has ended without a report.",)
        self._answer(200, "text/html; charset=utf-8", document(replace(page, notices=gone + page.notices), live=True))

    def _answer(self, status: int, kind: str, data: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        self.send_header("Content-Security-Policy", policy("'self' data:", "'self'") + "; frame-ancestors 'none'")
        for name, value in SAFE.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *arguments: object) -> None:
        """Log nothing, so that the address stays visible in the terminal."""


SAFE = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}


def serve(server: RunServer) -> None:
    """Answer requests until a signal ends the command, then free the port."""
    try:
        server.serve_forever(poll_interval=0.2)
    finally:
        server.server_close()
