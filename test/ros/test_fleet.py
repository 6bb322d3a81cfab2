"""The launch file of a fleet: the nodes that it starts, and three dampers side by side."""

from pathlib import Path
from typing import Any

import launch_stand_in
import pytest
from mr_damper_msgs.msg import DamperParameters, FitReport, PredictedForce
from support import Listener

from mr_damper_ros.nodes.quality import latched
from mr_damper_ros.processes.programs import hosting

FILE = Path(__file__).parents[2] / "launch" / "fleet.launch.py"


@pytest.fixture
def description(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Description returned by the launch file."""
    return launch_stand_in.load(FILE, monkeypatch).generate_launch_description()


def bridges(started: list[Any]) -> list[Any]:
    return [node for node in started if node.executable == "bridge"]


def test_every_damper_has_a_bridge_and_a_place_at_identifier_and_model(
    description: list[Any],
) -> None:
    started = launch_stand_in.nodes(description, {"dampers": "left right"})
    assert [node.namespace for node in bridges(started)] == ["left", "right"]
    for name in ("identifier", "model"):
        (host,) = (node for node in started if node.executable == name)
        places = hosting(host.arguments).places
        assert [place.namespace for place in places] == ["left", "right"]
        assert all(place.file.endswith(f"config/{name}.yaml") for place in places)
    started = launch_stand_in.nodes(description, {"dampers": "8"})
    assert [node.namespace for node in bridges(started)] == [f"damper_{k}" for k in range(1, 9)]


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
    (first,) = bridges(launch_stand_in.nodes(description, {"dampers": "left"}))
    with pytest.raises(RuntimeError, match="left/bridge has ended with exit code 2"):
        first.on_exit(event, launch_stand_in.Context())
    assert first.on_exit(event, launch_stand_in.Context(is_shutdown=True)) is None


def test_dampers_share_workers_and_are_identified_side_by_side(
    start: Any, listener: Listener, description: list[Any]
) -> None:
    dampers = ("left", "middle", "right")
    reports = {side: listener.listen(FitReport, f"/{side}/damper/fit_report") for side in dampers}
    forces = {
        side: listener.listen(PredictedForce, f"/{side}/damper/predicted_force") for side in dampers
    }
    identifier, *others = launch_stand_in.nodes(description, {"dampers": " ".join(dampers)})
    fitting = start(identifier.executable, "--workers", "1", *identifier.arguments)
    for node in others:
        options, parameters = launch_stand_in.command_line(node)
        start(node.executable, *options, **parameters)
    listener.until(
        lambda: all(reports[side] and forces[side] for side in dampers), "reports of all dampers"
    )
    assert len(fitting.children) == 1


def test_each_namespace_takes_its_own_parameters(
    start: Any, listener: Listener, tmp_path: Path
) -> None:
    places = []
    for name, law in (("left", "bingham"), ("right", "sigmoid_lag")):
        file = tmp_path / f"{name}.yaml"
        file.write_text(f"/**:\n  ros__parameters:\n    model: {law}\n")
        places += ["--namespace", f"{name}={file}"]
    sets = {
        name: listener.listen(DamperParameters, f"/{name}/damper/parameters", latched())
        for name in ("left", "right")
    }
    start("identifier", *places)
    listener.until(lambda: all(sets.values()), "the sets of both")
    assert {name: found[-1].model for name, found in sets.items()} == {
        "left": "bingham",
        "right": "sigmoid_lag",
    }
