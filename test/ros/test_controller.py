"""The controller as a process: commands for a desired force, otherwise the safe current."""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from mr_damper_msgs.msg import CurrentCommand, DesiredForce
from press import BLOCK, Press
from rclpy.duration import Duration
from support import Listener

from mr_damper_ros.control.force_controller import ForceController, ForceControlSettings
from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import CONDITIONS, parameters
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import header
from mr_damper_ros.signals.blocks import SampleBlock
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.tracking.validity import DoubtKind

ROOT = Path(__file__).parents[2]
BAG = ROOT / "bags" / "5.0mm_1Hz_1.5A"
CONDITION = next(condition for condition in CONDITIONS if condition.name == BAG.name)
KNOWN = ParameterSet(
    parameters(CONDITION), set_id="known", peak_velocity_range=(0.0, 0.1), current_range=(0.0, 2.0)
)
WANTED = 300.0
"""[N]; the damper reaches it in extension, but not in compression."""

SAFE = 0.25


@pytest.fixture(scope="module")
def recording() -> Recording:
    return read_bag(BAG)[0]


@pytest.fixture
def known(tmp_path: Path) -> Path:
    path = tmp_path / "known.yaml"
    KNOWN.save(path)
    return path


def block(recording: Recording, first: int) -> SampleBlock:
    part = slice(first, first + BLOCK)
    return SampleBlock(
        recording.stamp_ns(first),
        first,
        recording.period,
        recording.displacement[part],
        recording.force[part],
    )


def test_the_commands_are_those_of_the_core(
    start: Any, listener: Listener, recording: Recording, known: Path
) -> None:
    commands = listener.listen(CurrentCommand, "supply/current_command", quality.lossless())
    start(
        "controller", parameter_file=known, demand_timeout=3600.0, max_age=0.0, samples_timeout=60.0
    )
    press = Press(listener)
    demand = listener.node.create_publisher(DesiredForce, "damper/desired_force", 1)
    listener.until(lambda: demand.get_subscription_count() == 1, "the controller's subscription")
    demand.publish(DesiredForce(header=header(recording.start_ns, "damper"), force=WANTED))
    assert demand.wait_for_all_acked(Duration(seconds=30))
    listener.wait_for_finding("controller: command", "no samples arrive")
    commands.clear()
    press.run(recording)
    count = math.ceil(recording.sample_count / BLOCK)
    listener.until(lambda: len(commands) >= count, "a command for every block")

    core = ForceController(ForceControlSettings(demand_timeout=3600.0))
    core.predictor.set_parameters(KNOWN)
    core.want(recording.start_ns, WANTED)
    for index in (*range(0, recording.sample_count, BLOCK), recording.sample_count - 1):
        core.predictor.add_current(recording.stamp_ns(index), float(recording.current[index]))
    expected = []
    for first in range(0, recording.sample_count, BLOCK):
        expected.append(core.command(block(recording, first)))
        core.predictor.catch_up()
    got = [command.current for command in commands[:count]]
    np.testing.assert_allclose(got, [command.current for command in expected])
    assert any(not command.doubt and command.attainable for command in expected)
    assert len({round(current, 3) for current in got}) > 3
    status = listener.wait_for_finding("controller: tracking", "")
    assert status.level in (DiagnosticStatus.OK, DiagnosticStatus.WARN)


def test_without_samples_the_safe_current_is_commanded_again_and_again(
    start: Any, listener: Listener, known: Path
) -> None:
    commands = listener.listen(CurrentCommand, "supply/current_command")
    controller = start("controller", parameter_file=known, safe_current=SAFE)
    listener.until(lambda: len(commands) >= 5, "commands")
    controller.stop()
    assert {command.current for command in commands} == {SAFE}
    assert all(command.header.stamp.sec > 0 for command in commands)


def test_when_it_ends_the_supply_is_left_with_the_safe_current(
    start: Any, listener: Listener, known: Path
) -> None:
    commands = listener.listen(CurrentCommand, "supply/current_command")
    controller = start("controller", parameter_file=known, safe_current=SAFE, samples_timeout=60.0)
    listener.wait_for_publishers("supply/current_command")
    listener.wait_for_finding("controller: command", "the safe current")
    controller.stop()
    listener.until(partial(bool, commands), "the last command")
    assert commands[-1].current == SAFE


def test_it_says_what_it_lacks(start: Any, listener: Listener, recording: Recording) -> None:
    start("controller", max_age=0.0)
    press = Press(listener)
    press.run(recording)
    status = listener.wait_for_finding("controller: command", "no parameters yet")
    assert {value.key: value.value for value in status.values}["doubt"] == DoubtKind.MISSING.name
    listener.wait_for_finding("controller: tracking", "no desired force has been given")
    demand = listener.node.create_publisher(DesiredForce, "damper/desired_force", 1)
    listener.until(demand.get_subscription_count, "the controller's subscription")
    demand.publish(DesiredForce(header=header(recording.start_ns, "damper"), force=WANTED))
    assert demand.wait_for_all_acked(Duration(seconds=30))
    press.run(replace(recording, start_ns=recording.start_ns + 10**10))
    listener.wait_for_finding("controller: tracking", "no desired force was attainable")
