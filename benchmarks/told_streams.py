"""What the programs say of live streams: topics, a network sender, replays, leaps of the clock."""

from __future__ import annotations

import math
import socket
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from mr_damper_msgs.msg import MtsSamples, PredictedForce, SupplyCurrent
from sensor_msgs.msg import JointState

from benchmarks.figure import Measured
from benchmarks.nodes import Nodes
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import header, set_stamp, to_nanoseconds
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.tracking.validity import DoubtKind

RATE = 200.0
_BAG = Path(__file__).parents[1] / "bags" / "5.0mm_1Hz_0.5A"
_PATIENCE = 5.0
"""Longest time [s] in which a cause is waited for."""

_TOPICS: dict[str, object] = {
    "source": "topics",
    "mirror_rate": 0.0,
    "topics__displacement_topic": "press/joint_states",
    "topics__displacement_field": "position[rod]",
}
_WRENCH: dict[str, object] = {
    **_TOPICS,
    "topics__force_topic": "cell/wrench",
    "topics__force_type": "geometry_msgs/WrenchStamped",
    "topics__force_field": "wrench.force.x",
}
_EFFORT: dict[str, object] = {**_TOPICS, "topics__force_field": "effort[rod]"}


class _Press:
    """A press and a load cell on topics, 5 mm at 1 Hz and 600 N; ``change`` alters the messages."""

    def __init__(self, nodes: Nodes) -> None:
        node = nodes.observer.node
        self._observer = nodes.observer
        self._joints = node.create_publisher(JointState, "press/joint_states", quality.stream())
        self._wrenches = node.create_publisher(WrenchStamped, "cell/wrench", quality.stream())
        self._sent = 0

    def run(
        self,
        seconds: float,
        change: Callable[[int, JointState, WrenchStamped], tuple[Any, Any]] = (
            lambda k, joints, wrench: (joints, wrench)
        ),
        rate: float = RATE,
    ) -> Iterator[float]:
        """Send for so long; yields the time [s] since the start at every spin."""
        began, began_ns, first = time.monotonic(), time.time_ns(), self._sent
        while (passed := time.monotonic() - began) < seconds:
            while self._sent - first < passed * rate:
                k, self._sent = self._sent - first, self._sent + 1
                phase = 2.0 * math.pi * k / rate
                stamp = header(began_ns + round(k / rate * NANOSECONDS), "rod")
                force = 600.0 * math.tanh(3.0 * math.cos(phase))
                joints = JointState(header=stamp, name=["rod"], effort=[force])
                joints.position = [0.005 * math.sin(phase)]
                wrench = WrenchStamped(header=header(to_nanoseconds(stamp.stamp), "cell"))
                wrench.wrench.force.x = force
                joints, wrench = change(k, joints, wrench)
                for publisher, message in ((self._joints, joints), (self._wrenches, wrench)):
                    if message is not None:
                        publisher.publish(message)
            self._observer.spin_once(0.002)
            yield passed


class _Said:
    """The states of a node's concern: the findings with the time [s] of their first report."""

    def __init__(self, nodes: Nodes, name: str) -> None:
        self.states: list[tuple[float, int, str, str]] = []
        self._name = name
        nodes.observer.listen(DiagnosticArray, "/diagnostics", take=self._take)

    def _take(self, array: DiagnosticArray) -> None:
        for status in array.status:
            if status.name == self._name:
                values = {value.key: value.value for value in status.values}
                found = values.get("finding", "")
                self.states.append((time.monotonic(), status.level[0], found, status.message))


def _stamped(joints: JointState, wrench: WrenchStamped, stamp_ns: int) -> tuple[Any, Any]:
    for message in (joints, wrench):
        set_stamp(message.header.stamp, stamp_ns)
    return joints, wrench


def _nan_effort(k: int, joints: JointState, wrench: WrenchStamped) -> tuple[Any, Any]:
    joints.effort = [math.nan]
    return joints, wrench


