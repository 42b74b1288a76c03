"""Lifetimes of scene objects: rules about objects, garbage collection and threads while a pass is traced or recorded.

Mitsuba registers every scene object with Dr.Jit. Dr.Jit traces a virtual function call through all registered objects,
including the objects of other scenes. Four rules follow, which this module enforces for all passes:

1. No object outlives its scene. An area light has a raw pointer to its shape, and tracing the light after the shape is
   freed crashes the process. Stored facts about a scene contain its objects. They are therefore released together with
   the scene, once nothing else references the scene. (`nodes` ensures that traversals leave no reference cycles.)
2. No object is created or freed between two virtual function calls of one kernel. Otherwise Dr.Jit emits the same
   function twice ("invalid redefinition"). The cyclic garbage collector is therefore off during a pass, and scenes are
   released before the pass. They are not released either while other integrators trace.
3. No scene is freed while `dr.freeze` records. Freeing a scene launches a host function, which cannot be recorded and
   crashes the process. No scene is therefore released during a recording, and objects that may have become garbage are
   hidden from the collector until the recording has ended. `dr.freeze` also traverses the registry outside of the
   recording, and raises an error if the number of objects has changed in the meantime. No scene is therefore released
   during the whole call of a frozen function.
4. Only one Python thread renders at a time. All threads of a process share Dr.Jit's registry and memory. Threads that
   trace or launch kernels concurrently get wrong results or crash the process. A pass therefore raises an error if
   another thread has a pass in progress; `exclusive` lets threads take turns. `one_renderer` does the same for steps of
   an optimisation, which also change the scene.
"""

from __future__ import annotations

import atexit
import gc
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FrameType
from typing import Generic, TypeVar

import drjit as dr
import mitsuba as mi

from pathreplay.errors import PathreplayError

T = TypeVar("T")

_OUTSIDE = "outside of the current dr.isolate_grad() scope"
"""Part of Dr.Jit's message about edges of its AD graph that a pass must not traverse."""
_UNPROPAGATED = (
    "forward mode: tangents have not been propagated to all parameters that this pass traces: call "
    "dr.forward(x, dr.ADFlag.ClearEdges) before it for each variable x from which parameters are computed, and detach "
    "parameters without tangents, also those of other scenes that are alive (params[key] = dr.detach(params[key]), "
    "then params.update())"
)


@dataclass
class _Entry(Generic[T]):
    """A scene and the facts stored about it."""

    scene: mi.Scene
    about: T
    held_once: object = field(default_factory=object)  # object without other references: see `is_unreferenced`

    @property
    def is_unreferenced(self) -> bool:
        """Whether only this entry references the scene. Python's reference count includes Mitsuba's references."""
        return sys.getrefcount(self.scene) <= sys.getrefcount(self.held_once)


class SceneMemory(Generic[T]):
    """Cache of facts about each scene that is still referenced elsewhere."""

    def __init__(self) -> None:
        self._entries: dict[int, _Entry[T]] = {}

    def about(self, scene: mi.Scene, is_right: Callable[[T], bool], find: Callable[[], T]) -> T:
        """Return the facts about a scene; ``find`` computes them if there are none or ``is_right`` rejects them."""
        entry = self._entries.get(id(scene))
        if entry is None or not is_right(entry.about):
            entry = self._entries[id(scene)] = _Entry(scene, find())
        return entry.about

    def release(self) -> None:
        """Remove, and thereby free, the scenes that nothing else references."""
        for key in [key for key, entry in self._entries.items() if entry.is_unreferenced]:
            self._entries.pop(key, None)

    def clear(self) -> None:
        self._entries.clear()


SCENES: SceneMemory = SceneMemory()
"""Facts about the scenes of this process, released according to the rules above."""
_ONE_THREAD = threading.RLock()
_AT_COLLECTION = threading.Lock()
"""Locked while `_on_collection` may hold `_ONE_THREAD`. A pass then waits briefly instead of raising an error."""
_passes = 0  # number of nested passes in progress
_last_thread = 0  # thread of the last pass. It may be tracing, so collections in other threads release no scene.
_hidden = False  # whether this module has hidden objects from the collector
_hidden_by_others = False  # whether other code had hidden objects when they were last counted


def is_recording() -> bool:
    """Return whether `dr.freeze` is recording."""
    return bool(dr.flag(dr.JitFlag.FreezingScope))


