"""Hostile clients of `pathreplay watch` who know its token: it still answers afterwards, and no run is stopped."""

from __future__ import annotations

import numpy as np

from .case import Action, add, recipe
from .room import ODD_FILES, Room

KIND = "watch"

# PORT and HOST are put into what is sent.
ASK = """
import contextlib, socket, threading, time
from pathlib import Path
from pathreplay.report.watch import server as watch
watch.PATIENCE = 2.0
run = Path("runs/job")
server = watch.RunServer(run, "127.0.0.1", 0, "token")
threading.Thread(target=server.serve_forever, kwargs={{"poll_interval": 0.02}}, daemon=True).start()
address = ("127.0.0.1", server.server_address[1])
host = b"127.0.0.1:%d" % address[1]

def ask(data):
    with socket.create_connection(address, timeout=10) as client:
        answer = b""
        try:
            client.sendall(data.replace(b"HOST", host))
            with contextlib.suppress(OSError):  # ENOTCONN: the server has reset the connection, which it may
                client.shutdown(socket.SHUT_WR)
            while part := client.recv(2**16):
                answer += part
        except ConnectionError:
            pass
        return answer

{act}
server.shutdown()
"""
SEND = """
asked = {data!r}
answer = ask(asked)
assert answer.count(b"Server: pathreplay") <= 1, answer
assert ask(b"GET /token/ HTTP/1.1\\r\\nHost: HOST\\r\\n\\r\\n").startswith(b"HTTP/1.0 200")
assert {stopped} or not (run / "stop").exists()
"""

GET, STOP = b"GET /token/ HTTP/1.1\r\nHost: HOST\r\n", b"POST /token/stop HTTP/1.1\r\nHost: HOST\r\n"
REQUESTS = {
    "nothing": b"",
    "a NUL": b"\0",
    "an end of line": b"\r\n",
    "no version": b"GET /token/\r\n",
    "a version that is none": b"GET /token/ HTTP/9.9.9\r\n\r\n",
    "a version of digits": b"GET /token/ HTTP/" + b"1" * 5000 + b".1\r\n\r\n",
    "an address of 100 kB": b"GET /token/" + b"x" * 100_000 + b" HTTP/1.1\r\n\r\n",
    "an address that is none": b"GET http://[ HTTP/1.1\r\nHost: HOST\r\n\r\n",
    "an address of odd bytes": b"GET /token/\xff\xfe%ff%00 HTTP/1.1\r\nHost: HOST\r\n\r\n",
    "a picture outside": b"GET /token/previews/..%2frun.json HTTP/1.1\r\nHost: HOST\r\n\r\n",
    "a header of 100 kB": GET + b"X: " + b"x" * 100_000 + b"\r\n\r\n",
    "10000 headers": GET + b"X: y\r\n" * 10_000 + b"\r\n",
    "a header without a colon": GET + b"nothing\r\n\r\n",
    "a host that is none": b"GET /token/ HTTP/1.1\r\nHost: [\r\n\r\n",
    "two hosts": GET + b"Host: evil.example\r\n\r\n",
    "no host": b"GET /token/ HTTP/1.1\r\n\r\n",
    "a request within a request": GET + b"Content-Length: 70\r\n\r\n" + STOP + b"\r\n",
    "a request in chunks": GET + b"Transfer-Encoding: chunked\r\n\r\n" + STOP + b"\r\n",
    "a request behind a request": GET + b"\r\n" + STOP + b"\r\n",
    "a request behind one that is refused": b"X / HTTP/1.1\r\nHost: HOST\r\n\r\n" + STOP + b"\r\n",
    "a length below zero": GET + b"Content-Length: -5\r\n\r\n",
    "a length that is no number": GET + b"Content-Length: many\r\n\r\n",
    "a method of 60 kB": b"X" * 60_000 + b" / HTTP/1.1\r\n\r\n",
    "Expect": GET + b"Expect: 100-continue\r\n\r\n",
    "an upgrade": GET + b"Connection: Upgrade\r\nUpgrade: h2c\r\n\r\n",
    "TLS": bytes.fromhex("160301020001000001fc0303") + bytes(500),
    **{
        f"Origin: {origin}": STOP + f"Origin: {origin}\r\n\r\n".encode()
        for origin in ("http://[", "null", "http://evil.example", "http://a@[b", "x" * 5000)
    },
}


def _ask(name: str, act: str) -> None:
    def spoil(room: Room, rng: np.random.Generator) -> Action:
        room.put_run()
        return Action(script=ASK.format(act=act))

    add(KIND, name, spoil)


for _name, _data in REQUESTS.items():
    _ask(_name, SEND.format(data=_data, stopped=False))


@recipe(KIND, fuzz=True)
def bytes_that_are_spoiled(room: Room, rng: np.random.Generator) -> Action:
    room.put_run()
    data = bytearray(GET + b"Origin: http://HOST\r\nContent-Length: 3\r\n\r\nabc")
    for at in rng.integers(0, len(data), 6):
        data[int(at)] = int(rng.integers(256))
    return Action(script=ASK.format(act=SEND.format(data=bytes(data), stopped=False)))


for _odd in ODD_FILES:
    for _file in ("stop", "previews/page.json", "report.html", "lock"):

        def _odd_file(room: Room, rng: np.random.Generator, file: str = _file, odd: str = _odd) -> Action:
            Room(room.put_run(), room.assets).odd_file(file, odd)
            asked = (STOP + b"\r\n", GET + b"\r\n")
            act = f"for asked in {asked!r}:\n    assert ask(asked).count(b'Server: pathreplay') == 1"
            return Action(script=ASK.format(act=act), writes=("runs/job",))

        add(KIND, f"{_file} is {_odd}", _odd_file)

_ask(
    "clients that drip",
    """
clients = [socket.create_connection(address) for _ in range(5)]
for at in range(20):
    for client in clients:
        try:
            client.sendall(GET[at : at + 1])
        except OSError:
            pass
    time.sleep(0.2)
assert threading.active_count() <= 3, threading.enumerate()
""".replace("GET", repr(GET)),
)
_ask(
    "60 clients that say nothing",
    """
clients = [socket.create_connection(address) for _ in range(60)]
time.sleep(0.3)
assert threading.active_count() <= watch.MOST + 3
time.sleep(3)
assert ask(b"GET /token/ HTTP/1.1\\r\\nHost: HOST\\r\\n\\r\\n").startswith(b"HTTP/1.0 200")
""",
)
