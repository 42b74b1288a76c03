"""Pages to test with: one that says everything a page can say, in words of choice."""

from __future__ import annotations

import base64
import io

import numpy as np
import PIL.Image

from pathreplay.report.page_parts import uri
from pathreplay.report.pages.page import (
    Comparison,
    Head,
    Mesh,
    Page,
    Parameter,
    Picture,
    Plot,
    Row,
    Series,
    Still,
    Table,
    View,
)

HOSTILE = (
    "</script><script>window.hacked = 1</script>",
    "<img src=x onerror='window.hacked = 1'>",
    "a \"quoted\" 'name' & `more`",
    "two\nlines\r\nand\ta tab",
    "long " + "x" * 4091,
    "{{ 7 * 7 }}${7 * 7}\u2028\u202e\ufeff",
)


def png(colour: tuple[int, int, int], width: int = 40, height: int = 30) -> str:
    """A picture of one colour, as an address."""
    buffer = io.BytesIO()
    PIL.Image.new("RGB", (width, height), colour).save(buffer, "png")
    return uri("image/png", buffer.getvalue())


def packed(values: object, kind: type) -> str:
    return base64.b64encode(np.asarray(values, kind).tobytes()).decode()


TETRAHEDRON = Mesh(
    {
        "start": packed([0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1], np.float32),
        "result": packed([0, 0, 0, 2, 0, 0, 0, 1, 0, 0, 0, 1], np.float32),
    },
    packed([0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3], np.uint32),
)


def sample(word: str = "plain", views: int = 2) -> Page:
    """Every text of it holds ``word``; views are red as targets and green as results."""
    x = tuple(float(i) for i in range(50))
    curve = Series(word, x, (*(0.5 ** (i / 10) for i in range(49)), None))
    colours = {"target": (200, 0, 0), "start": (9, 9, 9), "result": (0, 200, 0), "difference": (0, 0, 9)}
    pictures = tuple(Picture(kind, f"{word} {kind}", png(colour)) for kind, colour in colours.items())
    film = tuple(Still(10 * i, png((80 * i, 80, 80))) for i in range(3))
    table = Table((Head(""), Head(word, word)), (Row(word, (word,), "#336699"),))
    return Page(
        title=word,
        lead=(word, word, word),
        notices=(word,),
        facts=((word, word),),
        comparison=Comparison(word, png((1, 2, 3)), table, word),
        views=tuple(View(f"{word} {i}", pictures, 1.0, 4.0, bool(i), word, () if i else film) for i in range(views)),
        likeness=table,
        likeness_note=word,
        views_note=word,
        plots=(Plot(word, (curve,)), Plot(word, (curve, curve), code=word), Plot("one", (Series("", (0.0,), (1.0,)),))),
        drawing=png((5, 5, 5)),
        parameters=(
            Parameter(word, pictures[:3], rows=table.rows, note=word, film=film),
            Parameter("mesh", mesh=TETRAHEDRON),
        ),
        command=word,
        how=table.rows,
        log=(word, word),
    )  # fmt: skip
