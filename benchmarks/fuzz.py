"""Malformed and hostile input: blocks, record files, bags, parameter and state files.

Every case corrupts good input. A case fails if it raises an undocumented error, exceeds a time
limit, or yields a valid value that differs from the law. The same seed gives the same cases.
"""

from __future__ import annotations

import math
import os
import random
import signal
import struct
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat

from benchmarks.figure import Measured
from mr_damper_ros.io.bag_files import BagError
from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.io.bag_writer import write_bag
from mr_damper_ros.io.columns import ColumnError, RecordError
from mr_damper_ros.io.records import read_record
from mr_damper_ros.models.parameter_set import ParameterError, ParameterSet
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.models.sigmoid.law import sine_force
from mr_damper_ros.signals.blocks import NANOSECONDS, BlockError, SampleBlock
from mr_damper_ros.signals.recording import Recording, RecordingError
from mr_damper_ros.tracking.predictor import ForcePredictor, PredictorSettings
from mr_damper_ros.tracking.state_directory import StateDirectory, StateError
from mr_damper_ros.tracking.window_assembler import WindowAssembler

PERIOD = 1e-3
AMPLITUDE, FREQUENCY, CURRENT = 5e-3, 2.0, 1.5
T0 = 1_700_000_000 * NANOSECONDS

NUMBERS = (
    *(0.0, -0.0, -1.0, 1e-320, 1e300, -1e300, 1e18, 2.0**53, 0.1),
    *(math.nan, math.inf, -math.inf),
)
WORDS = (
    *(b"nan", b"inf", b"-1", b"1e999", b"0x10", b"1,5", b";", b",", b"\t", b"\n", b"\r", b"\0"),
    *(b"\xff\xfe", b"\xef\xbb\xbf", b"\xc3\xa4", b"'", b'"', b"#", b"---", b"&a [*a]", b"!!python"),
    *(b"{", b"[" * 50, b"[" * 5000, b"2001-02-31", b"!!int ''", b"]", b": ", b"? ", b"1" * 400),
    *(b"null", b"~", b"<<: *a", b"!!binary ="),
)


def spoilt(chance: random.Random, good: bytes) -> bytes:
    """The bytes with a few of them changed, removed or doubled, or with words inserted."""
    data = bytearray(good)
    for _ in range(chance.choice((1, 1, 1, 2, 5))):
        first = chance.randrange(len(data) + 1)
        last = min(first + chance.choice((1, 1, 4, 16, len(data))), len(data))
        change = chance.randrange(5)
        if change == 0:
            data[first:last] = b""
        elif change == 1:
            data[first:first] = data[first:last][:4000]
        elif change == 2:
            data[first:first] = chance.choice(WORDS)
        elif change == 3:
            data[first:last] = chance.choice(WORDS)
        elif first < len(data):
            data[first] ^= 1 << chance.randrange(8)
    return bytes(data)


