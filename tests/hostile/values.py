"""Hostile texts, numbers and values, for wherever one can be given."""

from __future__ import annotations

from typing import Any

import numpy as np

from .toml_text import Raw

ESCAPE = "\x1b[2J\x1b]0;owned\x07"

#: Texts that a command line can be given (no NUL; a lone surrogate is a byte that is not UTF-8).
TEXTS: tuple[str, ...] = (
    "",
    " ",
    "-",
    "--",
    ".",
    "..",
    "/",
    "/dev/zero",
    "\udcff\udcfe",
    ESCAPE,
    "two\nlines",
    "x" * 100_000,
    "../" * 40 + "nowhere/at/all",
    "$(touch ../outside/hacked)",
    "; touch hacked",
    "%s%n%x",
    "{0.__class__}",
    "[bold red]x[/nope]",
    "*",
    "**",
    "[",
    "[!",
    "(?P<",
    "wall (1)",
    "\u202eevil",
    "na\u0308ıve 🙂",
    "None",
    "null",
    "0x10",
)

#: Numbers as they are typed.
NUMBERS: tuple[str, ...] = (
    "-1",
    "0",
    "1.5",
    "1e400",
    "nan",
    "inf",
    "-inf",
    "1e-320",
    "999999999999",
    "99999999999999999999",
    "9" * 5000,
    "１２",
    "1_0",
    "true",
)

#: Values in a config. None of them is one with which a job would rightly run for a long time.
VALUES: tuple[Any, ...] = (
    -1,
    0,
    True,
    1.5,
    1e308,
    -1e308,
    1e30,
    5e-324,
    float("nan"),
    float("inf"),
    10**12,
    10**30,
    -(10**30),
    Raw("1979-05-27"),
    Raw("12:30:00"),
    "",
    "6",
    "nan",
    ".",
    "/dev/zero",
    "a\x00b",
    ESCAPE,
    "x" * 100_000,
    "matplotlib:",
    "../" * 40,
    [],
    [[]],
    [1, "two"],
    [float("nan")] * 3,
    [1e38, 1e38, 1e38],
    [0.5] * 1000,
    {},
    {"type": "diffuse"},
    {"image": 3},
    {"a": {"b": {"c": []}}},
)


#: Of the texts, those that cannot name a place outside of the current folder: for what is to be written.
LOCAL = tuple(text for text in TEXTS if "/" not in text and text not in (".", ".."))


def pick(rng: np.random.Generator, among: tuple[Any, ...]) -> Any:
    """One of them (as it is: NumPy would change its type)."""
    return among[int(rng.integers(len(among)))]


def spoiled(data: bytes, rng: np.random.Generator) -> bytes:
    """Bytes cut short, overwritten here and there, or with a piece repeated or left out."""
    at, way = int(rng.integers(len(data) + 1)), int(rng.integers(4))
    if way == 0:
        return data[:at]
    if way == 1:
        damaged = bytearray(data)
        for place in rng.integers(len(data), size=1 + int(rng.integers(20))):
            damaged[int(place)] = int(rng.integers(256))
        return bytes(damaged)
    length = int(rng.integers(1, 64))
    return data[:at] + data[at : at + length] * 2 + data[at + length :] if way == 2 else data[:at] + data[at + length :]
