"""The documentation site: it builds without a warning, its links hold, and a browser shows it from disk alone."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest

from places import ROOT

pytest.importorskip("furo")
pytest.importorskip("myst_nb")
CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)
IN_A_BROWSER = pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here")
pytestmark = pytest.mark.slow

#: Images that cannot be shown, and the width of the page beyond that of the window.
SEEN = """() => [
    [...document.images].filter(i => i.getClientRects().length && !(i.complete && i.naturalWidth)).map(i => i.src),
    document.documentElement.scrollWidth - innerWidth,
    getComputedStyle(document.body).backgroundColor,
]"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site as `make docs` builds it, but that notebooks are not run."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-c", "docs", "-d", str(folder / "doctrees")]
    environment = {**os.environ, "PATHREPLAY_DOCS_NOTEBOOKS": "off"}
    built = subprocess.run(
        [*command, ".", str(folder / "html")], cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert built.returncode == 0, built.stdout + built.stderr
    return folder / "html"


class Page(HTMLParser):
    """What a page refers to, and the places in it that others may refer to."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.references: list[str] = []
        self.places: set[str] = set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        for name, value in attributes:
            if name == "id" and value:
                self.places.add(value)
            elif name in ("href", "src") and value:
                self.references.append(value)


def test_the_site_has_a_page_for_every_source(site: Path) -> None:
    sources = [*(ROOT / "docs").rglob("*.md"), *(ROOT / "examples").glob("*/README.md"), ROOT / "CHANGELOG.md"]
    missing = [path for path in sources if not (site / path.relative_to(ROOT)).with_suffix(".html").is_file()]
    assert len(sources) > 30 and missing == []


def test_links_of_the_site_lead_somewhere(site: Path) -> None:
    pages = {path: Page(path) for path in site.rglob("*.html") if "_static" not in path.parts}
    broken = []
    for path, page in pages.items():
        for reference in page.references:
            parts = urlsplit(reference)
            if parts.scheme in ("http", "https", "mailto", "data"):
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            place = unquote(parts.fragment)
            if not target.is_file() or (place and target in pages and place not in pages[target].places):
                broken.append((str(path.relative_to(site)), reference))
    assert broken == []


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as tool:
        browser = tool.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@IN_A_BROWSER
@pytest.mark.parametrize(("scheme", "width"), [("light", 1300), ("light", 400), ("dark", 1300), ("dark", 400)])
def test_every_page_is_shown(browser: Any, site: Path, scheme: str, width: int) -> None:
    asked: list[str] = []
    wrong: list[str] = []
    tab = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
    tab.on("request", lambda request: asked.append(request.url))
    tab.on("pageerror", lambda error: wrong.append(str(error)))
    tab.on("requestfailed", lambda request: wrong.append(request.url))
    grounds = set()
    for path in sorted(site.rglob("docs/**/*.html")) + sorted(site.rglob("examples/**/*.html")):
        tab.goto(path.as_uri())
        broken, beyond, ground = tab.evaluate(SEEN)
        grounds.add(ground)
        if broken or beyond > 0:
            wrong.append(f"{path.relative_to(site)}: {broken}, {beyond} pixels too wide")
    tab.close()
    assert wrong == []
    assert [url for url in asked if not url.startswith((site.as_uri(), "data:"))] == []
    (ground,) = grounds
    channels = [int(number) for number in ground.removeprefix("rgb(").removesuffix(")").split(",")]
    assert min(channels) > 200 if scheme == "light" else max(channels) < 60


@IN_A_BROWSER
def test_search_finds_a_page_without_a_server(browser: Any, site: Path) -> None:
    tab = browser.new_page()
    tab.goto(f"{(site / 'search.html').as_uri()}?q=null_branching")
    tab.wait_for_selector("#search-results li a")
    found = tab.eval_on_selector_all("#search-results li a", "links => links.map(link => link.href)")
    tab.close()
    assert any("docs/media.html" in link for link in found), found


@IN_A_BROWSER
@pytest.mark.parametrize(("motion", "shown"), [("reduce", "still"), ("no-preference", "moving")])
def test_the_film_of_the_first_page_rests_for_those_who_prefer_it(
    browser: Any, site: Path, motion: str, shown: str
) -> None:
    tab = browser.new_page(reduced_motion=motion)
    tab.goto((site / "docs" / "index.html").as_uri())
    assert [name for name in ("still", "moving") if tab.locator(f"img.{name}").is_visible()] == [shown]
    tab.close()
