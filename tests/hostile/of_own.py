"""Hostile functions of the user's own: losses, penalties, derivations that return, or do, anything."""

from __future__ import annotations

import numpy as np

from .case import Action, add, recipe
from .room import DERIVED, JOB, Room
from .values import pick

KIND = "own function"

START = """import os, sys, threading
import drjit as dr, mitsuba as mi, numpy as np
calls = []
loop = [1.0]
loop.append(loop)
table = {}
table["a"] = table
deep = 1.0
for _ in range(10000):
    deep = [deep]
class Endless:
    def __len__(self): return 1
    def __getitem__(self, i): return self
class Lying:
    shape = (6, 8, 3)
    __dlpack__ = None
    __array_interface__ = {"shape": (6, 8, 3), "typestr": "<f4", "data": (8, False), "version": 3}
def good(first, *others):
    if WHERE == "loss":
        return dr.square(first - others[0])
    return dr.mean(dr.square(first), axis=None) if WHERE == "penalty" else first * others[0].array
def endless():
    while True:
        yield 1.0
"""

#: Of a function f(first, *others): what it returns. None is a number that depends on what it is given.
RETURNED = {
    "a text": "'much'",
    "an empty text": "''",
    "bytes": "b'much'",
    "a dict": "{'a': first}",
    "an empty dict": "{}",
    "a dict that holds itself": "table",
    "a list that holds itself": "loop",
    "a tuple that holds itself": "(loop,)",
    "a list 10000 deep": "deep",
    "a list of texts": "[first, 'much']",
    "a ragged list": "[[1.0], [1.0, 2.0]]",
    "an empty list": "[]",
    "an endless iterator": "endless()",
    "an endless sequence": "Endless()",
    "what is no array": "Lying()",
    "a set": "{1.0}",
    "a type": "float",
    "a module": "mi",
    "a function": "f",
    "a BSDF": "mi.load_dict({'type': 'diffuse'})",
    "a pointer": "mi.BSDFPtr(0)",
    "None": "None",
    "a complex number": "1j",
    "a number of 400 digits": "10**400",
    "NaN": "float('nan')",
    "first times NaN": "first * float('nan')",
    "infinity": "first + float('inf')",
    "NumPy's texts": "np.array(['much'])",
    "NumPy's objects": "np.array([{}, []], dtype=object)",
    "NumPy's complex numbers": "np.ones(3, complex)",
    "an array of another shape": "mi.TensorXf([1.0, 2, 3, 4, 5], (5,))",
    "an empty tensor": "mi.TensorXf([], (0, 0))",
    "whole numbers": "mi.TensorXu(first)",
    "masks": "first > 0.5",
    "a matrix": "mi.Transform4f()",
    "a spectrum": "mi.Color3f(1, 2, 3)",
}
DONE = {
    "ends Python with 7": "sys.exit(7)",
    "ends Python with 0": "sys.exit(0)",
    "ends Python with words": "sys.exit('no more')",
    "quits": "quit()",
    "fails": "return 1 / 0",
    "fails with two lines": "raise ValueError('two\\nlines\\x1b[2J')",
    "fails with nothing": "raise ValueError",
    "recurses": "return f(first, *others)",
    "runs out of memory": "raise MemoryError",
    "wants too many arguments": "return first + missing",
    "changes what it is given": "first *= 0.5; return good(first, *others)",
    "changes the variant": "mi.set_variant('scalar_rgb'); return 1.0",
    "depends on nothing": "return mi.TensorXf(np.array(dr.detach(first)))",
    "is computed by NumPy": "return np.array(first) ** 2",
    "loses its derivative": "return dr.detach(first)",
    "starts a thread": "threading.Thread(target=lambda: np.zeros(9)).start(); return good(first, *others)",
    "evaluates and forgets": "dr.eval(first); dr.flush_kernel_cache(); return good(first, *others)",
    "prints": "print('x' * 1000); return good(first, *others)",
}
WHERE = ("loss", "penalty", "derivation")


def use(room: Room, where: str, body: str, head: str = "def f(first, *others):") -> None:
    """Write a function, and a job that asks for it."""
    room.write("own.py", f"WHERE = {where!r}\n{START}\n{head}\n    {body}\n")
    if where == "loss":
        room.change("loss", "own:f")
    elif where == "penalty":
        room.change("parameters.0.regularizer", "own:f", JOB)
    else:
        room.change("derived.0.function", "own:f", DERIVED)


for _count in (1, 2, 3, 4, 6):
    for _doing, _end in {
        "fails": "raise ValueError('enough')",
        "ends Python": "sys.exit(0)",
        "returns a text": "return 'much'",
        "depends on nothing": "return 0.0",
    }.items():
        DONE[f"{_doing} after {_count} calls"] = (
            f"calls.append(1)\n    if len(calls) > {_count}: {_end}\n    return good(first, *others)"
        )

#: What some place can make something of.
SOMETIMES = frozenset(
    {"a number of 400 digits", "masks", "whole numbers", "a matrix", "a spectrum", "infinity", "a ragged list",
     "an array of another shape", "an empty tensor"}
)  # fmt: skip

REFUSED = {*RETURNED} - SOMETIMES | {name for name in DONE if name.startswith("ends Python with")}

for _where in WHERE:
    for _name, _body in {**{name: f"return {value}" for name, value in RETURNED.items()}, **DONE}.items():

        def _spoil(room: Room, rng: np.random.Generator, where: str = _where, body: str = _body) -> None:
            use(room, where, body)

        add(KIND, f"{_where}: {_name}", _spoil, refused=_name in REFUSED)


@recipe(KIND, fuzz=True)
def what_a_script_is_given(room: Room, rng: np.random.Generator) -> Action:
    """`check_gradient` with a loss of one's own."""
    value = pick(rng, tuple(RETURNED.values()))
    return Action(
        script="import pathreplay, mitsuba as mi\nmi.set_variant('llvm_ad_rgb')\nWHERE = 'loss'\n"
        + START
        + "def f(first, *others):\n"
        f"    return {value}\n"
        "scene = mi.load_file('ball.xml', optimize=False)\n"
        "pathreplay.check_gradient(scene, 'paint.reflectance.data', loss=f, seeds=2, spp=1)\n"
    )


@recipe(KIND, refused=True, fuzz=True)
def a_module_that_ends_python(room: Room, rng: np.random.Generator) -> None:
    use(
        room,
        pick(rng, WHERE),
        "return first",
        pick(rng, ("sys.exit(7)\ndef f(first):", "raise SystemExit\ndef f(first):")),
    )


@recipe(KIND, fuzz=True)
def a_function_of_other_arguments(room: Room, rng: np.random.Generator) -> None:
    head = pick(rng, ("def f():", "def f(a, b, c, d):", "def f(*, image):", "async def f(*a):", "def f(a, a2=None):"))
    use(room, pick(rng, WHERE), "return 1.0", head)
