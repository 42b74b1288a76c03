"""Atomic file writes: a temporary file beside the target is written, flushed to disk, and renamed."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeAlias

from pathreplay.errors import PathreplayError
from pathreplay.platform.files import file_problem
from pathreplay.platform.interrupts import undisturbed

Chunk: TypeAlias = "bytes | memoryview"
Content: TypeAlias = "bytes | Callable[[], Iterable[Chunk]]"
"""Content of a file: bytes, or a function that returns the bytes in chunks."""


def chunks(content: Content) -> Iterable[Chunk]:
    """Return the content of a file in chunks."""
    return (content,) if isinstance(content, bytes) else content()


def made(make: Callable[..., bytes], *arguments: object) -> Content:
    """Return content that ``make(*arguments)`` computes only when the file is written."""
    return lambda: (make(*arguments),)


def require_writable(path: Path, option: str) -> None:
    """Raise PathreplayError if no file can be written at ``path``.

    Possible reasons: the path is a folder or a device, its folder does not exist, or permissions are missing.
    """
    problem = file_problem(path)
    if problem.startswith(("is ", "cannot be reached")):
        raise PathreplayError(f"{path} {problem}; give {option} the name of a file")
    if not path.parent.is_dir():
        raise PathreplayError(f"Folder {path.parent} for {path.name} does not exist; create it first")
    if not os.access(path.parent, os.W_OK):
        raise PathreplayError(f"{path} cannot be written (permissions of its folder); give {option} another file")


def write_whole(path: Path, data: bytes, option: str) -> None:
    """Write a file atomically, and replace an existing file.

    Raises PathreplayError if the file cannot be written, and leaves no partial file behind.
    """
    part = None
    try:
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name[:100]}.", delete=False) as file:
            part = Path(file.name)
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        with undisturbed():
            part.chmod(0o666 & ~_umask())
            os.replace(part, path)
    except BaseException as error:
        if part is not None:
            with contextlib.suppress(OSError):
                part.unlink()
        if isinstance(error, OSError):
            raise PathreplayError(_why(path, error, option)) from error
        raise


@contextmanager
def whole_folder(path: Path, option: str) -> Iterator[Path]:
    """Yield a temporary folder, which is renamed to ``path`` at the end of the block, or removed if the block raises.

    Raises PathreplayError if ``path`` cannot be written, or exists and is not an empty folder.
    """
    if os.path.lexists(path) and not (path.is_dir() and not path.is_symlink() and not any(path.iterdir())):
        raise PathreplayError(f"{path} exists already; give {option} a new folder")
    part = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name[:100]}."))
        yield part
        with undisturbed():
            part.chmod(0o777 & ~_umask())
            os.replace(part, path)  # this call also replaces an empty folder at ``path``
    except BaseException as error:
        if part is not None:
            shutil.rmtree(part, ignore_errors=True)
        if isinstance(error, OSError):
            raise PathreplayError(_why(path, error, option)) from error
        raise


def _umask() -> int:
    """Return the umask of this process.

    Temporary files and folders are created without permissions for other users. Before the final renaming, callers use
    the umask to set the permissions that a new file or folder usually has.
    """
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _why(path: Path, error: OSError, option: str) -> str:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"No space left on the disk for {path}: free some space, or give {option} another place"
    return f"{path} cannot be written ({error.strerror or error}); give {option} another place"
