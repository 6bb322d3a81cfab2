"""The engine: identification and prediction of one stream, connected as in the nodes."""

import math
from dataclasses import replace
from pathlib import Path

import known
import numpy as np
import pytest
from random_motion import BandLimitedRandom

import mr_damper_ros as mr
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.processes.worker import Done, Failed, InlineWorker
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.signals.recording import CurrentReading, TemperatureReading, stream_of
from mr_damper_ros.tools import replay
from mr_damper_ros.tracking.acceptance import Verdict
from mr_damper_ros.tracking.engine import Engine, EngineSettings
from mr_damper_ros.tracking.tracker import TrackerSettings

QUICK = EngineSettings(tracking=TrackerSettings(method="least_squares", global_period=0))


def recording(samples: int = 5000) -> mr.Recording:
    run = known.run(samples=samples)
    current = np.full(samples, run.current)
    return mr.Recording("run", known.T0, 1e-3, run.displacement, run.force, current)


def test_an_outcome_takes_effect_after_its_delay() -> None:
    run = recording()
    early, late = (mr.replay(run, settings=replace(QUICK, fit_delay=d)) for d in (0.1, 1.1))
    assert [r.stamp_ns for r in early.reports] == [r.stamp_ns for r in late.reports]
    first_report = early.document()["reports"][0]
    assert first_report["time"] == pytest.approx((early.reports[0].stamp_ns - known.T0) * 1e-9)
    first_valid = [said.time[np.argmax(said.valid)] for said in (early, late)]
    assert first_valid[1] - first_valid[0] == pytest.approx(1.0, abs=0.02)


def test_a_stream_that_ends_completes_the_jobs_that_wait() -> None:
    engine = Engine(replace(QUICK, fit_delay=100.0))
    for _ in engine.follow(stream_of(recording())):
        assert engine.take_publications() == []
    stamps = [each.report.stamp_ns for each in engine.take_publications()]
    assert len(stamps) == 4
    assert stamps == sorted(stamps)


def test_the_given_set_predicts_from_the_start() -> None:
    run = recording()
    truth = ParameterSet(
        known.PLAUSIBLE, peak_velocity_range=(0.0, 1.0), current_range=(0.0, 2.0), set_id="given"
    )
    said = mr.replay(run, truth, settings=QUICK)
    before_a_window = slice(1500, 2000)
    assert said.valid[before_a_window].all()
    assert said.error.nrmse < 0.05


def test_numbers_of_numpy_are_as_good_as_those_of_python() -> None:
    run = recording()
    stuck = np.where(np.arange(5000) < 3000, run.force, run.force[3000])
    python = replace(run, force=stuck)
    numpy = replace(python)
    for name, value in (("start_ns", np.int64(run.start_ns)), ("period", np.float64(run.period))):
        object.__setattr__(numpy, name, value)
    assert np.array_equal(*(mr.replay(r, settings=QUICK).doubts for r in (python, numpy)))
    given = replace(run, period=np.float64(run.period), start_ns=np.int64(run.start_ns))
    assert (type(given.period), type(given.start_ns)) == (float, int)


def test_the_law_is_that_of_the_given_set(tmp_path: Path) -> None:
    given = mr.identify(recording(2000), model="bingham").parameter_set
    given.save(tmp_path / "set.yaml")
    said = mr.replay(recording(), tmp_path / "set.yaml")
    assert {found.model for found in said.sets} <= {"bingham"}
    assert said.reports[0].verdict is not Verdict.FAILED


def test_a_result_prints_and_draws(capsys: pytest.CaptureFixture[str]) -> None:
    said = mr.replay(recording(), settings=QUICK)
    assert "window-1" in str(said)
    assert "accepted" in said._repr_html_()
    assert said.document()["reports"][0]["verdict"] == "ACCEPTED"
    assert len(said.plot().axes) == 3
    assert replay.main(["nowhere", "--plot", "replay.xyz"]) == 2
    assert "replay.xyz must end in .png, .svg, .pdf" in capsys.readouterr().err
    with pytest.raises(ValueError, match="a recording cannot be of type dict"):
        mr.replay({})  # type: ignore[arg-type]


def test_a_recording_is_read_in_order() -> None:
    run = recording(25)
    current = np.where(np.arange(25) < 13, 0.5, 1.0)
    items = list(stream_of(replace(run, current=current, temperature=np.full(25, 40.0)), 10))
    readings = [item for item in items if isinstance(item, CurrentReading)]
    assert [(r.stamp_ns - run.start_ns) * 1000 // NANOSECONDS for r in readings] == [
        *(0, 9),
        *(13, 19),
        24,
    ]
    assert [r.current for r in readings] == [0.5, 0.5, 1.0, 1.0, 1.0]
    assert sum(isinstance(item, TemperatureReading) for item in items) == 3
    with pytest.raises(ValueError, match="at least 1"):
        next(stream_of(run, 0))


def test_a_task_ends_after_its_latency_and_a_failure_is_an_outcome() -> None:
    worker = InlineWorker(lambda task: float(task))
    worker.set_time(1.0)
    number = worker.submit(lambda task, control: task / 2, 4)
    assert worker.poll() == []
    worker.set_time(5.0)
    assert worker.poll() == [Done(number, 2.0)]
    number = worker.submit(lambda task, control: math.sqrt(task), -1)
    with pytest.raises(RuntimeError, match="busy"):
        worker.submit(lambda task, control: None, 1)
    worker.cancel()
    (outcome,) = worker.poll()
    assert isinstance(outcome, Failed)
    assert outcome.task == number
    assert "math domain error" in outcome.reason or "nonnegative" in outcome.reason


def test_a_search_of_random_motion_is_computed() -> None:
    count = 18_000
    time = 1e-3 * np.arange(count)
    moved = BandLimitedRandom(3e-3, 0.3, 3.0, seed=1).at(time)
    current = np.where(time % 6.0 < 3.0, 0.4, 1.2)
    force = (300.0 + 500.0 * current) * np.tanh(moved.velocity / 0.02) + 1500.0 * moved.velocity
    noise = np.random.default_rng(2).normal(0.0, 5.0, count)
    run = mr.Recording("random", known.T0, 1e-3, moved.displacement, force + noise, current)
    said = mr.replay(run, settings=EngineSettings(tracking=TrackerSettings(global_period=2)))
    searches = [each for each in said.reports if each.method == "differential_evolution"]
    assert searches, "two currents and good windows call for a search"
    assert all(each.verdict is not Verdict.FAILED for each in said.reports)
