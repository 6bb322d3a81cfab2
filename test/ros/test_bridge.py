"""The bridge as a process: its topics and its behaviour."""

import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import State, Transition
from mr_damper_msgs.msg import CurrentCommand, ExcitationCommand, MtsSamples, SupplyCurrent
from sensor_msgs.msg import JointState, Temperature
from support import Listener

from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import from_field, header, to_nanoseconds

BAG = Path(__file__).parents[2] / "bags" / "5.0mm_1Hz_1.5A"


def stamps(messages: list[Any]) -> np.ndarray:
    return np.array([to_nanoseconds(message.header.stamp) for message in messages])


def joined(messages: list[MtsSamples], field: str) -> np.ndarray:
    return np.concatenate([from_field(getattr(message, field)) for message in messages])


def test_the_emulated_rig_streams_until_it_is_told_to_stop(start: Any, listener: Listener) -> None:
    samples = listener.listen(MtsSamples, "mts/samples")
    current = listener.listen(SupplyCurrent, "supply/current")
    temperature = listener.listen(Temperature, "temperature")
    mirror = listener.listen(JointState, "joint_states")
    bridge = start("bridge", block_size=20, rate=4.0, wait_for_subscribers=1)
    listener.until(lambda: len(samples) >= 100 and len(temperature) >= 2, "two seconds of data")
    bridge.stop(signal.SIGTERM)

    assert [message.seq for message in samples] == list(range(0, 20 * len(samples), 20))
    assert {len(message.force) for message in samples} == {20}
    assert {message.header.frame_id for message in [*samples, *current, *mirror]} == {"damper"}
    offsets = stamps(samples) - to_nanoseconds(samples[0].header.stamp)
    assert (offsets == np.arange(len(samples)) * 20_000_000).all()
    assert stamps(current)[0] == stamps(samples)[0]
    assert {message.current for message in current} == {1.5}
    assert (np.diff(stamps(current)) == 100_000_000).all()
    assert 27.0 < temperature[0].temperature < temperature[-1].temperature < 40.0
    displacement, force = joined(samples, "displacement"), joined(samples, "force")
    assert np.ptp(displacement) == pytest.approx(0.010, rel=0.01)
    assert 800.0 < np.abs(force).max() < 2000.0
    # The mirror shows the same samples.
    index = (stamps(mirror)[0] - stamps(samples)[0]) // 1_000_000
    assert mirror[0].position[0] == displacement[index]
    assert mirror[0].effort[0] == force[index]
    assert mirror[0].velocity[0] == pytest.approx(
        (displacement[index] - displacement[index - 20]) / 0.020
    )


def test_stamps_are_those_of_now(start: Any, listener: Listener) -> None:
    ages: list[float] = []

    def take(message: MtsSamples) -> None:
        last = to_nanoseconds(message.header.stamp) + 99_000_000
        now = listener.node.get_clock().now().nanoseconds
        ages.append(now - last)

    listener.listen(MtsSamples, "mts/samples", take=take)
    start("bridge", block_size=100, wait_for_subscribers=1)
    listener.until(lambda: len(ages) >= 30, "three seconds of data")
    youngest = min(ages)
    assert youngest >= 0.0, "no sample comes before its time"
    # A busy computer may delay a message, but not all of them.
    assert youngest < 100_000_000, "the stream is not late by itself"


def test_a_bag_as_fast_as_possible_loses_nothing_and_the_node_stays(
    start: Any, listener: Listener
) -> None:
    samples = listener.listen(MtsSamples, "mts/samples", quality.lossless())
    current = listener.listen(SupplyCurrent, "supply/current", quality.lossless())
    bridge = start("bridge", source="bag", bag=BAG, rate=0.0, block_size=4, wait_for_subscribers=1)
    recording = read_bag(BAG)[0]
    listener.until(lambda: 4 * len(samples) >= recording.sample_count, "all samples")
    bridge.wait_for_log(f"end of the recording: {recording.sample_count} samples")
    assert "provenance: re-synthesised" in bridge.errors
    listener.wait_for_finding("bridge: source", "the recording has ended")

    assert [message.seq for message in samples] == list(range(0, recording.sample_count, 4))
    assert (joined(samples, "displacement") == recording.displacement).all()
    assert (joined(samples, "force") == recording.force).all()
    assert {message.current for message in current} == {1.5}
    assert stamps(current)[-1] == stamps(samples)[-1], "the current is known to the last sample"


def test_the_supply_is_turned_while_the_rig_runs(start: Any, listener: Listener) -> None:
    samples = listener.listen(MtsSamples, "mts/samples")
    current = listener.listen(SupplyCurrent, "supply/current")
    start("bridge", emulated__damper="5.0mm_1Hz_0.5A", emulated__current=0.5)
    listener.until(lambda: current, "the current")
    assert listener.set_parameter("bridge", "emulated.current", 1.0).successful
    listener.until(lambda: current[-1].current == 1.0, "the new current")
    step = next(to_nanoseconds(m.header.stamp) for m in current if m.current == 1.0)
    listener.until(lambda: stamps(samples)[-1] > step + 600_000_000, "samples with it")
    after = [m for m in samples if to_nanoseconds(m.header.stamp) >= step]
    assert np.abs(joined(after, "force")).max() > 0.0

    refused = listener.set_parameter("bridge", "emulated.current", 11.0)
    assert not refused.successful
    assert "emulated.current" in refused.reason
    refused = listener.set_parameter("bridge", "block_size", 20)
    assert not refused.successful
    assert "fixed while the node is configured" in refused.reason
    refused = listener.set_parameter("bridge", "emulated.current", "much")
    assert not refused.successful


