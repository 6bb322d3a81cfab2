"""Effect of single hostile messages on the running nodes: unresponsive time and memory.

The rig runs during the test. A node counts as unresponsive while it leaves a service call
unanswered.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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
from rclpy.client import Client
from rclpy.parameter import Parameter
from sensor_msgs.msg import Temperature
from std_msgs.msg import Header

from benchmarks.figure import Measured
from benchmarks.kills import ThreeNodes, three_nodes
from benchmarks.nodes import resident_bytes
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import to_field
from mr_damper_ros.processes.programs import PATIENCE
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import MOST_SAMPLES

_MB = 1e6
_SIZE = 1_000_000
"""Size of the largest messages [B]."""

_PARAMETER = 70
"""Size of a parameter in a request [B]: its name, and a field for each type of value."""

_WATCHED = 0.5
"""Time [s] for which a node is observed after a message, and at least after it last responded
late."""

_SLOW = 0.1
"""Response time [s] above which a node counts as unresponsive."""

_NODES = ("identifier", "model")

_OPTIONS: dict[str, dict[str, object]] = {
    # Only a few messages count: a computer that is busy with other work answers late as well.
    "bridge": {"block_size": 100},
    "identifier": {},
    "model": {},
}


@dataclass(frozen=True)
class HostileMessage:
    """A named message: either ``publish`` on a topic, or a request to a service.

    ``node`` is the node that offers the service.
    """

    name: str
    message: Any
    topic: str = ""
    node: str = ""
    service: str = ""
    kind: type | None = None


@dataclass(frozen=True)
class Harm:
    """Effect of a message on a node.

    ``deaf`` is the longest unresponsive time [s], and ``grown`` the growth of the memory of the
    node with its child processes [MB].
    """

    case: str
    node: str
    deaf: float
    grown: float


def figures() -> Measured:
    """Worst effect of all messages."""
    harms = campaign()
    deaf = max(harms, key=lambda harm: harm.deaf)
    grown = max(harms, key=lambda harm: harm.grown)
    count = len({harm.case for harm in harms})
    return {
        "hostile_message_s": (deaf.deaf, f"The {deaf.node}, after {deaf.case}; of {count}."),
        "hostile_message_mb": (grown.grown, f"The {grown.node}, after {grown.case}."),
    }


def campaign(chosen: Callable[[HostileMessage], bool] = lambda _: True) -> list[Harm]:
    """Effect of each message; raises RuntimeError if a node ends."""
    with three_nodes(_OPTIONS) as rig:
        rig.observer.until(lambda: rig.sets and rig.reports[-1].accepted, "the first set")
        sender = _Sender(rig)
        return [harm for case in cases() if chosen(case) for harm in sender.harm(case)]


class _Sender:
    """Sends a message and measures its effect."""

    def __init__(self, rig: ThreeNodes) -> None:
        self._rig = rig
        self._node = rig.observer.node
        self._publishers: dict[str, Any] = {}
        self._clients: dict[str, Client] = {}
        self._pings = {
            name: self._client(GetParameters, f"/{name}/get_parameters") for name in _NODES
        }

    def harm(self, case: HostileMessage) -> list[Harm]:
        """Send a message and measure its effect on both nodes."""
        # The time to send the message does not count for the node.
        send = self._ready(case)
        before = {name: self._memory(name) for name in _NODES}
        send()
        deaf = self._listen()
        result = []
        for name in _NODES:
            if not self._rig.programs[name].running:
                raise RuntimeError(
                    f"the {name} has ended after {case.name}: {self._rig.programs[name].last_words}"
                )
            peak = sum(_peak_bytes(pid) for pid in self._processes(name))
            result.append(Harm(case.name, name, deaf[name], (peak - before[name]) / _MB))
        return result

    def _ready(self, case: HostileMessage) -> Callable[[], object]:
        if case.topic:
            return lambda: self._publisher(type(case.message), case.topic).publish(case.message)
        assert case.kind is not None
        client = self._client(case.kind, f"/{case.node}/{case.service}")
        return lambda: client.call_async(case.message)

    def _publisher(self, kind: type, topic: str) -> Any:
        if topic not in self._publishers:
            profile = quality.latched() if kind is DamperParameters else quality.stream(10)
            publisher = self._node.create_publisher(kind, topic, profile)
            self._publishers[topic] = publisher
            self._rig.observer.until(publisher.get_subscription_count, f"a subscriber of {topic}")
            # The other side may connect later than this one.
            self._rig.observer.spin_for(0.5)
        return self._publishers[topic]

    def _client(self, kind: type, name: str) -> Client:
        if name not in self._clients:
            self._clients[name] = self._node.create_client(kind, name)
            self._rig.observer.until(self._clients[name].service_is_ready, name)
        return self._clients[name]

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

    def _processes(self, name: str) -> list[int]:
        node = self._rig.programs[name]
        return [node.pid, *node.children]

    def _memory(self, name: str) -> int:
        """Memory in use [B]; its peak is measured from this point on."""
        for pid in self._processes(name):
            Path(f"/proc/{pid}/clear_refs").write_text("5")
        return sum(resident_bytes(pid) for pid in self._processes(name))


def _peak_bytes(pid: int) -> int:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    # A child process that has just ended has none.
    return sum(1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM"))


# -- the messages ------------------------------------------------------------------------------


def cases() -> Iterator[HostileMessage]:
    """All of them."""
    yield from _samples()
    for kind, topic in _TOPICS.items():
        for what, message in _spoilt(kind, _usual(kind)):
            yield HostileMessage(f"{topic} with {what}", message, topic)
    for kind, service in ((SaveParameters, "save_parameters"), (LoadParameters, "load_parameters")):
        for what, request in _spoilt(kind.Request, {}):
            yield HostileMessage(f"{service} with {what}", request, "", "identifier", service, kind)
    for what, goal in _spoilt(IdentifyGlobal.Goal, {}):
        kind = IdentifyGlobal.Impl.SendGoalService
        request = kind.Request(goal=goal)
        request.goal_id.uuid = np.frombuffer(hashlib.md5(what.encode()).digest(), dtype=np.uint8)
        service = "identify_global/_action/send_goal"
        yield HostileMessage(f"a goal with {what}", request, "", "identifier", service, kind)
    yield from _parameter_services()


def _samples() -> Iterator[HostileMessage]:
    chance = np.random.default_rng(0)
    most = _SIZE // 16
    alternating = np.tile([1e-3, -1e-3], most // 2)
    noise = 1e-3 * chance.normal(size=most)
    signals = {
        "of a sine": 5e-3 * np.sin(2e-3 * math.pi * np.arange(most)),
        "of noise": noise,
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
        odd = _block(noise, np.zeros(count), 1e-3)
        yield HostileMessage(f"{most} displacements and {count} forces", odd, "mts/samples")


def _block(displacement: Array, force: Array, period: float) -> MtsSamples:
    return MtsSamples(
        header=Header(stamp=Time(sec=int(time.time())), frame_id="damper"),
        period=period,
        displacement=to_field(displacement),
        force=to_field(force),
    )


_TOPICS = {
    MtsSamples: "mts/samples",
    SupplyCurrent: "supply/current",
    Temperature: "temperature",
    DamperParameters: "damper/parameters",
    FitReport: "damper/fit_report",
}


def _usual(kind: type) -> dict[str, Any]:
    """Fields of a valid message that must differ from the defaults."""
    if kind is MtsSamples:
        small = to_field(1e-3 * np.ones(10))
        return {"period": 1e-3, "displacement": small, "force": small}
    if kind is FitReport:
        return {"confirms": True}
    if kind is DamperParameters:
        count = len(PARAMETER_NAMES)
        return {
            "id": "hostile",
            "model": "sigmoid",
            "names": list(PARAMETER_NAMES),
            "units": ["1"] * count,
            "values": to_field(THESIS_28_CELSIUS),
            "standard_errors": to_field(np.full(count, math.nan)),
            "observable": [True] * count,
            "source": "file",
            "peak_velocity_max": 1.0,
            "current_max": 2.0,
        }
    return {}


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


def _spoilt(kind: Any, usual: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Messages of one type, each with one hostile field."""
    for field, type_ in kind.get_fields_and_field_types().items():
        for what, value in _VALUES.get(type_, {}).items():
            yield f"{what} as {field}", kind(**{**usual, field: value})


