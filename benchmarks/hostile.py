"""Malformed and hostile input in one campaign: blocks, files and recordings.

Every case corrupts good input. A case fails if it raises an undocumented error, exceeds a time
limit, or yields a valid value that differs from the law. The same seed gives the same cases.
"""

from __future__ import annotations

import math
import random
import signal
import struct
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat

import mr_damper_ros as mr
from benchmarks.dampers import DAMPERS
from benchmarks.figure import Measured
from benchmarks.motions import scheduled, stairs, stops
from mr_damper_ros.data_check.recordings import require_units
from mr_damper_ros.emulation.emulator import EmulatedDamper, EmulatedRig, RigSettings
from mr_damper_ros.emulation.faults import Instruments, faults_of
from mr_damper_ros.emulation.motions import Excitation, SineMotion, SteppedSine
from mr_damper_ros.io.bag_files import BagError
from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.io.bag_writer import write_bag
from mr_damper_ros.io.columns import ColumnError, RecordError
from mr_damper_ros.io.records import read_record
from mr_damper_ros.kinematics.periodic_motion import MotionKind, PeriodicMotion
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterError, ParameterSet
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.models.sigmoid.law import sine_force
from mr_damper_ros.signals.blocks import NANOSECONDS, BlockError, SampleBlock
from mr_damper_ros.signals.recording import Recording, RecordingError
from mr_damper_ros.tracking.predictor import ForcePredictor, PredictorSettings
from mr_damper_ros.tracking.window_assembler import WindowAssembler, WindowSettings

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

Try = Callable[[], str]
"""Runs one case and returns a description of the failure; empty if there is none."""


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
    # The phase keeps all samples away from the jump of the law between its branches.
    return SineMotion(AMPLITUDE, FREQUENCY, phase=0.3).at(time_)


# -- blocks ------------------------------------------------------------

_BLOCK = 20

_RIGHT, _SETTLED = 0.03, 2.0
"""Largest RMS error of a valid block against the law, as a fraction of the peak force, and the time
[s] of good samples after which it applies."""

_FOLLOWING, _LONG, _NEW_STREAM = 2, 0.02, 0.2
"""Number of good blocks after a bad one; fraction of the cases that continue until everything has
settled, and fraction that start a new stream."""

_BLIND = 0.25
"""Time [s] after a restart in which the motion is unknown: half a cycle."""

_PEAK = float(
    np.max(np.abs(sine_force(THESIS_28_CELSIUS, *motion(np.linspace(0.0, 0.5, 500)), CURRENT)))
)


