"""Effect of single hostile messages on the running nodes: unresponsive time and memory.

The rig runs during the test. A node counts as unresponsive while it leaves a service call
unanswered.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from builtin_interfaces.msg import Time
from mr_damper_msgs.action import IdentifyGlobal
from mr_damper_msgs.msg import DamperParameters, FitReport, MtsSamples, SupplyCurrent
from mr_damper_msgs.srv import LoadParameters, SaveParameters
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.parameter import Parameter
from sensor_msgs.msg import Temperature
from std_msgs.msg import Header

from benchmarks.figure import Measured
from benchmarks.kills import ThreeNodes, three_nodes
from benchmarks.nodes import resident_bytes
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import parameters_message, to_field
from mr_damper_ros.processes.programs import PATIENCE
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import MOST_SAMPLES

_MB = 1e6
_SIZE = 1_000_000
"""Size of the largest messages [B]."""

_PARAMETER = 70
"""Size of a parameter in a request [B]: its name, and a field for each type of value."""

_WATCHED, _SLOW = 0.5, 0.1
"""Time [s] for which a node is observed after a message, and after an answer that took longer than
the second time [s]."""

_NODES = ("identifier", "model")

_OPTIONS: dict[str, dict[str, object]] = {
    # Only a few messages count: a computer that is busy with other work answers late as well.
    "bridge": {"block_size": 100},
    "identifier": {},
}


class HostileMessage(NamedTuple):
    """A named message to a topic, or a request to a service of a ``kind``."""

    name: str
    message: Any
    target: str
    kind: type | None = None


Harm = tuple[float, float, str]
"""Longest unresponsive time of a node [s], growth of the memory of the node with its child
processes [MB], and node and message in words."""


def figures() -> Measured:
    """Worst effect of all messages; raises RuntimeError if a node ends."""
    with three_nodes(_OPTIONS) as rig:
        rig.observer.until(lambda: rig.sets and rig.reports[-1].accepted, "the first set")
        sender = _Sender(rig)
        harms = [harm for case in cases() for harm in sender.harm(case)]
    deaf = max(harms, key=lambda harm: harm[0])
    grown = max(harms, key=lambda harm: harm[1])
    return {
        "hostile_message_s": (deaf[0], f"{deaf[2]}; of {len(harms) // len(_NODES)}."),
        "hostile_message_mb": (grown[1], f"{grown[2]}."),
    }


class _Sender:
    """Sends a message and measures its effect."""

    def __init__(self, rig: ThreeNodes) -> None:
        self._rig = rig
        self._targets: dict[str, Any] = {}
        self._pings = {
            name: self._client(GetParameters, f"/{name}/get_parameters") for name in _NODES
        }

    def harm(self, case: HostileMessage) -> list[Harm]:
        """Send a message and measure its effect on both nodes."""
        # The time to send the message does not count for the node.
        if case.kind is None:
            send = self._publisher(type(case.message), case.target).publish
        else:
            send = self._client(case.kind, case.target).call_async
        before = {name: self._memory(name) for name in _NODES}
        send(case.message)
        deaf = self._listen()
        result = []
        for name in _NODES:
            node = self._rig.programs[name]
            if not node.running:
                raise RuntimeError(f"the {name} has ended after {case.name}: {node.last_words}")
            peak = sum(_peak_bytes(pid) for pid in (node.pid, *node.children))
            result.append(
                (deaf[name], (peak - before[name]) / _MB, f"The {name}, after {case.name}")
            )
        return result

    def _publisher(self, kind: type, topic: str) -> Any:
        if topic not in self._targets:
            profile = quality.latched() if kind is DamperParameters else quality.stream(10)
            publisher = self._rig.observer.node.create_publisher(kind, topic, profile)
            self._targets[topic] = publisher
            self._rig.observer.until(publisher.get_subscription_count, f"a subscriber of {topic}")
            # The other side may connect later than this one.
            self._rig.observer.spin_for(0.5)
        return self._targets[topic]

    def _client(self, kind: type, name: str) -> Any:
        if name not in self._targets:
            self._targets[name] = self._rig.observer.node.create_client(kind, name)
            self._rig.observer.until(self._targets[name].service_is_ready, name)
        return self._targets[name]

    def _listen(self) -> dict[str, float]:
        """Longest time [s] that each node left a call unanswered."""
        deaf = dict.fromkeys(_NODES, 0.0)
        asked: dict[str, tuple[float, Any]] = {}
        until = time.monotonic() + _WATCHED
        while time.monotonic() < until or asked:
            now = time.monotonic()
            for name, client in self._pings.items():
                if name in asked:
                    since, answer = asked[name]
                    waited = now - since
                    if answer.done():
                        del asked[name]
                        deaf[name] = max(deaf[name], waited)
                        if waited > _SLOW:
                            until = now + _WATCHED
                    elif waited > PATIENCE:
                        return {**deaf, name: math.inf}
                elif now < until:
                    request = GetParameters.Request(names=["frame_id"])
                    asked[name] = (now, client.call_async(request))
            self._rig.observer.spin_once(0.002)
        return deaf

    def _memory(self, name: str) -> int:
        """Memory in use [B]; its peak is measured from this point on."""
        node = self._rig.programs[name]
        processes = (node.pid, *node.children)
        for pid in processes:
            Path(f"/proc/{pid}/clear_refs").write_text("5")
        return sum(map(resident_bytes, processes))


def _peak_bytes(pid: int) -> int:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    # A child process that has just ended has none.
    return sum(1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM"))


# -- the messages ------------------------------------------------------------------------------


def cases() -> Iterator[HostileMessage]:
    """All of them."""
    yield from _samples()
    small = to_field(1e-3 * np.ones(10))
    known = ParameterSet(
        THESIS_28_CELSIUS,
        set_id="hostile",
        peak_velocity_range=(0.0, 1.0),
        current_range=(0.0, 2.0),
    )
    valid: dict[str, Callable[[], Any]] = {
        "mts/samples": lambda: MtsSamples(period=1e-3, displacement=small, force=small),
        "supply/current": SupplyCurrent,
        "temperature": Temperature,
        "damper/parameters": lambda: parameters_message(known, "damper", ""),
        "damper/fit_report": lambda: FitReport(confirms=True),
    }
    for topic, make in valid.items():
        for what, message in _spoilt(make):
            yield HostileMessage(f"{topic} with {what}", message, topic)
    for kind, service in ((SaveParameters, "save_parameters"), (LoadParameters, "load_parameters")):
        for what, request in _spoilt(kind.Request):
            yield HostileMessage(f"{service} with {what}", request, f"/identifier/{service}", kind)
    send_goal = IdentifyGlobal.Impl.SendGoalService
    for what, goal in _spoilt(IdentifyGlobal.Goal):
        request = send_goal.Request(goal=goal)
        request.goal_id.uuid = np.frombuffer(hashlib.md5(what.encode()).digest(), dtype=np.uint8)
        service = "/identifier/identify_global/_action/send_goal"
        yield HostileMessage(f"a goal with {what}", request, service, send_goal)
    for node in _NODES:
        for kind, field, values in _PARAMETER_REQUESTS:
            for what, value in values.items():
                request, service = kind.Request(**{field: value}), _SERVICES[kind]
                yield HostileMessage(f"{service} with {what}", request, f"/{node}/{service}", kind)


def _samples() -> Iterator[HostileMessage]:
    most = _SIZE // 16
    alternating = np.tile([1e-3, -1e-3], most // 2)
    signals = {
        "of a sine": 5e-3 * np.sin(2e-3 * math.pi * np.arange(most)),
        "of noise": 1e-3 * np.random.default_rng(0).normal(size=most),
        "that alternate": alternating,
        "of zeros": np.zeros(most),
        "of spikes": 1e12 * np.sign(alternating),
    }
    for what, signal in signals.items():
        for count, period in (
            *((most, 1e-3), (18_750, 1000.0)),
            *((MOST_SAMPLES, 1e-3), (MOST_SAMPLES, 1e-5), (10, 1.0), (1, 1.0)),
        ):
            block = _block(signal[:count], 1e5 * signal[:count], period)
            name = f"{count} samples {what}, {period:g} s apart"
            yield HostileMessage(name, block, "mts/samples")
    for count in (0, 1, 10):
        odd = _block(alternating, np.zeros(count), 1e-3)
        yield HostileMessage(f"{most} displacements and {count} forces", odd, "mts/samples")


def _block(displacement: Array, force: Array, period: float) -> MtsSamples:
    return MtsSamples(
        header=Header(stamp=Time(sec=int(time.time())), frame_id="damper"),
        period=period,
        displacement=to_field(displacement),
        force=to_field(force),
    )


_VALUES: dict[str, dict[str, Any]] = {
    "double": {f"{value}": value for value in (math.nan, math.inf, -1e300, 1e300, 1e-320)},
    "uint32": {"all bits": 2**32 - 1},
    "uint64": {"all bits": 2**64 - 1, "the highest bit": 2**63},
    "string": {"1 MB": "x" * _SIZE, "1 MB of ../": "../" * (_SIZE // 3)},
    "sequence<string>": {"1 MB": ["x"] * (_SIZE // 8)},
    "sequence<double>": {"1 MB": to_field(np.ones(_SIZE // 8))},
    "sequence<boolean>": {"1 MB": [True] * _SIZE},
    "std_msgs/Header": {
        "a frame of 1 MB": Header(frame_id="x" * _SIZE),
        "a stamp of 1902": Header(stamp=Time(sec=-(2**31))),
        "a stamp of 2038": Header(stamp=Time(sec=2**31 - 1, nanosec=999_999_999)),
        "a stamp of 1970": Header(stamp=Time()),
        "four seconds of nanoseconds": Header(stamp=Time(sec=1_700_000_000, nanosec=2**32 - 1)),
    },
}
"""Hostile values by type of field."""


def _spoilt(make: Callable[[], Any]) -> Iterator[tuple[str, Any]]:
    """Valid messages of one type, each with one hostile field."""
    for field, type_ in make().get_fields_and_field_types().items():
        for what, value in _VALUES.get(type_, {}).items():
            message = make()
            setattr(message, field, value)
            yield f"{what} as {field}", message


_NAMES = {
    "names of one letter": ["x"] * (_SIZE // 8),
    "a name of 1 MB": ["x" * _SIZE],
    "a known name over and over": ["frame_id"] * (_SIZE // 16),
    "a prefix over and over": ["qos_overrides"] * (_SIZE // 20),
}

_ASSIGNMENTS: dict[str, list[tuple[str, Any]]] = {
    "one parameter over and over": [("frame_id", f"{n}") for n in range(_SIZE // _PARAMETER)],
    "a text of 1 MB": [("frame_id", "x" * _SIZE)],
    "a name of 1 MB": [("x" * _SIZE, 1.0)],
    "many parameters": [(f"x{n}", 1.0) for n in range(_SIZE // _PARAMETER)],
    "1 MB of numbers": [("frame_id", [1.0] * (_SIZE // 8))],
}

_NEW_VALUES = {
    what: [Parameter(name, value=value).to_parameter_msg() for name, value in parameters]
    for what, parameters in _ASSIGNMENTS.items()
}

_SERVICES: dict[Any, str] = {
    GetParameters: "get_parameters",
    GetParameterTypes: "get_parameter_types",
    DescribeParameters: "describe_parameters",
    ListParameters: "list_parameters",
    SetParameters: "set_parameters",
    SetParametersAtomically: "set_parameters_atomically",
}
"""Services that rclpy adds to every node."""

_PARAMETER_REQUESTS: list[tuple[Any, str, dict[str, Any]]] = [
    *((kind, "names", _NAMES) for kind in (GetParameters, GetParameterTypes, DescribeParameters)),
    (ListParameters, "prefixes", _NAMES),
    *((kind, "parameters", _NEW_VALUES) for kind in (SetParameters, SetParametersAtomically)),
]
