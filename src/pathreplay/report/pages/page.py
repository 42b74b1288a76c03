"""The content of a page about a run as plain data, from which `document` makes HTML.

The document shows all texts literally. The ``src`` of an image is a data URI in a self-contained page, and a relative
address in a served page.
"""

from __future__ import annotations

from dataclasses import dataclass, field

# Maximum number of points of a curve. Longer curves are subsampled.
MOST_POINTS = 1500


@dataclass(frozen=True)
class Picture:
    """An image with its caption. ``kind`` is a name such as 'target' or 'result'."""

    kind: str
    caption: str
    src: str


@dataclass(frozen=True)
class Still:
    """One frame of a time-lapse film: an image after a number of iterations."""

    iteration: int
    src: str


@dataclass(frozen=True)
class View:
    """Images of one view.

    ``stored`` is the exposure with which the images are encoded, and ``own`` the best exposure for this view.
    """

    name: str
    pictures: tuple[Picture, ...]
    stored: float = 1.0
    own: float = 1.0
    is_test: bool = False
    note: str = ""
    film: tuple[Still, ...] = ()


@dataclass(frozen=True)
class Row:
    """A table row, which consists of a name, cells, and a colour swatch (#rrggbb, or "" for none)."""

    name: str
    cells: tuple[str, ...]
    colour: str = ""


@dataclass(frozen=True)
class Head:
    """A column header: a text, optionally followed by a parameter key (``code``)."""

    text: str
    code: str = ""


@dataclass(frozen=True)
class Table:
    """Rows under column headers. The first header belongs to the row names."""

    heads: tuple[Head, ...]
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class Mesh:
    """An interactive mesh with n vertices and m faces, whose arrays are encoded in base64.

    ``vertices`` contains the positions (3n float32) of each version of the mesh: 'start', 'result' and 'truth', if
    known. ``faces`` contains vertex indices (3m uint32).
    """

    vertices: dict[str, str]
    faces: str


@dataclass(frozen=True)
class Parameter:
    """The section about one parameter, with optional images, table rows, note, film and mesh."""

    key: str
    pictures: tuple[Picture, ...] = ()
    columns: int = 3
    rows: tuple[Row, ...] = ()
    note: str = ""
    film: tuple[Still, ...] = ()
    mesh: Mesh | None = None


@dataclass(frozen=True)
class Series:
    """A line of a plot. ``name`` is "" if the plot has only one line. Unknown values are None."""

    name: str
    x: tuple[float, ...]
    y: tuple[float | None, ...]


@dataclass(frozen=True)
class Plot:
    """Curves, usually over iterations. The scale is logarithmic if ``log`` is set and all values are positive."""

    title: str
    series: tuple[Series, ...]
    log: bool = True
    code: str = ""
    """Parameter key at the end of the title."""
    along: str = "iteration"
    """Unit of x."""


@dataclass(frozen=True)
class Comparison:
    """Comparison of a run with its baseline at equal time: a plot, a table and an explanation."""

    title: str
    src: str
    table: Table
    note: str


@dataclass(frozen=True)
class Page:
    """All content of a page, from top to bottom."""

    title: str
    lead: tuple[str, str, str]
    """Three parts of a sentence: text, a name in a monospace font, and text."""
    notices: tuple[str, ...] = ()
    facts: tuple[tuple[str, str], ...] = ()
    comparison: Comparison | None = None
    views: tuple[View, ...] = ()
    likeness: Table | None = None
    likeness_note: str = ""
    views_note: str = ""
    exposure: float = 1.0
    """Display exposure of all views, unless the reader chooses the best exposure of each view."""
    left: str = "target"
    right: str = "result"
    """``left`` and ``right`` are the kinds of the images at first shown left and right of the movable border."""
    plots: tuple[Plot, ...] = ()
    plots_note: str = ""
    drawing: str = ""
    """The first plot as an image, for readers without JavaScript."""
    parameters: tuple[Parameter, ...] = ()
    command: str = ""
    how: tuple[Row, ...] = ()
    log: tuple[str, ...] = ()
    titles: dict[str, str] = field(default_factory=dict)
    """Replacements of the headings 'views', 'plots', 'parameters' and 'how'."""


def thinned(count: int, most: int = MOST_POINTS) -> list[int]:
    """Return the indices of the points of a curve to draw.

    If there are more than ``most`` points, about ``most`` evenly spaced points and the last point are drawn.
    """
    step = -(-count // most) or 1
    return [*range(0, count - 1, step), count - 1] if count else []
