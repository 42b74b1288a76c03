"""Pages as documents: whatever they are told is text, their policy fits what they hold, and curves stay short."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import re
from html.parser import HTMLParser
from types import SimpleNamespace
from typing import Any

import numpy as np
import PIL.Image
import pytest

from page_samples import HOSTILE, sample
from pathreplay.inverse.config.schema import make_config
from pathreplay.inverse.images.io import exposure_for, levels
from pathreplay.inverse.loop.checkpoint import Entry
from pathreplay.report.drawing import own_settings
from pathreplay.report.outcome import Recovered, ViewPictures
from pathreplay.report.page_parts import common_exposure, facts, plots
from pathreplay.report.pages.document import document
from pathreplay.report.pages.page import MOST_POINTS, thinned
from pathreplay.report.report import summary


class Elements(HTMLParser):
    """The elements of a document, what stands in scripts and styles, and all other text."""

    def __init__(self, html: str) -> None:
        super().__init__(convert_charrefs=True)
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.within: dict[str, list[str]] = {"script": [], "style": []}
        self.text = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        if self.lasttag in self.within and self.cdata_elem:
            self.within[self.lasttag].append(data)
        else:
            self.text += data


@pytest.mark.parametrize("word", HOSTILE, ids=range(len(HOSTILE)))
@pytest.mark.parametrize("live", [False, True])
def test_whatever_a_page_says_is_text(word: str, live: bool) -> None:
    plain, hostile = (Elements(document(sample(w), live).decode()) for w in ("plain", word))
    assert [tag for tag, _ in hostile.found] == [tag for tag, _ in plain.found]
    allowed = {name for _, attributes in plain.found for name in attributes}
    assert {name for _, attributes in hostile.found for name in attributes} <= allowed
    assert not {name for name in allowed if name.startswith("on")} and "style" not in allowed
    assert hostile.text.count(word.replace("\r\n", "\n")) + hostile.text.count(word) > 10
    assert len(hostile.within["script"]) == 2


def test_data_come_through_whatever_they_hold() -> None:
    for word in HOSTILE:
        parsed = Elements(document(sample(word)).decode())
        data = json.loads(parsed.within["script"][0])
        assert data["views"][0]["name"] == f"{word} 0" and data["plots"][1]["code"] == word


def test_the_policy_lets_its_own_script_and_style_run_and_nothing_else() -> None:
    parsed = Elements(document(sample()).decode())
    (policy,) = [a["content"] for tag, a in parsed.found if a.get("http-equiv") == "Content-Security-Policy"]
    rules = dict(rule.split(" ", 1) for rule in (policy or "").split("; "))
    for kind, text in (("script", parsed.within["script"][1]), ("style", parsed.within["style"][0])):
        wanted = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert rules[f"{kind}-src"] == f"'sha256-{wanted}'"
    assert rules["default-src"] == "'none'" and rules["img-src"] == "data:" and rules["connect-src"] == "'none'"


def test_a_page_names_no_other_host() -> None:
    html = document(sample()).decode()
    assert not re.search(r"https?:|//[a-z]+\.|url\((?!#)|@import", re.sub(r"data:[^\"]*", "", html))


@pytest.mark.parametrize("count", [0, 1, 2, MOST_POINTS, MOST_POINTS + 1, 10 * MOST_POINTS + 7])
def test_long_curves_are_thinned_and_keep_their_ends(count: int) -> None:
    places = thinned(count)
    assert len(places) <= MOST_POINTS + 1 and places == sorted(set(places))
    assert count == 0 or (places[0], places[-1]) == (0, count - 1)


def test_a_parameter_that_the_last_stage_freezes_keeps_its_curve() -> None:
    history = [Entry(0, 1.0, 0.5, {"a": 1.0, "b": 2.0}), Entry(1, 0.5, 0.5, {"b": 1.0})]
    curves = {plot.code: plot.series[0].y for plot in plots(history) if plot.title == "gradient norm of"}
    assert curves == {"a": (1.0, None), "b": (2.0, 1.0)}


def test_one_exposure_is_that_of_all_pixels_together() -> None:
    dark, bright = np.full((4, 4, 3), 0.5, np.float32), np.full((4, 4, 3), 2.0, np.float32)
    assert common_exposure([(dark, None)]) == pytest.approx(2)
    assert common_exposure([(dark, None), (bright, None)]) == pytest.approx(0.5)


def test_pixels_that_do_not_count_set_no_exposure() -> None:
    target, weight = np.full((4, 4, 3), 0.5, np.float32), np.full((4, 4, 1), 2.0, np.float32)
    target[:2], weight[:2] = 9.0, 0.0
    assert common_exposure([(target, weight)]) == exposure_for(levels(target, weight)) == pytest.approx(2)
    assert common_exposure([(target, None)]) == pytest.approx(1 / 9)


def test_samples_of_a_step_are_those_that_were_taken() -> None:
    """Stages and `spp = "auto"` take others than the job's."""
    config = make_config({"scene": "s.xml", "target": {"scene": "s.xml"}, "parameters": [{"key": "a"}], "spp": 16})

    def samples(*taken: int) -> str:
        history = [Entry(i, 1.0, 0.5, {}, spp=spp) for i, spp in enumerate(taken)]
        return dict((label, value) for value, label in facts(config, history))["samples per pixel and step"]

    assert (samples(), samples(64, 64), samples(16, 64, 8)) == ("16", "64", "8 to 64")


@pytest.mark.drawn
@pytest.mark.parametrize("shape", [(2100, 1, 1), (1, 2100, 3), (3, 2, 3)])
def test_the_sheet_of_a_run_has_room_for_images_of_any_shape(shape: tuple[int, ...]) -> None:
    """Rows of images have at most 8 times the height of their width, and at least an eighth."""
    values = np.linspace(0, 1, int(np.prod(shape)), dtype=np.float32).reshape(shape)
    item = Recovered("curve", "curve", values, values, None)
    view = ViewPictures("eye", *3 * (np.full((8, 8, 3), 0.5, np.float32),), exposure=1.0)
    outcome: Any = SimpleNamespace(views=[view], recovered=[item], caption=str)
    with own_settings(), PIL.Image.open(io.BytesIO(summary(outcome))) as sheet:
        width, height = sheet.size
    ratio = min(max(shape[0] / shape[1], 1 / 8), 8)
    assert width == 4 * 210 and height == pytest.approx(40 + 210 + 210 * ratio, abs=2)
