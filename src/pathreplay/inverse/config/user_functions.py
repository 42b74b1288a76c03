"""Functions of the user's own, by import path (``module:function``) or as objects: losses, regularizers and more."""

from __future__ import annotations

import importlib
import importlib.util
import numbers
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError, shown
from pathreplay.scenes.descriptions import one_line

DEEPEST = 8
"""Of lists in each other, whose numbers are looked at."""


@dataclass(frozen=True)
class Imported:
    """A function, and what it is called in messages: 'Loss', and 'module:function'."""

    kind: str
    name: str
    function: Callable[..., Any]

    def __str__(self) -> str:
        return f"{self.kind} '{self.name}'"

    def __call__(self, convert: Callable[[Any], Any], *args: Any) -> Any:
        """``convert`` of what it returns.

        Raises PathreplayError for whatever either of them raises, and where what is returned is not made of numbers.
        """
        try:
            with _same_variant(str(self)):
                value = self.function(*args)
            if wrong := _no_numbers(value):
                raise PathreplayError(f"{self} gives {wrong}; return numbers, or Dr.Jit's arrays of them")
            return convert(value)
        except PathreplayError:
            raise
        except (Exception, SystemExit) as error:  # whatever the function does
            raise PathreplayError(f"{self} cannot be computed ({_why(error)}); mend it, or name another") from error


class Modules:
    """The modules that a job names: those of the folder ``base`` first, each run once, then installed ones.

    ``given`` are callables by the name that stands for them in a job.
    """

    def __init__(self, base: Path | None = None, given: Mapping[str, Callable[..., Any]] | None = None) -> None:
        self._base, self._given = base, dict(given or {})
        self._known: dict[str, Any] = {}

    def function(self, kind: str, name: str, takes: str) -> Imported:
        """The function ``name``, which is to be one that ``takes`` something; ``kind`` is what it is for.

        Its module is run. Raises PathreplayError if there is none, if it fails, or has no such function.
        """
        if name in self._given:
            return Imported(kind, getattr(self._given[name], "__qualname__", name), self._given[name])
        module, _, function = name.partition(":")
        try:
            if module not in self._known:
                with _same_variant(f"The module of {kind} '{name}'"):
                    self._known[module] = self._loaded(module)
            found = getattr(self._known[module], function)
        except PathreplayError:
            raise
        except (Exception, SystemExit) as error:  # whatever the module does when it is imported
            why = f"{kind} '{name}' cannot be imported ({_why(error)}); write module:function"
            raise PathreplayError(why) from None
        if not callable(found):
            raise PathreplayError(f"{kind} '{name}' is no function of {takes}, but {shown(found)}; name another")
        return Imported(kind, name, found)

    def _loaded(self, name: str) -> Any:
        """The module in the folder, anew, since other folders may have others of that name; else an installed one.

        While it is run it finds itself and its neighbours, as it would if Python had been started in its folder.
        """
        path = None if self._base is None else self._base / f"{name}.py"
        if self._base is None or path is None or not path.is_file():
            return importlib.import_module(name)
        spec = importlib.util.spec_from_file_location(name, path)
        if spec is None or spec.loader is None:
            raise ImportError(f"{path} is no module")
        module = importlib.util.module_from_spec(spec)
        folder, before = str(self._base.resolve()), dict(sys.modules)
        sys.path.insert(0, folder)
        sys.modules[name] = module
        try:
            spec.loader.exec_module(module)
        finally:
            sys.path.remove(folder)
            for each, found in list(sys.modules.items()):
                if each not in before and Path(getattr(found, "__file__", None) or "").parent == Path(folder):
                    del sys.modules[each]
            if name in before:
                sys.modules[name] = before[name]
            else:
                sys.modules.pop(name, None)
        return module


@contextmanager
def _same_variant(who: str) -> Iterator[None]:
    """Raise PathreplayError, which names ``who``, where Mitsuba's variant is another after this block; put it back."""
    before = mi.variant()
    yield
    if (after := mi.variant()) != before:
        mi.set_variant(before)
        raise PathreplayError(
            f"{who} sets the variant '{after}', and the job runs in '{before}'; leave that to the job"
        )


def _why(error: BaseException) -> str:
    if isinstance(error, SystemExit):
        return f"it ends Python: {error!r}"
    return one_line(error) or type(error).__name__


def _no_numbers(value: Any, depth: int = 0) -> str:
    """What a value is, if it is none of what Dr.Jit's types can be made of; else "".

    Those types look into whatever has entries, also into texts, whose entries are texts again: they would do so for
    ever, and hear no signal.
    """
    if isinstance(value, (list, tuple)):
        if depth == DEEPEST:
            return f"lists in each other, more than {DEEPEST} deep"
        return next(filter(None, (_no_numbers(each, depth + 1) for each in value)), "")
    if isinstance(value, (np.ndarray, np.generic)):
        return "" if value.dtype.kind in "biuf" else f"NumPy's array of {value.dtype}"
    transform = hasattr(value, "matrix") and type(value).__module__.startswith("mitsuba")
    others = hasattr(value, "__dlpack__") or hasattr(value, "__cuda_array_interface__")  # arrays of other packages
    if isinstance(value, numbers.Real) or dr.is_array_v(value) or transform or others:
        return ""
    return "nothing" if value is None else f"the {type(value).__name__}, {shown(value)},"
