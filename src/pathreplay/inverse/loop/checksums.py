"""Checksums of the files that a run resumes from, which detect corruption before the data is used."""

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
"""Name of the file that lists the sizes and checksums of the initial and target images in a run folder."""

SEAL = "sha256"
"""Name of the last tensor of a sealed file. This tensor contains the checksum of all preceding bytes."""

_SEAL_BYTES = hashlib.sha256().digest_size
_AT_ONCE, _MOST_BYTES = 2**20, 64 * 2**20
_REMEDY = "start a new run"


@dataclass(frozen=True)
class _Sum:
    """Size and checksum of a file."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    bytes: int
    sha256: str


_TABLE = TypeAdapter(dict[str, _Sum])


def sealed_chunks(arrays: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> Iterator[Chunk]:
    """Yield the chunks of a safetensors file of the arrays, followed by its checksum (`SEAL`)."""
    digest = hashlib.sha256()
    for chunk in safetensors_chunks(arrays, metadata, {SEAL: _SEAL_BYTES}):
        digest.update(chunk)
        yield chunk
        del chunk
    yield digest.digest()


def require_seal(path: Path) -> None:
    """Raise ValueError unless the checksum of a sealed file is correct."""
    size = path.stat().st_size - _SEAL_BYTES
    with path.open("rb") as file:
        digest = _digest(file.read(min(_AT_ONCE, size - at)) for at in range(0, size, _AT_ONCE))
        if file.read(_SEAL_BYTES + 1) != digest.digest():
            raise ValueError("its checksum is wrong: it has changed since it was written")


def with_sums(files: Mapping[str, Content]) -> dict[str, Content]:
    """Add the file `SUMS` to ``files`` (by name). Its content is generated after the other files are written."""
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
    """The checksums in a run folder. Raises PathreplayError if they are missing or damaged."""

    def __init__(self, folder: Path) -> None:
        self.folder, path = folder, folder / SUMS
        if problem := file_problem(path, _MOST_BYTES):
            old = "" if path.exists() else " (runs of versions without checksums cannot be resumed)"
            raise PathreplayError(f"File {path} {problem}{old}; {_REMEDY}")
        try:
            self.table = _TABLE.validate_json(path.read_bytes(), strict=True)
        except (OSError, ValidationError):
            raise PathreplayError(f"File {path} is damaged; {_REMEDY}") from None

    def require(self, path: Path) -> None:
        """Raise PathreplayError unless the checksum of an image in the folder is correct."""
        if problem := file_problem(path):
            raise PathreplayError(f"Image {path} {problem}; {_REMEDY}")
        known = self.table.get(path.relative_to(self.folder).as_posix())
        if known is None or known.bytes != path.stat().st_size or known.sha256 != _of_file(path):
            raise PathreplayError(
                f"Image {path} has changed since it was written: its checksum differs from {SUMS}; {_REMEDY}"
            )


def _of_file(path: Path) -> str:
    with path.open("rb") as file:
        return _digest(iter(partial(file.read, _AT_ONCE), b"")).hexdigest()


def _digest(parts: Iterator[bytes]) -> hashlib._Hash:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part)
    return digest
