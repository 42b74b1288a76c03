"""Pages in a browser: pictures are shown, what should move moves, no other host is asked, nothing sticks out."""

from __future__ import annotations

import contextlib
import io
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest

from page_samples import HOSTILE, png, sample
from pathreplay.report.live_page import FOLDER, PAGE, PAGES, STOP
from pathreplay.report.page_parts import uri
from pathreplay.report.pages.document import document
from pathreplay.report.pages.page import Page
from pathreplay.report.watch.server import RunServer
from small_job import TIMEOUT_S, ended, start, wait_for, write_job

playwright = pytest.importorskip("playwright.sync_api")
CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)
pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here")]

WIDE, NARROW = {"width": 1200, "height": 900}, {"width": 400, "height": 800}


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as tool:
        browser = tool.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


class Seen:
    """A page in the browser, what it asked for and what went wrong in it."""

    def __init__(self, browser: Any, address: str, size: dict[str, int] = WIDE, **options: Any) -> None:
        self.asked: list[str] = []
        self.wrong: list[str] = []
        self.tab = browser.new_page(viewport=size, **options)
        self.tab.on("request", lambda request: self.asked.append(request.url))
        self.tab.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.tab.on("console", lambda message: self.wrong.append(message.text) if message.type == "error" else None)
        self.tab.goto(address)
        if options.get("java_script_enabled", True):
            self.tab.wait_for_selector("html.ready")

    def elsewhere(self, own: str) -> list[str]:
        """What was asked for that is neither in the page nor below its own address."""
        return [url for url in self.asked if not url.startswith(("data:", own))]

    def broken(self) -> list[str]:
        """Pictures that are in the page and cannot be shown."""
        return self.tab.evaluate(
            "[...document.images].filter(i => i.src && !(i.complete && i.naturalWidth)).map(i => i.alt)"
        )

    def until(self, expression: str) -> None:
        """Wait for it to be true; Playwright's own waiting is refused by the page's policy, as it should be."""
        end = time.monotonic() + TIMEOUT_S
        while True:
            with contextlib.suppress(playwright.Error):  # the page is being loaded anew
                if self.tab.evaluate(expression):
                    return
            assert time.monotonic() < end, expression
            self.tab.wait_for_timeout(50)

    def width(self) -> int:
        return self.tab.evaluate("document.documentElement.scrollWidth")

    def colour(self, selector: str, across: float, down: float = 0.5) -> tuple[int, ...]:
        """The colour of a place in an element, as it is on the screen."""
        element = self.tab.locator(selector).first
        element.scroll_into_view_if_needed()
        data = element.screenshot()
        picture = PIL.Image.open(io.BytesIO(data)).convert("RGB")
        pixel = picture.getpixel((int(across * (picture.width - 1)), int(down * (picture.height - 1))))
        return tuple(pixel)


@pytest.fixture
def show(browser: Any, tmp_path: Path) -> Iterator[Any]:
    seen: list[Seen] = []

    def shown(page: Page, size: dict[str, int] = WIDE, **options: Any) -> Seen:
        path = tmp_path / "page.html"
        path.write_bytes(document(page))
        seen.append(Seen(browser, path.as_uri(), size, **options))
        return seen[-1]

    yield shown
    for each in seen:
        each.tab.close()
        assert not each.wrong


RED, GREEN = (200, 0, 0), (0, 200, 0)


def test_pictures_are_shown_and_nothing_is_asked_for(show: Any, tmp_path: Path) -> None:
    seen = show(sample())
    assert not seen.broken() and seen.asked[0] == (tmp_path / "page.html").as_uri()
    assert not seen.elsewhere(seen.asked[0])


def test_the_border_moves(show: Any) -> None:
    seen = show(sample())
    assert (seen.colour(".stage", 0.3, 0.2), seen.colour(".stage", 0.7, 0.2)) == (RED, GREEN)
    seen.tab.locator(".wipe").fill("0.9")
    assert (seen.colour(".stage", 0.7, 0.2), seen.colour(".stage", 0.97, 0.2)) == (RED, GREEN)
    box = seen.tab.locator(".stage").bounding_box()
    seen.tab.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 50)
    seen.tab.mouse.down()
    seen.tab.mouse.move(box["x"] + 0.1 * box["width"], box["y"] + 50)
    seen.tab.mouse.up()
    assert (seen.colour(".stage", 0.05, 0.2), seen.colour(".stage", 0.3, 0.2)) == (RED, GREEN)
    seen.tab.locator(".stage").press("ArrowRight")
    assert float(seen.tab.locator(".wipe").input_value()) == pytest.approx(0.12, abs=0.01)


