"""The launch files; they run only where launch is installed."""

from __future__ import annotations

import ast
import importlib.util
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest
from mr_damper_msgs.msg import DamperParameters, PredictedForce
from support import PATIENCE, Listener

from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.bridge_node import BridgeParameters
from mr_damper_ros.nodes.parameter_table import options
from mr_damper_ros.nodes.replay_node import ReplayParameters

ROOT = Path(__file__).parents[2]
FILE = ROOT / "launch" / "identify.launch.py"
BAG = ROOT / "bags" / "5.0mm_1Hz_1.5A"


def description() -> Any:
    pytest.importorskip("launch_ros", reason="launch is not installed")
    spec = importlib.util.spec_from_file_location("identify_launch", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.generate_launch_description()


def test_it_is_python_and_sets_only_parameters_that_exist() -> None:
    tree = ast.parse(FILE.read_text(encoding="utf-8"))
    source = next(
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "source"
    )
    assert isinstance(source, ast.Dict)
    names = {ast.literal_eval(key) for key in source.keys if key is not None}
    for table in (BridgeParameters, ReplayParameters):
        assert names <= {item.name for item in options(table)}


def test_its_arguments_are_described() -> None:
    arguments = {argument.name: argument for argument in description().get_launch_arguments()}
    assert {"bag", "rate", "loop", "namespace", "use_sim_time"} <= set(arguments)
    assert all(argument.description for argument in arguments.values())


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