def _parameter_services() -> Iterator[HostileMessage]:
    """Services that rclpy adds to every node."""
    names = {
        "names of one letter": ["x"] * (_SIZE // 8),
        "a name of 1 MB": ["x" * _SIZE],
        "a known name over and over": ["frame_id"] * (_SIZE // 16),
        "a prefix over and over": ["qos_overrides"] * (_SIZE // 20),
    }
    values = {
        "one parameter over and over": [
            Parameter("frame_id", value=f"{number}") for number in range(_SIZE // _PARAMETER)
        ],
        "a text of 1 MB": [Parameter("frame_id", value="x" * _SIZE)],
        "a name of 1 MB": [Parameter("x" * _SIZE, value=1.0)],
        "many parameters": [Parameter(f"x{n}", value=1.0) for n in range(_SIZE // _PARAMETER)],
        "1 MB of numbers": [Parameter("frame_id", value=[1.0] * (_SIZE // 8))],
    }
    for node in _NODES:
        for kind, service in (
            (GetParameters, "get_parameters"),
            (GetParameterTypes, "get_parameter_types"),
            (DescribeParameters, "describe_parameters"),
            (ListParameters, "list_parameters"),
        ):
            field = "prefixes" if kind is ListParameters else "names"
            for what, entries in names.items():
                request = kind.Request(**{field: entries})
                yield HostileMessage(f"{service} with {what}", request, "", node, service, kind)
        for kind, service in (
            (SetParameters, "set_parameters"),
            (SetParametersAtomically, "set_parameters_atomically"),
        ):
            for what, parameters in values.items():
                request = kind.Request(parameters=[p.to_parameter_msg() for p in parameters])
                yield HostileMessage(f"{service} with {what}", request, "", node, service, kind)
