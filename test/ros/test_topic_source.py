"""Topics of other nodes become samples: one message or two topics, from a real process."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Vector3, Wrench, WrenchStamped
from mr_damper_msgs.msg import MtsSamples, SupplyCurrent
from sensor_msgs.msg import JointState
from support import Listener

from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import from_field, header, to_nanoseconds

RATE = 500.0
START_NS = 1_700_000_000_000_000_000


def displacement(time: np.ndarray | float) -> Any:
    return 0.005 * np.sin(2.0 * math.pi * np.asarray(time))


def force(time: np.ndarray | float) -> Any:
    return 1000.0 * np.cos(2.0 * math.pi * np.asarray(time))


class Controller:
    """Publishes like ros2_control, 20 samples per 40 ms of the test."""

    def __init__(self, listener: Listener, *, two_topics: bool = False) -> None:
        node = listener.node
        self._joints = node.create_publisher(JointState, "press/joints", quality.stream())
        self._wrench = (
            node.create_publisher(WrenchStamped, "press/wrench", quality.stream())
            if two_topics
            else None
        )
        self.taken = 0
        self.skipped: set[int] = set()
        self.force_is_measured = True
        self.wrench_ahead = 0.0
        """Error of the clock of the wrench [s]."""
        self.wrench_delay = 0
        """Largest number of timer periods by which the wrench arrives late; it varies slowly."""
        self._waiting: list[tuple[int, WrenchStamped]] = []
        self.also: Callable[[JointState], None] = lambda joints: None
        listener.until(
            lambda: all(
                publisher.get_subscription_count() > 0
                for publisher in (self._joints, self._wrench)
                if publisher is not None
            ),
            "the bridge",
        )
        self._timer = node.create_timer(0.04, self._send)

    def _send(self) -> None:
        for _ in range(20):
            k, self.taken = self.taken, self.taken + 1
            if k in self.skipped:
                continue
            time = k / RATE
            stamp = header(START_NS + round(1e9 * time), "press")
            joints = JointState(header=stamp, name=["table", "rod"])
            # Millimetres, and positive in compression.
            joints.position = [0.0, -1e3 * float(displacement(time))]
            if self._wrench is None:
                joints.effort = [0.0, -float(force(time)) if self.force_is_measured else math.nan]
            else:
                # Its samples are taken 0.7 ms later.
                late = time + 0.7e-3
                stamp_ns = START_NS + round(1e9 * (late + self.wrench_ahead))
                wrench = WrenchStamped(header=header(stamp_ns, "cell"))
                wrench.wrench = Wrench(force=Vector3(x=-float(force(late))))
                turn = self.taken // 20
                self._waiting.append((turn + turn // 50 % (self.wrench_delay + 1), wrench))
                while self._waiting and self._waiting[0][0] <= turn:
                    self._wrench.publish(self._waiting.pop(0)[1])
            self._joints.publish(joints)
            self.also(joints)


JOINTS: dict[str, object] = {
    "source": "topics",
    "topics__displacement_topic": "press/joints",
    "topics__displacement_field": "position[rod]",
    "topics__displacement_scale": -1e-3,
    "topics__force_field": "effort[rod]",
    "topics__force_scale": -1.0,
}

WRENCH = {
    **JOINTS,
    "topics__force_topic": "press/wrench",
    "topics__force_type": "geometry_msgs/WrenchStamped",
    "topics__force_field": "wrench.force.x",
}


def count(samples: list[MtsSamples]) -> int:
    return sum(len(message.force) for message in samples)


def parts(samples: list[MtsSamples]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times [s] since the start, displacement and force of all samples."""
    times = [
        (to_nanoseconds(m.header.stamp) - START_NS) * 1e-9 + m.period * np.arange(len(m.force))
        for m in samples
    ]
    return (
        np.concatenate(times),
        np.concatenate([from_field(m.displacement) for m in samples]),
        np.concatenate([from_field(m.force) for m in samples]),
    )


