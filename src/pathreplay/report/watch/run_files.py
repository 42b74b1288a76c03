"""Reads the files of a run folder that `watch` serves (live page or report, images), and finds the run's process."""

from __future__ import annotations

import contextlib
import os
import re
import socket
import stat
from pathlib import Path

from pydantic import ValidationError

from pathreplay.errors import PathreplayError
from pathreplay.platform.files import file_problem
from pathreplay.report.live_page import FOLDER, PAGE, PAGES, STOP
from pathreplay.report.pages.page import Page
from pathreplay.runs.folder_lock import LOCK

REPORT = "report.html"
# Maximum size of a file that is read, in bytes. The files of a run are far smaller.
MOST_BYTES = 256 * 2**20
PICTURES = {".png": "image/png", ".webp": "image/webp"}


def require_run(run: Path) -> None:
    """Raise PathreplayError if the folder is not a run folder, or has no page and no report yet."""
    if not run.is_dir():
        raise PathreplayError(f"No run folder {run}; give a folder that optimize has created")
    if not (run / "run.json").is_file():
        raise PathreplayError(f"{run} is not a run folder (no run.json); give a folder that optimize has created")
    if not (run / PAGE).is_file() and not (run / REPORT).is_file():
        raise PathreplayError(f"Run folder {run} has no {PAGE} and no {REPORT} yet; wait until it has one")


def read_own(path: Path) -> bytes | None:
    """Return the content of a file; None if the file does not exist, is not a regular file, or is too large.

    Symbolic links are not followed.
    """
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    try:
        with open(os.open(path, flags), "rb") as file:
            about = os.fstat(file.fileno())
            return file.read() if stat.S_ISREG(about.st_mode) and about.st_size <= MOST_BYTES else None
    except (OSError, ValueError):
        return None


def picture(run: Path, name: str) -> tuple[str, bytes] | None:
    """Return media type and content of a preview image; None if it does not exist, or is not in ``previews``."""
    kind = PICTURES.get(Path(name).suffix)
    if kind is None or not re.fullmatch(r"[\w.-]+", name) or (run / FOLDER).is_symlink():
        return None
    data = read_own(run / FOLDER / name)
    return None if data is None else (kind, data)


def report(run: Path) -> bytes | None:
    """Return the report; None if it does not exist, or if the live page is newer because the run was resumed."""
    with contextlib.suppress(OSError):
        written = (run / REPORT).stat().st_mtime_ns
        with contextlib.suppress(FileNotFoundError):
            if (run / PAGE).stat().st_mtime_ns > written:
                return None
        return read_own(run / REPORT)
    return None


def page(run: Path) -> Page:
    """Read the live page of a run. Raises PathreplayError if the page is missing or damaged."""
    path = run / PAGE
    if problem := file_problem(path, MOST_BYTES):
        raise PathreplayError(f"{path} {problem}; wait for the run to write it")
    try:
        return PAGES.validate_json(read_own(path) or b"", strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise PathreplayError(f"{path} is damaged ({where}: {first['msg']}); wait for the run to write it") from None


def holder(run: Path) -> str | None:
    """Return the process that the run's lock file names; None if the named process has ended.

    Processes on other machines cannot be checked, and count as running.
    """
    data = read_own(run / LOCK) or b""
    match = re.fullmatch(r"(\d+) ([\w.-]+)\s*", data.decode("ascii", "replace"))
    if match is None:
        return None
    if match[2] == socket.gethostname():
        try:
            os.kill(int(match[1]), 0)
        except PermissionError:
            pass
        except (OSError, OverflowError):
            return None
    return f"process {match[1]} on {match[2]}"


def ask_to_stop(run: Path) -> None:
    """Create the file that requests a stop of the run. Raises PathreplayError if the file cannot be written."""
    # Opening must not block, even if there is a pipe of this name that nobody reads.
    flags = os.O_WRONLY | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    try:
        os.close(os.open(run / STOP, flags, 0o644))
    except OSError as error:
        why = file_problem(run / STOP) or f"cannot be written ({error.strerror})"
        raise PathreplayError(f"{run / STOP} {why}; remove it, or stop the run with SIGTERM") from None