def test_the_zoom_shows_a_part(show: Any) -> None:
    """A picture whose left half is white: four times as large, the right half is out of sight."""
    half = np.zeros((30, 40, 3), np.uint8)
    half[:, :20] = 255
    buffer = io.BytesIO()
    PIL.Image.fromarray(half).save(buffer, "png")
    page = sample()
    view = page.views[0]
    pictures = tuple(replace(p, src=uri("image/png", buffer.getvalue())) for p in view.pictures)
    seen = show(replace(page, views=(replace(view, pictures=pictures),)))
    assert seen.colour(".stage", 0.8, 0.2) == (0, 0, 0)
    box = seen.tab.locator(".stage").bounding_box()
    seen.tab.mouse.dblclick(box["x"] + 4, box["y"] + 40)
    assert seen.colour(".stage", 0.8, 0.2) == (255, 255, 255)
    assert "400 %" in seen.tab.locator(".tools").nth(1).inner_text()
    seen.tab.mouse.move(box["x"] + 0.9 * box["width"], box["y"] + 60)
    seen.tab.mouse.down()
    seen.tab.mouse.move(box["x"] - 2 * box["width"], box["y"] + 60, steps=3)  # drag: the right end comes
    seen.tab.mouse.up()
    assert seen.colour(".stage", 0.8, 0.2) == (0, 0, 0)
    seen.tab.get_by_role("button", name="fit").click()
    assert seen.colour(".stage", 0.2, 0.2) == (255, 255, 255)


def test_exposure_is_one_for_all_and_a_view_may_have_its_own(show: Any) -> None:
    """Of sRGB 100 two stops more are 4 x its linear value, 0.5089: sRGB 188. A view's own exposure is that here."""
    page = sample()
    grey = tuple(replace(p, src=png((100, 100, 100))) for p in page.views[0].pictures)
    seen = show(replace(page, views=tuple(replace(view, pictures=grey) for view in page.views)))
    rows = [f"section.view >> nth={i} >> img >> nth=0" for i in (0, 1)]
    look = lambda: [seen.colour(row, 0.5)[0] for row in rows]  # noqa: E731
    assert look() == [100, 100]
    seen.tab.get_by_label("exposure in stops").fill("2")
    assert look() == pytest.approx([188, 188], abs=1)
    seen.tab.get_by_label("exposure in stops").fill("0")
    seen.tab.locator("input.own").check()
    assert look() == pytest.approx([188, 100], abs=1)
    assert seen.colour(".stage", 0.3, 0.2)[0] == pytest.approx(188, abs=1)


def test_curves_are_drawn_and_tell_what_is_under_the_pointer(show: Any) -> None:
    seen = show(sample())
    lines = seen.tab.locator("#plots path.line")
    assert lines.count() == 4 and seen.tab.locator("#plots figure").count() == 3
    assert all(d.count("L") == 48 for d in lines.evaluate_all("all => all.map(p => p.getAttribute('d'))")[:3])
    first = seen.tab.locator("#plots figure").first
    first.scroll_into_view_if_needed()
    box = first.locator("svg").bounding_box()
    seen.tab.mouse.move(box["x"] + 58 + (box["width"] - 66) * 10 / 48, box["y"] + 60)
    assert "iteration 10: 0.5" in first.locator(".legend").inner_text()
    assert seen.tab.locator("#plots img").count() == 0  # what stands for readers without JavaScript


def test_films_play_and_can_be_beside_the_target(show: Any) -> None:
    seen = show(sample())
    film = seen.tab.locator(".film").first
    film.locator("input").fill("1")
    assert "after 10 iterations" in film.inner_text() and seen.colour(".film img", 0.5) == (80, 80, 80)
    film.locator("button").click()
    seen.until("document.querySelector('.film output').textContent !== 'after 10 iterations'")
    seen.tab.locator(".tools select").nth(2).select_option("through time")
    seen.tab.get_by_label("iteration").first.fill("0")
    assert seen.colour(".stage", 0.8, 0.2) == (0, 80, 80)


@pytest.mark.parametrize("word", HOSTILE, ids=range(len(HOSTILE)))
@pytest.mark.parametrize("size", [WIDE, NARROW], ids=["wide", "narrow"])
def test_hostile_names_are_text_and_nothing_sticks_out(show: Any, word: str, size: dict[str, int]) -> None:
    seen = show(sample(word), size)
    assert seen.tab.evaluate("window.hacked") is None
    assert seen.tab.locator("h1").evaluate("e => e.textContent") == word.replace("\r\n", "\n")
    assert seen.width() <= size["width"]
    seen.tab.locator(".tools select").first.select_option("1")
    assert not seen.broken() and len(seen.asked) == len([url for url in seen.asked if not url.startswith("http")])


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [WIDE, NARROW], ids=["wide", "narrow"])
def test_light_and_dark(show: Any, scheme: str, size: dict[str, int]) -> None:
    seen = show(sample(), size, color_scheme=scheme)
    ground, ink = (
        sum(int(x) for x in seen.tab.evaluate(f"getComputedStyle(document.body).{name}")[4:-1].split(","))
        for name in ("backgroundColor", "color")
    )
    assert (ground > 700 and ink < 120) if scheme == "light" else (ground < 120 and ink > 600)
    assert seen.width() <= size["width"]


