"""The launch file: the nodes that it starts, checked without launch, and with it if installed."""

import signal
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import launch_stand_in
import pytest
from mr_damper_msgs.msg import DamperParameters, PredictedForce
from rosgraph_msgs.msg import Clock
from support import PATIENCE, Listener

from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.bridge_node import BridgeParameters
from mr_damper_ros.nodes.replay_node import ReplayParameters
from mr_damper_ros.settings.option_table import options

ROOT = Path(__file__).parents[2]
FILE = ROOT / "launch" / "identify.launch.py"
BAG = ROOT / "bags" / "5.0mm_1Hz_1.5A"

Arguments = dict[str, str]


@pytest.fixture
def description(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Description returned by the launch file."""
    loaded = launch_stand_in.load(FILE, monkeypatch)
    return loaded.generate_launch_description()


def by_name(description: list[Any], **arguments: str) -> dict[str, Any]:
    return {node.name: node for node in launch_stand_in.nodes(description, arguments)}


def test_what_is_started_follows_the_arguments(description: list[Any]) -> None:
    arguments = [item for item in description if isinstance(item, launch_stand_in.Argument)]
    assert len(arguments) >= 10
    assert all(argument.description.endswith(".") for argument in arguments)
    nodes = by_name(description)
    assert list(nodes) == ["bridge", "identifier", "model"]
    assert nodes["model"].parameters[1] == {"use_sim_time": False}
    assert list(by_name(description, live="true")) == ["bridge", "identifier", "model", "live"]
    nodes = by_name(description, control="true")
    assert list(nodes) == ["bridge", "identifier", "model", "controller"]
    assert nodes["bridge"].parameters[1]["wait_for_subscribers"] == 3
    file = str(ROOT / "config" / "invented_damper.yaml")
    nodes = by_name(description, control="true", parameters=file)
    assert "parameter_file" not in nodes["bridge"].parameters[1]
    assert nodes["identifier"].parameters[1]["initial_parameters"].value == file
    assert nodes["model"].parameters[1]["parameter_file"].value == file
    assert nodes["controller"].parameters[1]["parameter_file"].value == file
    nodes = by_name(description, bag=str(BAG))
    assert list(nodes) == ["replay", "identifier", "model"]
    assert nodes["replay"].parameters[1]["topics"].value == "inputs"
    assert nodes["identifier"].parameters[1] == {"use_sim_time": True}
    for arguments, table in (({}, BridgeParameters), ({"bag": str(BAG)}, ReplayParameters)):
        first = launch_stand_in.nodes(description, arguments)[0]
        assert set(first.parameters[1]) <= {item.name for item in options(table)}
    nodes = by_name(description, enclave="/left/")
    for name, node in nodes.items():
        assert node.ros_arguments == ["--enclave", f"/left/{name}"]


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        ({"use_sim_time": "maybe"}, "maybe"),
        ({"loop": "perhaps"}, "perhaps"),
        ({"at_end": "explode"}, "explode"),
        ({"rate": "fast"}, "rate must be a number"),
        ({"rate": "-1"}, "rate must be a number"),
        ({"rate": "nan"}, "rate must be a number"),
        ({"bag": "/nowhere/at/all"}, "there is no bag /nowhere/at/all"),
        ({"parameters": "/nowhere.yaml"}, "parameters: there is no file"),
        ({"model_config": "/nowhere.yaml"}, "model_config: there is no file"),
    ],
)
def test_a_wrong_argument_is_refused_before_anything_starts(
    description: list[Any], arguments: Arguments, part: str
) -> None:
    with pytest.raises(RuntimeError, match=part):
        launch_stand_in.nodes(description, arguments)


def end(node: Any, code: int, *, is_shutdown: bool = False) -> Any:
    """Actions after the end of a node."""
    return node.on_exit(SimpleNamespace(returncode=code), SimpleNamespace(is_shutdown=is_shutdown))


def test_it_ends_after_the_bag_unless_it_shall_stay(description: list[Any]) -> None:
    (timer,) = end(by_name(description, bag=str(BAG))["replay"], 0)
    assert timer.period > 0.0
    assert len(timer.actions) == 1
    assert end(by_name(description, bag=str(BAG), at_end="stay")["replay"], 0) is None
    assert end(by_name(description)["model"], -15, is_shutdown=True) is None


@pytest.mark.parametrize("name", ["bridge", "identifier", "model"])
def test_it_fails_with_any_node(description: list[Any], name: str) -> None:
    node = by_name(description)[name]
    with pytest.raises(RuntimeError, match=f"{name} has ended with exit code 2"):
        end(node, 2)


def test_two_bags_in_two_namespaces_have_a_clock_each(
    start: Any, listener: Listener, description: list[Any]
) -> None:
    # The samples have no subscriber here: each replay waits for identifier and model.
    clocks = {}
    for side in ("left", "right"):
        clocks[side] = listener.listen(Clock, f"/{side}/clock")
        arguments = {"bag": str(BAG), "namespace": side, "clock": f"/{side}/clock", "rate": "20.0"}
        for node in launch_stand_in.nodes(description, arguments):
            options_given, parameters = launch_stand_in.command_line(node)
            start(node.executable, *options_given, **parameters)
    left = listener.listen(PredictedForce, "/left/damper/predicted_force")
    sets = listener.listen(DamperParameters, "/right/damper/parameters", quality.latched())
    listener.until(lambda: left and len(sets) >= 2, "forces on the left, a new set on the right")
    assert all(clocks.values())
    assert listener.node.count_publishers("/clock") == 0
    assert listener.node.count_subscribers("/clock") == 0


def test_a_bag_is_identified_and_its_force_predicted(listener: Listener) -> None:
    pytest.importorskip("ros2launch", reason="ros2 launch is not installed")
    force = listener.listen(PredictedForce, "/left/damper/predicted_force")
    parameters = listener.listen(DamperParameters, "/left/damper/parameters", quality.latched())
    arguments = [f"bag:={BAG}", "rate:=2.0", "namespace:=left"]
    launch = subprocess.Popen(["ros2", "launch", str(FILE), *arguments], start_new_session=True)
    try:
        listener.until(lambda: force and len(parameters) >= 2, "predictions and a new set")
    finally:
        launch.send_signal(signal.SIGINT)
        code = launch.wait(PATIENCE)
    assert code == 0
