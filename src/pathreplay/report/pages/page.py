"""What a page about a run says, as plain data: whoever knows the run fills it in, and `document` makes HTML of it.

Texts are texts: whatever they hold, the document shows it letter by letter. A ``src`` is a data URI in a page that is
one file, and a relative address in one that is served.
"""

from __future__ import annotations

from dataclasses import dataclass, field

# A curve of more points is no better to look at; every so many of a longer one are taken.
MOST_POINTS = 1500


@dataclass(frozen=True)
class Picture:
    """A picture of one kind ('target', 'result', ...), with what stands below it."""

    kind: str
    caption: str
    src: str


@dataclass(frozen=True)
class Still:
    """One picture of a film: how something looked after so many iterations."""

    iteration: int
    src: str


@dataclass(frozen=True)
class View:
    """Pictures of one view. ``stored`` is the exposure that they have, ``own`` the one that suits this view best."""

    name: str
    pictures: tuple[Picture, ...]
    stored: float = 1.0
    own: float = 1.0
    is_test: bool = False
    note: str = ""
    film: tuple[Still, ...] = ()


@dataclass(frozen=True)
class Row:
    """A line of a table: its name, what stands there, and a colour (#rrggbb) to show, or ""."""

    name: str
    cells: tuple[str, ...]
    colour: str = ""


@dataclass(frozen=True)
class Head:
    """What stands over a column: words, and a key after them."""

    text: str
    code: str = ""


@dataclass(frozen=True)
class Table:
    """Rows under heads, of which the first is over the names."""

    heads: tuple[Head, ...]
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class Mesh:
    """A mesh to turn about: vertices by kind (3 n float32, base64), and faces (3 m uint32, base64)."""

    vertices: dict[str, str]
    faces: str


@dataclass(frozen=True)
class Parameter:
    """What is told of one parameter: pictures, a table, a line, how it changed, a mesh; whatever there is."""

    key: str
    pictures: tuple[Picture, ...] = ()
    columns: int = 3
    rows: tuple[Row, ...] = ()
    note: str = ""
    film: tuple[Still, ...] = ()
    mesh: Mesh | None = None


@dataclass(frozen=True)
class Series:
    """A line of a plot, named where there are several. What is not known at an x is None."""

    name: str
    x: tuple[float, ...]
    y: tuple[float | None, ...]


@dataclass(frozen=True)
class Plot:
    """Curves, over iterations as a rule, on a logarithmic scale where all are above zero and ``log`` says so."""

    title: str
    series: tuple[Series, ...]
    log: bool = True
    code: str = ""
    """A key that ends the title."""
    along: str = "iteration"
    """What x counts."""


@dataclass(frozen=True)
class Comparison:
    """A run next to another one that had the same time: a drawing, a table and what they mean."""

    title: str
    src: str
    table: Table
    note: str


@dataclass(frozen=True)
class Page:
    """Everything that a page says, from top to bottom."""

    title: str
    lead: tuple[str, str, str]
    """Words, a name in the letters of code, and words."""
    notices: tuple[str, ...] = ()
    facts: tuple[tuple[str, str], ...] = ()
    comparison: Comparison | None = None
    views: tuple[View, ...] = ()
    likeness: Table | None = None
    likeness_note: str = ""
    views_note: str = ""
    exposure: float = 1.0
    """The one under which all views are shown, unless someone wants a view's own."""
    left: str = "target"
    right: str = "result"
    """Which pictures the wipe begins with."""
    plots: tuple[Plot, ...] = ()
    plots_note: str = ""
    drawing: str = ""
    """The first plot as a picture, for readers without JavaScript."""
    parameters: tuple[Parameter, ...] = ()
    command: str = ""
    how: tuple[Row, ...] = ()
    log: tuple[str, ...] = ()
    titles: dict[str, str] = field(default_factory=dict)
    """Other words for the headings: 'views', 'plots', 'parameters', 'how'."""


def thinned(count: int, most: int = MOST_POINTS) -> list[int]:
    """The places of a sequence that a curve takes: all, or every so many, and the last."""
    step = -(-count // most) or 1
    return [*range(0, count - 1, step), count - 1] if count else []
