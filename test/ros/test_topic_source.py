"""Topics of other nodes become samples: one message or two topics, from a real process."""

import math
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
                joints.effort = [0.0, -float(force(time))]
            else:
                # Its samples are taken 0.7 ms later.
                late = time + 0.7e-3
                self._wrench.publish(
                    WrenchStamped(
                        header=header(START_NS + round(1e9 * late), "cell"),
                        wrench=Wrench(force=Vector3(x=-float(force(late)))),
                    )
                )
            self._joints.publish(joints)


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
