"""The model as a process: a prediction for every block, and the reason if it is invalid."""

import os
import signal
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
from mr_damper_msgs.msg import DamperParameters, MtsSamples, PredictedForce
from press import BAD_BLOCKS, BLOCK, Press, block_message
from rosgraph_msgs.msg import Clock
from support import Listener

import mr_damper_ros as mr
from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.models import MODELS
from mr_damper_ros.models import Model as ForceModel
from mr_damper_ros.models.parameter_set import ParameterError, ParameterSet
from mr_damper_ros.models.plausibility import check_plausible
from mr_damper_ros.models.published import CONDITIONS, parameters
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import (
    from_field,
    parameter_set,
    parameters_message,
    to_nanoseconds,
    to_stamp,
)
from mr_damper_ros.signals.recording import Recording

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
"""Seconds after which observer and centre of a 1 Hz motion have settled."""


@pytest.fixture(scope="module")
def recording() -> Recording:
    return read_bag(BAG)[0]


class Rig:
    """A model node, the machine that publishes its samples, and the predicted forces."""

    def __init__(self, start: Any, listener: Listener, listeners: int = 1, **options: Any) -> None:
        self._listener = listener
        self._forces = listener.listen(PredictedForce, "damper/predicted_force", quality.lossless())
        self._listeners = listeners
        start("model", **options)

    @cached_property
    def press(self) -> Press:
        """The machine; created when first used."""
        self._listener.until(
            lambda: self._listener.node.count_publishers("damper/predicted_force"),
            "the model's topic",
        )
        return Press(self._listener, self._listeners)

    def run(self, recording: Recording, **how: Any) -> list[PredictedForce]:
        """Publish a recording and wait for the predictions of all its blocks."""
        self._forces.clear()
        blocks = self.press.run(recording, **how)
        forces = self._predictions(len(blocks))
        assert [f.seq for f in forces] == [b.seq for b in blocks]
        assert [f.header for f in forces] == [b.header for b in blocks]
        assert [len(f.force) for f in forces] == [len(b.force) for b in blocks]
        assert {f.period for f in forces} == {recording.period}
        assert all(f.valid == (not f.reason) == (not any(f.sample_doubts)) for f in forces)
        assert all(len(f.sample_doubts) == len(f.force) for f in forces)
        return forces

    def send(self, *blocks: MtsSamples) -> list[PredictedForce]:
        """Publish these blocks and wait for their predictions."""
        self._forces.clear()
        for block in blocks:
            self.press.samples.publish(block)
        return self._predictions(len(blocks))

    def _predictions(self, count: int) -> list[PredictedForce]:
        self._listener.until(lambda: len(self._forces) >= count, "a prediction for every block")
        return list(self._forces)


@pytest.fixture
def rig(start: Any, listener: Listener, tmp_path: Path) -> Rig:
    """A rig whose model predicts with the true parameters, from a file."""
    path = tmp_path / "true.yaml"
    path.write_text(TRUE_SET.to_yaml())
    return Rig(start, listener, parameter_file=path, wrench_rate=5.0)


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_a_parameter_set_passes_through_its_message_unchanged(model: ForceModel) -> None:
    count = len(model.parameters)
    original = replace(
        TRUE_SET,
        model=model.name,
        values=np.clip(np.arange(1.0, count + 1.0), *model.bounds),
        standard_errors=np.linspace(0.1, 1.6, count),
        discrepancies=np.linspace(0.05, 0.8, count),
        observable=np.arange(count) % 2 == 0,
        dependence_range=(0.02, 0.033),
    )
    message = parameters_message(original, "damper", "/test")
    assert (message.model, message.names) == (model.name, list(model.parameter_names))
    assert parameter_set(message).to_yaml() == original.to_yaml()


def test_an_error_over_part_of_a_cycle_is_not_judged(
    rig: Rig, listener: Listener, recording: Recording
) -> None:
    arrays = ("displacement", "force", "current")
    rig.run(replace(recording, **{name: getattr(recording, name)[:3000] for name in arrays}))
    assert listener.wait_for_finding("model: prediction", "valid").message == "valid"


def test_with_a_parameter_file_it_works_alone(
    rig: Rig, listener: Listener, recording: Recording
) -> None:
    wrenches = listener.listen(WrenchStamped, "damper/predicted_wrench", quality.lossless())
    predicted = rig.run(recording)
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


