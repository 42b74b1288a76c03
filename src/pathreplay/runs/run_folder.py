"""The run folder on disk: a new one for every run, every file whole or absent, an earlier run never touched."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import secrets
import shutil
import stat
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.parsing import YAML
from pathreplay.inverse.config.schema import Config, load_config
from pathreplay.platform.atomic_files import Content, chunks
from pathreplay.platform.files import file_problem
from pathreplay.platform.interrupts import undisturbed
from pathreplay.runs.folder_lock import FolderLock

PART = ".part"
_CONFIGS = "config.toml", "config.yaml", "config.json"
_FOLDERS = "images", "volumes", "baseline", "previews"
CHECKPOINT = "checkpoint.safetensors"
BASELINE_CHECKPOINT = "baseline/checkpoint.safetensors"


@dataclass(frozen=True)
class Job:
    """What a run does, the file that says so (None where Python does), and the folder where its paths start.

    ``changes`` are those that the command line made to the file.
    """

    config: Config
    source: Path | None
    base: Path
    changes: tuple[str, ...] = ()


class RunFolder:
    """A folder that belongs to one run, until its ``lock`` is closed.

    ``given`` is its path from the folder ``home`` (default: the current one), and stays it wherever the user goes.
    """

    def __init__(self, given: Path, home: Path | None = None) -> None:
        self.given, self.home = given, Path.cwd() if home is None else home
        self.path = self.home / given
        self.lock = FolderLock(self.path)
        self.identity = _identity(self.path)
        self.made_for_it: list[Path] = []
        """Folders that it was put into and that were not there before, the innermost first."""

    @property
    def name(self) -> Path:
        """The path to be told to somebody who is in the current folder."""
        with contextlib.suppress(OSError):  # that folder may be gone
            if Path.cwd() == self.home:
                return self.given
        return self.path

    def remove(self) -> None:
        """Remove it with all that is in it, where it still is the folder that was made, and what was made for it."""
        if _identity(self.path) != self.identity:
            return
        # Half a folder would look like a run; the process may end in the middle of this.
        hidden = self.path.with_name(f".{self.path.name[:100]}.{secrets.token_hex(4)}{PART}")
        with contextlib.suppress(OSError):
            os.rename(self.path, hidden)
        for path in (hidden, self.path):
            if _identity(path) == self.identity:
                shutil.rmtree(path, ignore_errors=True)
        _remove_empty(self.made_for_it)

    def require_in_place(self, lost: str, held: int | None = None) -> None:
        """Raise PathreplayError if the folder is no longer where it was; ``lost`` names what was not saved.

        Or if one that is ``held`` is not this.
        """
        if _identity(self.path if held is None else held) != self.identity:
            raise PathreplayError(
                f"Run folder {self.name} was removed or renamed during the run, which ends here: {lost} lost; if it "
                "was renamed, go on with: pathreplay optimize --resume NEW_NAME, else start the job again"
            )

    def write(self, files: Mapping[str, Content]) -> None:
        """Write all files or none: each goes to a temporary name first, and all are renamed once all are on the disk.

        Links are not followed: a link in the place of a file is replaced.

        What is made while it is written is not held before, and not after.

        Raises:
            PathreplayError: the disk is full, the folder is gone or cannot be written, or a folder in it is a link that
                leads elsewhere. Temporary files are removed, and so are folders that were made for them.
        """
        parts: list[str] = []
        made: list[str] = []
        lost = "what was not yet written is"
        with _held(self.path) as held:
            self.require_in_place(lost, held)
            # By the folder itself: another one, or a link, may get its name meanwhile.
            base = self.path if held is None else Path()
            try:
                for name, content in files.items():
                    self._make_parent(name, made, held)
                    parts.append(name)
                    _write_through(base / f"{name}{PART}", content, held)
                self.require_in_place(lost)
                with undisturbed():  # all or none: a second Ctrl-C waits
                    for name in parts:
                        os.replace(base / f"{name}{PART}", base / name, src_dir_fd=held, dst_dir_fd=held)
            except BaseException as error:  # a second Ctrl-C, too
                for remove, name in (*((os.unlink, f"{name}{PART}") for name in parts), *((os.rmdir, n) for n in made)):
                    with contextlib.suppress(OSError):
                        remove(base / name, dir_fd=held)
                if isinstance(error, OSError):
                    raise PathreplayError(self._failure(error)) from error
                raise

    def discard(self, names: Iterable[str]) -> None:
        """Remove files of it, where it still is the folder that was made. Links to folders are not followed.

        Raises nothing.
        """
        with _held(self.path) as held:
            if _identity(self.path if held is None else held) != self.identity:
                return
            base = self.path if held is None else Path()
            for name in names:
                parent = os.path.dirname(name)
                with contextlib.suppress(OSError):
                    if not (parent and _is_link(base / parent, held)):
                        os.unlink(base / name, dir_fd=held)

    def _make_parent(self, name: str, made: list[str], held: int | None) -> None:
        parent = os.path.dirname(name)
        if not parent:
            return
        folder = self.path / parent if held is None else Path(parent)
        try:
            if _is_link(folder, held):
                what = f"{self.path / parent} is a link that may lead out of the run folder"
                raise PathreplayError(f"{what}; replace it by the folder that it leads to")
        except FileNotFoundError:
            os.mkdir(folder, dir_fd=held)
            made.append(parent)

    def _failure(self, error: OSError) -> str:
        if (self.path / CHECKPOINT).exists():
            rescue = f"then go on with: pathreplay optimize --resume {self.name}"
        else:
            rescue = "or give --output elsewhere, then start again (this folder was removed)"
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            return f"No space left on the disk for run folder {self.name}: free some space, {rescue}"
        return f"Run folder {self.name} cannot be written ({error.strerror}): mend that, {rescue}"


def create_run_folder(output: Path, job: Job, files: Mapping[str, Content], home: Path | None = None) -> RunFolder:
    """Make ``output``, or ``output-2``, ``-3``, … where that exists, and put the job and its first files into it.

    A relative ``output`` starts at ``home`` (default: the current folder).

    The config is copied as it was written (``config.toml`` or ``.yaml``), or as JSON where it came from Python or was
    changed. What fails leaves no folder behind. Raises PathreplayError where the folder cannot be made or written.
    """
    if job.source is not None and job.source.suffix != ".json" and not job.changes:
        name = "config.yaml" if job.source.suffix.lower() in YAML else "config.toml"
        copy: dict[str, Content] = {name: (job.base / job.source.name).read_bytes()}
    else:
        copy = {"config.json": job.config.model_dump_json(indent=2, exclude_unset=True).encode()}
    origin: dict[str, Any] = {
        "base": str(job.base.resolve()),
        "config": None if job.source is None else str(job.source),
    }
    if job.changes:
        origin["changes"] = list(job.changes)
    home = Path.cwd() if home is None else home
    missing = [folder for folder in (home / output).parents if not folder.exists()]
    with undisturbed(), contextlib.ExitStack() as undo:
        undo.callback(_remove_empty, missing)
        part = _make_part(output, home)
        undo.callback(shutil.rmtree, part, ignore_errors=True)
        run = RunFolder(part)
        run.given, run.home, run.made_for_it = _free(output, home), home, missing
        undo.callback(run.lock.close)
        run.write({**copy, "run.json": json.dumps(origin, indent=2).encode(), **files})
        run.given = _claim(part, output, home)
        run.path = home / run.given
        undo.pop_all()
    return run


class _Origin(BaseModel):
    """run.json: where relative paths of the config start, the config that the run was started with, and `changes`."""

    model_config = ConfigDict(strict=True, extra="forbid")

    base: str
    config: str | None
    changes: list[str] = []


def open_run_folder(path: Path) -> tuple[Job, RunFolder]:
    """The job of an existing run folder, and that folder, locked.

    What a killed run has left half written in it is removed.

    Raises PathreplayError if it is no run folder, holds no checkpoint to go on from, is damaged, or is in use.
    """
    require_writable_name(path, "--resume")
    copy = _config_in(path)
    if not (path / CHECKPOINT).is_file():
        raise PathreplayError(f"Run folder {path} has no checkpoint to resume from; start the job from its config")
    job, run = _job(path, copy), RunFolder(path)
    _remove_parts(path)
    return job, run


def _remove_parts(path: Path) -> None:
    """Remove what a killed run has half written, in the folder and in those that a run makes in it. Raises nothing."""
    for folder in (path, *(path / name for name in _FOLDERS)):
        if folder.is_symlink():
            continue
        for part in folder.glob(f"*{PART}"):
            with contextlib.suppress(OSError):
                part.unlink()


def read_job(path: Path) -> Job:
    """The job of an existing run folder, which may be in use. Raises PathreplayError if it is none, or damaged."""
    return _job(path, _config_in(path))


def _config_in(path: Path) -> Path:
    copy = next((path / name for name in _CONFIGS if (path / name).is_file()), None)
    if copy is None or not (path / "run.json").is_file():
        raise PathreplayError(f"{path} is no run folder (no config, no run.json); give a folder that optimize has made")
    return copy


def _job(path: Path, copy: Path) -> Job:
    try:
        if problem := file_problem(path / "run.json", 2**20):  # far above what two paths take
            raise ValueError(f"it {problem}")
        origin = _Origin.model_validate_json((path / "run.json").read_bytes())
        if "\0" in origin.base + (origin.config or ""):
            raise ValueError("a path with a null character")
    except (OSError, ValueError) as error:
        what = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error
        raise PathreplayError(f"{path / 'run.json'} cannot be used ({what}); start the job from its config") from None
    source = None if origin.config is None else Path(origin.config)
    return Job(load_config(copy), source, Path(origin.base), tuple(origin.changes))


def new_output(output: str | Path | None, source: Path | None) -> Path:
    """The path of a new run folder: ``output``, or one in ``runs`` with the name of the config file.

    A file that is called config gives the name of its folder. Raises PathreplayError if no folder can be there.
    """
    if output is None:
        named = "optimize" if source is None else source.stem
        return Path("runs") / (source.resolve().parent.name if source and named == "config" else named)
    path = Path(output)
    require_writable_name(path, "--output")
    if not str(output) or path.name in ("", ".."):
        raise PathreplayError(f"Run folder '{output}' has no name of its own; give --output a new folder, as runs/mine")
    if os.path.lexists(path) and not path.is_dir():
        raise PathreplayError(f"Run folder {path} cannot be made: there is a file of that name; give another --output")
    return path


def require_writable_name(path: Path, option: str) -> None:
    """Raise PathreplayError if the path cannot be written into reports, or is none at all."""
    try:
        str(path).encode()
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            os.lstat(path)
    except UnicodeEncodeError:
        raise PathreplayError(f"Run folder {str(path)!a} is not UTF-8; give another {option}") from None
    except (OSError, ValueError) as error:  # too long; a null character
        name = ascii(str(path))
        raise PathreplayError(f"Run folder {name} cannot be used ({error}); give another {option}") from None


def _remove_empty(folders: Iterable[Path]) -> None:
    """Remove folders in which nothing is; who put something into one meanwhile keeps it."""
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.rmdir()


def _make_part(output: Path, home: Path) -> Path:
    """A folder beside the one that is wanted, which takes its place when it is whole: a process may end at any time."""
    wanted = home / output
    part = wanted.with_name(f".{wanted.name[:100]}.{secrets.token_hex(4)}{PART}")
    try:
        wanted.parent.mkdir(parents=True, exist_ok=True)
        part.mkdir()
        return part
    except OSError as error:
        raise PathreplayError(_not_made(output, error)) from error


def _free(output: Path, home: Path) -> Path:
    """``output``, or the first of ``output-2``, ``-3``, … that does not exist."""
    number, found = 1, output
    while os.path.lexists(home / found):
        number += 1
        found = output.with_name(f"{output.name}-{number}")
    return found


def _claim(part: Path, output: Path, home: Path) -> Path:
    """Give the folder the first name that is free; two runs at once cannot get the same one, since none is empty."""
    while True:
        found = _free(output, home)
        try:
            os.rename(part, home / found)
            return found
        except OSError as error:
            if error.errno not in (errno.EEXIST, errno.ENOTEMPTY, errno.ENOTDIR):
                raise PathreplayError(_not_made(output, error)) from error


def _not_made(output: Path, error: OSError) -> str:
    return f"Run folder {output} cannot be made ({error.strerror}); give another with --output"


@contextlib.contextmanager
def _held(folder: Path) -> Iterator[int | None]:
    """The folder itself, whatever it may be called meanwhile; None where it cannot be held (Windows, no right)."""
    with contextlib.ExitStack() as stack:
        held = None
        if os.unlink in os.supports_dir_fd:
            with contextlib.suppress(OSError):
                held = os.open(folder, os.O_RDONLY)
                stack.callback(os.close, held)
        yield held


def _identity(path: Path | int) -> tuple[int, int] | None:
    """Device and number of a folder, given by its path or its descriptor; None if there is none."""
    try:
        about = os.stat(path)
    except OSError:
        return None
    return about.st_dev, about.st_ino


def _is_link(path: Path, held: int | None) -> bool:
    """Raises OSError if there is nothing of that name."""
    return stat.S_ISLNK(os.stat(path, dir_fd=held, follow_symlinks=False).st_mode)


def _write_through(path: Path, content: Content, held: int | None) -> None:
    """Write a file and wait until it is on the disk; the path is one in a folder that is ``held``, if there is one."""
    # What a killed run has left is removed, and a link by that name is not followed.
    with contextlib.suppress(FileNotFoundError):
        os.unlink(path, dir_fd=held)
    with open(path, "xb", opener=lambda name, flags: os.open(name, flags, 0o666, dir_fd=held)) as file:
        for chunk in chunks(content):
            file.write(chunk)
            del chunk
        file.flush()
        os.fsync(file.fileno())  # some file systems report a full disk only when the data are written out