def _no_effort(k: int, joints: JointState, wrench: WrenchStamped) -> tuple[Any, Any]:
    joints.effort = []
    return joints, wrench


def _simulated_wrench(k: int, joints: JointState, wrench: WrenchStamped) -> tuple[Any, Any]:
    set_stamp(wrench.header.stamp, round(k / RATE * NANOSECONDS) + 10 * NANOSECONDS)
    return joints, wrench


def _in_groups(k: int, joints: JointState, wrench: WrenchStamped) -> tuple[Any, Any]:
    stamp_ns = to_nanoseconds(joints.header.stamp)
    return _stamped(joints, wrench, stamp_ns - round(k % 10 / RATE * NANOSECONDS))


def _scaled(displacement: float, force: float) -> Callable[..., tuple[Any, Any]]:
    def change(k: int, joints: JointState, wrench: WrenchStamped) -> tuple[Any, Any]:
        joints.position = [displacement * joints.position[0]]
        wrench.wrench.force.x *= force
        return joints, wrench

    return change


CAUSES: dict[str, tuple[str, dict[str, object], Callable[..., tuple[Any, Any]]]] = {
    "effort NaN": ("not_finite", _EFFORT, _nan_effort),
    "no effort": ("unusable", _EFFORT, _no_effort),
    "wrench in simulated time": ("clocks_apart", _WRENCH, _simulated_wrench),
    "stamps in groups": ("grouped_stamps", _WRENCH, _in_groups),
    "stamps frozen": ("frozen_stamps", _WRENCH, lambda k, j, w: _stamped(j, w, NANOSECONDS)),
    "stamps zero": ("no_stamps", _WRENCH, lambda k, j, w: _stamped(j, w, 0)),
    "no wrench": ("channel_silent", _WRENCH, lambda k, j, w: (j, None)),
    "no joint states": ("channel_silent", _WRENCH, lambda k, j, w: (None, w)),
    "millimetres": ("unit", _WRENCH, _scaled(1e3, 1.0)),
    "kilonewtons": ("unit", _WRENCH, _scaled(1.0, 1e-3)),
}
"""Faulty topics: the finding, the options of the bridge, and the change of the messages."""


def _said_after(name: str) -> tuple[float, str]:
    """Time [s] from the first message to the right cause, and what was said; inf if never."""
    expected, options, change = CAUSES[name]
    with Nodes() as nodes:
        said = _Said(nodes, "bridge: source")
        press = _Press(nodes)
        nodes.start("bridge", **options)
        nodes.observer.wait_for_subscribers("press/joint_states")
        nodes.observer.until(lambda: said.states, "the first report of the bridge")
        began = time.monotonic()
        for _ in press.run(_PATIENCE, change):
            found = [state for state in said.states if state[0] > began and state[1] == 1]
            if found:
                right = found[0][2] == expected
                return found[0][0] - began if right else math.inf, f"{name}: {found[0][3]}"
    return math.inf, f"{name}: nothing was said"


@contextmanager
def _sender(row: Callable[[int], bytes], rate: float = 1000.0) -> Iterator[str]:
    """A sender of rows by TCP; yields its address."""
    ended = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(30.0)

        def serve() -> None:
            connection, _ = server.accept()
            began, sent = time.monotonic(), 0
            with connection:
                while not ended.is_set():
                    until = math.floor((time.monotonic() - began) * rate)
                    try:
                        connection.sendall(b"".join(map(row, range(sent, until))))
                    except OSError:
                        return
                    sent = until
                    time.sleep(0.01)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield f"tcp:127.0.0.1:{server.getsockname()[1]}"
        ended.set()
        thread.join()


def _row(k: int, end: bytes = b"\n", unit: float = 1e6) -> bytes:
    phase = 2.0 * math.pi * k / 1000.0
    values = (k / 1000.0 * unit, 5.0 * math.sin(phase), 600.0 * math.tanh(3.0 * math.cos(phase)))
    return b"%.6g,%.6g,%.6g" % values + end


