"""Functions of the user's own by their import path, ``module:function``: losses, penalties, derived parameters."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pathreplay.errors import PathreplayError, shown
from pathreplay.scenes.descriptions import one_line


@dataclass(frozen=True)
class Imported:
    """A function, and what it is called in messages: 'Loss', and 'module:function'."""

    kind: str
    name: str
    function: Callable[..., Any]

    def __str__(self) -> str:
        return f"{self.kind} '{self.name}'"

    def __call__(self, convert: Callable[[Any], Any], *args: Any) -> Any:
        """``convert`` of what it returns. Raises PathreplayError for whatever either of them raises."""
        try:
            return convert(self.function(*args))
        except Exception as error:  # whatever the function does
            raise PathreplayError(f"{self} cannot be computed ({_why(error)}); mend it, or name another") from error


def imported(kind: str, name: str, base: Path | None, takes: str) -> Imported:
    """The function ``name``, whose module may be in the folder ``base``; it is to be one that ``takes`` something.

    The module is run. Raises PathreplayError if there is none, if it fails, or has no such function.
    """
    module, _, function = name.partition(":")
    try:
        found = getattr(_module(module, base), function)
    except Exception as error:  # whatever the module does when it is imported
        raise PathreplayError(f"{kind} '{name}' cannot be imported ({_why(error)}); write module:function") from None
    if not callable(found):
        raise PathreplayError(f"{kind} '{name}' is no function of {takes}, but {shown(found)}; name another")
    return Imported(kind, name, found)


def _why(error: Exception) -> str:
    return one_line(error) or type(error).__name__


def _module(name: str, base: Path | None) -> Any:
    """The module in the folder, anew, since other folders may have others of that name; else an installed one."""
    path = None if base is None else base / f"{name}.py"
    if path is None or not path.is_file():
        return importlib.import_module(name)
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} is no module")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