def test_it_predicts_what_a_replay_predicts(rig: Rig, recording: Recording) -> None:
    predicted = rig.run(recording)
    replayed = mr.replay(recording, TRUE_SET, identify=False, block_size=BLOCK)
    force = np.concatenate([from_field(f.force) for f in predicted])
    doubts = np.concatenate([f.sample_doubts for f in predicted])
    np.testing.assert_array_equal(force, replayed.predicted)
    np.testing.assert_array_equal(doubts, replayed.doubts)


def test_what_is_missing_makes_the_force_invalid_with_the_reason(
    start: Any, listener: Listener, recording: Recording
) -> None:
    latched = listener.node.create_publisher(
        DamperParameters, "damper/parameters", quality.latched()
    )

    def use(parameters: ParameterSet) -> None:
        latched.publish(parameters_message(parameters, "damper", "/test"))
        listener.wait_for_finding("model: parameters", f"predicting with {parameters.set_id}")

    rig = Rig(start, listener)
    listener.wait_for_finding("model: input", "nothing publishes mts/samples")
    listener.wait_for_finding("model: parameters", "no parameters yet")
    listener.wait_for_finding("model: latency", "no block since the last report")
    nothing = rig.run(recording)
    assert {(f.valid, f.parameter_set) for f in nothing} == {(False, "")}
    assert "no parameters yet" in nothing[-1].reason
    assert np.isnan(nothing[-1].force).all()
    listener.wait_for_finding("model: prediction", "not valid: no parameters yet")

    use(TRUE_SET)
    later = replace(recording, start_ns=recording.start_ns + 10**10)
    fresh = rig.run(later)
    assert fresh[-1].valid
    assert fresh[-1].parameter_set == "true"

    stale = replace(recording, start_ns=recording.start_ns + 3 * 10**10)
    old = rig.run(stale, with_current=False)
    assert not any(f.valid for f in old)
    assert "current is" in old[-1].reason
    assert "old" in old[-1].reason

    use(replace(TRUE_SET, set_id="other current", current_range=(0.0, 0.5)))
    confirmed = rig.run(replace(recording, start_ns=recording.start_ns + 5 * 10**10))
    # The measured force confirms it as soon as the motion is known.
    assert confirmed[-1].valid
    wrong = replace(TRUE_SET, current_range=(0.0, 0.5), peak_velocity_range=(0.1, 0.2))
    use(replace(wrong, set_id="other current and speed"))
    outside = rig.run(replace(recording, start_ns=recording.start_ns + 7 * 10**10))
    assert not any(f.valid for f in outside)
    assert outside[-1].doubt == PredictedForce.OUT_OF_RANGE
    assert "current of 1.50 A is outside the identified range of 0.00 to 0.50 A" in (
        outside[-1].reason
    )


@pytest.mark.parametrize(
    ("field", "value", "sentence"),
    [
        ("model", "bouc_wen", "the parameters of model 'bouc_wen' must be c0, k0, "),
        ("names", ["f0"], "in this order"),
        ("current_min", 9.0, "lower bound first"),
        ("values", [-TRUE_SET.values[0], *TRUE_SET.values[1:]], "a force that is not dissipative"),
        ("id", "two\nlines", "printable characters"),
        ("node", "x" * 1000, "the name of the node of the parameters is"),
    ],
)
def test_a_message_of_unusable_parameters_is_refused(field: str, value: Any, sentence: str) -> None:
    bad = parameters_message(TRUE_SET, "damper", "/test")
    setattr(bad, field, value)
    with pytest.raises(ParameterError) as refused:
        check_plausible(parameter_set(bad))
    assert sentence in str(refused.value)


def test_refused_parameters_are_reported_and_change_nothing(
    start: Any, listener: Listener, recording: Recording
) -> None:
    latched = listener.node.create_publisher(
        DamperParameters, "damper/parameters", quality.latched()
    )
    rig = Rig(start, listener)
    latched.publish(parameters_message(TRUE_SET, "damper", "/test"))
    status = listener.wait_for_finding("model: parameters", "predicting with true")
    assert {pair.key: pair.value for pair in status.values}["from"] == "/test"
    for field, value, sentence in (
        ("model", "magic", "model 'magic' is unknown"),
        ("values", [-1e9, *TRUE_SET.values[1:]], "more than the limit of 1e+06 N"),
    ):
        bad = parameters_message(TRUE_SET, "damper", "/test")
        bad.id = "bad"
        setattr(bad, field, value)
        latched.publish(bad)
        status = listener.wait_for_finding("model: parameters", sentence)
        assert "are not used" in status.message
        assert status.level != b"\x00"
    predicted = rig.run(recording)
    assert {f.parameter_set for f in predicted} == {"true"}
    assert predicted[-1].valid