SENDERS: dict[str, tuple[str, str, Callable[[int], bytes], dict[str, object]]] = {
    "lines ended by CR": (
        "no_line_end",
        "time:us,displacement:mm,force:N",
        lambda k: _row(k, b"\r"),
        {},
    ),
    "semicolons and words": (
        "unreadable",
        "time:us,displacement:mm,force:N",
        lambda k: b"t=%d;x=1;f=2\n" % k,
        {},
    ),
    "another unit of the time": (
        "wrong_time_unit",
        "time:ms,displacement:mm,force:N",
        _row,
        {},
    ),
    "another rate": (
        "wrong_rate",
        "-,displacement:mm,force:N",
        _row,
        {"stream__rate": 500.0},
    ),
}
"""Faulty senders: the finding, the columns, the rows and other options of the bridge."""


def _sender_said_after(name: str) -> tuple[float, str]:
    expected, columns, row, options = SENDERS[name]
    with _sender(row) as address, Nodes() as nodes:
        said = _Said(nodes, "bridge: source")
        nodes.start(
            "bridge",
            source="stream",
            stream__address=address,
            stream__columns=columns,
            **options,
        )
        nodes.observer.until(lambda: said.states, "the first report of the bridge")
        began = time.monotonic()
        while time.monotonic() - began < _PATIENCE:
            nodes.observer.spin_once(0.01)
            for at, level, found, message in said.states:
                if level == 1:
                    right = found == expected
                    return max(at - began, 0.0) if right else math.inf, f"{name}: {message}"
    return math.inf, f"{name}: nothing was said"


def cause_figures() -> Measured:
    """Faulty streams of which the right cause is said first, and the longest time until then."""
    results = [_said_after(name) for name in CAUSES]
    results += [_sender_said_after(name) for name in SENDERS]
    slowest, told = max(results)
    right = sum(math.isfinite(after) for after, _ in results) / len(results)
    return {"streams_cause_said": (right, told), "streams_cause_s": (slowest, told)}


def _forces(nodes: Nodes) -> list[tuple[float, PredictedForce]]:
    found: list[tuple[float, PredictedForce]] = []
    nodes.observer.listen(
        PredictedForce, "damper/predicted_force", take=lambda m: found.append((time.monotonic(), m))
    )
    return found


def _restarts(forces: list[tuple[float, PredictedForce]]) -> list[int]:
    """Indices of the forces at which the stamps jump back."""
    stamps = [to_nanoseconds(message.header.stamp) for _, message in forces]
    return [k for k in range(1, len(stamps)) if stamps[k] < stamps[k - 1] - NANOSECONDS]


def _outdated(forces: list[tuple[float, PredictedForce]]) -> float:
    """Time [s] of the data with outdated force."""
    return sum(
        message.period * sum(code == DoubtKind.OUTDATED for code in message.sample_doubts)
        for _, message in forces
    )


def replay_figures(passes: int = 3) -> Measured:
    """A bag in a loop and at rate 5, with identifier and model in simulated time."""
    with Nodes() as nodes:
        forces = _forces(nodes)
        nodes.start("identifier", use_sim_time=True)
        nodes.start("model", use_sim_time=True)
        nodes.start("replay", bag=str(_BAG), loop=True, wait_for_subscribers=2)
        nodes.observer.until(lambda: len(_restarts(forces)) >= passes, "the passes", 30.0 * passes)
        begin, *_, end = _restarts(forces)
        outdated = _outdated(forces[begin:end]) / (passes - 1)
    skipped: dict[str, float] = defaultdict(float)
    with Nodes() as nodes:
        forces = _forces(nodes)
        samples = nodes.observer.listen(MtsSamples, "mts/samples")
        said = _Said(nodes, "model: latency")
        nodes.start("identifier", use_sim_time=True)
        nodes.start("model", use_sim_time=True)
        nodes.start("replay", bag=str(_BAG), rate=5.0, wait_for_subscribers=3)
        nodes.observer.until(lambda: samples, "the samples")
        nodes.observer.spin_for(5.0)
        answered = {message.seq for _, message in forces}
        skipped["blocks"] = 1.0 - len(answered) / len({message.seq for message in samples})
        told = any(level == 1 for _, level, _, _ in said.states)
    unsaid = 0.0 if told else skipped["blocks"]
    return {
        "replay_outdated_s": outdated,
        "replay_skipped": (skipped["blocks"], "said" if told else "not said"),
        "replay_skipped_unsaid": unsaid,
    }


