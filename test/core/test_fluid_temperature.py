"""Temperature maps of the force: known ones, those learnt by a tracker, and those of a program."""

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from pathlib import Path

import known
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mr_damper_ros.api.details import temperature_maps
from mr_damper_ros.api.measured_runs import measured_run
from mr_damper_ros.emulation.emulator import EmulatedDamper, EmulatedRig, ThermalModel
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.io.bag_writer import write_bag
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import LITERATURE, THESIS_28_CELSIUS, THESIS_71_CELSIUS
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.tracking.force_scale import (
    ForceScale,
    TemperatureMap,
    temperature_map,
    with_temperature,
)
from mr_damper_ros.tracking.operating_point import KnownPoints, PointRecord
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.tracker import TrackerSettings, WindowTracker
from mr_damper_ros.tracking.tracker_state import from_text, to_text
from mr_damper_ros.tracking.window_assembler import RawWindow

POINT = (0.0314, 1.5)


# -- the emulated damper -----------------------------------------------------------------------


def learnt(pairs: Iterable[tuple[float, ForceScale]]) -> TemperatureMap:
    points = KnownPoints()
    for celsius, scale in pairs:
        points = with_temperature(points, POINT, celsius, scale)
    return temperature_map(points.at(POINT))


# -- known maps --------------------------------------------------------------------------------

ERROR = 2e-3
"""Relative standard error of the force scale of a window."""


def observed(
    seed: int = 0, *, rate: float = -7e-3, count: int = 60, span: float = 40.0, bend: float = 0.0
) -> tuple[Array, Array, Array]:
    """Temperatures, noisy force scales and their standard errors of an exponential law."""
    rng = np.random.default_rng(seed)
    celsius = 30.0 + span * np.sort(rng.random(count))
    true = np.exp(rate * (celsius - 30.0) + bend * (celsius - 30.0) ** 2)
    return celsius, true * (1.0 + ERROR * rng.normal(size=count)), np.full(count, ERROR)


def fitted(*data: Array) -> TemperatureMap:
    return temperature_map(PointRecord(POINT, temperatures=np.column_stack(data)))


@known.fixed(20)
@given(st.floats(-0.02, -0.004), st.floats(15.0, 60.0), st.integers(0, 1000))
def test_the_inverse_is_the_inverse(rate: float, span: float, seed: int) -> None:
    found = fitted(*observed(seed, rate=rate, span=span))
    for celsius in np.linspace(found.low, found.high, 7)[1:-1]:
        again = found.temperature(found.scale(celsius))
        # Kelvin: rounding, amplified by the root of a nearly straight parabola.
        assert again.celsius == pytest.approx(celsius, abs=1e-6)


def test_the_standard_errors_are_true() -> None:
    """The errors of the temperature of a new window agree with its standard error."""
    deviations = []
    for seed in range(200):
        found = fitted(*observed(seed))
        noise = ERROR * np.random.default_rng([seed, 1]).normal()
        value = math.exp(-7e-3 * 20.0) * (1.0 + noise)
        told = found.temperature(ForceScale(value, ERROR * value))
        deviations.append((told.celsius - 50.0) / told.standard_error)
    # Of a standard deviation of 1 from 200 draws: four of its standard errors of 5 %.
    assert np.std(deviations) == pytest.approx(1.0, abs=0.2)


def test_the_error_of_the_temperature_holds_the_scatter_about_the_map() -> None:
    """It is included even if the windows state errors ten times too small."""
    celsius, scales, errors = observed()
    found = fitted(celsius, scales, 0.1 * errors)
    told = found.temperature(ForceScale(found.scale(50.0).value, 0.1 * ERROR))
    assert told.standard_error >= found.scatter / abs(found.slope(50.0))


def test_outside_of_what_was_seen_nothing_is_known() -> None:
    found = fitted(*observed())
    for celsius in (found.low - 0.1, found.high + 0.1):
        assert math.isnan(found.scale(celsius).value)
    for celsius in (found.low - 3.0, found.high + 3.0):
        scale = ForceScale(math.exp(-7e-3 * (celsius - 30.0)), ERROR)
        assert math.isnan(found.temperature(scale).celsius)
        assert math.isnan(found.temperature(scale).standard_error)


@pytest.mark.parametrize(
    "data",
    [
        observed(count=7),
        observed(span=0.5),
        observed(rate=0.0),
        observed(span=0.0),
        observed(rate=-4e-3, bend=1e-4),
    ],
    ids=["few windows", "small span", "no effect", "one temperature", "force falls and rises"],
)
def test_what_does_not_identify_a_map_gives_none(data: tuple[Array, Array, Array]) -> None:
    assert fitted(*data) is None


def test_unknown_temperatures_and_scales_are_left_out() -> None:
    pairs = []
    for celsius, scale, error in zip(*observed(), strict=True):
        pairs += [(celsius, ForceScale(scale, error)), (math.nan, ForceScale(scale, error))]
        pairs.append((celsius, ForceScale()))
    assert learnt(pairs).windows == 60


def test_what_is_kept_of_a_long_run_is_bounded_and_says_the_same() -> None:
    data = observed(count=3000)
    pairs = zip(*data, strict=True)
    kept, whole = learnt((c, ForceScale(scale, error)) for c, scale, error in pairs), fitted(*data)
    assert kept.windows <= 400
    assert (kept.low, kept.high) == (whole.low, whole.high)
    middle = 0.5 * (whole.low + whole.high)
    expected = whole.scale(middle).value
    # Of the error of one window: difference of maps of the stored points and of all points.
    assert kept.scale(middle).value == pytest.approx(expected, abs=0.2 * ERROR)