def test_in_simulated_time_a_second_pass_of_a_bag_is_not_outdated(
    start: Any, listener: Listener, recording: Recording
) -> None:
    end_ns = recording.stamp_ns(recording.sample_count)
    latched = listener.node.create_publisher(
        DamperParameters, "damper/parameters", quality.latched()
    )
    clock = listener.node.create_publisher(Clock, "/clock", 10)
    rig = Rig(start, listener, use_sim_time=True)
    # Set and clock are those of the end of the first pass.
    confirmed = replace(TRUE_SET, stamp_ns=end_ns)
    latched.publish(parameters_message(confirmed, "damper", "/test"))
    listener.node.create_timer(0.1, lambda: clock.publish(Clock(clock=to_stamp(end_ns))))
    listener.wait_for_finding("model: parameters", "predicting with true")
    predicted = rig.run(recording)
    assert PredictedForce.OUTDATED not in {code for f in predicted for code in f.sample_doubts}
    assert predicted[-1].valid


def test_two_publishers_of_parameters_are_an_error(start: Any, listener: Listener) -> None:
    publishers = [
        listener.node.create_publisher(DamperParameters, "damper/parameters", quality.latched())
        for _ in range(2)
    ]
    start("model")
    status = listener.wait_for_finding("model: parameters", "damper/parameters is published by")
    assert status.level == DiagnosticStatus.ERROR
    listener.node.destroy_publisher(publishers.pop())
    listener.wait_for_finding("model: parameters", "no parameters yet")


def test_a_model_that_has_fallen_behind_goes_straight_to_the_newest(
    start: Any, listener: Listener, recording: Recording, tmp_path: Path
) -> None:
    path = tmp_path / "true.yaml"
    path.write_text(TRUE_SET.to_yaml())
    forces = listener.listen(PredictedForce, "damper/predicted_force", quality.lossless())
    model = start("model", parameter_file=path)
    listener.until(
        lambda: listener.node.count_publishers("damper/predicted_force"), "the model's topic"
    )
    heard = listener.listen(DiagnosticArray, "/diagnostics")
    press = Press(listener)
    began_ns = listener.node.get_clock().now().nanoseconds
    live = replace(recording, start_ns=began_ns)
    os.kill(model.pid, signal.SIGSTOP)
    sent = press.run(live, with_current=False)
    assert live.duration > SETTLED
    # The stamps are in the future at first; the model is released when the last one is late.
    listener.until(
        lambda: listener.node.get_clock().now().nanoseconds > live.stamp_ns(live.sample_count),
        "the end of the recording",
        patience=60.0,
    )
    os.kill(model.pid, signal.SIGCONT)
    listener.until(
        lambda: any(
            status.level == DiagnosticStatus.WARN and "blocks have no prediction" in status.message
            for array in heard
            for status in array.status
        ),
        "a warning of skipped blocks",
    )
    listener.until(lambda: forces and forces[-1].seq == sent[-1].seq, "the newest force")
    assert len(forces) < len(sent) // 2


def test_blocks_that_cannot_be_used_are_counted(
    rig: Rig, listener: Listener, recording: Recording
) -> None:
    for sentence, changes in BAD_BLOCKS.items():
        rig.press.samples.publish(block_message(recording, 0, **changes))
        listener.wait_for_finding("model: input", sentence)
    rig.press.send_current(recording.start_ns, float("inf"))
    listener.wait_for_finding("model: current", "the current is inf")
    assert rig.run(recording)[-1].valid


def test_it_predicts_with_what_the_identifier_finds(
    start: Any, listener: Listener, recording: Recording
) -> None:
    sets = listener.listen(DamperParameters, "damper/parameters", quality.latched())
    start("identifier")
    rig = Rig(start, listener, listeners=2)
    listener.until(lambda: sets, "the initial set")
    first = rig.run(recording)
    assert not any(f.valid for f in first if f.parameter_set == "literature")
    listener.until(lambda: len(sets) > 1, "an accepted set")
    listener.wait_for_finding("model: parameters", "predicting with window-")
    later = replace(recording, start_ns=recording.start_ns + 10**10)
    second = rig.run(later)
    assert second[-1].valid
    assert second[-1].parameter_set.startswith("window-")
