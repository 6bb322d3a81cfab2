"""Starts from corrupted state and parameter files: each must succeed or explain its refusal.

Some files have the damage of a defective disk. Others have a valid checksum, as after an edit, and
entries of the set and of the memory that no tracker writes. A start covers everything that the
nodes do with the file before the first sample: read, check, resume, build the messages and store.
The same seed gives the same cases.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import random
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from mr_damper_msgs.msg import DamperParameters
from rclpy.serialization import serialize_message

from benchmarks.figure import Measured
from benchmarks.hostile import CURRENT, NUMBERS, PERIOD, T0, described, motion, spoilt
from benchmarks.nodes import Nodes
from mr_damper_ros.models.parameter_set import ParameterError, ParameterSet, start_set
from mr_damper_ros.models.plausibility import check_plausible
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.models.sigmoid.law import sine_force
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import parameter_set, parameters_message, report_message
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.tracking.acceptance import Verdict
from mr_damper_ros.tracking.state_directory import StateDirectory, StateError, read_parameter_file
from mr_damper_ros.tracking.tracker import TrackerSettings, WindowTracker
from mr_damper_ros.tracking.tracker_state import TrackerState
from mr_damper_ros.tracking.window_assembler import RawWindow

_NAME = "identifier"

_FOLLOWED = 0.1
"""Fraction of the starts that continue with a good window."""

_SAMPLES, _NOISE = 1000, 5.0
"""Samples of a window, and noise of the force [N]."""

_WORDS = ("", "x", "\ud800", "a\nb", "ä", "\0", "x" * 5000, "../x", "nan", "1e999", "bingham")
_COUNTS = (-1, 0, 1, 2**31, 2**31 * 10**9, 2**63, -(2**63), 10**40)
_SETTINGS = {
    "window": TrackerSettings(method="least_squares"),
    "bingham": TrackerSettings(method="least_squares", model="bingham"),
}


def figures(count: int = 10_000, seed: int = 0, nodes: int = 40) -> Measured:
    """Run a number of starts in this process and of real nodes."""
    faults = campaign(count, seed) + campaign_of_nodes(nodes, seed)
    return {"poisoned_starts": (len(faults), f"Of {count} and {nodes}. " + "; ".join(faults[:5]))}


def campaign(cases: int, seed: int) -> list[str]:
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
        state.resume(tracker)
        for number in range(3):
            tracker.follow(_window(number, temperature=30.0 + number))
        assert tracker.accepted_windows
        assert state.keep_now(tracker) == ""
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
    return tracker, TrackerState(StateDirectory(folder), _NAME)


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
        state.resume(tracker).encode()
        state.set_aside.encode()
        _publishable(check_plausible(tracker.parameters))
        fault = state.keep_now(tracker)
        if not fault and follow:
            fault = _followed(tracker) or state.keep_now(tracker)
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
    first_line, _, body = good.partition(b"\n")
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
    head = first_line.rpartition(b" ")[0]
    return b"%s %s\n%s" % (head, hashlib.sha256(body).hexdigest().encode(), body), False


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


def campaign_of_nodes(count: int, seed: int) -> list[str]:
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
