"""The model as a process: a prediction for every block, and the reason where it is not valid."""

from __future__ import annotations

import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from geometry_msgs.msg import WrenchStamped
from mr_damper_msgs.msg import DamperParameters, PredictedForce
from press import BAD_BLOCKS, BLOCK, Press, block_message
from support import Listener, assert_one_sentence

from mr_damper_ros.damper.parameters import ParameterSet
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import from_field, to_nanoseconds
from mr_damper_ros.nodes.model import ModelParameters
from mr_damper_ros.nodes.parameters import options
from mr_damper_ros.nodes.results import parameter_set, parameters_message
from mr_damper_ros.rig.bags import read_bag
from mr_damper_ros.rig.recording import Recording
from mr_damper_ros.rig.thesis import CONDITIONS, parameters

ROOT = Path(__file__).parents[2]
BAG = ROOT / "bags" / "5.0mm_1Hz_1.5A"
CONDITION = next(condition for condition in CONDITIONS if condition.name == BAG.name)
TRUE_SET = ParameterSet(
    parameters(CONDITION),
    standard_errors=np.linspace(0.1, 1.6, 16),
    observable=np.arange(16) % 2 == 0,
    set_id="true",
    source="file",
    peak_velocity_range=(0.03, 0.033),
    current_range=(1.5, 1.5),
    nrmse=0.005,
    stamp_ns=1_700_000_000_000_000_001,
)
SETTLED = 2.5
"""Seconds after which observer and centre of a motion of 1 Hz have settled."""


@pytest.fixture(scope="module")
def recording() -> Recording:
    return read_bag(BAG)[0]


@pytest.fixture
def forces(listener: Listener) -> list[PredictedForce]:
    return listener.listen(PredictedForce, "damper/predicted_force", quality.lossless())


@pytest.fixture
def parameter_file(tmp_path: Path) -> Path:
    path = tmp_path / "true.yaml"
    path.write_text(TRUE_SET.to_yaml())
    return path


def run(
    listener: Listener, press: Press, forces: list[PredictedForce], recording: Recording, **how: Any
) -> list[PredictedForce]:
    """Publish a recording and wait for the predictions of all its blocks."""
    forces.clear()
    listener.until(
        lambda: listener.node.count_publishers("damper/predicted_force"), "the model's topic"
    )
    blocks = press.run(recording, **how)
    listener.until(lambda: len(forces) >= len(blocks), "a prediction for every block")
    assert [f.seq for f in forces] == [b.seq for b in blocks]
    assert [f.header for f in forces] == [b.header for b in blocks]
    assert [len(f.force) for f in forces] == [len(b.force) for b in blocks]
    assert {f.period for f in forces} == {recording.period}
    assert all(f.valid == (not f.reason) for f in forces)
    return list(forces)


def test_the_configuration_file_has_every_parameter_with_its_default() -> None:
    text = (ROOT / "config" / "model.yaml").read_text()
    assert yaml.safe_load(text)["/**"]["ros__parameters"] == {
        item.name: item.default for item in options(ModelParameters)
    }


def test_a_parameter_set_passes_through_its_message_unchanged() -> None:
    again = parameter_set(parameters_message(TRUE_SET, "damper"))
    assert again.to_yaml() == TRUE_SET.to_yaml()