Changed = Callable[[int, JointState, WrenchStamped], tuple[Any, Any]]


def _unchanged(k: int, joints: JointState, wrench: WrenchStamped) -> tuple[Any, Any]:
    return joints, wrench


def _pausing(k: int, joints: JointState, wrench: WrenchStamped) -> tuple[Any, Any]:
    return (None, None) if k % 4000 < 1000 else (joints, wrench)


def _losing(k: int, joints: JointState, wrench: WrenchStamped) -> tuple[Any, Any]:
    return (None if k % 97 == 0 else joints), (None if k % 101 == 0 else wrench)


def _jittering(k: int, joints: JointState, wrench: WrenchStamped) -> tuple[Any, Any]:
    late_ns = round(0.4 * math.sin(12.9898 * k) / RATE * NANOSECONDS)
    return _stamped(joints, wrench, to_nanoseconds(joints.header.stamp) + late_ns)


def _at_rest(k: int, joints: JointState, wrench: WrenchStamped) -> tuple[Any, Any]:
    joints.position = [0.001]
    wrench.wrench.force.x = 2.0 + 0.1 * math.sin(78.233 * k)
    return joints, wrench


HEALTHY: dict[str, tuple[dict[str, object], Changed, float]] = {
    "two topics": (_WRENCH, _unchanged, RATE),
    "one topic": (_EFFORT, _unchanged, RATE),
    "50 Hz": (_WRENCH, _unchanged, 50.0),
    "pauses": (_WRENCH, _pausing, RATE),
    "losses": (_WRENCH, _losing, RATE),
    "jitter": (_WRENCH, _jittering, RATE),
    "at rest": (_WRENCH, _at_rest, RATE),
}
"""Healthy topics: the options of the bridge, the change of the messages, and the rate [Hz]."""

_CONCERNS = ("bridge: source", "identifier: input", "model: input")


def _warnings_on_topics(name: str, seconds: float) -> list[str]:
    """What bridge, identifier and model warn of in healthy topics."""
    options, change, rate = HEALTHY[name]
    with Nodes() as nodes:
        said = [_Said(nodes, concern) for concern in _CONCERNS]
        press = _Press(nodes)
        for node in ("identifier", "model"):
            nodes.start(node)
        nodes.start("bridge", **options)
        for _ in press.run(seconds, change, rate):
            pass
        return _warned(name, said)


def _warnings_of_sender(seconds: float) -> list[str]:
    with _sender(_row) as address, Nodes() as nodes:
        said = [_Said(nodes, concern) for concern in _CONCERNS]
        for node in ("identifier", "model"):
            nodes.start(node)
        columns = "time:us,displacement:mm,force:N"
        nodes.start("bridge", source="stream", stream__address=address, stream__columns=columns)
        nodes.observer.spin_for(seconds)
        return _warned("lines by TCP", said)


def _warnings_of_replay(rate: float, seconds: float) -> list[str]:
    with Nodes() as nodes:
        said = [_Said(nodes, concern) for concern in _CONCERNS[1:]]
        for node in ("identifier", "model"):
            nodes.start(node, use_sim_time=True)
        bag = str(_BAG)
        nodes.start("replay", bag=bag, rate=rate, wait_for_subscribers=2)
        nodes.observer.spin_for(min(seconds, 7.0 / rate))
        return _warned(f"replay at rate {rate:g}", said)


