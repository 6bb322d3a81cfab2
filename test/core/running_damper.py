"""Data that a damper shows during identification, put into a record without a node."""

import math
import time
from collections.abc import Callable

import known
import numpy as np

from mr_damper_ros.live.live_record import Concern, LiveRecord
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.tracking.acceptance import Verdict
from mr_damper_ros.tracking.force_scale import FluidTemperature, ForceScale
from mr_damper_ros.tracking.reports import Report

START = 1_700_000_000.0
COEFFICIENTS = {"f_t": 620.0, "alpha": 41.0, "k_c": 1.2, "k_e": 1.1, "v_h": -8e-3, "v_d": 2e-4}
RATE = 100


def add_signals(
    record: LiveRecord,
    at: float,
    displacement: float,
    velocity: float,
    current: float,
    measured: float,
    predicted: float,
    *,
    valid: bool,
) -> None:
    """One sample, with its current and velocity."""
    record.add_current(at, current)
    sample = (np.array([x]) for x in (displacement, measured, predicted, float(valid), velocity))
    record.add_samples(at, 0.01, *sample)


def show_signals(record: LiveRecord, begin: float, duration: float) -> None:
    """Signals of a sine at 100 Hz; the prediction is invalid during the first second."""
    omega, amplitude = 2.0 * math.pi * 1.5, 5e-3
    at = np.arange(begin, begin + duration - 1e-9, 1.0 / RATE)
    u, v = amplitude * np.sin(omega * at), amplitude * omega * np.cos(omega * at)
    force = 620.0 * np.tanh(41.0 * (v - 0.15 * omega * u)) * (1.0 + 0.5 * np.abs(v))
    measured = force + np.random.default_rng(7).normal(0.0, 12.0, at.size)
    record.add_current(START + begin, 0.5)
    record.add_samples(START + begin, 1.0 / RATE, u, measured, 0.97 * force + 8.0, at >= 1.0, v)


def show_samples(record: LiveRecord, duration: float) -> None:
    """The same motion at 1 kHz, in blocks of ten."""
    record.add_current(START, 0.5)
    omega, amplitude = 2.0 * math.pi * 1.5, 5e-3
    for begin in np.arange(0.0, duration - 1e-9, 0.01):
        at = begin + 1e-3 * np.arange(10)
        u, v = amplitude * np.sin(omega * at), amplitude * omega * np.cos(omega * at)
        force = 620.0 * np.tanh(41.0 * (v - 0.15 * omega * u)) * (1.0 + 0.5 * np.abs(v))
        record.add_samples(START + begin, 1e-3, u, force, 0.97 * force + 8.0, np.ones(10))


def show_window(record: LiveRecord, number: int, *, accepted: bool = True) -> None:
    """Outcome of a window that ended ``number`` seconds after the start."""
    scale, end_ns = 1.0 - 0.004 * number, round((START + number) * 1e9)
    values = np.array([*COEFFICIENTS.values(), 14.0])
    report = Report(
        window_start_ns=end_ns - 2_000_000_000,
        stamp_ns=end_ns,
        sample_count=2000,
        method="nelder_mead",
        verdict=Verdict.ACCEPTED if accepted else Verdict.DISTURBED,
        reason="it predicts better than the previous set" if accepted else "a hammer blow",
        set_id=f"nelder_mead-{number}",
        nrmse_before=0.05 + 0.01 * (number % 3),
        nrmse_after=0.045,
        scale=ForceScale(scale, 0.003),
        fluid=FluidTemperature(24.0 + 0.3 * number, 0.4),
        temperature=24.0 + 0.31 * number,
        current=0.5,
        peak_velocity=0.047,
        amplitude=5e-3,
        frequency=1.5,
        coefficient_names=(*COEFFICIENTS, "f_d"),
        coefficients=scale * values,
        coefficient_errors=0.02 * np.abs(values),
    )
    record.add_report(report, 0.012)
    if accepted:
        show_set(record, number)


def show_set(record: LiveRecord, number: int) -> None:
    """A set in use whose last two parameters are undetermined."""
    values = known.PLAUSIBLE * (1.0 + 0.01 * math.sin(number))
    record.set_parameters(
        ParameterSet(
            values,
            0.02 * np.abs(values),
            np.arange(values.size) < values.size - 2,
            set_id=f"nelder_mead-{number}",
            source="nelder_mead",
            stamp_ns=round((START + number) * 1e9),
        )
    )


def show_health(record: LiveRecord, nodes: str | tuple[str, ...] = "") -> None:
    """Diagnostics of the nodes, or of some of them."""
    for concern in (
        Concern(
            "model: prediction", 0, "valid; NRMSE 4.1% of the measured force", {"doubt": "NONE"}
        ),
        Concern(
            "model: latency",
            0,
            "at most 0.61 ms from a block to its prediction; the samples were up to 12 ms old",
            {"slowest [ms]": "0.612", "age [ms]": "12.0", "skipped blocks": "0"},
        ),
        Concern(
            "model: input",
            1,
            "3 samples were lost",
            {"samples/s": "1000.0", "lost": "3", "bridged": "3", "repeated": "0"},
        ),
        Concern(
            "supply: supply",
            0,
            "on; its watchdog switches off after 1 s of silence",
            {"output": "on"},
        ),
        Concern(
            "supply: current",
            0,
            "0.503 A; the current is commanded",
            {"origin": "COMMAND", "set [A]": "0.5", "measured [A]": "0.5031"},
        ),
        Concern(
            "controller: command",
            0,
            "0.5 A for 200 N",
            {"current [A]": "0.5000", "desired force [N]": "200", "expected force [N]": "198.4"},
        ),
        Concern(
            "campaign: campaign",
            0,
            "run 3: 5 mm, 1.5 Hz; the run is recorded",
            {"stage": "RECORDING", "run": "3", "worst error": "0.021", "runs left": "2"},
        ),
        Concern("bridge: motion", 0, "5 mm, 1.5 Hz commanded", {"excitation": "5 mm, 1.5 Hz"}),
        Concern("safety: interlock", 0, "closed", {}),
        Concern("identifier: window", 0, "window 40% full", {}),
        Concern("identifier: state", 2, "the state cannot be kept: the disk is full", {}),
    ):
        if concern.name.startswith(nodes):
            record.add_concern(concern)


def running(seconds: int = 30, clock: Callable[[], float] = time.monotonic) -> LiveRecord:
    """A record of so many seconds with one window per second."""
    record = LiveRecord(clock)
    show_signals(record, 0.0, seconds)
    for number in range(2, seconds + 1):
        show_window(record, number, accepted=number % 4 != 0)
    show_health(record)
    return record
