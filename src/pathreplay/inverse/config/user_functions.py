"""User functions (losses, regularizers, derivations), by import path ``module:function`` or as callables."""

from __future__ import annotations

import importlib
import importlib.util
import numbers
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError, shown
from pathreplay.scenes.descriptions import one_line

T = TypeVar("T")

DEEPEST = 8
"""Deepest nesting of lists in a return value."""

_IMPORTS = threading.RLock()
"""Lock that is held while `sys.path` and `sys.modules` contain the folder and the modules of one job."""


@dataclass(frozen=True, eq=False)  # the function may be an object without a hash
class Imported:
    """A user function. Messages name the function by its kind, e.g. 'Loss', and its import path 'module:function'."""

    kind: str
    name: str
    function: Callable[..., object]
    surroundings: Callable[[], AbstractContextManager[None]] = nullcontext
    """Block in which the function is called."""

    def __str__(self) -> str:
        return f"{self.kind} '{self.name}'"

    def __call__(self, convert: Callable[[object], T], *args: object) -> T:
        """Call the function and return its value, converted by ``convert``.

        Raises PathreplayError if the function or the conversion raises, or if the return value is not numeric.
        """
        try:
            with self.surroundings(), _same_variant(str(self)):
                value = self.function(*args)
            if wrong := _no_numbers(value):
                raise PathreplayError(f"{self} returns {wrong}; return numbers or Dr.Jit arrays")
            return convert(value)
        except PathreplayError:
            raise
        except (Exception, SystemExit) as error:  # user code may raise anything
            raise PathreplayError(f"{self} cannot be computed ({_why(error)}); fix it, or name another") from error


class Modules:
    """Finds and imports user functions.

    Modules and packages in the folder ``base`` take precedence over installed ones. Each module is executed once.
    Functions of the folder can import other modules of the folder, also when they are called. ``given`` maps names to
    callables, which take precedence over modules.
    """

    def __init__(self, base: Path | None = None, given: Mapping[str, Callable[..., object]] | None = None) -> None:
        self._base, self._given = None if base is None else base.resolve(), dict(given or {})
        self._known: dict[str, ModuleType] = {}
        self._executed: dict[str, ModuleType] = {}  # modules of the folder, also those that other modules import

    def function(self, kind: str, name: str, takes: str) -> Imported:
        """Import a function; this executes its module on first use.

        Args:
            kind: purpose of the function, for messages.
            name: import path ``module:function``, or a name in ``given``.
            takes: description of its arguments, for messages.

        Raises:
            PathreplayError: the module does not exist, its import fails, or it has no such function.
        """
        if name in self._given:
            return Imported(kind, getattr(self._given[name], "__qualname__", name), self._given[name])
        module, _, function = name.partition(":")
        try:
            if module not in self._known:
                with _same_variant(f"The module of {kind} '{name}'"):
                    self._known[module] = self._loaded(module)
            imported = getattr(self._known[module], function)
        except PathreplayError:
            raise
        except (Exception, SystemExit) as error:  # an import may raise anything
            why = f"{kind} '{name}' cannot be imported ({_why(error)}); write module:function"
            raise PathreplayError(why) from None
        if not callable(imported):
            raise PathreplayError(f"{kind} '{name}' is not a function of {takes}, but {shown(imported)}; name another")
        return Imported(kind, name, imported, self._searched_first if module in self._executed else nullcontext)

    def _loaded(self, name: str) -> ModuleType:
        """Execute a module of the folder ``base``, or import an installed one.

        A module of the folder is executed even if a module of the same name is already loaded, e.g. from another
        folder.
        """
        root, path = self._place(name)
        if path is None:
            return importlib.import_module(name)
        with self._searched_first(root):
            if root not in sys.modules:
                _execute(root, path)
            return sys.modules[root] if root == name else importlib.import_module(name)

    def _place(self, name: str) -> tuple[str, Path | None]:
        """Return the outermost package of a module, and its file, or None if the folder ``base`` does not have it."""
        package = _root(name)
        if self._base is not None:
            if (file := self._base / f"{name}.py").is_file():
                return name, file
            if package and (file := self._base / package / "__init__.py").is_file():
                return package, file
        return package, None

    @contextmanager
    def _searched_first(self, root: str = "") -> Iterator[None]:
        """Let imports search the folder ``base`` first, as if Python had been started there.

        Within the block, `sys.modules` has the modules of the folder that were executed by this object. Afterwards,
        they are hidden from other folders with modules of the same names. If ``root`` is given, a module of this name
        that is already loaded, and the modules within it, are hidden in the block.
        """
        folder = str(self._base)
        with _IMPORTS:
            before = dict(sys.modules)
            for key in before if root else ():
                if _root(key) == root:
                    del sys.modules[key]
            sys.modules.update(self._executed)
            sys.path.insert(0, folder)
            try:
                yield
            finally:
                with suppress(ValueError):  # user code may change the list
                    sys.path.remove(folder)
                for key, module in list(sys.modules.items()):
                    if module is not before.get(key) and (_root(key) == root or self._is_own(key, module)):
                        self._executed[key] = module
                        del sys.modules[key]
                sys.modules.update({key: module for key, module in before.items() if key not in sys.modules})

    def _is_own(self, key: str, module: ModuleType) -> bool:
        """Return whether a module is a file of the folder ``base``, or part of a package in it."""
        places = [file] if (file := getattr(module, "__file__", None)) else list(getattr(module, "__path__", []))
        if self._base is None or not places:
            return False
        # Other folders within ``base`` do not count, because one may contain installed packages.
        place = Path(places[0])
        return place.parent == self._base or place.is_relative_to(self._base / _root(key))


