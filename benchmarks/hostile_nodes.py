"""Hostile input to the real nodes: messages while the rig runs, and files to start from.

A node counts as unresponsive while it leaves a service call unanswered. Some files have the damage
of a defective disk. Others have a valid checksum, as after an edit, and entries of the set and of
the memory that no tracker writes. A start covers everything that the nodes do with the file before
the first sample: read, check, resume, build the messages and store. The same seed gives the same
cases.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import random
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from builtin_interfaces.msg import Time
from mr_damper_msgs.action import IdentifyGlobal
from mr_damper_msgs.msg import DamperParameters, FitReport, MtsSamples, SupplyCurrent
from mr_damper_msgs.srv import LoadParameters, SaveParameters
from rcl_interfaces.srv import GetParameters
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Temperature
from std_msgs.msg import Header

from benchmarks.figure import Measured
from benchmarks.hostile import CURRENT, NUMBERS, PERIOD, T0, described, motion, spoilt
from benchmarks.nodes import Nodes, ThreeNodes, memory_bytes
from mr_damper_ros.models.parameter_set import ParameterError, ParameterSet, start_set
from mr_damper_ros.models.plausibility import check_plausible
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.models.sigmoid.law import sine_force
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import (
    parameter_set,
    parameters_message,
    report_message,
    to_field,
)
from mr_damper_ros.processes.programs import PATIENCE
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import MOST_SAMPLES, NANOSECONDS
from mr_damper_ros.tracking.acceptance import Verdict
from mr_damper_ros.tracking.state_directory import StateDirectory, StateError, read_parameter_file
from mr_damper_ros.tracking.tracker import TrackerSettings, WindowTracker
from mr_damper_ros.tracking.tracker_state import TrackerState
from mr_damper_ros.tracking.window_assembler import RawWindow

# -- messages --------------------------------------------------------------------------------------

_SIZE = 1_000_000
"""Size of the largest messages [B]."""

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


def message_figures() -> Measured:
    """Worst effect of all messages; raises RuntimeError if a node ends."""
    deaf: list[tuple[float, str]] = []
    grown: list[tuple[float, str]] = []
    with ThreeNodes(_OPTIONS) as rig:
        rig.observer.until(lambda: rig.sets and rig.reports[-1].accepted, "the first set")
        sender = _Sender(rig)
        for case in cases():
            before = {name: sender.memory(name, "VmRSS") for name in _NODES}
            for name, unanswered in sender.harm(case).items():
                node, told = rig.programs[name], f"The {name}, after {case.name}"
                if not node.running:
                    raise RuntimeError(f"the {name} has ended after {case.name}: {node.last_words}")
                deaf.append((unanswered, told))
                grown.append(((sender.memory(name, "VmHWM") - before[name]) / 1e6, told))
    longest, largest = max(deaf), max(grown)
    count = len(deaf) // len(_NODES)
    return {
        "hostile_message_s": (longest[0], f"{longest[1]}; of {count}."),
        "hostile_message_mb": (largest[0], f"{largest[1]}."),
    }


class _Sender:
    """Sends a message and measures its effect."""

    def __init__(self, rig: ThreeNodes) -> None:
        self._rig = rig
        self._targets: dict[str, Any] = {}
        self._pings = {
            name: self._client(GetParameters, f"/{name}/get_parameters") for name in _NODES
        }

    def _publisher(self, kind: type, topic: str) -> Any:
        observer = self._rig.observer
        if topic not in self._targets:
            profile = quality.latched() if kind is DamperParameters else quality.stream(10)
            publisher = observer.node.create_publisher(kind, topic, profile)
            self._targets[topic] = publisher
            observer.until(publisher.get_subscription_count, f"a subscriber of {topic}")
            # The other side may connect later than this one.
            observer.spin_for(0.5)
        return self._targets[topic]

    def _client(self, kind: type, name: str) -> Any:
        if name not in self._targets:
            self._targets[name] = self._rig.observer.node.create_client(kind, name)
            self._rig.observer.until(self._targets[name].service_is_ready, name)
        return self._targets[name]

    def harm(self, case: HostileMessage) -> dict[str, float]:
        """Send a message; returns the longest time [s] that each node left a call unanswered."""
        # The time to send the message does not count for the node.
        if case.kind is None:
            self._publisher(type(case.message), case.target).publish(case.message)
        else:
            self._client(case.kind, case.target).call_async(case.message)
        deaf = dict.fromkeys(_NODES, 0.0)
        asked: dict[str, tuple[float, Any]] = {}
        until = time.monotonic() + _WATCHED
        while time.monotonic() < until or asked:
            now = time.monotonic()
            for name, client in self._pings.items():
                since, answer = asked.get(name, (now, None))
                if answer is None:
                    if now < until:
                        request = GetParameters.Request(names=["frame_id"])
                        asked[name] = (now, client.call_async(request))
                elif answer.done():
                    del asked[name]
                    deaf[name] = max(deaf[name], now - since)
                    if now - since > _SLOW:
                        until = now + _WATCHED
                elif now - since > PATIENCE:
                    return {**deaf, name: math.inf}
            self._rig.observer.spin_once(0.002)
        return deaf

    def memory(self, name: str, entry: str) -> int:
        """Memory [B] of a node and its children: in use, or its peak since the last call."""
        node = self._rig.programs[name]
        pids = (node.pid, *node.children)
        found = sum(memory_bytes(pid, entry) for pid in pids)
        for pid in pids:
            Path(f"/proc/{pid}/clear_refs").write_text("5")
        return found


def cases() -> Iterator[HostileMessage]:
    """All messages."""
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
    shapes = [(most, 1e-3), (18_750, 1000.0), (MOST_SAMPLES, 1e-3), (MOST_SAMPLES, 1e-5)]
    for what, signal in signals.items():
        for count, period in (*shapes, (10, 1.0), (1, 1.0)):
            name = f"{count} samples {what}, {period:g} s apart"
            yield _block(name, signal[:count], 1e5 * signal[:count], period)
    for count in (0, 1, 10):
        name = f"{most} displacements and {count} forces"
        yield _block(name, alternating, np.zeros(count), 1e-3)


def _block(name: str, displacement: Array, force: Array, period: float) -> HostileMessage:
    message = MtsSamples(
        header=Header(stamp=Time(sec=int(time.time())), frame_id="damper"),
        period=period,
        displacement=to_field(displacement),
        force=to_field(force),
    )
    return HostileMessage(name, message, "mts/samples")


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


# -- starts from saved states and parameter files --------------------------------------------------

_NAME = "identifier"

_FOLLOWED = 0.1
"""Fraction of the starts that continue with a good window."""

_SAMPLES, _NOISE = 1000, 5.0
"""Samples of a window, and noise of the force [N]."""

_WORDS = ("", "x", "\ud800", "a\nb", "ä", "\0", "x" * 5000, "../x", "nan", "1e999", "bingham")
_COUNTS = (-1, 0, 1, 2**31, 2**31 * 10**9, 2**63, -(2**63), 10**40)
_SETTINGS = {
    "window": TrackerSettings(method="least_squares"),
    "recursive": TrackerSettings(method="least_squares", tracker="recursive"),
    "bingham": TrackerSettings(method="least_squares", model="bingham"),
}


def start_figures(count: int = 10_000, seed: int = 0, nodes: int = 40) -> Measured:
    """Run a number of starts in this process and of real nodes."""
    faults = starts(count, seed) + starts_of_nodes(nodes, seed)
    return {"poisoned_starts": (len(faults), f"Of {count} and {nodes}. " + "; ".join(faults[:5]))}


def starts(cases: int, seed: int) -> list[str]:
    """Failures of a number of starts in this process."""
    chance = random.Random(seed)
    faults = []
    with tempfile.TemporaryDirectory(prefix="starts-") as folder:
        files = _good_files(Path(folder) / "good")
        for number in range(cases):
            kind = chance.choice(list(_SETTINGS))
            poisoned, follow = _poisoned(chance, files[kind]), chance.random() < _FOLLOWED
            fault = described(partial(_start, kind, Path(folder) / "state", follow, *poisoned))
            if fault:
                faults.append(f"start {number}, {kind}: {fault}")
    return faults


def _good_files(folder: Path) -> dict[str, bytes]:
    """The state of each tracker after a few windows, one of them with a temperature."""
    files = {}
    for kind in _SETTINGS:
        tracker, state = _tracker(kind, folder / kind)
        state.resume()
        for number in range(3):
            tracker.follow(_window(number, temperature=30.0 + number))
        assert tracker.accepted_windows
        assert state.keep_now() == ""
        state.close()
        files[kind] = (folder / kind / f"{_NAME}.yaml").read_bytes()
    return files


def _window(number: int, temperature: float = math.nan) -> RawWindow:
    """A second of a good stream."""
    u, v, a = motion(np.arange(_SAMPLES) * PERIOD)
    noise = np.random.default_rng(number).normal(0.0, _NOISE, _SAMPLES)
    current = np.full(_SAMPLES, CURRENT)
    return RawWindow(
        start_ns=T0 + number * round(_SAMPLES * PERIOD * NANOSECONDS),
        period=PERIOD,
        displacement=u,
        force=sine_force(THESIS_28_CELSIUS, u, v, a, current) + noise,
        current=current,
        temperature=temperature,
    )


def _tracker(kind: str, folder: Path) -> tuple[WindowTracker, TrackerState]:
    settings = _SETTINGS[kind]
    start = start_set(settings.law)
    if settings.law == "sigmoid":
        start = ParameterSet(0.9 * THESIS_28_CELSIUS, set_id="start")
    tracker = WindowTracker(settings, start)
    return tracker, TrackerState(tracker, StateDirectory(folder), _NAME)


def _start(kind: str, folder: Path, follow: bool, data: bytes, damaged: bool) -> str:
    """Start an identifier from a state and a model from a parameter file; return any failure.

    ``damaged`` means that the checksum of the file is wrong.
    """
    folder.mkdir(exist_ok=True)
    path = folder / f"{_NAME}.yaml"
    path.write_bytes(data)
    try:
        _publishable(check_plausible(read_parameter_file(path)))
        if damaged:
            return "a damaged file was believed"
    except (StateError, ParameterError) as error:
        str(error).encode()
    tracker, state = _tracker(kind, folder)
    try:
        state.resume().encode()
        state.set_aside.encode()
        _publishable(check_plausible(tracker.parameters))
        fault = state.keep_now()
        if not fault and follow:
            fault = _followed(tracker) or state.keep_now()
        state.acknowledge()
    finally:
        state.close()
        for left in folder.glob(f"{_NAME}.*"):
            left.unlink()
    return fault


def _publishable(parameters: ParameterSet) -> None:
    message = parameters_message(parameters, "damper", "/identifier")
    serialize_message(message)
    parameter_set(message)


def _followed(tracker: WindowTracker) -> str:
    """Follow a good window; returns its failure."""
    report = tracker.follow(_window(9))
    assert report is not None
    serialize_message(report_message(report, 0.0, "damper", "/identifier"))
    _publishable(tracker.parameters)
    return f"a good window: {report.reason}" if report.verdict is Verdict.FAILED else ""


def _poisoned(chance: random.Random, good: bytes) -> tuple[bytes, bool]:
    """A state file with wrong entries and a valid checksum, or a damaged one.

    The second value says whether the checksum reveals the damage.
    """
    how = chance.randrange(4)
    if how == 0:
        data = spoilt(chance, good)
        # Line ends of other systems are the same lines.
        lines = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        return data, b"sha256" in lines.partition(b"\n")[0] and lines != good
    body = good.partition(b"\n")[2]
    if how == 1:
        body = spoilt(chance, body)
    else:
        text, mark, memory = body.decode().partition("\n# memory ")
        if how == 2:
            document = yaml.safe_load(text)
            _spoil_entry(chance, document)
            # JSON is valid YAML and can express values that no YAML dumper writes.
            text = json.dumps(document, allow_nan=True).replace("NaN", ".nan")
            text = text.replace("-Infinity", "-.inf").replace("Infinity", ".inf")
        else:
            document = json.loads(memory)
            for _ in range(chance.choice((1, 1, 3))):
                _spoil_entry(chance, document)
            memory = json.dumps(document) + "\n"
        body = f"{text}{mark}{memory}".encode()
    version = 2 if b"\n# memory " in body else 1
    digest = hashlib.sha256(body).hexdigest()
    head = f"# mr_damper_ros parameters, version {version}, sha256 {digest}\n"
    return head.encode() + body, False


def _spoil_entry(chance: random.Random, document: Any) -> None:
    """Replace an entry somewhere in nested lists and mappings."""
    places: list[tuple[Any, Any]] = []
    waiting = [document]
    while waiting:
        inner = waiting.pop()
        keys = list(inner) if isinstance(inner, dict) else list(range(len(inner)))
        places += [(inner, key) for key in keys]
        waiting += [inner[key] for key in keys if isinstance(inner[key], (dict, list))]
    inner, key = chance.choice(places)
    before = inner[key]
    if isinstance(before, dict) and "float64" in before and chance.random() < 0.7:
        _spoil_array(chance, before)
    elif isinstance(before, list) and before and chance.random() < 0.5:
        chance.shuffle(before)
        del before[chance.randrange(len(before) + 1) :]
    else:
        odd: tuple[Any, ...] = (None, True, [], {}, [[]], [before], [before, before])
        factors = ((-1.0, 1e-9, 1e9, 1e300, 0.0), (-1.0, 0.5, 2.0, 10.0))
        scaled = [[_scaled(before, factor) for factor in each] for each in factors]
        inner[key] = chance.choice(chance.choice((NUMBERS, _WORDS, _COUNTS, odd, *scaled)))


def _scaled(value: Any, factor: float) -> Any:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not is_number or not math.isfinite(value):
        return factor
    scaled = value * factor
    return int(scaled) if isinstance(value, int) and math.isfinite(scaled) else scaled


def _spoil_array(chance: random.Random, stored: dict[str, Any]) -> None:
    """Change some of the numbers of an array, or its shape."""
    try:
        values = np.frombuffer(base64.b64decode(stored["float64"]), "<f8").copy()
    except (TypeError, ValueError):
        return  # spoilt before
    what = chance.randrange(4)
    if what == 0 and values.size:
        values[chance.randrange(values.size)] = chance.choice(NUMBERS)
    elif what == 1:
        values[:] = chance.choice(NUMBERS)
    elif what == 2:
        values *= chance.choice((-1.0, 1e-12, 1e3, 1e200))
    else:
        stored["shape"] = chance.choice(([], [0], [values.size, 1], [1, values.size], [-1]))
    stored["float64"] = base64.b64encode(values.tobytes()).decode()


def starts_of_nodes(count: int, seed: int) -> list[str]:
    """Failures of a number of starts of real nodes, two of three from a state, one from a file."""
    chance = random.Random(seed)
    faults = []
    with tempfile.TemporaryDirectory(prefix="starts-") as folder, Nodes() as nodes:
        good = _good_files(Path(folder) / "good")["window"]
        for number in range(count):
            state = Path(folder) / str(number)
            state.mkdir()
            (state / f"{_NAME}.yaml").write_bytes(_poisoned(chance, good)[0])
            fault = described(partial(_start_node, nodes, state, by_file=number % 3 == 2))
            if fault:
                faults.append(f"node {number}: {fault}")
    return faults


def _start_node(nodes: Nodes, state: Path, by_file: bool) -> str:
    """An identifier must start from a state; it may refuse a file with an explanation."""
    heard = nodes.observer.listen(DamperParameters, "damper/parameters", quality.latched())
    if by_file:
        node = nodes.start(_NAME, initial_parameters=state / f"{_NAME}.yaml")
    else:
        node = nodes.start(_NAME, state_dir=state)
    nodes.observer.until(lambda: heard or not node.running, "a set, or the end of the node")
    refused = by_file and not node.running and node.wait() == 2
    bad = "Traceback" in node.log or not (heard or refused)
    told = repr(node.log[-300:]) if bad else ""
    nodes.end(_NAME)
    return told