def motion(time_: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Displacement [m], velocity [m/s] and acceleration [m/s²] of the sine behind all input."""
    rate = 2.0 * math.pi * FREQUENCY
    # The phase keeps all samples away from the jump of the law between its branches.
    angle = rate * time_ + 0.3
    return (
        AMPLITUDE * np.sin(angle),
        AMPLITUDE * rate * np.cos(angle),
        -AMPLITUDE * rate**2 * np.sin(angle),
    )


# -- blocks ------------------------------------------------------------

_BLOCK = 20

_RIGHT = 0.03
"""Largest RMS error of a valid block against the law, as a fraction of the peak force."""

_SETTLED = 2.0
"""Time [s] of good samples after which this error limit applies."""

_FOLLOWING, _LONG, _NEW_STREAM = 2, 0.02, 0.2
"""Number of good blocks after a bad one; fraction of the cases that continue until everything has
settled, and fraction that start a new stream."""

_BLIND = 0.25
"""Time [s] after a restart in which the motion is unknown: half a cycle."""

_CYCLE = motion(np.linspace(0.0, 0.5, 500))
_PEAK = float(np.max(np.abs(sine_force(THESIS_28_CELSIUS, *_CYCLE, CURRENT))))


class HostileStream:
    """A good stream with bad blocks in between, predicted with the right parameters."""

    def __init__(self, chance: random.Random) -> None:
        self._chance = chance
        self._begin()

    def _begin(self) -> None:
        self._predictor = ForcePredictor(PredictorSettings())
        self._predictor.set_parameters(
            ParameterSet(
                THESIS_28_CELSIUS,
                peak_velocity_range=(0.05, 0.08),
                current_range=(CURRENT, CURRENT),
            )
        )
        self._assembler = WindowAssembler(0.5, 0.25, 1)
        self._sample = 0
        self._good = 0

    def try_block(self) -> str:
        """One corrupted block, followed by a short or long series of good blocks."""
        if self._chance.random() < _NEW_STREAM:
            self._begin()
        long = self._chance.random() < _LONG
        following = round(2.0 * _SETTLED / PERIOD / _BLOCK) if long else _FOLLOWING
        for number in range(1 + following):
            fault = self._follow(spoil=number == 0)
            if fault:
                return fault
        return ""

    def _follow(self, *, spoil: bool) -> str:
        values = self._next()
        if spoil:
            self._spoil(values)
        try:
            block = SampleBlock(**values)
        except BlockError:
            self._good = 0
            return ""
        prediction = self._predictor.predict(block)
        self._predictor.catch_up()
        for window in self._assembler.add_block(block):
            if window.force.size != window.current.size:
                return "a window of unequal lengths"
        self._assembler.take_events()
        if prediction.force.size != block.sample_count:
            return "a prediction of another length"
        if prediction.valid == bool(prediction.reason):
            return "not valid without a reason, or valid with one"
        self._good = 0 if spoil else self._good + block.sample_count
        return self._judge(block, prediction.force) if prediction.valid else ""

    def _judge(self, block: SampleBlock, predicted: np.ndarray) -> str:
        if not np.isfinite(predicted).all():
            return "a force that is not finite is valid"
        good = self._good * PERIOD
        if good < _BLIND and self._sample * PERIOD < _BLIND:
            return "valid before anything can be known"
        if good < _SETTLED:
            return ""
        time_ = (block.sequence + np.arange(block.sample_count)) * PERIOD
        u, v, a = motion(time_)
        truth = sine_force(THESIS_28_CELSIUS, u, v, a, np.full(time_.size, CURRENT))
        error = math.sqrt(float(np.mean((predicted - truth) ** 2)))
        return f"a force that is wrong by {error:.0f} N is valid" if error > _RIGHT * _PEAK else ""

    def _next(self) -> dict[str, Any]:
        """The next correct block and its current."""
        first = self._sample
        self._sample += _BLOCK
        stamp = T0 + round(first * PERIOD * NANOSECONDS)
        self._add_current(stamp, CURRENT)
        time_ = (first + np.arange(_BLOCK)) * PERIOD
        u, _, _ = motion(time_)
        return {
            "start_ns": stamp,
            "sequence": first,
            "period": PERIOD,
            "displacement": u,
            "force": 1e4 * u,
        }

    def _spoil(self, values: dict[str, Any]) -> None:
        chance = self._chance
        number, count = chance.choice(NUMBERS), chance.choice((0, 1, 5000))
        spoilt = np.array(values["displacement"])
        spoilt[chance.randrange(_BLOCK)] = number
        shift = chance.choice((-(10**18), -(10**8), -1, 1, 10**8, 10**18, 2**62))
        change: dict[str, Any] = chance.choice(
            (
                {chance.choice(("displacement", "force")): spoilt},
                {"displacement": np.full(_BLOCK, number)},
                {"force": np.zeros(chance.choice((0, 1, 1000)))},
                {"period": number},
                {"start_ns": int(values["start_ns"]) + shift},
                {"sequence": chance.choice((0, -1, 2**63, 2**64 - 1))},
                {"displacement": np.zeros(count), "force": np.zeros(count)},
                {"displacement": 1e3 * np.asarray(values["displacement"])},
                {},
            )
        )
        values.update(change)
        if not change:
            stamp = int(values["start_ns"]) + chance.choice((-(10**12), 10**12, 0))
            self._add_current(stamp, number if math.isfinite(number) else 1.0)

    def _add_current(self, stamp_ns: int, current: float) -> None:
        self._predictor.add_current(stamp_ns, current)
        self._assembler.add_current(stamp_ns, current)


# -- records, bags and parameter files ------------------------------------------------------------

_COLUMNS = (
    *("time:s,displacement:mm,force:N,current:A", "time:s,displacement:mm,force:kN,-"),
    *("displacement,force", "", "a:b:c", "time:s,time:s,force:N", ",,,", "force:N*1e400", "\0:s"),
    "time:s," + "-," * 500 + "force:N",
)

YAML = b"""model: bingham
id: a
nrmse: 0.1
current_range: [0, 1.5]
parameters:
  f_y: {value: 1.0, standard_error: 0.1}
  c0: 2e3
  f0: 0
"""


def _table() -> np.ndarray:
    time_ = np.arange(30) * PERIOD
    return np.column_stack((time_, 1e3 * motion(time_)[0], 1e4 * time_, np.ones(30)))


def record_text() -> bytes:
    """A valid text record."""
    rows = "\n".join(",".join(f"{value:.6g}" for value in row) for row in _table())
    return f"t,u,F,i\n{rows}\n".encode()


def record_mat() -> bytes:
    """A valid MAT file."""
    stored = BytesIO()
    savemat(stored, {"data": _table(), "name": "x"})
    return stored.getvalue()


def record_bag(folder: Path) -> bytes:
    """A valid bag without checksums, which would reveal every change."""
    time_ = np.arange(200) * PERIOD
    u = motion(time_)[0]
    write_bag(folder / "good", Recording("good", T0, PERIOD, u, 1e4 * u, np.ones(200)))
    whole = bytearray(next((folder / "good").glob("*.mcap")).read_bytes())
    for place in checksum_places(whole):
        whole[place : place + 4] = bytes(4)
    return bytes(whole)


def checksum_places(whole: bytes | bytearray) -> list[int]:
    """Positions of the checksums of chunks, data section and summary in an MCAP file."""
    places, position = [], 8
    while position < len(whole) - 8:
        operation, length = struct.unpack_from("<BQ", whole, position)
        offset = {0x06: 24, 0x0F: 0, 0x02: 16}.get(operation)
        if offset is not None:
            places.append(position + 9 + offset)
        position += 9 + length
    return places


def try_record(chance: random.Random, path: Path, data: bytes) -> str:
    """Read corrupted bytes as a record; returns a description of a wrong result, if any."""
    path.write_bytes(data)
    columns = _COLUMNS[0] if chance.random() < 0.7 else chance.choice(_COLUMNS)
    options: dict[str, Any] = {}
    if chance.random() < 0.2:
        options = {"current": chance.choice(NUMBERS), "period": chance.choice(NUMBERS)}
    try:
        recording = read_record(path, columns, **options)
        recording.check_plausible()
    except (RecordError, ColumnError, RecordingError, OSError):
        return ""
    return _fault_of(recording)


def try_bag(path: Path, data: bytes) -> str:
    """Read corrupted bytes as a bag; returns a description of a wrong result, if any."""
    path.write_bytes(data)
    try:
        recordings = read_bag(path)
        for recording in recordings:
            recording.check_plausible()
    except (BagError, RecordingError, OSError):
        return ""
    return next(filter(None, map(_fault_of, recordings)), "")


def _fault_of(recording: Recording) -> str:
    for values in (recording.displacement, recording.force, recording.current):
        if values.shape != (recording.sample_count,) or not np.isfinite(values).all():
            return "a recording with values that are not finite, or missing"
    return "" if recording.period > 0.0 else "a recording without a period"


def try_yaml(data: bytes) -> str:
    """Read corrupted bytes as a parameter file; returns a description of a wrong result, if any."""
    try:
        text = data.decode()
    except UnicodeDecodeError:
        return ""
    try:
        parameters = ParameterSet.from_yaml(text)
    except ParameterError:
        return ""
    return "" if np.isfinite(parameters.values).all() else "a parameter that is not finite"


# -- names of state files -------------------------------------------------------------------------

_NAME_PARTS = (
    *("..", "/", "\\", "a", "identifier", ".yaml", "~", "\0", "\n", " ", "ä"),
    *("\u202e", "\ud800"),
    *("x" * 300, "-", "%2e", "*", "$HOME", ":", "link", "loop", "pipe", "folder"),
)


class HostileNames:
    """Names of files in a state folder, next to a file that must stay untouched.

    :mod:`benchmarks.poisoned_starts` corrupts the contents of such files.
    """

    def __init__(self, chance: random.Random, folder: Path) -> None:
        self._chance = chance
        folder.mkdir(parents=True)
        self._folder, self._outside = folder, folder.parent / "outside.yaml"
        self._outside.write_text("untouched")
        (folder / "link.yaml").symlink_to(self._outside)
        (folder / "loop.yaml").symlink_to(folder / "loop.yaml")
        os.mkfifo(folder / "pipe.yaml")
        (folder / "folder.yaml").mkdir()
        self._around = sorted(os.listdir(folder.parent))
        self._state = StateDirectory(folder)
        self._set = ParameterSet(THESIS_28_CELSIUS, set_id="good")

    def try_name(self) -> str:
        """Description of a wrong result for a name, if any."""
        name = "".join(self._chance.choices(_NAME_PARTS, k=self._chance.choice((1, 1, 2, 3))))
        action = self._chance.choice((self._state.load, self._save, self._state.file))
        try:
            result = action(name)
        except StateError:
            result = None
        if sorted(os.listdir(self._outside.parent)) != self._around:
            return f"the name {name!r} has made a file outside"
        if self._outside.read_text() != "untouched":
            return f"the name {name!r} has reached a file outside"
        if isinstance(result, Path) and result.parent != self._folder:
            return f"the name {name!r} means {result}"
        return ""

    def _save(self, name: str) -> Path:
        if name.removesuffix(".yaml") in ("link", "loop", "pipe"):
            raise StateError("these are needed as they are")
        return self._state.save(name, self._set)


# -- all of them ------------------------------------------------------------

TIME_LIMIT = 10.0
"""Time [s] after which a case counts as hanging."""

_SHARES = {"blocks": 35, "text": 20, "yaml": 20, "names": 23, "mat": 1, "bag": 1}
"""Percentage of each kind of input."""


def figures(cases: int = 100_000, seed: int = 0) -> Measured:
    """Run a number of cases."""
    tried, faults = campaign(cases, seed, TIME_LIMIT)
    return {"fuzz_failures": (len(faults), "; ".join([str(dict(tried)), *faults[:3]]))}


def campaign(
    cases: int, seed: int, limit: float | None = None, kinds: tuple[str, ...] = tuple(_SHARES)
) -> tuple[Counter[str], list[str]]:
    """Number of cases of each kind, and the failures; ``limit`` [s] is the time limit of a case."""
    chance = random.Random(seed)
    tried: Counter[str] = Counter()
    faults: list[str] = []
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        tries = _tries(chance, Path(folder))
        weights = [_SHARES[kind] for kind in kinds]
        for number in range(cases):
            (kind,) = chance.choices(kinds, weights)
            tried[kind] += 1
            try:
                with _limited(limit):
                    fault = tries[kind]()
            except Exception as error:
                fault = f"{type(error).__name__}: {str(error)[:200]}"
            if fault:
                faults.append(f"case {number}, {kind}: {fault}")
    return tried, faults


@contextmanager
def _limited(seconds: float | None) -> Iterator[None]:
    """Raise TimeoutError if the body takes longer than the limit."""

    def ring(*_: object) -> None:
        raise TimeoutError(f"it takes longer than {seconds} s")

    if seconds is None:
        yield
        return
    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def _tries(chance: random.Random, folder: Path) -> dict[str, Callable[[], str]]:
    text, mat, bag = record_text(), record_mat(), record_bag(folder)
    names = HostileNames(chance, folder / "states" / "state")
    return {
        "blocks": HostileStream(chance).try_block,
        "text": lambda: try_record(chance, folder / "record.csv", spoilt(chance, text)),
        "mat": lambda: try_record(chance, folder / "record.mat", spoilt(chance, mat)),
        "bag": lambda: try_bag(folder / "record.mcap", spoilt(chance, bag)),
        "yaml": lambda: try_yaml(spoilt(chance, YAML)),
        "names": names.try_name,
    }
