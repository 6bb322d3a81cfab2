"""Candidate runs: within all limits, and selected by their information."""

from collections import Counter
from dataclasses import asdict, replace

import known
import numpy as np
import pytest
from campaign_of_three import perform, played
from hypothesis import given
from hypothesis import strategies as st

from mr_damper_ros.campaign.course import fault_of_run
from mr_damper_ros.campaign.runs import RunNotFoundError, cut_run, signal
from mr_damper_ros.estimation.experiment_design import (
    CandidateRuns,
    ForceGoal,
    MachineLimits,
    PlannedRun,
    candidate_runs,
    motions_of,
    window_information,
)
from mr_damper_ros.kinematics.periodic_motion import MotionKind

EVERY_KIND = tuple(MotionKind)
GOAL = ForceGoal(0.02, (0.02, 0.2), (0.0, 1.5))
LIMITS = MachineLimits(0.01, 0.2, 5000.0, 1.5, 4.0, motions=EVERY_KIND)
SWEEP = PlannedRun(0.005, 0.8, (0.0, 0.9), 4.0, MotionKind.SWEEP, 6.2)
RANDOM = PlannedRun(0.005, 1.0, (0.6,), 4.0, MotionKind.RANDOM, 8.0, 1)
SINE = PlannedRun(0.005, 2.5, (0.3, 0.6, 1.2), 4.0)
RUNS = pytest.mark.parametrize("run", [SINE, SWEEP, RANDOM], ids=lambda run: run.kind.value)

ROUNDING = 1e-9
"""Relative tolerance."""


@st.composite
def machines(draw: st.DrawFn) -> tuple[ForceGoal, MachineLimits]:
    speed = draw(st.floats(0.02, 0.5))
    current = draw(st.floats(0.0, 3.0))
    limits = MachineLimits(
        amplitude=draw(st.floats(2e-3, 0.05)),
        peak_velocity=speed * draw(st.floats(0.5, 2.0)),
        force=1e4,
        current=current * draw(st.floats(0.5, 2.0)),
        duration=draw(st.floats(2.0, 6.0)),
        frequency=(draw(st.floats(0.05, 0.5)), draw(st.floats(2.0, 15.0))),
        steps=draw(st.booleans()),
        motions=EVERY_KIND,
    )
    return ForceGoal(0.01, (0.1 * speed, speed), (0.0, current)), limits


@known.fixed(8)
@given(machines())
def test_no_sample_of_any_run_leaves_the_limits(machine: tuple[ForceGoal, MachineLimits]) -> None:
    goal, limits = machine
    # Runs differ in motion and in currents; each is checked once.
    runs = candidate_runs(goal, limits)
    by_motion = {run.motion: run for run in runs}
    for run in by_motion.values():
        time, displacement, _ = signal(run, 40.0 * max(run.frequency, run.highest_frequency))
        velocity = np.diff(displacement) / np.diff(time)
        assert np.abs(displacement).max() <= limits.amplitude * (1.0 + ROUNDING)
        # Tolerance of the velocity, a difference of neighbouring samples.
        assert np.abs(velocity).max() <= limits.peak_velocity * (1.0 + 1e-3)
        assert run.duration <= limits.duration
        assert limits.frequency[0] * (1.0 - ROUNDING) <= run.frequency
        assert max(run.frequency, run.highest_frequency) <= limits.frequency[1]
    for run in runs:
        assert 0.0 <= min(run.currents) <= max(run.currents) <= limits.current * 1.005


def test_every_kind_is_there_where_the_machine_can_make_it() -> None:
    counts = Counter(run.kind for run in candidate_runs(GOAL, LIMITS))
    assert set(counts) == set(EVERY_KIND)
    named = candidate_runs(GOAL, replace(LIMITS, motions=("sine", "sweep", "random")))
    assert Counter(run.kind for run in named) == counts
    sines = candidate_runs(GOAL, replace(LIMITS, motions=(MotionKind.SINE,)))
    assert {run.kind for run in sines} == {MotionKind.SINE}
    assert (0.0, 0.3, 0.6, 0.9, 1.2, 1.5) in {run.currents for run in sines}


@RUNS
def test_a_run_tells_and_demands_what_was_foreseen(run: PlannedRun) -> None:
    foreseen = CandidateRuns(known.SIGMOID, [run], 1000.0).gains(known.PLAUSIBLE, 20.0, 20.0)[0]
    recording = perform(run, noise=0.0, rate=1000.0)
    windows = run.windows(recording)
    found = window_information(known.SIGMOID, windows, [20.0] * len(windows), known.PLAUSIBLE)
    seen = np.diag(found) > 1e-9 * np.diag(found).max()
    # Relative: the few samples on the steep parts of a loop vary between the two samplings.
    ratios = np.diag(foreseen)[seen] / np.diag(found)[seen]
    assert ratios == pytest.approx(1.0, rel=0.6)
    assert np.median(ratios) == pytest.approx(1.0, rel=0.15)
    force, heat = CandidateRuns(known.SIGMOID, [run], 1000.0).demands([known.PLAUSIBLE])
    assert force[0] == pytest.approx(np.abs(recording.force).max(), rel=0.02)
    velocity = np.gradient(recording.displacement, recording.period)
    work = float(np.sum(recording.force * velocity)) * recording.period
    assert heat[0] == pytest.approx(work, rel=0.05)
    assert [window.current[0] for window in windows] == list(run.currents)
    for window in windows:
        left = known.SIGMOID.window_force(window, known.PLAUSIBLE) - window.force
        assert known.rms(left) < 0.01 * known.rms(window.force)


@RUNS
def test_a_run_is_cut_out_of_a_recording_and_read_back(run: PlannedRun) -> None:
    found = cut_run(run, played(run))
    assert found.sample_count == round(run.duration * 500.0)
    assert fault_of_run(run, found) == ""
    assert PlannedRun.from_document(asdict(run)) == run


def test_motions_are_named() -> None:
    assert motions_of(["random", "sine", "sine"]) == (MotionKind.SINE, MotionKind.RANDOM)
    with pytest.raises(ValueError, match="'square' is unknown: use sine, sweep, random"):
        motions_of(["square"])
    with pytest.raises(ValueError, match="sine must be one of them"):
        replace(LIMITS, motions=(MotionKind.SWEEP,))


def test_a_run_is_not_cut_out_of_another() -> None:
    with pytest.raises(RunNotFoundError, match="s of random motion"):
        cut_run(RANDOM, played(SWEEP))


def test_a_sine_made_instead_of_a_sweep_is_refused() -> None:
    instead = perform(replace(SINE, currents=SWEEP.currents), noise=0.0, rate=1000.0)
    assert "from a swept sine as planned" in fault_of_run(SWEEP, instead)
