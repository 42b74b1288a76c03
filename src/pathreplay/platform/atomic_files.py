"""Files that are there whole or not at all: written beside their place first, and renamed once they are on the disk."""

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
"""What is written into a file: bytes, or what makes them, chunk by chunk, when it is called."""


def chunks(content: Content) -> Iterable[Chunk]:
    """What a file shall hold, a chunk after the other."""
    return (content,) if isinstance(content, bytes) else content()


def made(make: Callable[..., bytes], *arguments: object) -> Content:
    """The bytes that a function makes of the arguments, when they are written and not before."""
    return lambda: (make(*arguments),)


def require_writable(path: Path, option: str) -> None:
    """Raise PathreplayError where no file can be written: a folder or a device of that name, no folder, no right."""
    problem = file_problem(path)
    if problem.startswith(("is ", "cannot be reached")):
        raise PathreplayError(f"{path} {problem}; give {option} the name of a file")
    if not path.parent.is_dir():
        raise PathreplayError(f"Folder {path.parent} for {path.name} does not exist; make it first")
    if not os.access(path.parent, os.W_OK):
        raise PathreplayError(f"{path} may not be written (permissions of its folder); give {option} another file")


def write_whole(path: Path, data: bytes, option: str) -> None:
    """Write the file, in the place of one that is there. Raises PathreplayError where that fails; nothing is left."""
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
    """A folder to fill, which becomes ``path`` at the end of the block, and is removed where the block raises.

    Raises PathreplayError where ``path`` exists already (an empty folder may), or cannot be written.
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
            os.replace(part, path)  # in the place of an empty folder, too
    except BaseException as error:
        if part is not None:
            shutil.rmtree(part, ignore_errors=True)
        if isinstance(error, OSError):
            raise PathreplayError(_why(path, error, option)) from error
        raise


def _umask() -> int:
    """What the user wants taken from permissions: temporary files have none for others."""
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _why(path: Path, error: OSError, option: str) -> str:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"No space left on the disk for {path}: free some space, or give {option} another place"
    return f"{path} cannot be written ({error.strerror or error}); give {option} another place"
