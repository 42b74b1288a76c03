"""Jobs in YAML: the same job as in TOML, and the same answers to what is none."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from pathreplay.errors import PathreplayError
from pathreplay.jobs import load_config, make_config, optimize
from wall_job import JOB

pytestmark = pytest.mark.usefixtures("wall_room")

TEXT = """
scene: room.xml
integrator: {type: prb, max_depth: 2}
iterations: 8
spp: 4
eval_spp: 4
deterministic: true
learning_rate: 2e-2   # no text, as it is to YAML 1.1
parameters:
- key: wall.bsdf.reflectance.value
  initial: [.2, 0.5, 7e-1]
target:
  spp: 016
  values:
    wall.bsdf.reflectance.value: [0.6, 0.5, 0.1]
"""


@pytest.mark.parametrize("name", ["job.yaml", "job.YML"])
def test_a_job_in_yaml_is_the_one_in_toml(name: str) -> None:
    Path(name).write_text(TEXT)
    assert load_config(Path(name)) == make_config({**JOB, "learning_rate": 0.02})
    assert load_config(Path(name), ["spp=32"]).spp == 32


@pytest.mark.slow
def test_a_run_keeps_its_yaml_and_goes_on_from_it() -> None:
    Path("job.yaml").write_text(TEXT.replace("iterations: 8", "iterations: 1"))
    folder = optimize("job.yaml", progress=False).folder
    kept = folder / "config.yaml"
    assert kept.read_bytes() == Path("job.yaml").read_bytes()
    kept.write_text(kept.read_text().replace("iterations: 1", "iterations: 2"))
    assert optimize(resume=folder, progress=False).iterations == 2


REFUSED = {
    "spp: yes": "'spp' is 'yes'",
    "spp: 0b11": "'spp' is '0b11'",
    "spp: 0o18": "'spp' is '0o18'",
    "spp: -0x10": "'spp' is '-0x10'",
    "spp: 1:30": "'spp' is '1:30'",
    "seed: 2001-01-01": "'seed' is '2001-01-01'",
    "warmup_steps: .nan": "'warmup_steps' is nan",
    "spp:": "'spp' is None",
    "spp: 16": "'spp' is given twice",
    "spq: 16": "unknown key 'spq'; did you mean 'spp'?",
    "seed: &a 3": "anchors and aliases are not supported",
    "seed: *a": "anchors and aliases are not supported",
    "seed: !!python/object/apply:os.system [touch harm]": "the tag 'tag:yaml.org,2002:python/object/apply:os.system'",
    "seed: !!int three": "is not supported",
    "3: 4": "a key is not a string",
    "? [a, b]\n: 4": "a key is not a string",
    "seed: " + "[" * 3000 + "]" * 3000: "nested too deeply",
    "seed: " + "{a: " * 100 + "1" + "}" * 100: "nested too deeply",
    "seed: " + "9" * 5000: "more digits than Python reads",
    "seed: [1, 2": "is not valid YAML",
    "--- \nseed: 3": "is not valid YAML",
    "seed: \x07": "is not valid YAML",
    "<<: {spp: 3}": "unknown key '<<'",
}


@pytest.mark.parametrize("line", REFUSED)
def test_what_is_no_job_is_told_in_one_line(line: str) -> None:
    text = TEXT if "given twice" in REFUSED[line] or not line.startswith("spp") else TEXT.replace("spp: 4\ne", "e", 1)
    Path("job.yaml").write_text(f"{text}{line}\n")
    with pytest.raises(PathreplayError) as told:
        load_config(Path("job.yaml"))
    assert REFUSED[line] in str(told.value) and "job.yaml" in str(told.value) and "\n" not in str(told.value)
    assert not Path("harm").exists()


@pytest.mark.parametrize(("text", "number"), [("0o17", 15), ("0x1F", 31), ("010", 10), ("+7", 7)])
def test_whole_numbers_are_those_of_yaml_1_2(text: str, number: int) -> None:
    Path("job.yaml").write_text(f"{TEXT}seed: {text}\n")
    assert load_config(Path("job.yaml")).seed == number


def test_what_a_program_writes_comes_back() -> None:
    values = {**JOB, "seed": 17, "learning_rate": 1e-7, "output": "yes", "scene_parameters": {"a": "12", "b": False}}
    Path("job.yaml").write_text(yaml.safe_dump(values))
    assert load_config(Path("job.yaml")) == make_config(values)


def test_a_file_that_would_take_long_to_read_is_no_job() -> None:
    Path("job.yaml").write_text("- [1, 2]\n" * 40_000)
    with pytest.raises(PathreplayError, match="has 360000 bytes, more than the limit of 262144"):
        load_config(Path("job.yaml"))


@pytest.mark.parametrize("text", ["", "- a", "3", "null"])
def test_a_file_without_a_table_is_no_job(text: str) -> None:
    Path("job.yaml").write_text(text)
    with pytest.raises(PathreplayError, match="write a table"):
        load_config(Path("job.yaml"))
