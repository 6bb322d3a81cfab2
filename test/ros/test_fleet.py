"""The launch file of a fleet: what it would start, and two dampers side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import launch_stand_in
import pytest
from mr_damper_msgs.msg import FitReport, PredictedForce
from support import Listener

FILE = Path(__file__).parents[2] / "launch" / "fleet.launch.py"


@pytest.fixture
def description(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What the launch file describes."""
    made: list[Any] = launch_stand_in.load(FILE, monkeypatch).generate_launch_description()
    return made


def test_every_damper_has_three_nodes_in_its_namespace(description: list[Any]) -> None:
    started = launch_stand_in.nodes(description, {"dampers": "left right"})
    assert [(node.namespace, node.name) for node in started] == [
        (side, name) for side in ("left", "right") for name in ("bridge", "identifier", "model")
    ]


def test_dampers_can_be_counted(description: list[Any]) -> None:
    started = launch_stand_in.nodes(description, {"dampers": "8"})
    assert {node.namespace for node in started} == {f"damper_{k}" for k in range(1, 9)}


def test_each_damper_may_have_a_file_of_its_own(description: list[Any], tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / f"{name}.yaml").touch()
    given = {"dampers": "a b", "bridge_config": str(tmp_path / "{damper}.yaml")}
    files = [n.parameters[0] for n in launch_stand_in.nodes(description, given)][::3]
    assert files == [str(tmp_path / "a.yaml"), str(tmp_path / "b.yaml")]


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"dampers": ""}, "dampers is empty"),
        ({"dampers": "0"}, "dampers is empty"),
        ({"dampers": "left left"}, "the same name"),
        ({"dampers": "left-hand"}, "cannot be called 'left-hand'"),
        ({"model_config": "/nowhere/{damper}.yaml"}, "there is no file /nowhere/damper_1.yaml"),
    ],
)
def test_a_wrong_argument_is_refused(
    description: list[Any], given: dict[str, str], sentence: str
) -> None:
    with pytest.raises(RuntimeError, match=sentence):
        launch_stand_in.nodes(description, given)


def test_it_fails_with_any_node(description: list[Any]) -> None:
    event = launch_stand_in.Action(returncode=2)
    (first, *_) = launch_stand_in.nodes(description, {"dampers": "left"})
    with pytest.raises(RuntimeError, match="left/bridge has ended with exit code 2"):
        first.on_exit(event, launch_stand_in.Context())
    assert first.on_exit(event, launch_stand_in.Context(is_shutdown=True)) is None


def test_two_dampers_are_identified_side_by_side(
    start: Any, listener: Listener, description: list[Any]
) -> None:
    sides = ("left", "right")
    reports = {side: listener.listen(FitReport, f"/{side}/damper/fit_report") for side in sides}
    forces = {
        side: listener.listen(PredictedForce, f"/{side}/damper/predicted_force") for side in sides
    }
    for node in launch_stand_in.nodes(description, {"dampers": " ".join(sides)}):
        options, parameters = launch_stand_in.command_line(node)
        start(node.executable, *options, **parameters)
    listener.until(
        lambda: all(reports[side] and forces[side] for side in sides), "reports of both dampers"
    )