# -- tracker temperature ---------------------------------------------------------------------------

COLD, HOT = 28.0, 71.0
SAMPLES = 1000
WARMING = 24
"""Number of windows from 28 to 71 °C."""


def warmed(number: int, celsius: float, *, thermometer: bool) -> RawWindow:
    """Window of the thesis' damper at a temperature, with or without a thermometer."""
    run = known.run(
        THESIS_28_CELSIUS, current=1.5, samples=SAMPLES, start=number * SAMPLES * 1e-3, seed=None
    )
    clean = known.drifting_force(run, (celsius - COLD) / (HOT - COLD))
    noise = np.random.default_rng(number).normal(0.0, known.NOISE, SAMPLES)
    changed = dataclasses.replace(run, force=clean + noise)
    measured = celsius if thermometer else math.nan
    return known.raw_window(changed, number=number, temperature=measured)


def new() -> WindowTracker:
    settings = TrackerSettings(method="least_squares", global_period=0)
    return WindowTracker(settings, ParameterSet(LITERATURE))


@cache
def warming() -> tuple[str, ParameterSet, tuple[Report, ...]]:
    """The memory, the running set and the reports of a tracker that has followed the warming."""
    tracked = new()
    reports = [
        known.fed(tracked, warmed(number, celsius, thermometer=True))[0]
        for number, celsius in enumerate(np.linspace(COLD, HOT, WARMING).tolist())
    ]
    return to_text(tracked.memory), tracked.parameters, tuple(reports)


def experienced() -> WindowTracker:
    text, parameters, _ = warming()
    tracked = new()
    tracked.resume(parameters, from_text(text, parameters.law))
    return tracked


def test_where_it_is_not_it_is_estimated_from_the_force() -> None:
    """A tracker restarted with the stored memory estimates it too."""
    tracked = experienced()
    for number, celsius in enumerate((65.0, 50.0, 40.0, 32.0), start=WARMING):
        (report,) = known.fed(tracked, warmed(number, celsius, thermometer=False))
        assert math.isnan(report.temperature)
        # Four standard errors, and 0.1 K for the map, a curve in ln s, against the straight line in
        # F.
        allowed = 4.0 * report.fluid.standard_error + 0.1
        assert abs(report.fluid.celsius - celsius) < allowed
        # Kelvin: a larger error would be useless for a warming of 43 K.
        assert allowed < 2.0


def leaked(tracked: WindowTracker, later: float) -> Report:
    """Change check on a damper that lost a fifth of its force ``later`` windows after the last."""
    before = warmed(WARMING, 50.0, thermometer=False)
    known.fed(tracked, before)
    window = warmed(WARMING + 1, 50.0, thermometer=False)
    duration = window.start_ns - before.start_ns
    look = dataclasses.replace(
        window,
        start_ns=before.start_ns + round(later * duration),
        force=0.8 * window.force,
        look=SAMPLES // 2,
    )
    return tracked.follow(look)


def test_a_sudden_change_forgets_the_map() -> None:
    """A sudden loss of a fifth of the force must not be taken for warming."""
    tracked = experienced()
    early = leaked(tracked, 0.5)
    assert not any(record.temperatures.size for record in tracked.points.records)
    assert math.isnan(early.fluid.celsius)


# -- temperature maps of bags, for which a thermometer is required ---------------------------------

COLD_SET = ParameterSet(THESIS_28_CELSIUS)


def heated(current: float = 1.5, *, thermometer: bool = True) -> Recording:
    """Fifty seconds in which the damper heats from 28 °C to nearly 71 °C."""
    rig = EmulatedRig(
        EmulatedDamper(THESIS_28_CELSIUS, THESIS_71_CELSIUS),
        SineMotion(5e-3, 1.0),
        current,
        thermal=ThermalModel(heat_capacity=25.0, conductance=0.0),
    )
    recording = rig.record(50.0)
    return recording if thermometer else replace(recording, temperature=None)


def test_a_bag_with_a_thermometer_gives_the_map(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", heated())
    (found,) = temperature_maps([measured_run(tmp_path / "bag")], COLD_SET)
    # [m/s] and [A] of the operating point of a steady run.
    assert found.operating_point == pytest.approx((0.0314, 1.5), abs=1e-3)
    # Ratio of the forces at 71 °C and 28 °C in the loops of the two published sets.
    expected = 1.0 - (1.0 - 0.7561) * (found.high - found.low) / (HOT - COLD)
    # Kelvin: the map must cover most of the 43 K; the last windows end a little earlier.
    assert found.high - found.low > 35.0
    ratio = found.scale(found.high).value / found.scale(found.low).value
    # Noise of a ratio of two forces, and the difference between a curve in ln s and a line in F.
    assert ratio == pytest.approx(expected, abs=0.01)


def test_a_bag_without_a_thermometer_gives_none(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", heated(thermometer=False))
    bag = measured_run(tmp_path / "bag")
    assert [part.temperature for part in bag.recordings] == [None]
    assert temperature_maps([bag], COLD_SET) == []