def test_without_javascript_it_is_a_document(show: Any) -> None:
    seen = show(sample(), java_script_enabled=False)
    assert seen.tab.locator("section.view img").count() == 8 and seen.tab.locator(".stage").count() == 0
    assert seen.tab.locator("#plots img").is_visible()


def test_on_paper_there_are_pictures_and_curves_and_no_buttons(show: Any) -> None:
    seen = show(sample())
    seen.tab.emulate_media(media="print")
    assert not seen.tab.locator("#viewer").is_visible() and seen.tab.locator("section.view img").first.is_visible()
    assert seen.tab.locator("#plots svg").first.is_visible() and not seen.tab.locator(".film").first.is_visible()


# ------------------------------ A run under way ------------------------------


def test_a_page_that_is_served_looks_for_news(browser: Any, tmp_path: Path) -> None:
    run = tmp_path / HOSTILE[1].replace("/", "")
    (run / FOLDER).mkdir(parents=True)
    (run / PAGE).write_bytes(PAGES.dump_json(replace(sample(), facts=(("one", "iterations"),))))
    server = RunServer(run, "127.0.0.1", 0)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        seen = Seen(browser, server.address)
        seen.tab.locator(".wipe").fill("0.25")
        (run / PAGE).write_bytes(PAGES.dump_json(replace(sample(views=2), facts=(("two", "iterations"),))))
        seen.until("document.querySelector('.facts b').textContent === 'two'")
        assert seen.tab.locator(".wipe").input_value() == "0.25" and not seen.broken()
        seen.tab.locator("#stop").click()
        seen.until("document.getElementById('stop').textContent.startsWith('Stopping')")
        assert (run / STOP).is_file()
        (run / "report.html").write_bytes(document(replace(sample(), title="the end")))
        seen.until("document.querySelector('h1').textContent === 'the end'")
        seen.tab.wait_for_selector(".stage")  # the policy of the header lets the report's script run
        assert not seen.broken() and not seen.elsewhere(server.address) and not seen.wrong
        seen.tab.close()
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def test_a_run_is_followed_and_stopped(browser: Any, tmp_path: Path) -> None:
    """All of it as users have it: two commands, a page, a click; then the report from the disk."""
    write_job(tmp_path, iterations=100_000, preview={"share": 0.3})
    process = start(tmp_path, "job.json", "--quiet")
    wait_for(tmp_path / "run" / PAGE, process)
    watch = subprocess.Popen(
        [sys.executable, "-m", "pathreplay.cli", "watch", "run"], cwd=tmp_path, stdout=subprocess.PIPE, text=True
    )
    try:
        address = (watch.stdout.readline() if watch.stdout else "").strip()
        seen = Seen(browser, address, NARROW)
        seen.until("document.querySelectorAll('#plots path.line').length === 5")
        seen.until("document.querySelector('.tools select').options.length === 2")
        assert seen.width() <= NARROW["width"] and not seen.broken()
        seen.tab.locator("#stop").click()
        status, out, _ = ended(process)
        assert status == 0 and "stopped early by the stop button" in out
        seen.tab.wait_for_selector("text=Stopped after", timeout=60_000)
        assert not seen.elsewhere(address) and not seen.wrong
        watch.send_signal(2)
        assert watch.wait(30) == 0
        seen.tab.goto((tmp_path / "run/report.html").as_uri())
        seen.tab.wait_for_selector(".stage")
        assert not seen.broken() and seen.width() <= NARROW["width"] and not seen.wrong
        seen.tab.close()
    finally:
        for each in (process, watch):
            if each.poll() is None:
                each.kill()
        watch.communicate()


def test_a_mesh_is_shown_and_turns(show: Any) -> None:
    seen = show(sample())
    canvas = seen.tab.locator("canvas.mesh")
    if canvas.count() == 0:
        pytest.skip("this browser has no WebGL")

    def painted() -> tuple[float, bytes]:
        canvas.scroll_into_view_if_needed()
        data = canvas.screenshot()
        pixels = np.asarray(PIL.Image.open(io.BytesIO(data)).convert("RGB")).astype(int)
        return float((np.abs(pixels - pixels[2, 2]).sum(axis=2) > 30).mean()), data

    share, before = painted()
    assert 0.02 < share < 0.9  # a body on its ground
    box = canvas.bounding_box()
    seen.tab.mouse.move(box["x"] + 200, box["y"] + 200)
    seen.tab.mouse.down()
    seen.tab.mouse.move(box["x"] + 330, box["y"] + 260, steps=3)
    seen.tab.mouse.up()
    assert painted()[1] != before
    turned = painted()[1]
    seen.tab.locator(".extra select").select_option("start")
    assert painted()[1] != turned
