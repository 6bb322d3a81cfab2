"""A tracker learns force over temperature while it is measured, and estimates it when it is not."""

from __future__ import annotations

import dataclasses
import math
from functools import cache

import known
import numpy as np

from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import LITERATURE, THESIS_28_CELSIUS
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.tracker import TrackerSettings, WindowTracker
from mr_damper_ros.tracking.tracker_state import from_text, to_text
from mr_damper_ros.tracking.window_assembler import RawWindow

COLD, HOT = 28.0, 71.0
SAMPLES = 1000
WARMING = 24
"""Windows from 28 to 71 °C."""


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
    """The memory, the running set and the reports of a tracker that has seen the warming."""
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
    """Also by a tracker that was started anew with what the other had learnt."""
    tracked = experienced()
    for number, celsius in enumerate((65.0, 50.0, 40.0, 32.0), start=WARMING):
        (report,) = known.fed(tracked, warmed(number, celsius, thermometer=False))
        assert math.isnan(report.temperature)
        # By which an estimate may miss the truth: one in some ten thousand would by chance.
        # Kelvin by which a curve in ln s may differ from the known damper's straight line in F.
        allowed = 4.0 * report.fluid.standard_error + 0.1
        assert abs(report.fluid.celsius - celsius) < allowed
        # Kelvin: a temperature that is known no better than this would say little of 43 K of
        # warming.
        assert allowed < 2.0


def leaked(tracked: WindowTracker, later: float) -> Report:
    """A look at a damper that has lost a fifth of its force, so many windows after the last."""
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
    early = tracked.follow(look)
    assert early is not None
    return early


def test_a_sudden_change_forgets_the_map() -> None:
    """A damper that has lost a fifth of its force while one looked on is not a warm one."""
    tracked = experienced()
    early = leaked(tracked, 0.5)
    assert not any(record.temperatures.size for record in tracked.points.records)
    assert math.isnan(early.fluid.celsius)
