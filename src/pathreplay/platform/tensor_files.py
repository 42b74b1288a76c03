"""Safetensors files that are made while they are written: no tensor is copied, and one at a time is held.

The library's own `save` holds all of the file, and twice what it is made of.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping

import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.platform.atomic_files import Chunk

_KINDS = {"float32": "F32", "float64": "F64", "uint32": "U32", "int64": "I64", "uint8": "U8", "bool": "BOOL"}
_KINDS |= {"float16": "F16", "int32": "I32", "uint64": "U64"}


def safetensors_chunks(
    arrays: Mapping[str, np.ndarray], metadata: Mapping[str, str], room: Mapping[str, int] | None = None
) -> Iterator[Chunk]:
    """The bytes of a file of these arrays (by name), a chunk at a time. Each is asked for twice: see `WhenAsked`.

    ``room`` names tensors of so many bytes at the end of the file, which the caller writes.

    Raises PathreplayError for numbers of a kind that such files do not have.
    """
    header: dict[str, object] = {"__metadata__": dict(metadata)} if metadata else {}
    end = 0
    names = sorted(arrays)
    for name in names:
        array = np.asarray(arrays[name])
        if array.dtype.name not in _KINDS:
            raise PathreplayError(
                f"'{name}' holds numbers of the kind {array.dtype}; only {', '.join(_KINDS)} are kept"
            )
        begin, end = end, end + array.nbytes
        header[name] = {"dtype": _KINDS[array.dtype.name], "shape": list(array.shape), "data_offsets": [begin, end]}
        del array
    for name, size in (room or {}).items():
        begin, end = end, end + size
        header[name] = {"dtype": "U8", "shape": [size], "data_offsets": [begin, end]}
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)  # so that tensors begin where eight bytes do
    yield len(text).to_bytes(8, "little") + text
    for name in names:
        array = np.ascontiguousarray(arrays[name])
        yield array.reshape(-1).view(np.uint8).data
        del array
