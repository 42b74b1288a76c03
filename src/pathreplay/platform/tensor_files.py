"""Write safetensors files in chunks: no tensor is copied, and only one is in memory at a time.

The library's own `save` holds the whole file in memory, in addition to two copies of its tensors.
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
    """The bytes of a safetensors file with these arrays (by name), in chunks.

    Each array is accessed twice: see `WhenAsked`. ``room`` maps names to sizes in bytes of tensors at the end of the
    file, which the caller writes.

    Raises PathreplayError for a data type that the format does not support.
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
