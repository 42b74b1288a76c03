"""What may be alive, registered and collected while a pass is traced, recorded or frozen.

Mitsuba registers every scene object with Dr.Jit, which traces a virtual call through all that are registered, those of
other scenes included. Four rules follow. They hold for all passes and stand here alone:

1. No part outlives its scene. An area light has a bare pointer to its shape: traced after the shape is gone, it ends
   the process. So what we remember about a scene is kept here together with the scene, and is released once nobody else
   holds the scene. (`nodes` has the other half: traversals leave no cycles.)
2. No instance comes or goes between two virtual calls of one kernel, or one function is written twice ("invalid
   redefinition"). So the cyclic garbage collector is off during a pass, and scenes are released before it.
3. No scene is freed while `dr.freeze` records: that launches a function on the host, which cannot be recorded, and the
   process ends. So nothing is released then, and what could be garbage by then is kept from the collector until the
   recording is over.
4. One Python thread at a time. Dr.Jit's registry and its memory are shared by all threads of a process; two that trace
   or launch kernels side by side get wrong numbers, or end the process. So a pass that finds another one under way is
   refused, and `exclusive` lets threads take turns.
"""

from __future__ import annotations

import atexit
import gc
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import drjit as dr
import mitsuba as mi

from pathreplay.errors import PathreplayError

T = TypeVar("T")


@dataclass
class _Kept(Generic[T]):
    """A scene and what is remembered about it."""

    scene: mi.Scene
    about: T
    held_once: object = field(default_factory=object)  # its reference count is that of an unshared scene

    @property
    def is_dropped(self) -> bool:
        """Whether nobody else holds the scene. Mitsuba's own references to an object count as Python's do."""
        return sys.getrefcount(self.scene) <= sys.getrefcount(self.held_once)


class SceneMemory(Generic[T]):
    """Remembers one thing about each scene that somebody holds."""

    def __init__(self) -> None:
        self._kept: dict[int, _Kept[T]] = {}

    def about(self, scene: mi.Scene, is_right: Callable[[T], bool], find: Callable[[], T]) -> T:
        """What is remembered about a scene, found anew where it is not ``is_right`` any more."""
        kept = self._kept.get(id(scene))
        if kept is None or not is_right(kept.about):
            kept = self._kept[id(scene)] = _Kept(scene, find())
        return kept.about

    def release(self) -> None:
        """Forget the scenes that nobody else holds, which frees them."""
        for key in [key for key, kept in self._kept.items() if kept.is_dropped]:
            self._kept.pop(key, None)

    def clear(self) -> None:
        """Forget all scenes."""
        self._kept.clear()


SCENES: SceneMemory = SceneMemory()
"""What is known of the scenes of this process, released as the rules above say."""
_ONE_THREAD = threading.RLock()
_AT_COLLECTION = threading.Lock()
"""Held by `_collected`, which has the other one for a moment, in whatever thread Python collects."""
_passes = 0  # under way, one within the other
_put_aside = False  # objects are kept from the collector


def is_recording() -> bool:
    """Whether `dr.freeze` records what is done now."""
    return bool(dr.flag(dr.JitFlag.FreezingScope))


@contextmanager
def exclusive() -> Iterator[None]:
    """Within this block no other thread is in such a block, and none may render with an integrator of ours.

    Use it in each of several Python threads, around all that they do with Mitsuba and Dr.Jit: loading a scene,
    rendering, `dr.backward`, the step of an optimiser, reading results. All kernels have ended when the block ends.
    """
    with _ONE_THREAD:
        try:
            yield
        finally:
            dr.sync_thread()


@contextmanager
def careful() -> Iterator[None]:
    """Within this block, a pass, the rules above hold, and errors are plain (see `plain_errors`).

    Raises PathreplayError if another thread has one, or is `exclusive`.
    """
    global _passes
    if not _entered():
        raise PathreplayError(
            "pathreplay: another Python thread is rendering, and Dr.Jit computes wrong numbers if two use it at once: "
            "put all that each thread does with Mitsuba into 'with pathreplay.exclusive():', or use processes"
        )
    collecting = gc.isenabled()
    try:
        if _passes == 0 and not is_recording():
            SCENES.release()
        gc.disable()
        _passes += 1
        try:
            with plain_errors():
                yield
        finally:
            _passes -= 1
            if is_recording():
                _put_garbage_aside()
    finally:
        if collecting:
            gc.enable()
        _ONE_THREAD.release()


def _entered() -> bool:
    """Take the lock, unless another thread has it that does more than collect garbage."""
    while not _ONE_THREAD.acquire(blocking=False):
        if not _AT_COLLECTION.locked():
            return _ONE_THREAD.acquire(blocking=False)
        with _AT_COLLECTION:  # until that is over
            pass
    return True


@contextmanager
def plain_errors() -> Iterator[None]:
    """Within this block a PathreplayError that Dr.Jit wrapped in others, while a loop ends, is itself again."""
    try:
        yield
    except RuntimeError as error:
        cause: BaseException | None = error
        while cause is not None and not isinstance(cause, PathreplayError):
            cause = cause.__cause__
        if cause is None:
            raise
        raise cause from None


def _put_garbage_aside() -> None:
    """Keep all objects from the collector, unless somebody else does; takes no time. See `_collected`."""
    global _put_aside
    if _put_aside or gc.get_freeze_count() == 0:
        gc.freeze()
        _put_aside = True


def _collected(phase: str, info: dict[str, int]) -> None:
    """Called by the collector: before it runs, give back what was put aside; after it ran, release scenes."""
    global _put_aside
    if is_recording() or not _AT_COLLECTION.acquire(blocking=False):
        return
    try:
        if not _ONE_THREAD.acquire(blocking=False):
            return
        try:
            if _passes:
                return
            if phase == "start" and _put_aside:
                gc.unfreeze()
                _put_aside = False
            elif phase == "stop":
                SCENES.release()
        finally:
            _ONE_THREAD.release()
    finally:
        _AT_COLLECTION.release()


def _end() -> None:
    """Free what is left while Dr.Jit is still there to be told."""
    if _collected in gc.callbacks:
        gc.callbacks.remove(_collected)
    SCENES.clear()


gc.callbacks.append(_collected)
atexit.register(_end)