def test_a_motion_stamped_ahead_is_refused_and_two_commanders_are_told_beside(
    start: Any, listener: Listener
) -> None:
    start("bridge")
    with Listener() as other:
        commands, _ = (
            one.node.create_publisher(ExcitationCommand, "rig/excitation_command", 10)
            for one in (listener, other)
        )

        def command() -> None:
            ahead = header(listener.node.get_clock().now().nanoseconds + 450_000_000, "damper")
            commands.publish(ExcitationCommand(header=ahead, amplitude=0.005, frequency=1.0))

        timer = listener.node.create_timer(0.05, command)
        found = listener.wait_for_finding("bridge: motion", "s ahead, more than the tolerance")
        listener.node.destroy_timer(timer)
    assert found.level == DiagnosticStatus.ERROR
    assert "the motion is commanded by" in found.message


def test_the_emulated_rig_obeys_commands_of_the_current(start: Any, listener: Listener) -> None:
    current = listener.listen(SupplyCurrent, "supply/current")
    publisher = listener.node.create_publisher(CurrentCommand, "supply/current_command", 10)

    def command() -> None:
        now_ns = listener.node.get_clock().now().nanoseconds
        publisher.publish(CurrentCommand(header=header(now_ns, "damper"), current=0.7))

    timer = listener.node.create_timer(0.05, command)
    start("bridge")
    listener.until(lambda: current and current[-1].current == 0.7, "the commanded current")
    listener.node.destroy_timer(timer)
    listener.until(lambda: current[-1].current == 0.0, "no current once the commands have stopped")
    # Setting the parameter counts even if its value does not change.
    assert listener.set_parameter("bridge", "emulated.current", 1.5).successful
    listener.until(lambda: current[-1].current == 1.5, "the supply")


def test_a_lifecycle_manager_configures_activates_and_cleans_up(
    start: Any, listener: Listener
) -> None:
    samples = listener.listen(MtsSamples, "mts/samples")
    start("bridge", autostart=False)
    listener.wait_for_finding("bridge: source", "not configured")
    assert listener.state("bridge") == State.PRIMARY_STATE_UNCONFIGURED
    assert listener.change("bridge", Transition.TRANSITION_CONFIGURE)
    listener.wait_for_finding("bridge: source", "not active")
    assert not samples
    for _ in range(2):
        assert listener.change("bridge", Transition.TRANSITION_ACTIVATE)
        listener.until(lambda: len(samples) >= 5, "samples")
        assert listener.change("bridge", Transition.TRANSITION_DEACTIVATE)
        assert samples[0].seq in (0, 10), "each activation starts at the beginning"
        listener.wait_for_finding("bridge: source", "not active")
        samples.clear()
    assert listener.change("bridge", Transition.TRANSITION_CLEANUP)
    listener.until(
        lambda: not listener.node.get_publishers_info_by_topic("/mts/samples"), "no publisher"
    )
    assert listener.state("bridge") == State.PRIMARY_STATE_UNCONFIGURED


def test_before_it_is_configured_it_can_be_told_another_motion(
    start: Any, listener: Listener
) -> None:
    samples = listener.listen(MtsSamples, "mts/samples")
    start("bridge", autostart=False, rate=20.0)
    listener.wait_for_finding("bridge: source", "not configured")
    assert listener.set_parameter("bridge", "emulated.amplitude", 0.02).successful
    assert listener.set_parameter("bridge", "rate", 10.0).successful
    assert not listener.set_parameter("bridge", "autostart", True).successful
    assert listener.change("bridge", Transition.TRANSITION_CONFIGURE)
    refused = listener.set_parameter("bridge", "emulated.amplitude", 0.01)
    assert not refused.successful
    assert "fixed while the node is configured" in refused.reason
    assert listener.set_parameter("bridge", "emulated.current", 0.5).successful
    assert listener.change("bridge", Transition.TRANSITION_ACTIVATE)
    listener.until(lambda: len(samples) >= 100, "a cycle")
    assert np.abs(joined(samples, "displacement")).max() == pytest.approx(0.02, rel=1e-3)


def test_a_source_that_cannot_be_opened_leaves_a_managed_node_alive(
    start: Any, listener: Listener, tmp_path: Path
) -> None:
    bridge = start("bridge", autostart=False, source="bag", bag=tmp_path / "nowhere")
    assert not listener.change("bridge", Transition.TRANSITION_CONFIGURE)
    assert listener.state("bridge") == State.PRIMARY_STATE_UNCONFIGURED
    listener.wait_for_finding("bridge: source", "there is no bag")
    bridge.stop()
