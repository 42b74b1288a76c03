"""The run folder on disk: a new one for every run, every file whole or absent, an earlier run never touched."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config import Config, load_config

PART = ".part"
CHECKPOINT = "checkpoint.safetensors"
RIVAL_CHECKPOINT = "rival/checkpoint.safetensors"


@dataclass(frozen=True)
class RunFolder:
    """A folder that belongs to one run. ``origin`` is where relative paths of its config start."""

    path: Path
    origin: Path

    def write(self, files: Mapping[str, bytes]) -> None:
        """Write all files or none: each goes to a temporary name first, and all are renamed once all are on the disk.

        Raises:
            PathreplayError: the disk is full or the folder cannot be written. Temporary files are removed; a folder
                that holds no checkpoint yet is removed as a whole.
        """
        parts: list[tuple[Path, Path]] = []
        try:
            for name, data in files.items():
                final = self.path / name
                final.parent.mkdir(exist_ok=True)
                part = final.with_name(final.name + PART)
                parts.append((part, final))
                _write_through(part, data)
            for part, final in parts:
                os.replace(part, final)
        except OSError as error:
            _remove(parts)
            raise PathreplayError(self._failure(error)) from error
        except BaseException:  # a second Ctrl-C
            _remove(parts)
            raise

    def _failure(self, error: OSError) -> str:
        if (self.path / CHECKPOINT).exists():
            rescue = f"then go on with: pathreplay optimize --resume {self.path}"
            for folder in self.path.iterdir():
                if folder.is_dir():
                    with contextlib.suppress(OSError):
                        folder.rmdir()  # succeeds on an empty one only: what this failed write has made
        else:
            shutil.rmtree(self.path, ignore_errors=True)
            rescue = "or give --output elsewhere, then start again (this folder was removed)"
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            return f"No space left on the disk for run folder {self.path}: free some space, {rescue}"
        return f"Run folder {self.path} cannot be written ({error.strerror}): mend that, {rescue}"


def create_run_folder(output: Path, config: Config, source: Path | None, base: Path) -> RunFolder:
    """Make ``output``, or ``output-2``, ``-3``, … where that exists, and put the job into it.

    The config is copied as it was written (``config.toml``), or as JSON where it came from Python.
    """
    folder = _make_new(output)
    run = RunFolder(folder, base.resolve())
    if source is not None and source.suffix != ".json":
        copy = {"config.toml": source.read_bytes()}
    else:
        copy = {"config.json": config.model_dump_json(indent=2, exclude_unset=True).encode()}
    origin = {"base": str(run.origin), "config": None if source is None else str(source)}
    run.write({**copy, "run.json": json.dumps(origin, indent=2).encode()})
    return run


def open_run_folder(path: Path) -> tuple[RunFolder, Config, str | None]:
    """An existing run folder, its job, and the config path that it was started with.

    Raises:
        PathreplayError: it is no run folder, or holds no checkpoint to go on from.
    """
    copy = next((path / name for name in ("config.toml", "config.json") if (path / name).is_file()), None)
    if copy is None or not (path / "run.json").is_file():
        raise PathreplayError(f"{path} is no run folder (no config, no run.json); give a folder that optimize has made")
    if not (path / CHECKPOINT).is_file():
        raise PathreplayError(f"Run folder {path} has no checkpoint to resume from; start the job from its config")
    origin = json.loads((path / "run.json").read_text())
    return RunFolder(path, Path(origin["base"])), load_config(copy), origin["config"]


def default_output(source: Path | None) -> Path:
    """``runs/<name>``, named after the config file, or after its folder where it is just called config."""
    if source is None:
        return Path("runs/optimize")
    return Path("runs") / (source.resolve().parent.name if source.stem == "config" else source.stem)


def _make_new(output: Path) -> Path:
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        number = 1
        while True:
            folder = output if number == 1 else output.with_name(f"{output.name}-{number}")
            try:
                folder.mkdir()  # fails where it exists: two runs at once cannot get the same one
                return folder
            except FileExistsError:
                number += 1
    except OSError as error:
        raise PathreplayError(
            f"Run folder {output} cannot be made ({error.strerror}); give another with --output"
        ) from error


def _remove(parts: list[tuple[Path, Path]]) -> None:
    for part, _ in parts:
        with contextlib.suppress(OSError):
            part.unlink()


def _write_through(path: Path, data: bytes) -> None:
    # fsync: some file systems report a full disk only when the data are written out.
    with open(path, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