def _root(name: str) -> str:
    """Return the outermost package of a module."""
    return name.partition(".")[0]


def _execute(name: str, path: Path) -> None:
    """Execute the file of a module or a package, and add the module to `sys.modules`."""
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} is not a module")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        sys.modules.pop(name, None)
        raise


@contextmanager
def _same_variant(who: str) -> Iterator[None]:
    """If the code in the context changes Mitsuba's variant, restore the variant and raise PathreplayError.

    If the code raises an error, its error is kept. The message begins with ``who``.
    """
    before = mi.variant()
    try:
        yield
    finally:
        if (after := mi.variant()) != before:
            mi.set_variant(before)
    if after != before:
        raise PathreplayError(
            f"{who} sets the variant '{after}', but the job runs in '{before}'; do not set a variant there"
        )


def _why(error: BaseException) -> str:
    if isinstance(error, SystemExit):
        return f"it exits Python: {error!r}"
    return one_line(error) or type(error).__name__


def _no_numbers(value: object, depth: int = 0) -> str:
    """Describe a value that Dr.Jit cannot convert to an array. Returns "" if Dr.Jit can convert the value.

    The check is needed because Dr.Jit's constructors iterate over any sequence. The elements of a string are again
    strings, so a constructor would recurse forever and could not be interrupted by signals.
    """
    if isinstance(value, (list, tuple)):
        if depth == DEEPEST:
            return f"lists nested more than {DEEPEST} deep"
        return next(filter(None, (_no_numbers(entry, depth + 1) for entry in value)), "")
    if isinstance(value, (np.ndarray, np.generic)):
        return "" if value.dtype.kind in "biuf" else f"a NumPy array of {value.dtype}"
    transform = hasattr(value, "matrix") and type(value).__module__.startswith("mitsuba")
    others = hasattr(value, "__dlpack__") or hasattr(value, "__cuda_array_interface__")  # e.g. PyTorch tensors
    if isinstance(value, numbers.Real) or dr.is_array_v(value) or transform or others:
        return ""
    return "None" if value is None else f"the {type(value).__name__} {shown(value)}"