def test_with_a_parameter_file_it_works_alone(
    start: Any,
    listener: Listener,
    forces: list[PredictedForce],
    recording: Recording,
    parameter_file: Path,
) -> None:
    wrenches = listener.listen(WrenchStamped, "damper/predicted_wrench", quality.lossless())
    start("model", parameter_file=parameter_file, wrench_rate=5.0)
    predicted = run(listener, Press(listener), forces, recording)
    assert {f.parameter_set for f in predicted} == {"true"}

    first = int(SETTLED / recording.period) // BLOCK
    assert not predicted[0].valid
    assert {f.reason for f in predicted[first:]} == {""}
    force = np.concatenate([from_field(f.force) for f in predicted])
    measured = recording.force[first * BLOCK :]
    nrmse = np.sqrt(np.mean((force[first * BLOCK :] - measured) ** 2)) / np.std(measured)
    assert nrmse < 0.05
    assert listener.wait_for_finding("model: prediction", "valid; NRMSE")

    valid = [f for f in predicted if f.valid]
    assert 0 < len(wrenches) <= 5 * len(valid) * BLOCK * recording.period + 1
    by_stamp = {to_nanoseconds(f.header.stamp): f for f in valid}
    for wrench in wrenches:
        start_ns = to_nanoseconds(wrench.header.stamp) - (BLOCK - 1) * 1_000_000
        if start_ns in by_stamp:  # All but the last block, which is shorter.
            assert wrench.wrench.force.x == by_stamp[start_ns].force[-1]
    stamps = np.array([to_nanoseconds(wrench.header.stamp) for wrench in wrenches])
    assert (np.diff(stamps) >= 200_000_000).all()


def test_what_is_missing_makes_the_force_invalid_with_the_reason(
    start: Any, listener: Listener, forces: list[PredictedForce], recording: Recording
) -> None:
    latched = listener.node.create_publisher(
        DamperParameters, "damper/parameters", quality.latched()
    )

    def use(parameters: ParameterSet) -> None:
        latched.publish(parameters_message(parameters, "damper"))
        listener.wait_for_finding("model: parameters", f"predicting with {parameters.set_id}")

    start("model")
    listener.wait_for_finding("model: input", "nobody publishes mts/samples")
    listener.wait_for_finding("model: parameters", "no parameters yet")
    press = Press(listener)
    nothing = run(listener, press, forces, recording)
    assert {(f.valid, f.parameter_set) for f in nothing} == {(False, "")}
    assert "no parameters yet" in nothing[-1].reason
    assert np.isnan(nothing[-1].force).all()
    listener.wait_for_finding("model: prediction", "not valid: no parameters yet")

    use(TRUE_SET)
    later = replace(recording, start_ns=recording.start_ns + 10**10)
    fresh = run(listener, press, forces, later)
    assert fresh[-1].valid
    assert fresh[-1].parameter_set == "true"

    stale = replace(recording, start_ns=recording.start_ns + 3 * 10**10)
    old = run(listener, press, forces, stale, with_current=False)
    assert not any(f.valid for f in old)
    assert "current is" in old[-1].reason
    assert "old" in old[-1].reason

    use(replace(TRUE_SET, set_id="other current", current_range=(0.0, 0.5)))
    again = replace(recording, start_ns=recording.start_ns + 5 * 10**10)
    outside = run(listener, press, forces, again)
    assert not any(f.valid for f in outside)
    assert "current of 1.50 A is outside of the identified 0.00 to 0.50 A" in outside[-1].reason
    use(replace(TRUE_SET, set_id="other speed", peak_velocity_range=(0.1, 0.2)))
    again = replace(recording, start_ns=recording.start_ns + 7 * 10**10)
    outside = run(listener, press, forces, again)
    assert not any(f.valid for f in outside)
    assert "outside of the identified 0.1 to 0.2 m/s" in outside[-1].reason


def test_without_a_current_the_force_is_invalid(
    start: Any,
    listener: Listener,
    forces: list[PredictedForce],
    recording: Recording,
    parameter_file: Path,
) -> None:
    start("model", parameter_file=parameter_file)
    predicted = run(listener, Press(listener), forces, recording, with_current=False)
    assert not any(f.valid for f in predicted)
    assert "no supply current yet" in predicted[-1].reason


