"""File names made of what people call things in their scenes: short, safe on every file system, and each its own."""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Iterable

# Bytes. File systems take 255 in all; words in front, an ending and the mark of an unfinished file are added to this.
LONGEST = 150


def file_names(names: Iterable[str]) -> dict[str, str]:
    """Each name -> the file name (without ending) that stands for it; no two are the same, whatever their capitals.

    Letters, digits, ``_``, ``.`` and ``-`` stay, other characters become ``_``. A name that is too long is cut. Where
    two names would meet, or one was cut, a short hash of the name follows.
    """
    safe = {name: re.sub(r"[^\w.-]", "_", name) for name in names}
    # Some file systems ignore capitals: casefold.
    met = Counter(text.casefold() for text in safe.values())
    for name, text in safe.items():
        cut = text.encode()[:LONGEST].decode(errors="ignore")
        if met[text.casefold()] > 1 or cut != text:
            safe[name] = f"{cut}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
    return safe