def _warned(name: str, said: list[_Said]) -> list[str]:
    """The findings on the stream at the level of a warning, each once."""
    found = {
        message
        for each in said
        for _, level, finding, message in each.states
        if level == 1 and finding and finding != "no_publisher"
    }
    return [f"{name}: {message}" for message in sorted(found)]


def healthy_figures(seconds: float = 120.0) -> Measured:
    """Ten healthy streams of so many seconds each, and what is warned of."""
    warned = [text for name in HEALTHY for text in _warnings_on_topics(name, seconds)]
    warned += _warnings_of_sender(seconds)
    warned += [text for rate in (0.2, 1.0) for text in _warnings_of_replay(rate, seconds)]
    return {"streams_false_findings": (len(warned), "; ".join(warned))}


def soak_figures(minutes: float = 30.0) -> Measured:
    """One healthy stream on two topics for so many minutes."""
    warned = _warnings_on_topics("two topics", 60.0 * minutes)
    return {"streams_soak_findings": (len(warned), "; ".join(warned))}


LEAPS: dict[str, Callable[[int], int]] = {
    "one second ahead": lambda stamp_ns: stamp_ns + NANOSECONDS,
    "one second back": lambda stamp_ns: stamp_ns - NANOSECONDS,
    "an hour ahead": lambda stamp_ns: stamp_ns + 3600 * NANOSECONDS,
    "an hour back": lambda stamp_ns: stamp_ns - 3600 * NANOSECONDS,
    "back to zero": lambda stamp_ns: stamp_ns % (1000 * NANOSECONDS) + 1,
}


def _valid_after(name: str, settled: float = 6.0, observed: float = 6.0) -> tuple[float, str]:
    """Time [s] from a leap of the driver's stamps to the last force that is not valid."""
    leapt: list[float] = []
    frozen: list[int] = []

    def change(k: int, joints: JointState, wrench: WrenchStamped) -> tuple[Any, Any]:
        if k < settled * RATE:
            return joints, wrench
        if not leapt:
            leapt.append(time.monotonic())
            frozen.append(to_nanoseconds(joints.header.stamp))
        stamp_ns = to_nanoseconds(joints.header.stamp)
        if name in LEAPS:
            return _stamped(joints, wrench, LEAPS[name](stamp_ns))
        thaws = k >= (settled + 3.0) * RATE
        return _stamped(joints, wrench, stamp_ns if thaws else frozen[0])

    with Nodes() as nodes:
        forces = _forces(nodes)
        press = _Press(nodes)
        current = nodes.observer.node.create_publisher(
            SupplyCurrent, "supply/current", quality.stream()
        )
        # Only the time of validity is measured, so that any set that claims no accuracy will do.
        nodes.start("identifier")
        nodes.start("model")
        nodes.start("bridge", **_WRENCH)
        nodes.observer.wait_for_subscribers("press/joint_states")
        nodes.observer.wait_for_subscribers("supply/current", 2)
        sent = 0.0
        for passed in press.run(settled + observed + 3.0, change):
            if passed - sent >= 0.1:
                sent = passed
                stamp_ns = time.time_ns()
                current.publish(SupplyCurrent(header=header(stamp_ns, "coil"), current=0.5))
        before = [m for at, m in forces if at < leapt[0] and not any(m.sample_doubts[-1:])]
        invalid = [(at, m) for at, m in forces if at > leapt[0] and any(m.sample_doubts)]
        last_at, last = invalid[-1] if invalid else (leapt[0], None)
        if not before:
            return math.inf, f"{name}: no force was valid before the leap"
        reason = "" if last is None else last.reason
        if last_at > forces[-1][0] - 1.0:
            return math.inf, f"{name}: {reason}"
        return last_at - leapt[0], f"{name}: {reason}"


def leap_figures() -> Measured:
    """Leaps of the stamps of two topics, and the time until the model's force is valid again."""
    results = [_valid_after(name) for name in (*LEAPS, "frozen for 3 s")]
    return {"streams_leap_s": max(results)}


if __name__ == "__main__":
    import sys

    print(globals()[sys.argv[1]](*map(float, sys.argv[2:])))