@pytest.mark.parametrize("parameters", [JOINTS, WRENCH], ids=["one message", "two topics"])
def test_samples_are_those_of_the_topics_at_their_times(
    start: Any, listener: Listener, parameters: dict[str, object]
) -> None:
    samples = listener.listen(MtsSamples, "mts/samples")
    current = listener.listen(SupplyCurrent, "supply/current")
    start("bridge", block_size=10, **parameters)
    Controller(listener, two_topics=parameters is WRENCH)
    listener.until(lambda: count(samples) >= 1000, "two seconds of samples")
    time, moved, pulled = parts(samples)
    assert samples[0].period == pytest.approx(1.0 / RATE, rel=1e-6)
    numbers = np.concatenate([m.seq + np.arange(len(m.force)) for m in samples])
    assert (np.diff(numbers) == 1).all()
    np.testing.assert_allclose(pulled, force(time), atol=0.05)
    np.testing.assert_allclose(moved, displacement(time), atol=1e-7)
    assert current == [], "the current is the supply's"


def test_what_never_came_is_left_out_and_counted(start: Any, listener: Listener) -> None:
    samples = listener.listen(MtsSamples, "mts/samples")
    start("bridge", block_size=10, **JOINTS)
    controller = Controller(listener)
    controller.skipped = {600, 700, 701}
    listener.until(lambda: count(samples) >= 1000, "two seconds of samples")
    time, _, _ = parts(samples)
    taken = np.round(time * RATE).astype(int)
    missing = sorted(set(range(taken[0], taken[-1] + 1)) - set(taken.tolist()))
    assert missing == [600, 700, 701]
    numbers = np.concatenate([m.seq + np.arange(len(m.force)) for m in samples])
    assert len({int(n) for n in numbers - taken}) == 1, "the count goes on over the gap"
    found = listener.wait_for_finding("bridge: source", "")
    assert {value.key: value.value for value in found.values}["force lost"] == "3"


def test_a_field_that_is_not_in_the_messages_and_a_topic_of_nobody_are_told(
    start: Any, listener: Listener
) -> None:
    start("bridge", **{**JOINTS, "topics__force_field": "effort[piston]"})
    listener.wait_for_finding("bridge: source", "nothing publishes /press/joints")
    Controller(listener)
    listener.wait_for_finding("bridge: source", "have no field effort[piston] for the force")


def finding_of(status: Any) -> str:
    """Name of the finding in a diagnostic."""
    return {value.key: value.value for value in status.values}.get("finding", "")


def test_an_effort_that_is_not_measured_is_named_once(start: Any, listener: Listener) -> None:
    # joint_state_broadcaster without an effort interface publishes NaN.
    bridge = start("bridge", **JOINTS)
    controller = Controller(listener)
    controller.force_is_measured = False
    found = listener.wait_for_finding("bridge: source", "values of the force are not finite")
    assert finding_of(found) == "not_finite"
    listener.wait_for_finding("bridge: source", "values of the force are not finite")
    assert bridge.log.count("values of the force are not finite") == 1


def test_a_wrench_in_simulated_time_is_named(start: Any, listener: Listener) -> None:
    start("bridge", **WRENCH)
    controller = Controller(listener, two_topics=True)
    controller.wrench_ahead = -1e9
    found = listener.wait_for_finding("bridge: source", "stamps of the force are 1e+09 s away")
    assert finding_of(found) == "clocks_apart"


def test_a_second_publisher_is_named_by_its_values(start: Any, listener: Listener) -> None:
    start("bridge", **JOINTS)
    controller = Controller(listener)
    other = listener.node.create_publisher(JointState, "press/joints", quality.stream())
    controller.also = lambda joints: other.publish(
        JointState(header=joints.header, name=joints.name, position=[0.0, 0.0], effort=[0.0, 0.0])
    )
    found = listener.wait_for_finding("bridge: source", "is published by /listener and /listener")
    assert finding_of(found) == "several_publishers"


def test_a_delayed_wrench_is_no_drift_and_not_shifted(start: Any, listener: Listener) -> None:
    samples = listener.listen(MtsSamples, "mts/samples")
    bridge = start("bridge", block_size=10, **WRENCH)
    controller = Controller(listener, two_topics=True)
    controller.wrench_delay = 3
    listener.until(lambda: count(samples) >= 6000, "twelve seconds of samples")
    time, moved, pulled = parts(samples)
    np.testing.assert_allclose(pulled, force(time), atol=0.05)
    np.testing.assert_allclose(moved, displacement(time), atol=1e-7)
    assert "[WARN]" not in bridge.log