@contextmanager
def exclusive() -> Iterator[None]:
    """Context that gives one Python thread exclusive use of the integrators of this package.

    If several threads render, each thread must enclose all its use of Mitsuba and Dr.Jit: loading a scene, rendering,
    `dr.backward`, optimiser steps, reading results. Other threads wait at the start of their own `exclusive` blocks;
    outside such blocks, their passes raise an error. All kernels have finished when the block ends.
    """
    with _ONE_THREAD:
        try:
            yield
        finally:
            dr.sync_thread()


@contextmanager
def one_renderer() -> Iterator[None]:
    """Context in which a single Python thread renders and changes scenes.

    Raises PathreplayError if another thread is in such a context, in a pass, or in an `exclusive` block.
    """
    if not _acquire():
        raise PathreplayError(
            "pathreplay: another Python thread is rendering, and Dr.Jit computes wrong results if two use it at once: "
            "put all that each thread does with Mitsuba into 'with pathreplay.exclusive():', or use processes"
        )
    try:
        yield
    finally:
        _ONE_THREAD.release()


@contextmanager
def careful() -> Iterator[None]:
    """Context of a pass, in which the rules of this module hold and errors are unwrapped (see `plain_errors`).

    Raises PathreplayError like `one_renderer`.
    """
    global _passes, _last_thread
    with one_renderer():
        collecting = gc.isenabled()
        try:
            if _passes == 0 and not is_recording():
                SCENES.release()
            gc.disable()
            _passes += 1
            _last_thread = threading.get_ident()
            try:
                with plain_errors():
                    yield
            finally:
                _passes -= 1
                if is_recording():
                    _hide_garbage()
        finally:
            if collecting:
                gc.enable()


def _acquire() -> bool:
    """Try to acquire `_ONE_THREAD`; wait only while another thread runs `_on_collection`. Return True on success."""
    while not _ONE_THREAD.acquire(blocking=False):
        if not _AT_COLLECTION.locked():
            return _ONE_THREAD.acquire(blocking=False)
        with _AT_COLLECTION:  # wait for the end of the collection
            pass
    return True


@contextmanager
def plain_errors() -> Iterator[None]:
    """Context that replaces exceptions of Dr.Jit, which wraps exceptions raised inside of a loop, by their cause.

    The cause is a PathreplayError, or forward propagation along edges that are outside of the pass.
    """
    try:
        yield
    except RuntimeError as error:
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, PathreplayError):
                raise cause from None
            if _OUTSIDE in str(cause):
                raise PathreplayError(_UNPROPAGATED) from error
            cause = cause.__cause__
        raise


def _hide_garbage() -> None:
    """Hide all objects from the collector, unless other code has hidden any. See `_on_collection`.

    Hiding takes constant time. Counting takes time for each hidden object. Objects that other code has hidden are
    therefore counted only once between full collections, and count as hidden until the next one.
    """
    global _hidden, _hidden_by_others
    if not _hidden and not _hidden_by_others:
        _hidden_by_others = gc.get_freeze_count() > 0
    if not _hidden_by_others:
        gc.freeze()
        _hidden = True


def _on_collection(phase: str, info: dict[str, int]) -> None:
    """Handle a garbage collection: make hidden objects visible before it, and release scenes after it."""
    global _hidden, _hidden_by_others
    if phase == "stop" and info["generation"] == 2:
        _hidden_by_others = False
    if is_recording() or not _AT_COLLECTION.acquire(blocking=False):
        return
    try:
        if not _ONE_THREAD.acquire(blocking=False):
            return
        try:
            if _passes:
                return
            if phase == "start" and _hidden:
                gc.unfreeze()
                _hidden = False
            elif phase == "stop" and threading.get_ident() == _last_thread and not _within_drjit():
                SCENES.release()
        finally:
            _ONE_THREAD.release()
    finally:
        _AT_COLLECTION.release()


def _within_drjit() -> bool:
    """Return whether this thread is in Python code of Dr.Jit or Mitsuba, or traces a loop or a virtual function call.

    Other integrators or a frozen function may then use objects that no Python variable references.
    """
    if dr.flag(dr.JitFlag.SymbolicScope):
        return True
    frame: FrameType | None = sys._getframe()
    while frame is not None:
        if str(frame.f_globals.get("__name__")).partition(".")[0] in ("drjit", "mitsuba"):
            return True
        frame = frame.f_back
    return False


def _at_exit() -> None:
    """Free the remaining scenes at exit, while Dr.Jit is still loaded."""
    if _on_collection in gc.callbacks:
        gc.callbacks.remove(_on_collection)
    SCENES.clear()


gc.callbacks.append(_on_collection)
atexit.register(_at_exit)
