"""What a notebook shows while a job runs: one output, drawn anew, with bar, curve and pictures."""

from __future__ import annotations

import re
import sys
from types import SimpleNamespace

import pytest

from pathreplay.jobs import iterate, make_config, optimize
from pathreplay.report import notebook
from pathreplay.report.pages.page import Picture, View, thinned
from pathreplay.report.pages.panel import MOST_POINTS, Panel
from small_job import points
from wall_job import JOB

HOSTILE = "<script>alert('\"')</script>"


def test_only_a_kernel_is_a_notebook(outputs: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    assert notebook.in_notebook()
    terminal = SimpleNamespace()  # IPython's own shell: it has no kernel
    monkeypatch.setattr(sys.modules["IPython"], "get_ipython", lambda: terminal)
    assert not notebook.in_notebook()
    monkeypatch.delitem(sys.modules, "IPython")
    assert not notebook.in_notebook()


@pytest.mark.usefixtures("wall_room")
def test_a_run_draws_one_output_anew_and_prints_nothing(outputs: list[str], capfd: pytest.CaptureFixture[str]) -> None:
    job = {**JOB, "iterations": 4, "output": "run", "preview": {"share": 0.5}}
    result = optimize(make_config(job))
    assert capfd.readouterr().err == ""
    first, last = outputs[0], outputs[-1]
    assert "preparing" in first and "<img" not in first and "polyline" not in first
    assert f"{result.folder}: ended" in last and "4 of 4" in last
    assert f"→ {result.history[-1].loss:.4g}" in last and len(points(last)) == 4
    assert [*re.findall(r"<figcaption>(\w+)", last)] == ["target", "now", "difference"]
    assert last.count('src="data:image/webp;base64,') == 3
    # Pictures have changed since the start, the target has not.
    begun = next(html for html in outputs if "<img" in html)
    old, new = (re.findall(r'src="([^"]+)"', html) for html in (begun, last))
    assert old[0] == new[0] and old[1] != new[1]


@pytest.mark.usefixtures("wall_room")
def test_what_is_gone_on_with_shows_all_of_its_curve(outputs: list[str]) -> None:
    with iterate(make_config({**JOB, "iterations": 4, "output": "run"}), progress=True) as session:
        next(session), next(session)
    assert "2 of 4" in outputs[-1] and len(points(outputs[-1])) == 2
    outputs.clear()
    optimize(resume="run")
    assert not points(outputs[0]) and len(points(outputs[-1])) == 4 and "4 of 4" in outputs[-1]


@pytest.mark.usefixtures("wall_room")
def test_silence_where_it_is_asked_for(outputs: list[str]) -> None:
    optimize(make_config({**JOB, "iterations": 1, "output": "run"}), progress=False)
    assert outputs == []


def test_an_error_is_the_last_state(outputs: list[str]) -> None:
    with pytest.raises(ZeroDivisionError), notebook.NotebookPanel() as panel:
        panel.note("something\nin two lines")
        raise ZeroDivisionError
    assert "ended by ZeroDivisionError" in outputs[-1] and "in two lines" in outputs[-1]


def test_texts_are_texts() -> None:
    view = View(HOSTILE, (Picture("target", HOSTILE, "data:,"),))
    html = Panel(HOSTILE, HOSTILE, 1, 2, HOSTILE, (1.0, 0.5), (view,), (HOSTILE,)).html()
    assert "<script" not in html and html.count("&lt;script") == 8


@pytest.mark.parametrize("losses", [(), (1.0,), (1.0, 1.0), (0.0, -1.0), (1e-30, 1e30)])
def test_curves_stay_inside(losses: tuple[float, ...]) -> None:
    html = Panel("run", "optimizing", losses=losses).html()
    found = points(html)
    assert len(found) == (len(losses) if len(losses) > 1 else 0)
    assert all(0 <= x <= 480 and 0 <= y <= 120 for x, y in found)
    assert ("logarithmic" in html) == (len(losses) > 1 and min(losses) > 0)


def test_long_curves_are_thinned() -> None:
    values = tuple(map(float, range(10_000)))
    found = [values[i] for i in thinned(len(values), MOST_POINTS)]
    assert len(found) == MOST_POINTS and found[0] == values[0] and found[-1] == values[-1] and found == sorted(found)
    assert len(points(Panel("run", "optimizing", losses=values).html())) == MOST_POINTS
