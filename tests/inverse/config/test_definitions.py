"""What `--set KEY=VALUE` does to a job, and the schema by which editors know one."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from pathreplay.cli import app
from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.definitions import defined
from pathreplay.inverse.config.schema import Config
from pathreplay.jobs import load_config, make_config, optimize
from places import ROOT
from wall_job import JOB

TABLE: dict[str, Any] = {"scene": "a.xml", "spp": 16, "parameters": [{"key": "a"}, {"key": "b", "lower": 0.0}]}
GIVEN = {
    "spp=32": {"spp": 32},
    "scene=rooms/b c.xml": {"scene": "rooms/b c.xml"},
    'scene="16"': {"scene": "16"},
    "integrator.max_depth=3": {"integrator": {"max_depth": 3}},
    "parameters.1.lower=0.5": {"parameters": [{"key": "a"}, {"key": "b", "lower": 0.5}]},
    "parameters=[]": {"parameters": []},
    'target.values."wall.bsdf.reflectance.value"=[0.1, 0.2, 0.3]': {
        "target": {"values": {"wall.bsdf.reflectance.value": [0.1, 0.2, 0.3]}}
    },
    "deterministic=true": {"deterministic": True},
    "output=": {"output": ""},
    "loss=a=b": {"loss": "a=b"},
    "scene=1979-05-27": {"scene": "1979-05-27"},
}


@pytest.mark.parametrize("change", GIVEN)
def test_a_change_goes_where_it_says(change: str) -> None:
    before = json.dumps(TABLE)
    assert defined(TABLE, [change]) == {**TABLE, **GIVEN[change]}
    assert json.dumps(TABLE) == before


def test_the_last_change_counts() -> None:
    assert defined(TABLE, ["spp=1", "spp=2"])["spp"] == 2


REFUSED = {
    "spp": "has no '='",
    "=3": "names no key",
    "a b=3": "names no key",
    "a\nb=2": "names no key",
    "parameters.2.key=c": "not an index into a list of 2",
    "parameters.first.key=c": "not an index into a list of 2",
    "spp.x=1": "is not a table",
    f"parameters.{'9' * 5000}.key=c": "not an index into a list of 2",
    f"{'.'.join('a' * 3000)}=1": "names no key",
}


@pytest.mark.parametrize("change", REFUSED)
def test_what_leads_nowhere_is_refused_in_one_line(change: str) -> None:
    with pytest.raises(PathreplayError) as told:
        defined(TABLE, [change])
    assert REFUSED[change] in str(told.value) and "\n" not in str(told.value)


@pytest.fixture
def job(wall_room: Path) -> Path:
    path = wall_room / "job.json"
    path.write_text(json.dumps(JOB))
    return path


def test_changes_are_checked_like_the_file(job: Path) -> None:
    assert load_config(job, ["spp=2"]).spp == 2
    with pytest.raises(PathreplayError, match="unknown key 'sppp'; did you mean 'spp'"):
        load_config(job, ["sppp=2"])


def test_a_run_remembers_its_changes(job: Path) -> None:
    result = optimize(job, output="run", progress=False, define=["iterations=2", "loss=l1"])
    assert result.iterations == 2
    assert load_config(result.folder / "config.json").loss == "l1"
    assert "job.json --set iterations=2 --set loss=l1" in result.report.read_text()
    with pytest.raises(PathreplayError, match="omit CONFIG, --output and --set"):
        optimize(resume=result.folder, progress=False, define=["iterations=4"])


def test_the_schema_says_what_a_job_may_be() -> None:
    told = CliRunner().invoke(app, ["schema"])
    schema = json.loads(told.stdout)
    assert told.exit_code == 0
    assert set(schema["required"]) == {"scene", "parameters"}
    optimizer = schema["$defs"]["Optimizer"]["properties"]
    assert optimizer["type"]["enum"] == ["adam", "adamw", "sgd", "rmsprop", "l-bfgs-b", "levenberg-marquardt"]
    assert schema["additionalProperties"] is False


def test_every_key_says_what_it_is() -> None:
    schema = Config.model_json_schema()
    tables = {"job": schema, **schema["$defs"]}
    silent = [
        f"{name}.{key}"
        for name, table in tables.items()
        for key, about in table.get("properties", {}).items()
        if not about.get("description")
    ]
    assert not silent


def test_the_page_of_keys_is_made_of_the_schema() -> None:
    told = CliRunner().invoke(app, ["schema", "--markdown"])
    page = ROOT / "docs" / "job-reference.md"
    assert told.stdout == page.read_text(encoding="utf-8"), "write it with: pathreplay schema --markdown"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ({"rival": {"type": "prb"}}, "'rival'; it is called 'baseline' now"),
        ({"picture_spp": 4}, "'picture_spp'; it is called 'eval_spp' now"),
        ({"memory": "8 GB"}, "'memory'; it is called 'memory_limit' now"),
        ({"optimizer": {"type": "l-bfgs-b", "memory": 3}}, "'optimizer.memory'; it is called 'history_size' now"),
        ({"auto_spp": {"ratio": 1}}, "'auto_spp'; it is called 'adaptive_spp' now"),
        ({"parameters": [{"key": "x", "smooth": 3.0}]}, "'parameters.0.smooth'; it is called 'large_steps_lambda' now"),
        ({"parameters": [{"key": "x", "start": {}}]}, "'parameters.0.start'; it is called 'initial' now"),
    ],
)
def test_an_old_name_leads_to_the_new_one(old: dict[str, object], new: str) -> None:
    job = {"scene": "cornell-box", "parameters": [{"key": "x"}], "target": {"values": {"x": 1.0}}}
    with pytest.raises(PathreplayError) as told:
        make_config({**job, **old})
    assert f"unknown key {new}" in str(told.value)


def test_d_is_for_scene_parameters() -> None:
    told = CliRunner().invoke(app, ["optimize", "job.toml", "-D", "spp=32"])
    assert isinstance(told.exception, PathreplayError)
    assert str(told.exception) == "-D is for scene parameters; change a job with: --set spp=32"


OLD = (
    "learning_rate_decay warm_up views_per_step pixels_per_step picture_spp hold_out_every sample_ranges rival "
    "non_finite_in_a_row signal_to_noise auto_spp smoothdielectric sweeps_pixels render_and_backward restore_learned "
    "edge_spp pathreplay_tape pathreplay_rb pathreplay_listing"
).split()


#: Files that answer old names of keys and of properties with the new ones.
NAMES_THEM = ("errors.py", "integrator.py")


def test_no_old_name_is_left() -> None:
    root = ROOT
    files = [root / "README.md", *(root / "docs").glob("*.md"), *(root / "examples").rglob("*.[tm][od]*")]
    files += [path for path in (root / "src").rglob("*.py") if path.name not in NAMES_THEM]
    words = re.compile(r"\b(" + "|".join(OLD) + r")\b")
    found = [f"{file.name}: {word[0]}" for file in files for word in words.finditer(file.read_text(encoding="utf-8"))]
    assert len(files) > 250 and not found
