"""Following a run: what its folder shows, who may ask for it by which name, and what is not handed out."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import shutil
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from page_samples import sample
from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.schema import Config
from pathreplay.jobs import make_config, optimize
from pathreplay.report.live_page import FOLDER, PAGE, PAGES, STOP, frames
from pathreplay.report.progress import Progress
from pathreplay.report.watch import run_files
from pathreplay.report.watch.server import MOST, RunServer
from pathreplay.runs.run_folder import RunFolder
from room_job import JOB, SCENE, TEXTURE, room  # noqa: F401

SECRET = b"not for others"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A run folder as far as `watch` looks at it, and a secret beside it."""
    run = tmp_path / "a run"
    (run / FOLDER).mkdir(parents=True)
    (run / PAGE).write_bytes(PAGES.dump_json(sample()))
    (run / "run.json").write_text("{}")
    (run / FOLDER / "now.png").write_bytes(b"png")
    (run / "config.toml").write_bytes(SECRET)
    (tmp_path / "secret.png").write_bytes(SECRET)
    return run


@pytest.fixture
def server(folder: Path) -> Iterator[RunServer]:
    server = RunServer(folder, "127.0.0.1", 0, "token")
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    yield server
    server.shutdown()
    server.server_close()
    thread.join()


def ask(server: RunServer, path: str, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], bytes]:
    """Status, headers and content; the path is sent as it is."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=10)
    try:
        connection.putrequest(method, path, skip_host="Host" in headers)
        for name, value in headers.items():
            connection.putheader(name, value)
        connection.endheaders()
        answer = connection.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read()
    finally:
        connection.close()


def test_the_page_and_its_pictures_are_served(server: RunServer) -> None:
    status, headers, data = ask(server, "/token/")
    assert status == 200 and b"data-live" in data
    assert headers["Content-Security-Policy"].startswith("default-src 'none'; script-src 'sha256-")
    assert "connect-src 'self'" in headers["Content-Security-Policy"] and headers["Referrer-Policy"] == "no-referrer"
    status, headers, data = ask(server, "/token/previews/now.png?3")
    assert (status, headers["Content-Type"], data) == (200, "image/png", b"png")


@pytest.mark.parametrize("path", ["/", "/tokem/", "/token", "//token/x", "/previews/now.png", "/%74oken0/", "/%ff/"])
def test_nothing_is_served_without_the_token(server: RunServer, path: str) -> None:
    status, _, data = ask(server, path)
    assert status in (403, 404) and SECRET not in data and b"plain" not in data


def outside(folder: Path) -> list[str]:
    (folder / FOLDER / "link.png").symlink_to(folder.parent / "secret.png")
    os.mkfifo(folder / FOLDER / "pipe.png")
    (folder / FOLDER / "folder.png").mkdir()
    up = ["../config.toml", "../../secret.png", "..%2f..%2fsecret.png", "%2e%2e/%2e%2e/secret.png", "....//secret.png"]
    absolute = str(folder.parent / "secret.png")
    odd = ["", ".", "now.png%00", "now.png/", f"/{absolute}", absolute, "x" * 5000 + ".png"]
    return [*up, "link.png", "pipe.png", "folder.png", "page.json", *odd]


def test_no_file_but_pictures_of_the_page_is_served(server: RunServer, folder: Path) -> None:
    for name in outside(folder):
        status, _, data = ask(server, f"/token/previews/{name}")
        assert status == 404 and SECRET not in data, name
    for name in ("config.toml", "checkpoint.safetensors", "../secret.png", "previews", "stop"):
        assert ask(server, f"/token/{name}")[0] == 404


def test_a_folder_of_previews_that_is_a_link_is_not_followed(server: RunServer, folder: Path) -> None:
    shutil.move(folder / FOLDER, folder.parent / "elsewhere")
    (folder / FOLDER).symlink_to(folder.parent / "elsewhere")
    assert ask(server, "/token/previews/now.png")[0] == 404


@pytest.mark.parametrize(
    "name", ["evil.example", "127.0.0.1.evil.example", "localhost.evil.example:80", "", "[", "a@b"]
)
def test_other_names_are_refused(server: RunServer, name: str) -> None:
    """A page of evil.example may make that name lead to 127.0.0.1; the browser then asks for evil.example."""
    status, _, data = ask(server, "/token/", Host=name)
    assert status == 403 and b"plain" not in data
    assert ask(server, "/token/stop", "POST", Host=name)[0] == 403 and not (server.run / STOP).exists()


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost:1", "[::1]:80", "192.168.1.5", socket.gethostname()])
def test_names_of_this_machine_are_answered(server: RunServer, name: str) -> None:
    assert ask(server, "/token/", Host=name)[0] == 200


def test_the_button_leaves_a_wish_where_the_loop_looks(server: RunServer, folder: Path) -> None:
    assert ask(server, "/token/stop")[0] == 404 and ask(server, "/other/stop", "POST")[0] == 403
    assert ask(server, "/token/stop", "POST", Origin="http://evil.example")[0] == 403
    assert not (folder / STOP).exists()
    port = server.server_address[1]
    assert ask(server, "/token/stop", "POST", Origin=f"http://127.0.0.1:{port}")[0] == 200
    assert (folder / STOP).is_file()


def test_a_wish_does_not_follow_a_link(server: RunServer, folder: Path) -> None:
    (folder / STOP).symlink_to(folder.parent / "new")
    assert ask(server, "/token/stop", "POST")[0] == 500 and not (folder.parent / "new").exists()


def raw(server: RunServer, data: bytes) -> bytes:
    """All that is answered to these bytes."""
    with socket.create_connection(("127.0.0.1", server.server_address[1]), timeout=10) as client:
        client.sendall(data)
        answer = b""
        with contextlib.suppress(ConnectionResetError):  # what is left unread makes one of the end
            while part := client.recv(2**16):
                answer += part
        return answer


@pytest.mark.parametrize("origin", ["http://[", "http://]", "http://[::1", "null", "http://a@[b", "//", "x" * 9999])
def test_an_origin_that_is_none_is_refused(
    origin: str, server: RunServer, folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert ask(server, "/token/stop", "POST", Origin=origin)[0] == 403
    assert not (folder / STOP).exists() and capfd.readouterr().err == ""


def test_an_address_that_is_none_is_refused(server: RunServer, capfd: pytest.CaptureFixture[str]) -> None:
    host = f"127.0.0.1:{server.server_address[1]}"
    answer = raw(server, f"GET http://[ HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
    assert answer.startswith(b"HTTP/1.0 404") and capfd.readouterr().err == ""


def test_a_wish_does_not_wait_for_the_reader_of_a_pipe(server: RunServer, folder: Path) -> None:
    os.mkfifo(folder / STOP)
    status, _, data = ask(server, "/token/stop", "POST")
    assert status == 500 and b"is a pipe" in data and data.count(b"\n") == 1


@pytest.mark.parametrize("method", ["GET", "HEAD", "POST", "PUT"])
def test_what_is_sent_with_a_request_is_no_request(method: str, server: RunServer, folder: Path) -> None:
    host = f"Host: 127.0.0.1:{server.server_address[1]}\r\n"
    inner = f"POST /token/stop HTTP/1.1\r\n{host}\r\n"
    where = "/token/nothing" if method == "POST" else "/token/"
    for length in (f"Content-Length: {len(inner)}\r\n", "Transfer-Encoding: chunked\r\n", ""):
        answer = raw(server, f"{method} {where} HTTP/1.1\r\n{host}{length}\r\n{inner}".encode())
        assert answer.count(b"HTTP/1.") == 1 and not (folder / STOP).exists()


def test_a_client_that_drips_is_left(server: RunServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pathreplay.report.watch.server.PATIENCE", 0.3)
    end = time.monotonic() + 10
    with socket.create_connection(("127.0.0.1", server.server_address[1]), timeout=10) as client:
        client.settimeout(0.02)
        client.sendall(b"GET /token/ HTTP/1.1\r\n")
        while time.monotonic() < end:
            try:
                client.sendall(b"x")
                if client.recv(1) == b"":
                    break
            except TimeoutError:
                continue
            except OSError:
                break
        else:
            pytest.fail("it is still heard")
    assert ask(server, "/token/")[0] == 200


def test_connections_are_limited(server: RunServer) -> None:
    address = ("127.0.0.1", server.server_address[1])
    silent = [socket.create_connection(address, timeout=10) for _ in range(MOST)]
    try:
        end = time.monotonic() + 10
        while server.room._value and time.monotonic() < end:
            time.sleep(0.01)
        threads = threading.active_count()
        assert all(raw(server, b"") == b"" for _ in range(5)) and threading.active_count() <= threads
    finally:
        for each in silent:
            each.close()
    end = time.monotonic() + 10
    while server.room._value < MOST and time.monotonic() < end:
        time.sleep(0.01)
    assert ask(server, "/token/")[0] == 200


def test_other_methods_get_nothing(server: RunServer) -> None:
    for method in ("PUT", "DELETE", "OPTIONS", "TRACE", "X"):
        assert ask(server, "/token/", method)[0] == 501


def test_a_run_that_has_ended_shows_its_report(server: RunServer, folder: Path) -> None:
    page = folder / PAGE
    (folder / "report.html").write_text("the report")
    os.utime(folder / "report.html", ns=(1, page.stat().st_mtime_ns + 1))
    assert ask(server, "/token/")[2] == b"the report"
    os.utime(page, ns=(1, page.stat().st_mtime_ns + 10))  # it was resumed
    assert b"data-live" in ask(server, "/token/")[2]


def test_who_holds_the_run_is_known(folder: Path) -> None:
    assert run_files.holder(folder) is None
    (folder / "lock").write_text(f"{os.getpid()} {socket.gethostname()}\n")
    assert run_files.holder(folder) == f"process {os.getpid()} on {socket.gethostname()}"
    (folder / "lock").write_text(f"{2**22 + 1} {socket.gethostname()}\n")
    assert run_files.holder(folder) is None
    (folder / "lock").write_text("5 elsewhere\n")
    assert run_files.holder(folder) == "process 5 on elsewhere"


def test_a_page_of_a_process_that_is_gone_says_so(server: RunServer) -> None:
    assert b"has ended without a report" in ask(server, "/token/")[2]


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"title": 3}', b"\xff", json.dumps({"lead": []}).encode()])
def test_a_damaged_page_gets_one_line(server: RunServer, folder: Path, content: bytes) -> None:
    (folder / PAGE).write_bytes(content)
    status, _, data = ask(server, "/token/")
    assert status == 500 and b"page.json is damaged" in data and data.count(b"\n") == 1


def test_what_is_no_run_is_told(tmp_path: Path, folder: Path) -> None:
    with pytest.raises(PathreplayError, match="No run folder"):
        run_files.require_run(tmp_path / "missing")
    with pytest.raises(PathreplayError, match="is not a run folder"):
        run_files.require_run(tmp_path)
    (folder / PAGE).unlink()
    with pytest.raises(PathreplayError, match="wait until it has one"):
        run_files.require_run(folder)


@pytest.mark.parametrize(("host", "port"), [("no.such.host.invalid", 0), ("192.0.2.1", 0), ("127.0.0.1", None)])
def test_an_address_that_cannot_be_is_told(server: RunServer, folder: Path, host: str, port: int | None) -> None:
    with pytest.raises(PathreplayError, match="Cannot listen on"):
        RunServer(folder, host, server.server_address[1] if port is None else port)


# ------------------------------ What a run shows of itself ------------------------------


def config(**changes: object) -> Config:
    return make_config({**JOB, "output": "run", "test_views": ["right"], **changes})


@pytest.mark.slow
def test_a_run_keeps_its_page_and_a_bounded_number_of_frames(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: F811
    monkeypatch.setattr("pathreplay.report.live_page.time.perf_counter", iter(range(0, 10**9, 1000)).__next__)
    optimize(config(iterations=12, preview={"frames": 3, "share": 0.5}), progress=False)
    page = PAGES.validate_json((room / "run" / PAGE).read_bytes(), strict=True)
    assert [view.name for view in page.views] == ["left", "right"] and page.views[1].is_test
    assert page.facts[0][0] == "12 of 12" and page.plots[0].series[0].x == tuple(range(12))
    assert {f"{plot.title} {plot.code}" for plot in page.plots} >= {
        f"error of {TEXTURE}",
        f"gradient norm of {TEXTURE}",
    }
    named = {p.src.partition("?")[0] for v in page.views for p in v.pictures} | {
        s.src for v in page.views for s in v.film
    }
    assert named and all((room / "run" / name).is_file() for name in named)
    kept = sorted({iteration for iteration, _, _ in frames(room / "run")})
    assert kept[0] == 0 and kept[-1] == 12 and 3 <= len(kept) <= 5
    html = (room / "run/report.html").read_text()
    assert "data:image/webp" in html


@pytest.mark.slow
def test_previews_change_no_bit_of_a_run(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: F811
    same = {"integrator": {"type": "pathreplay", "max_depth": 3}, "deterministic": True, "iterations": 4}
    without = optimize(config(**same, preview={"share": 0.0}), progress=False)
    monkeypatch.setattr("pathreplay.report.live_page.time.perf_counter", iter(range(0, 10**9, 1000)).__next__)
    with_them = optimize(config(**same, preview={"share": 0.5}), progress=False)
    assert len({i for i, _, _ in frames(with_them.folder)}) >= 4 and not list(frames(without.folder))
    for key, value in without.parameters.items():
        assert value.tobytes() == with_them.parameters[key].tobytes()
    assert [e.loss for e in without.history] == [e.loss for e in with_them.history]


@pytest.mark.slow
def test_a_wish_in_the_folder_ends_the_run_like_sigterm(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: F811
    advance = Progress.advance

    def wish(self: Progress, loss: float) -> None:
        advance(self, loss)
        run_files.ask_to_stop(room / "run")

    with monkeypatch.context() as patch:
        patch.setattr(Progress, "advance", wish)
        result = optimize(config(), progress=False)
    assert result.stopped and result.stopped_by == "the stop button" and result.iterations == 1
    assert result.report.is_file() and not (room / "run" / STOP).exists()
    run_files.ask_to_stop(room / "run")  # to a run that is not under way: nobody's wish
    assert optimize(resume=room / "run", progress=False).iterations == 6


@pytest.mark.slow
def test_what_cannot_be_shown_ends_no_run(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: F811
    write = RunFolder.write

    def full(self: RunFolder, files: dict[str, bytes]) -> None:
        if any(name.startswith(FOLDER) for name in files):
            raise PathreplayError("No space left on the disk")
        write(self, files)

    monkeypatch.setattr(RunFolder, "write", full)
    assert optimize(config(), progress=False).iterations == 6


def test_names_are_text_on_the_page_of_a_run(server: RunServer, folder: Path) -> None:
    (folder / PAGE).write_bytes(PAGES.dump_json(replace(sample(), title="<script>alert(1)</script>")))
    assert b"<script>alert" not in ask(server, "/token/")[2]
