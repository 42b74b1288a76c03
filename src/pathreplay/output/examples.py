"""Writes out the examples: jobs with their scenes, scripts and explanations, which are part of the package."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path

from pathreplay.errors import PathreplayError
from pathreplay.platform.atomic_files import whole_folder

_PACKAGE = Path(__file__).resolve().parents[1]
_SOURCES = (".exr", ".md", ".py", ".sh", ".toml", ".xml")
"""Suffixes of source files. In a checkout, examples may have written results: PNG files, or files in subfolders."""


def example_files() -> list[Path]:
    """Return the source files of the examples. Each example has a folder of its own.

    An installed package contains these folders. In a checkout, they are in the folder ``examples`` of the repository.

    Raises PathreplayError if there are no examples.
    """
    installed = _PACKAGE / "examples"
    folder = installed if installed.is_dir() else _PACKAGE.parents[1] / "examples"
    files = sorted(path for path in folder.glob("*/*") if path.suffix in _SOURCES)
    if not files:
        raise PathreplayError(f"This installation has no examples ({folder} is missing); install pathreplay again")
    return files


def write_examples(folder: Path) -> str:
    """Write the examples into a new folder.

    Args:
        folder: folder to create; it may exist if it is empty.

    Returns:
        The message for the user: the paths of the jobs, and a command that runs one of them.

    Raises PathreplayError if the folder exists and is not empty, or cannot be written.
    """
    files = example_files()
    with whole_folder(folder, "the argument FOLDER") as part:
        for path in files:
            (part / path.parent.name).mkdir(exist_ok=True)
            shutil.copyfile(path, part / path.parent.name / path.name)
    jobs = [folder / path.parent.name / path.name for path in files if path.suffix == ".toml"]
    first = next(job for job in jobs if job.parent.name == "cornell-photo")
    return "\n".join([*map(str, jobs), f"Run one, for example: pathreplay optimize {shlex.quote(str(first))}"])
