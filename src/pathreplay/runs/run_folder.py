"""The run folder on disk. Each run gets a new folder, and never changes the folder of an earlier run.

Files are written atomically.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import secrets
import shlex
import shutil
import stat
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.parsing import YAML
from pathreplay.inverse.config.schema import Config, load_config
from pathreplay.inverse.config.tables import Plugin
from pathreplay.platform.atomic_files import Content, chunks
from pathreplay.platform.files import file_problem
from pathreplay.platform.interrupts import undisturbed
from pathreplay.runs.folder_lock import FolderLock
from pathreplay.types import Json

PART = ".part"
# In the order in which they are looked for: if `record_job` ends early, config.json is newer than the others.
_CONFIGS = "config.json", "config.toml", "config.yaml"
_FOLDERS = "images", "volumes", "baseline", "previews"
CHECKPOINT = "checkpoint.safetensors"
BASELINE_CHECKPOINT = "baseline/checkpoint.safetensors"
IN_MEMORY = "memory"
"""Value of ``scene`` in the config of a run whose scene is an object in memory."""


@dataclass(frozen=True)
class Job:
    """The config of a run, and its origin.

    ``source`` is the file of the config (None: the config comes from Python), ``base`` the folder to which relative
    paths in the config refer, and ``changes`` are the ``--set`` options of the command line.
    """

    config: Config
    source: Path | None
    base: Path
    changes: tuple[str, ...] = ()
    in_python: bool = False
    """Whether parts of the job are Python objects, which the config cannot describe."""
    content: bytes | None = None
    """Content of the file ``source`` when the config was read, for a new run folder."""


def resume_command(folder: Path, in_python: bool = False) -> str:
    """Return the command that resumes a run, or the Python call if the job has Python objects (``in_python``)."""
    if in_python:
        return f"pathreplay.minimize(problem, output={str(folder)!r}, resume=True)"
    return f"pathreplay optimize --resume {shlex.quote(str(folder))}"


class RunFolder:
    """A folder that belongs to one run until its ``lock`` is closed.

    Args:
        given: path of the folder, absolute or relative to the current folder.
        in_python: whether the job has Python objects; see `Job`.
    """

    def __init__(self, given: Path, in_python: bool = False) -> None:
        self.given, self.home = given, Path.cwd()
        self.in_python = in_python
        self.path = self.home / given
        self.lock = FolderLock(self.path)
        self.identity = _identity(self.path)
        self.created_parents: list[Path] = []
        """Parent folders that were created for this folder, innermost first."""

    @property
    def name(self) -> Path:
        """Return the path to show to the user, which is valid from the current folder."""
        with contextlib.suppress(OSError):  # the current folder may have been removed
            if Path.cwd() == self.home:
                return self.given
        return self.path

    def resume_command(self, name: Path | None = None) -> str:
        """Return the command or Python call that resumes this run from a folder ``name`` (default: this folder)."""
        return resume_command(self.name if name is None else name, self.in_python)

    def remove(self) -> None:
        """Remove the folder and the parents that were created for it, unless another folder now has its path."""
        if _identity(self.path) != self.identity:
            return
        # Rename first: if the process ends during the removal, a partial folder must not look like a run.
        hidden = self.path.with_name(f".{self.path.name[:100]}.{secrets.token_hex(4)}{PART}")
        with contextlib.suppress(OSError):
            os.rename(self.path, hidden)
        for path in (hidden, self.path):
            if _identity(path) == self.identity:
                shutil.rmtree(path, ignore_errors=True)
        _remove_empty(self.created_parents)

    def require_in_place(self, lost: str, descriptor: int | None = None) -> None:
        """Raise PathreplayError if the path (or the open ``descriptor``) no longer refers to this folder.

        ``lost`` names the unsaved data with a verb, such as "iterations 3 to 5 are".
        """
        if _identity(self.path if descriptor is None else descriptor) != self.identity:
            raise PathreplayError(
                f"Run folder {self.name} was removed or renamed during the run, so the run ends: {lost} lost; if it "
                f"was renamed, resume with: {self.resume_command(Path('NEW_NAME'))}, otherwise start the job again"
            )

    def write(self, files: Mapping[str, Content]) -> None:
        """Write all files or none: each file is written under a temporary name, and then all files are renamed.

        A symbolic link in the place of a file is replaced instead of followed. If the content of a file is given as a
        function (see `Content`), the content is in memory only while the file is written.

        Args:
            files: content by file name relative to the folder; missing subfolders are created.

        Raises:
            PathreplayError: the disk is full, the folder is gone or cannot be written, or a subfolder is a symbolic
                link. Temporary files and the subfolders that were created for them are removed.
        """
        parts: list[str] = []
        created: list[str] = []
        lost = "unwritten data is"
        with _opened(self.path) as descriptor:
            self.require_in_place(lost, descriptor)
            # Paths are relative to the open folder. During the call, the folder may be renamed, and another folder may
            # take its path.
            base = self.path if descriptor is None else Path()
            try:
                for name, content in files.items():
                    self._make_parent(name, created, descriptor)
                    parts.append(name)
                    _write_through(base / f"{name}{PART}", content, descriptor)
                self.require_in_place(lost)
                with undisturbed():  # a second Ctrl-C must not leave only some files renamed
                    for name in parts:
                        os.replace(base / f"{name}{PART}", base / name, src_dir_fd=descriptor, dst_dir_fd=descriptor)
            except BaseException as error:  # including a second Ctrl-C
                leftovers = [(os.unlink, f"{name}{PART}") for name in parts] + [(os.rmdir, name) for name in created]
                for remove, name in leftovers:
                    with contextlib.suppress(OSError):
                        remove(base / name, dir_fd=descriptor)
                if isinstance(error, OSError):
                    raise PathreplayError(self._failure(error)) from error
                raise

    def discard(self, names: Iterable[str]) -> None:
        """Remove files of the folder, unless another folder now has its path.

        Files in subfolders that are symbolic links are not removed. Raises nothing.
        """
        with _opened(self.path) as descriptor:
            if _identity(self.path if descriptor is None else descriptor) != self.identity:
                return
            base = self.path if descriptor is None else Path()
            for name in names:
                parent = os.path.dirname(name)
                with contextlib.suppress(OSError):
                    if not (parent and _is_link(base / parent, descriptor)):
                        os.unlink(base / name, dir_fd=descriptor)

    def _make_parent(self, name: str, created: list[str], descriptor: int | None) -> None:
        parent = os.path.dirname(name)
        if not parent:
            return
        folder = self.path / parent if descriptor is None else Path(parent)
        try:
            if _is_link(folder, descriptor):
                what = f"{self.path / parent} is a link that may lead out of the run folder"
                raise PathreplayError(f"{what}; replace it with the folder that it points to")
        except FileNotFoundError:
            os.mkdir(folder, dir_fd=descriptor)
            created.append(parent)

    def _failure(self, error: OSError) -> str:
        if (self.path / CHECKPOINT).exists():
            remedy = f"then resume with: {self.resume_command()}"
        else:
            remedy = "or choose another --output, then start again (this folder was removed)"
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            return f"No space left on the disk for run folder {self.name}: free some space, {remedy}"
        return f"Run folder {self.name} cannot be written ({error.strerror}): fix this, {remedy}"


def create_run_folder(output: Path, job: Job, files: Mapping[str, Content], home: Path | None = None) -> RunFolder:
    """Create a run folder with the job and its first files. A failure leaves no folder behind.

    Args:
        output: path of the folder. If the path exists, the first free path of ``output-2``, ``output-3``, … is used.
        job: the job. The content of its config file is written unchanged as ``config.toml`` or ``config.yaml``. A
            config that comes from Python or JSON, or was changed on the command line, is written as ``config.json``.
        files: content of further files by name.
        home: folder to which a relative ``output`` refers; default: the current folder.

    Raises:
        PathreplayError: the folder cannot be created or written.
    """
    home = Path.cwd() if home is None else home
    missing = [folder for folder in (home / output).parents if not folder.exists()]
    with undisturbed(), contextlib.ExitStack() as undo:
        undo.callback(_remove_empty, missing)
        part = _make_part(output, home, job.source)
        undo.callback(shutil.rmtree, part, ignore_errors=True)
        run = RunFolder(part, in_python=job.in_python)
        run.given, run.home, run.created_parents = _free(output, home), home, missing
        undo.callback(run.lock.close)
        run.write({**_job_files(job), **files})
        run.given = _claim(part, output, home, job.source)
        run.path = home / run.given
        undo.pop_all()
    return run


def _job_files(job: Job) -> dict[str, Content]:
    """Return the config of a job and run.json, by name."""
    if job.source is not None and job.content is not None and job.source.suffix.lower() != ".json" and not job.changes:
        name = "config.yaml" if job.source.suffix.lower() in YAML else "config.toml"
        copy: dict[str, Content] = {name: job.content}
    else:
        copy = {"config.json": job.config.model_dump_json(indent=2, exclude_unset=True).encode()}
    asked = job.config.target.integrator
    origin: Json = {
        "base": str(job.base.resolve()),
        "config": None if job.source is None else str(job.source),
        "integrator": job.config.integrator.model_dump(mode="json"),
        "target_integrator": None if asked is None else asked.model_dump(mode="json"),
    }
    if job.changes:
        origin["changes"] = list(job.changes)
    if job.in_python:
        origin["in_python"] = True
    return {**copy, "run.json": json.dumps(origin, indent=2).encode()}


def record_job(folder: RunFolder, job: Job) -> None:
    """Replace the job of a run folder by one from Python, whose config is ``config.json``.

    Raises the same errors as `RunFolder.write`.
    """
    folder.write(_job_files(job))
    folder.discard(name for name in _CONFIGS if name != "config.json")


class _Origin(BaseModel):
    """Content of run.json. ``config`` is the path of the config file. Most other fields are described in `Job`.

    The integrators are those of the job and of its targets, also if the config file leaves them out (see `completed`).
    """

    model_config = ConfigDict(strict=True, extra="forbid")

    base: str
    config: str | None
    changes: list[str] = []
    in_python: bool = False
    integrator: Plugin | None = None
    target_integrator: Plugin | None = None


def open_run_folder(path: Path, in_python: bool = False) -> tuple[Job, RunFolder]:
    """Open and lock an existing run folder, and remove temporary files of a killed run.

    Args:
        path: path of the folder.
        in_python: whether the caller can supply the Python objects of a job; see `Job`.

    Returns:
        The job and the folder.

    Raises:
        PathreplayError: ``path`` is not a run folder, has no checkpoint, or is damaged or in use. Also raised if
            the job has Python objects and ``in_python`` is False, or vice versa.
    """
    require_writable_name(path, "--resume")
    job = read_job(path)
    if not (path / CHECKPOINT).is_file():
        raise PathreplayError(f"Run folder {path} has no checkpoint to resume from; start a new run")
    if job.in_python != in_python:
        what = "was started in Python, with objects" if job.in_python else "was started from the file of a job"
        raise PathreplayError(f"Run {path} {what}; resume it with: {resume_command(path, job.in_python)}")
    run = RunFolder(path, in_python=in_python)
    _remove_parts(path)
    return job, run


def _remove_parts(path: Path) -> None:
    """Remove temporary files of a killed run from the folder and its subfolders. Raises nothing."""
    for folder in (path, *(path / name for name in _FOLDERS)):
        if folder.is_symlink():
            continue
        for part in folder.glob(f"*{PART}"):
            with contextlib.suppress(OSError):
                part.unlink()


def read_job(path: Path) -> Job:
    """Read the job of a run folder, which may be in use.

    Raises PathreplayError if ``path`` is not a run folder, or is damaged.
    """
    copy = next((path / name for name in _CONFIGS if (path / name).is_file()), None)
    if copy is None or not (path / "run.json").is_file():
        raise PathreplayError(
            f"{path} is not a run folder (config or run.json missing); give a folder that optimize has created"
        )
    try:
        if problem := file_problem(path / "run.json", 2**20):  # the limit is far more than a few paths need
            raise ValueError(f"it {problem}")
        origin = _Origin.model_validate_json((path / "run.json").read_bytes())
        if "\0" in origin.base + (origin.config or ""):
            raise ValueError("a path contains a null character")
    except (OSError, ValueError) as error:
        what = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error
        raise PathreplayError(f"{path / 'run.json'} cannot be used ({what}); start a new run") from None
    source = None if origin.config is None else Path(origin.config)
    config = load_config(copy)
    if origin.integrator is not None:
        config = config.model_copy(update={"integrator": origin.integrator})
    if origin.target_integrator is not None:
        target = config.target.model_copy(update={"integrator": origin.target_integrator})
        config = config.model_copy(update={"target": target})
    return Job(config, source, Path(origin.base), tuple(origin.changes), origin.in_python)


def new_output(output: str | Path | None, source: Path | None) -> Path:
    """Return the path of a new run folder: ``output``, or ``runs/NAME`` if ``output`` is None.

    NAME is the stem of the config file ``source``. If the stem is ``config``, NAME is the name of the file's folder.
    Without ``source``, NAME is ``optimize``. Raises PathreplayError if ``output`` cannot be a folder.
    """
    if output is None:
        named = "optimize" if source is None else source.stem
        return Path("runs") / (source.resolve().parent.name if source and named == "config" else named)
    path, option = Path(output), _option(source)
    require_writable_name(path, option)
    if not str(output) or path.name in ("", ".."):
        raise PathreplayError(f"Run folder '{output}' has no name of its own; give {option} a new name: runs/mine")
    if os.path.lexists(path) and not path.is_dir():
        raise PathreplayError(f"Run folder {path} cannot be created: a file has that name; give another {option}")
    return path


def _option(source: Path | None) -> str:
    """Return the name of the option of the run folder: that of Python if the config is not a file."""
    return "'output'" if source is None else "--output"


def require_writable_name(path: Path, option: str) -> None:
    """Raise PathreplayError if the path is invalid, or cannot be encoded in UTF-8, the encoding of reports."""
    try:
        str(path).encode()
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            os.lstat(path)
    except UnicodeEncodeError:
        raise PathreplayError(f"Folder {str(path)!a} is not UTF-8; give another {option}") from None
    except (OSError, ValueError) as error:  # the path is too long or contains a null character
        name = ascii(str(path))
        raise PathreplayError(f"Folder {name} cannot be used ({error}); give another {option}") from None


def _remove_empty(folders: Iterable[Path]) -> None:
    """Remove the folders that are empty. Another process may have put files into a folder."""
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.rmdir()


def require_creatable(output: Path, home: Path, source: Path | None) -> None:
    """Check that a run folder can be created, before a run spends time on images.

    The check creates and removes an empty folder in the innermost parent that exists.

    Args:
        output: path of the run folder.
        home: folder to which a relative ``output`` refers.
        source: the file of the config; None if the config comes from Python.

    Raises:
        PathreplayError: the run folder cannot be created.
    """
    try:
        parent = next(folder for folder in (home / output).parents if folder.exists())
        with undisturbed():
            os.rmdir(tempfile.mkdtemp(PART, ".", parent))
    except OSError as error:
        raise PathreplayError(_not_made(output, error, source)) from error


def is_empty_folder(path: Path) -> bool:
    """Return whether a path is a folder that contains nothing. A folder that cannot be read does not count as empty."""
    try:
        return path.is_dir() and not any(path.iterdir())
    except OSError:
        return False


def remove_empty_folder(path: Path) -> None:
    """Remove a folder if it is empty, so that a new run can have its name.

    Raises PathreplayError if the folder is empty, but cannot be removed, for example because it is a link.
    """
    if not is_empty_folder(path):
        return
    try:
        path.rmdir()
    except OSError as error:
        raise PathreplayError(
            f"Run folder {path} is empty, but cannot be replaced by that of a new run ({error.strerror}); give another "
            f"{_option(None)}"
        ) from error


def _make_part(output: Path, home: Path, source: Path | None) -> Path:
    """Create a hidden folder beside ``output``. `_claim` renames the hidden folder when its content is complete."""
    wanted = home / output
    part = wanted.with_name(f".{wanted.name[:100]}.{secrets.token_hex(4)}{PART}")
    try:
        wanted.parent.mkdir(parents=True, exist_ok=True)
        part.mkdir()
        return part
    except OSError as error:
        raise PathreplayError(_not_made(output, error, source)) from error


def _free(output: Path, home: Path) -> Path:
    """Return ``output``, or the first of ``output-2``, ``output-3``, … if ``output`` exists."""
    number, path = 1, output
    while os.path.lexists(home / path):
        number += 1
        path = output.with_name(f"{output.name}-{number}")
    return path


def _claim(part: Path, output: Path, home: Path, source: Path | None) -> Path:
    """Rename the folder to the first free name, and return this name.

    Two concurrent runs cannot get the same name: folders of runs are not empty, and renaming to a folder that is not
    empty fails.
    """
    while True:
        path = _free(output, home)
        try:
            os.rename(part, home / path)
            return path
        except OSError as error:
            if error.errno not in (errno.EEXIST, errno.ENOTEMPTY, errno.ENOTDIR):
                raise PathreplayError(_not_made(output, error, source)) from error


def _not_made(output: Path, error: OSError, source: Path | None) -> str:
    return f"Run folder {output} cannot be created ({error.strerror}); give another {_option(source)}"


@contextlib.contextmanager
def _opened(folder: Path) -> Iterator[int | None]:
    """Yield a descriptor of a folder, which stays valid if the folder is renamed.

    Yields None if the folder cannot be opened (Windows, no permission).
    """
    with contextlib.ExitStack() as stack:
        descriptor = None
        if os.unlink in os.supports_dir_fd:
            with contextlib.suppress(OSError):
                descriptor = os.open(folder, os.O_RDONLY)
                stack.callback(os.close, descriptor)
        yield descriptor


def _identity(path: Path | int) -> tuple[int, int] | None:
    """Return device and inode of a folder, given by path or descriptor; None if the folder does not exist."""
    try:
        status = os.stat(path)
    except OSError:
        return None
    return status.st_dev, status.st_ino


def _is_link(path: Path, descriptor: int | None) -> bool:
    """Return whether a path is a symbolic link. Raises OSError if the path does not exist.

    The path is relative to the open folder ``descriptor``, if there is one.
    """
    return stat.S_ISLNK(os.stat(path, dir_fd=descriptor, follow_symlinks=False).st_mode)


def _write_through(path: Path, content: Content, descriptor: int | None) -> None:
    """Write a file, and wait until it is on disk.

    The path is relative to the open folder ``descriptor``, if there is one.
    """
    # Remove the file or link of this name that a killed run may have left.
    with contextlib.suppress(FileNotFoundError):
        os.unlink(path, dir_fd=descriptor)
    with open(path, "xb", opener=lambda name, flags: os.open(name, flags, 0o666, dir_fd=descriptor)) as file:
        for chunk in chunks(content):
            file.write(chunk)
            del chunk
        file.flush()
        os.fsync(file.fileno())  # some file systems report a full disk only at this point
