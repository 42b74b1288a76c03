"""Writes safetensors files in chunks, without copying tensors, and with only one tensor in memory at a time.

The function `save` of the package safetensors needs memory for the whole file and for two copies of its tensors.
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
    """Yield the bytes of a safetensors file in chunks.

    Args:
        arrays: arrays by name; each is accessed twice (`WhenAsked` computes arrays on access).
        metadata: text fields of the header.
        room: further tensors at the end of the file, as sizes in bytes by name. The header describes these tensors, and
            the caller writes their bytes.

    Raises:
        PathreplayError: an array has a data type that is not supported.
    """
    header: dict[str, object] = {"__metadata__": dict(metadata)} if metadata else {}
    end = 0
    names = sorted(arrays)
    for name in names:
        array = np.asarray(arrays[name])
        if array.dtype.name not in _KINDS:
            raise PathreplayError(f"'{name}' has the data type {array.dtype}; only {', '.join(_KINDS)} can be stored")
        begin, end = end, end + array.nbytes
        header[name] = {"dtype": _KINDS[array.dtype.name], "shape": list(array.shape), "data_offsets": [begin, end]}
        del array
    for name, size in (room or {}).items():
        begin, end = end, end + size
        header[name] = {"dtype": "U8", "shape": [size], "data_offsets": [begin, end]}
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)  # aligns the tensors to eight bytes
    yield len(text).to_bytes(8, "little") + text
    for name in names:
        array = np.ascontiguousarray(arrays[name])
        yield array.reshape(-1).view(np.uint8).data
        del array
