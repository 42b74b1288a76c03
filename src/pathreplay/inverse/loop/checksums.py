"""Checksums of what a run goes on from: a bit that a disk or a copy has changed is told, and never computed with."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import ConfigDict, TypeAdapter, ValidationError

from pathreplay.errors import PathreplayError
from pathreplay.platform.atomic_files import Chunk, Content, chunks
from pathreplay.platform.files import file_problem
from pathreplay.platform.tensor_files import safetensors_chunks

SUMS = "checksums.json"
"""Size and checksum of each picture that a run folder was made with, by name."""

SEAL = "sha256"
"""The tensor at the end of a sealed file: the checksum of all bytes before it."""

_SEAL_BYTES = hashlib.sha256().digest_size
_AT_ONCE, _MOST_BYTES = 2**20, 64 * 2**20
_WAY_OUT = "start the job from its config"


@dataclass(frozen=True)
class _Sum:
    """What is known of a file."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    bytes: int
    sha256: str


_TABLE = TypeAdapter(dict[str, _Sum])


def sealed_chunks(arrays: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> Iterator[Chunk]:
    """`safetensors_chunks` of the arrays, and their `SEAL`."""
    digest = hashlib.sha256()
    for chunk in safetensors_chunks(arrays, metadata, {SEAL: _SEAL_BYTES}):
        digest.update(chunk)
        yield chunk
        del chunk
    yield digest.digest()


def require_seal(path: Path) -> None:
    """Raise ValueError unless the bytes of a sealed file are those that were written."""
    size = path.stat().st_size - _SEAL_BYTES
    with path.open("rb") as file:
        found = _digest(file.read(min(_AT_ONCE, size - at)) for at in range(0, size, _AT_ONCE))
        if file.read(_SEAL_BYTES + 1) != found.digest():
            raise ValueError("its checksum is wrong: bits of it have changed since it was written")


def with_sums(files: Mapping[str, Content]) -> dict[str, Content]:
    """The files by name, and behind them `SUMS`, which is made when they have been written."""
    sums: dict[str, _Sum] = {}

    def summed(name: str, content: Content) -> Iterator[Chunk]:
        digest, size = hashlib.sha256(), 0
        for chunk in chunks(content):
            digest.update(chunk)
            size += memoryview(chunk).nbytes
            yield chunk
            del chunk
        sums[name] = _Sum(size, digest.hexdigest())

    whole: dict[str, Content] = {name: partial(summed, name, content) for name, content in files.items()}
    whole[SUMS] = lambda: (_TABLE.dump_json(sums, indent=2),)
    return whole


class Sums:
    """The checksums in a run folder. Raises PathreplayError where they are missing or damaged."""

    def __init__(self, folder: Path) -> None:
        self.folder, path = folder, folder / SUMS
        if problem := file_problem(path, _MOST_BYTES):
            old = "" if path.exists() else " (runs of versions before checksums cannot be gone on with)"
            raise PathreplayError(f"File {path} {problem}{old}; {_WAY_OUT}")
        try:
            self.table = _TABLE.validate_json(path.read_bytes(), strict=True)
        except (OSError, ValidationError):
            raise PathreplayError(f"File {path} is damaged; {_WAY_OUT}") from None

    def require(self, path: Path) -> None:
        """Raise PathreplayError unless a picture of the folder is the one that was written."""
        if problem := file_problem(path):
            raise PathreplayError(f"Image {path} {problem}; {_WAY_OUT}")
        known = self.table.get(path.relative_to(self.folder).as_posix())
        if known is None or known.bytes != path.stat().st_size or known.sha256 != _of_file(path):
            raise PathreplayError(
                f"Image {path} or what {SUMS} says of it has changed since it was written: their checksums differ; "
                f"{_WAY_OUT}"
            )


def _of_file(path: Path) -> str:
    with path.open("rb") as file:
        return _digest(iter(partial(file.read, _AT_ONCE), b"")).hexdigest()


def _digest(parts: Iterator[bytes]) -> hashlib._Hash:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part)
    return digest
