"""An invalid configuration gives one sentence and an exit code at the start."""

from pathlib import Path
from typing import Any

import pytest
from support import assert_one_sentence

BAG = Path(__file__).parents[2] / "bags" / "5.0mm_1Hz_1.5A"

TOPICS = {
    "source": "topics",
    "topics__displacement_topic": "press/joints",
    "topics__displacement_field": "position[rod]",
    "topics__force_field": "effort[rod]",
}

PARAMETERS: list[tuple[str, dict[str, object], str]] = [
    ("bridge", {"source": "tape"}, "source must be one of bag, record, quarter_car, emulated"),
    ("bridge", {"sorce": "bag"}, "there is no parameter sorce: did you mean source?"),
    ("bridge", {"source": "bag", "bag": "/nowhere/at/all"}, "there is no bag"),
    ("bridge", {"source": "record", "record__file": "/nowhere"}, "record.columns is empty"),
    ("bridge", {"emulated__damper": "5mm"}, "no condition '5mm'"),
    ("bridge", {"use_sim_time": 3}, "use_sim_time"),
    ("bridge", {**TOPICS, "topics__force_type": "no_msgs/Thing"}, "not an installed message type"),
    ("bridge", {**TOPICS, "topics__force_type": "std_msgs/Float64"}, "no header with a stamp"),
    ("bridge", {**TOPICS, "topics__force_field": "effort[rod"}, "force_field is 'effort[rod'"),
    ("bridge", {**TOPICS, "topics__displacement_topic": "joint_states"}, "set mirror_rate to 0"),
    ("campaign", {"autostart": True}, "autostart needs a folder"),
    ("campaign", {"machine.motions": "sine square"}, "the motion 'square' is unknown"),
    ("identifier", {"hop": 3.0}, "hop (3 s) is longer than window (2 s)"),
    ("identifier", {"initial_parameters": "/nowhere.yaml"}, "initial_parameters: cannot"),
    ("identifier", {"state_dir": "/dev/null/state"}, "state_dir: cannot"),
    ("live", {"port": 0, "allowed_hosts": "http://rig"}, "allowed_hosts"),
    ("model", {"parameter_file": "/nowhere.yaml"}, "No such file"),
    ("replay", {}, "no bag is given"),
    ("replay", {"bag": BAG, "topics": "/mts/samples /nothing"}, "has no topic /nothing"),
    ("supply", {"address": "127.0.0.1:1"}, "127.0.0.1:1: Connection refused"),
    ("supply", {"profile": "mine"}, "the profile 'mine' cannot be read"),
    ("supply", {"watchdog": 0.05, "rate": 20.0}, "watchdog is 0.05 s"),
    ("suspension", {"function": "nowhere_at_all:f"}, "PYTHONPATH"),
]

OVERRIDE = "qos_overrides./mts/samples.subscription"

ARGUMENTS = [
    ("bridge", ["--rate=2"], "--rate"),
    ("model", ["--ros-args", "-p", f"{OVERRIDE}.reliability:=foo"], "must be one of reliable"),
    ("model", ["--ros-args", "-p", f"{OVERRIDE}.durability:=volatile"], "is not an override"),
]


@pytest.mark.parametrize(
    ("node", "arguments", "parameters", "part"),
    [(node, [], parameters, part) for node, parameters, part in PARAMETERS]
    + [(node, arguments, {}, part) for node, arguments, part in ARGUMENTS],
)
def test_what_a_node_cannot_work_with_is_one_sentence(
    start: Any, node: str, arguments: list[str], parameters: dict[str, object], part: str
) -> None:
    program = start(node, *arguments, **parameters)
    assert program.wait() == 2
    assert part in program.errors
    assert_one_sentence(program.errors)


@pytest.mark.parametrize("node", ["bridge", "model"])
def test_a_file_that_cannot_be_used_is_one_sentence(start: Any, tmp_path: Path, node: str) -> None:
    file = tmp_path / "file.yaml"
    if node == "bridge":
        file.write_text("/**:\n  ros__parameters:\n    rate: [1, fast]\n", encoding="utf-8")
        program = start("bridge", "--ros-args", "--params-file", str(file), "--")
        part = "the command line cannot be used"
    else:
        file.write_text("a: [", encoding="utf-8")
        program = start("model", parameter_file=file)
        part = "not valid YAML"
    assert program.wait() == 2
    assert part in program.errors
    assert_one_sentence(program.errors)


def test_help_lists_the_parameters(start: Any) -> None:
    program = start("bridge", "--help")
    assert program.wait() == 0
    assert "emulated.hot_force" in program.output