def test_parameters_that_cannot_be_used_are_refused(
    start: Any, listener: Listener, forces: list[PredictedForce], recording: Recording
) -> None:
    latched = listener.node.create_publisher(
        DamperParameters, "damper/parameters", quality.latched()
    )
    start("model")
    good = parameters_message(TRUE_SET, "damper")
    latched.publish(good)
    listener.wait_for_finding("model: parameters", "predicting with true")
    for field, value, sentence in (
        ("model", "bouc_wen", "for the model 'bouc_wen'"),
        ("names", ["f0"], "in this order"),
        ("values", [float("nan")] * 16, "give a finite number"),
        ("values", [1.0], "must hold 16 numbers"),
        ("current_min", 9.0, "lower bound first"),
    ):
        bad = parameters_message(TRUE_SET, "damper")
        bad.id = "bad"
        setattr(bad, field, value)
        latched.publish(bad)
        status = listener.wait_for_finding("model: parameters", "are not used")
        listener.wait_for_finding("model: parameters", sentence)
        assert status.level != b"\x00"
    predicted = run(listener, Press(listener), forces, recording)
    assert {f.parameter_set for f in predicted} == {"true"}
    assert predicted[-1].valid


def test_blocks_that_cannot_be_used_are_counted(
    start: Any,
    listener: Listener,
    forces: list[PredictedForce],
    recording: Recording,
    parameter_file: Path,
) -> None:
    start("model", parameter_file=parameter_file)
    press = Press(listener)
    for sentence, changes in BAD_BLOCKS.items():
        press.samples.publish(block_message(recording, 0, **changes))
        listener.wait_for_finding("model: input", sentence)
    press.send_current(recording.start_ns, float("inf"))
    listener.wait_for_finding("model: current", "the current is inf")
    assert run(listener, press, forces, recording)[-1].valid


def test_lost_samples_are_reported_and_the_prediction_starts_again(
    start: Any,
    listener: Listener,
    forces: list[PredictedForce],
    recording: Recording,
    parameter_file: Path,
) -> None:
    start("model", parameter_file=parameter_file)
    press = Press(listener)
    assert run(listener, press, forces, recording)[-1].valid
    count = recording.sample_count
    pause = 50
    forces.clear()
    late = replace(recording, start_ns=recording.stamp_ns(count - 1) + (pause + 1) * 1_000_000)
    press.send_current(late.start_ns, 1.5)
    press.samples.publish(block_message(late, 0, seq=count + pause))
    listener.until(lambda: forces, "a prediction")
    assert not forces[0].valid
    listener.wait_for_finding("model: input", "50 samples were lost")


def test_it_predicts_with_what_the_identifier_finds(
    start: Any, listener: Listener, forces: list[PredictedForce], recording: Recording
) -> None:
    sets = listener.listen(DamperParameters, "damper/parameters", quality.latched())
    start("identifier")
    start("model")
    listener.until(lambda: sets, "the initial set")
    press = Press(listener, listeners=2)
    first = run(listener, press, forces, recording)
    assert not any(f.valid for f in first if f.parameter_set == "literature")
    listener.until(lambda: len(sets) > 1, "an accepted set")
    listener.wait_for_finding("model: parameters", "predicting with window-")
    later = replace(recording, start_ns=recording.start_ns + 10**10)
    second = run(listener, press, forces, later)
    assert second[-1].valid
    assert second[-1].parameter_set.startswith("window-")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_ends_cleanly(start: Any, listener: Listener, number: signal.Signals) -> None:
    model = start("model")
    listener.wait_for_finding("model: latency", "ms from a block")
    model.stop(number)


@pytest.mark.parametrize(
    ("content", "part"),
    [(None, "No such file"), ("parameters: {f0: 1}", "is missing"), ("a: [", "not valid YAML")],
)
def test_a_parameter_file_that_cannot_be_used_is_one_sentence(
    start: Any, tmp_path: Path, content: str | None, part: str
) -> None:
    path = tmp_path / "parameters.yaml"
    if content is not None:
        path.write_text(content)
    model = start("model", parameter_file=path)
    assert model.wait() == 2
    assert_one_sentence(model.errors)
    assert part in model.errors
