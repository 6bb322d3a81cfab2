"""Modules that the nodes import: none is heavy or unused, and a missing one is named."""

import pytest
from fresh_python import alone


@pytest.mark.parametrize(
    "modules",
    [
        "mr_damper_ros.tracking.predictor",
        "mr_damper_ros.tracking.tracker, mr_damper_ros.tracking.tracker_state",
        "mr_damper_ros.tracking.identifier, mr_damper_ros.processes.worker",
        "mr_damper_ros.io.bag_reader, mr_damper_ros.io.bag_writer, mr_damper_ros.io.records",
        "mr_damper_ros.rig.sources",
    ],
)
def test_a_node_starts_without_scipy(modules: str) -> None:
    assert "scipy" not in loaded_by(modules)


def test_what_a_source_alone_needs_is_loaded_when_it_is_opened() -> None:
    loaded = loaded_by("mr_damper_ros.rig.sources")
    assert not loaded & {"rosbags", "csv", "serial", "mr_damper_ros.io.records"}


@pytest.mark.parametrize("name", ["check", "live", "watch"])
def test_a_tool_that_needs_ros_says_so_where_it_is_missing(name: str) -> None:
    said = alone(
        "import sys; from contextlib import redirect_stderr; sys.modules['rclpy'] = None; "
        "from mr_damper_ros.__main__ import main\n"
        f"with redirect_stderr(sys.stdout): code = main([{name!r}])\n"
        "print(code)"
    )
    sentence, code = said.splitlines()
    assert "needs ROS 2" in sentence
    assert code == "2"


def loaded_by(modules: str) -> set[str]:
    """All modules in a fresh interpreter after these imports."""
    return set(alone(f"import {modules}; print(*sys.modules)").split())