class HostileStream:
    """A good stream with bad blocks in between, predicted with the right parameters."""

    def __init__(self, chance: random.Random) -> None:
        self._chance = chance
        self._begin()

    def _begin(self) -> None:
        known = ParameterSet(
            THESIS_28_CELSIUS, peak_velocity_range=(0.05, 0.08), current_range=(CURRENT, CURRENT)
        )
        self._predictor = ForcePredictor(PredictorSettings())
        self._predictor.set_parameters(known)
        self._assembler = WindowAssembler(WindowSettings(0.5, 0.25, looks=1))
        self._sample = self._good = 0

    def try_block(self) -> str:
        """One corrupted block, followed by a short or long series of good blocks."""
        if self._chance.random() < _NEW_STREAM:
            self._begin()
        long = self._chance.random() < _LONG
        following = round(2.0 * _SETTLED / PERIOD / _BLOCK) if long else _FOLLOWING
        faults = (self._follow(spoil=number == 0) for number in range(1 + following))
        return next(filter(None, faults), "")

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
        moved = motion((block.sequence + np.arange(block.sample_count)) * PERIOD)
        error = predicted - sine_force(THESIS_28_CELSIUS, *moved, CURRENT)
        rms = math.sqrt(float(np.mean(error**2)))
        return f"a force that is wrong by {rms:.0f} N is valid" if rms > _RIGHT * _PEAK else ""

    def _next(self) -> dict[str, Any]:
        """The next correct block; its current is sent."""
        first = self._sample
        self._sample += _BLOCK
        stamp = T0 + round(first * PERIOD * NANOSECONDS)
        self._add_current(stamp, CURRENT)
        u, _, _ = motion((first + np.arange(_BLOCK)) * PERIOD)
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
        wrong = np.array(values["displacement"])
        wrong[chance.randrange(_BLOCK)] = number
        shift = chance.choice((-(10**18), -(10**8), -1, 1, 10**8, 10**18, 2**62))
        change: dict[str, Any] = chance.choice(
            (
                {chance.choice(("displacement", "force")): wrong},
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

_YAML = b"""model: bingham
id: a
nrmse: 0.1
current_range: [0, 1.5]
parameters:
  f_y: {value: 1.0, standard_error: 0.1}
  c0: 2e3
  f0: 0
"""


def _good_files(folder: Path) -> dict[str, bytes]:
    """A valid text record, MAT file, bag and parameter file."""
    time_ = np.arange(200) * PERIOD
    u = motion(time_)[0]
    table = np.column_stack((time_, 1e3 * u, 1e4 * time_, np.ones(200)))[:30]
    rows = "\n".join(",".join(f"{value:.6g}" for value in row) for row in table)
    stored = BytesIO()
    savemat(stored, {"data": table, "name": "x"})
    write_bag(folder / "good", Recording("good", T0, PERIOD, u, 1e4 * u, np.ones(200)))
    bag = bytearray(next((folder / "good").glob("*.mcap")).read_bytes())
    for place in checksum_places(bag):  # they would reveal every change
        bag[place : place + 4] = bytes(4)
    return {
        "text": f"t,u,F,i\n{rows}\n".encode(),
        "mat": stored.getvalue(),
        "bag": bytes(bag),
        "yaml": _YAML,
    }


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


def _read_record(chance: random.Random, path: Path) -> list[Recording]:
    columns = _COLUMNS[0] if chance.random() < 0.7 else chance.choice(_COLUMNS)
    options: dict[str, Any] = {}
    if chance.random() < 0.2:
        options = {"current": chance.choice(NUMBERS), "period": chance.choice(NUMBERS)}
    return [read_record(path, columns, **options)]


def _try_file(path: Path, data: bytes, read: Callable[[Path], Sequence[Recording]]) -> str:
    """Read corrupted bytes as recordings."""
    path.write_bytes(data)
    try:
        recordings = read(path)
        for recording in recordings:
            require_units(recording)
    except (BagError, RecordError, ColumnError, RecordingError, OSError):
        return ""
    for found in recordings:
        for values in (found.displacement, found.force, found.current):
            if values.shape != (found.sample_count,) or not np.isfinite(values).all():
                return "a recording with values that are not finite, or missing"
        if not found.period > 0.0:
            return "a recording without a period"
    return ""


def _try_yaml(data: bytes) -> str:
    """Read corrupted bytes as a parameter file."""
    try:
        parameters = ParameterSet.from_yaml(data.decode())
    except (UnicodeDecodeError, ParameterError):
        return ""
    return "" if np.isfinite(parameters.values).all() else "a parameter that is not finite"


# -- recordings with little information -----------------------------------------------------------

_PACKAGE = Path(mr.__file__).parent

_MOTIONS: Mapping[str, Excitation] = {
    "sine": SineMotion(5e-3, 1.3),
    "slow": SineMotion(2e-2, 0.05),
    "tiny": SineMotion(2e-5, 1.0),
    "random": PeriodicMotion(MotionKind.RANDOM, 1e-2, 0.3, 6.0, 30.0, 1),
    "chirp": PeriodicMotion(MotionKind.SWEEP, 4e-3, 0.5, 4.0, 10.0),
    "stepped": SteppedSine(4e-3, 0.5, 4.0, 10.0),
    "resting": stops(SineMotion(6e-3, 1.5), 0.3, 3.0, 6),
    "burst": stairs(2e-2, 3.0, (1.0, 0.2, 0.01), 0.5),
}

_FAULTS = (
    *("", "swapped", "backlash", "friction"),
    *("force_gain:-1", "force_gain:1000", "force_offset:800", "force_clip:300"),
    *("force_stuck@0.2", "force_spikes:500", "force_delay:0.003", "force_hum:20"),
    *("displacement_coarse:0.0005", "displacement_stuck@1", "displacement_delay:0.01"),
)
"""Faults as text; the first entry means no fault."""


def _try_identification(rng: np.random.Generator) -> str:
    """Identify from recordings of emulated dampers of several laws.

    It must return a set with a finite error or raise a ValueError of this package: the message of
    an error of a library does not help the user.
    """
    law, levels = _one_of(rng, MODELS), float(rng.choice([0.0, 0.1]))
    damper = _one_of(rng, DAMPERS)
    recordings = [_poor_recording(damper, rng) for _ in range(rng.integers(1, 4))]
    try:
        found = mr.identify(recordings, model=law, level_per_record=levels)
        end = "" if np.isfinite(found.parameter_set.nrmse) and str(found) else "no number"
    except Exception as error:  # a failure, except a ValueError of the package
        place = Path(traceback.extract_tb(error.__traceback__)[-1].filename)
        ours = isinstance(error, ValueError) and place.is_relative_to(_PACKAGE)
        end = "" if ours else f"{type(error).__name__}: {error}"
    told = "; ".join(each.name for each in recordings)
    return f"{law}, {damper}: {told}: {end}" if end else ""


def _poor_recording(damper: str, rng: np.random.Generator) -> Recording:
    rate = float(rng.choice((100.0, 200.0, 500.0, 1000.0)))
    count = int(rng.choice((300, 800, 2000)))
    moved, fault = _one_of(rng, _MOTIONS), str(rng.choice(_FAULTS))
    each = float(rng.choice([0.2, 1e3]))  # seconds of a current, or one for all
    times = np.arange(0.0, count / rate, each)
    faults = faults_of(fault.split())
    rig = EmulatedRig(
        EmulatedDamper(DAMPERS[damper]),
        _MOTIONS[moved],
        scheduled(times, rng.uniform(0.0, 2.0, times.size)),
        settings=RigSettings(
            sample_rate=rate,
            force_noise=float(rng.choice((0.0, 0.5, 5.0, 30.0))),
            displacement_noise=float(rng.choice((0.0, 1e-6, 1e-5))),
        ),
        faults=faults,
    )
    ((block, _),) = Instruments(faults).read(rig.next_block(count))
    name = f"{moved} {fault or 'sound'} ({count} samples, {rate:g} Hz, {times.size} currents)"
    signals = block.displacement, block.force, block.current
    return Recording(name, block.start_ns, block.period, *signals)


def _one_of(rng: np.random.Generator, names: Mapping[str, object]) -> str:
    return list(names)[int(rng.integers(len(names)))]


# -- the campaign ---------------------------------------------------------------------------------

_SHARES = {"blocks": 46, "text": 26, "yaml": 26, "mat": 1, "bag": 1}
"""Kinds of quick cases, with their percentages."""

TIME_LIMIT = 10.0
"""Time [s] after which a quick case counts as hanging."""


def figures(cases: int = 100_000, seed: int = 0) -> Measured:
    """Run a number of quick cases."""
    kinds = random.Random(seed).choices(list(_SHARES), list(_SHARES.values()), k=cases)
    faults = campaign(kinds, seed, TIME_LIMIT)
    return {"fuzz_failures": (len(faults), "; ".join([str(dict(Counter(kinds))), *faults[:3]]))}


def identification_figures(cases: int = 100, seed: int = 0) -> Measured:
    """Run a number of identifications."""
    faults = campaign(["recording"] * cases, seed)
    return {"identify_failures": (len(faults), "; ".join([f"Of {cases}.", *faults[:3]]))}


def campaign(kinds: Sequence[str], seed: int, limit: float | None = None) -> list[str]:
    """Failures of a case of each of the ``kinds``; ``limit`` [s] is the time limit of a case."""
    faults = []
    with tempfile.TemporaryDirectory(prefix="hostile-") as folder:
        tries = _tries(random.Random(seed), seed, Path(folder))
        for number, kind in enumerate(kinds):
            fault = described(tries[kind], limit)
            if fault:
                faults.append(f"case {number}, {kind}: {fault}")
    return faults


def described(trial: Try, limit: float | None = None) -> str:
    """Failure of a case, which may be an error; one slower than ``limit`` [s] fails."""
    try:
        with _limited(limit):
            return trial()
    except Exception as error:
        return f"{type(error).__name__}: {str(error)[:200]!a}"


@contextmanager
def _limited(seconds: float | None) -> Iterator[None]:
    """Raise TimeoutError if the body takes longer than the limit."""

    def ring(*_: object) -> None:
        raise TimeoutError(f"it takes longer than {seconds} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds or 0.0)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def _tries(chance: random.Random, seed: int, folder: Path) -> dict[str, Try]:
    good = _good_files(folder)
    numbers = iter(range(2**31))

    def file(kind: str, name: str, read: Callable[[Path], Sequence[Recording]]) -> Try:
        return lambda: _try_file(folder / name, spoilt(chance, good[kind]), read)

    return {
        "blocks": HostileStream(chance).try_block,
        "text": file("text", "record.csv", lambda path: _read_record(chance, path)),
        "mat": file("mat", "record.mat", lambda path: _read_record(chance, path)),
        "bag": file("bag", "record.mcap", read_bag),
        "yaml": lambda: _try_yaml(spoilt(chance, good["yaml"])),
        "recording": lambda: _try_identification(np.random.default_rng((seed, next(numbers)))),
    }
