"""The content of a page about a run as plain data, from which `document` makes HTML.

The document shows all texts literally. A ``src`` is a data URI in a self-contained page, and a relative address in a
served page.
"""

from __future__ import annotations

from dataclasses import dataclass, field

# Maximum points of a curve; longer curves are subsampled.
MOST_POINTS = 1500


@dataclass(frozen=True)
class Picture:
    """An image of one kind, as 'target' or 'result', with its caption."""

    kind: str
    caption: str
    src: str


@dataclass(frozen=True)
class Still:
    """One frame of a film: an image after a number of iterations."""

    iteration: int
    src: str


@dataclass(frozen=True)
class View:
    """Images of one view. ``stored`` is the exposure of the stored images, ``own`` the view's own best exposure."""

    name: str
    pictures: tuple[Picture, ...]
    stored: float = 1.0
    own: float = 1.0
    is_test: bool = False
    note: str = ""
    film: tuple[Still, ...] = ()


@dataclass(frozen=True)
class Row:
    """A table row: its name, its cells, and a colour swatch (#rrggbb) or ""."""

    name: str
    cells: tuple[str, ...]
    colour: str = ""


@dataclass(frozen=True)
class Head:
    """A column header: words, optionally followed by a parameter key."""

    text: str
    code: str = ""


@dataclass(frozen=True)
class Table:
    """Rows under column headers; the first header is that of the row names."""

    heads: tuple[Head, ...]
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class Mesh:
    """An interactive mesh: vertices by kind (3 n float32, base64), and faces (3 m uint32, base64)."""

    vertices: dict[str, str]
    faces: str


@dataclass(frozen=True)
class Parameter:
    """The section of one parameter: any of images, table rows, a note, a film and a mesh."""

    key: str
    pictures: tuple[Picture, ...] = ()
    columns: int = 3
    rows: tuple[Row, ...] = ()
    note: str = ""
    film: tuple[Still, ...] = ()
    mesh: Mesh | None = None


@dataclass(frozen=True)
class Series:
    """A line of a plot, named if there are several. Unknown values are None."""

    name: str
    x: tuple[float, ...]
    y: tuple[float | None, ...]


@dataclass(frozen=True)
class Plot:
    """Curves, usually over iterations; on a logarithmic scale if ``log`` is set and all values are positive."""

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
    """Text, a name in a monospace font, and text."""
    notices: tuple[str, ...] = ()
    facts: tuple[tuple[str, str], ...] = ()
    comparison: Comparison | None = None
    views: tuple[View, ...] = ()
    likeness: Table | None = None
    likeness_note: str = ""
    views_note: str = ""
    exposure: float = 1.0
    """Common exposure of all views, unless the reader chooses a view's own."""
    left: str = "target"
    right: str = "result"
    """Initial images of the wipe comparison."""
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
    """Indices of the drawn points of a sequence: all, or evenly subsampled ones and the last."""
    step = -(-count // most) or 1
    return [*range(0, count - 1, step), count - 1] if count else []
