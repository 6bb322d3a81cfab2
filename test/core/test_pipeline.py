"""Windows and searches are processed in the order of the data under all circumstances."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from step_worker import StepWorker

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.models.sigmoid.law import sine_force
from mr_damper_ros.tracking.identifier import (
    Event,
    Identifier,
    PipelineSettings,
    Publication,
    Search,
    SearchEnded,
    SearchProgress,
)
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.tracker import TrackerSettings, WindowTracker
from mr_damper_ros.tracking.window_assembler import RawWindow, WindowAssembler, WindowSettings

PERIOD = 1.0 / 512.0
COUNT = 1024
INITIAL = ParameterSet(THESIS_28_CELSIUS * np.where(np.arange(16) == 0, 0.7, 1.0), set_id="start")
QUICK_SEARCH = EvolutionSettings(generations=3, population=5)


def window(number: int, current: float = 1.0, speed: float = 1.0) -> RawWindow:
    """A window of a damper that weakens by 5 % from one window to the next."""
    t = np.arange(COUNT) * PERIOD
    w = 2.0 * math.pi * speed
    u, v, a = 5e-3 * np.sin(w * t), 5e-3 * w * np.cos(w * t), -5e-3 * w * w * np.sin(w * t)
    noise = np.random.default_rng(number).normal(0.0, 5.0, COUNT)
    return RawWindow(
        start_ns=number * 10**9,
        period=PERIOD,
        displacement=u,
        force=0.95**number * sine_force(THESIS_28_CELSIUS, u, v, a, np.full(COUNT, current))
        + noise,
        current=np.full(COUNT, current),
    )


@dataclass
class Bench:
    """An identification with all its parts."""

    identifier: Identifier
    worker: StepWorker
    tracker: WindowTracker

    def work_off(self) -> list[Event]:
        events: list[Event] = []
        while True:
            self.worker.work()
            events += self.identifier.poll()
            if not self.identifier.running:
                return events


class StateByHand:
    """Replaces the state folder; a state is written when :meth:`write` is called."""

    def __init__(self) -> None:
        self.given = self.done = 0
        self.writer = self

    def keep(self, tracker: WindowTracker) -> None:
        self.given += 1

    def keep_now(self, tracker: WindowTracker) -> str:
        self.keep(tracker)
        self.write()
        return ""

    def write(self) -> None:
        self.done = self.given


def bench(*, waiting_windows: int = 1000, global_period: int = 0, disk: Any = None) -> Bench:
    worker = StepWorker()
    settings = TrackerSettings(global_period=global_period, evolution=QUICK_SEARCH)
    tracker = WindowTracker(settings, INITIAL)
    identifier = Identifier(
        WindowAssembler(WindowSettings(2.0, 1.0, looks=0)),
        tracker,
        worker,  # type: ignore[arg-type]
        PipelineSettings(waiting_windows=waiting_windows),
        disk,
    )
    return Bench(identifier, worker, tracker)


def of_windows(events: list[Event]) -> list[Report]:
    """Reports of windows."""
    searches = {id(e.outcome.report) for e in events if isinstance(e, SearchEnded) and e.outcome}
    reports = [e.report for e in events if isinstance(e, Publication)]
    return [report for report in reports if id(report) not in searches]


def starts(events: list[Event]) -> list[int]:
    return [report.window_start_ns // 10**9 for report in of_windows(events)]


def results(events: list[Event]) -> list[tuple[Any, ...]]:
    """All contents of the reports in a comparable form."""
    return [
        (e.report.stamp_ns, e.report.accepted, e.report.set_id, e.report.coefficients.tobytes())
        for e in events
        if isinstance(e, Publication)
    ]


def test_the_results_do_not_depend_on_how_fast_the_windows_come() -> None:
    windows = [window(n, current=0.5 * (n % 3), speed=1.0 + n % 2) for n in range(8)]
    fast, slow = bench(global_period=3), bench(global_period=3)
    for item in windows:
        fast.identifier.add_windows([item])
    fast_events = fast.work_off()
    slow_events: list[Event] = []
    for item in windows:
        slow.identifier.add_windows([item])
        slow_events += slow.work_off()
    assert results(fast_events) == results(slow_events)
    assert any(isinstance(event, SearchEnded) for event in fast_events)
    assert np.array_equal(fast.tracker.parameters.values, slow.tracker.parameters.values)


def test_the_oldest_waiting_window_makes_room() -> None:
    b = bench(waiting_windows=1)
    for number in range(5):
        b.identifier.add_windows([window(number)])
    assert b.identifier.dropped_windows == 3
    assert starts(b.work_off()) == [0, 4]


def test_a_window_that_cannot_be_fitted_has_its_report() -> None:
    b = bench()
    b.worker.failing = True
    b.identifier.add_windows([window(0)])
    (report,) = of_windows(b.work_off())
    assert not report.accepted
    assert report.reason == "the worker process died"
    assert b.tracker.parameters is INITIAL
    b.worker.failing = False
    b.identifier.add_windows([window(1)])
    (report,) = of_windows(b.work_off())
    assert report.accepted


def test_a_search_goes_before_the_windows_that_wait() -> None:
    b = bench()
    for number in range(2):
        b.identifier.add_windows([window(number, speed=1.0 + number)])
    b.work_off()
    for number in range(2, 5):
        b.identifier.add_windows([window(number, speed=1.0 + number)])
    search = Search(QUICK_SEARCH)
    b.identifier.add_search(search)
    events = b.work_off()
    kinds = [type(event) for event in events if not isinstance(event, SearchProgress)]
    assert kinds == [Publication, Publication, SearchEnded, Publication, Publication]
    progress = [event for event in events if isinstance(event, SearchProgress)]
    assert progress
    assert all(event.search is search for event in progress)


def test_a_cancelled_search_keeps_the_best_so_far() -> None:
    b = bench()
    b.identifier.add_windows([window(0)])
    b.work_off()
    search = Search(EvolutionSettings(generations=10**6, population=5))
    b.identifier.add_search(search)
    b.identifier.cancel_search(search)
    (event,) = [e for e in b.work_off() if isinstance(e, SearchEnded)]
    assert event.outcome is not None
    assert event.outcome.found is not None


def test_a_search_cancelled_in_the_queue_never_runs() -> None:
    b = bench()
    b.identifier.add_windows([window(0)])
    search = Search(QUICK_SEARCH)
    b.identifier.add_search(search)
    b.identifier.cancel_search(search)
    events = b.work_off()
    assert len(of_windows(events)) == 1
    (event,) = [e for e in events if isinstance(e, SearchEnded)]
    assert event.outcome is None


def test_reset_forgets_what_runs_and_what_waits() -> None:
    b = bench()
    for number in range(3):
        b.identifier.add_windows([window(number)])
    b.identifier.reset()
    assert b.work_off() == []
    assert b.tracker.parameters is INITIAL
    b.identifier.add_windows([window(3)])
    assert starts(b.work_off()) == [3]


def test_a_new_set_makes_the_running_fit_start_again_from_it() -> None:
    b = bench()
    for number in range(2):
        b.identifier.add_windows([window(number)])
    loaded = ParameterSet(THESIS_28_CELSIUS, set_id="loaded")
    b.identifier.replace(loaded)
    assert b.tracker.parameters is loaded
    reference = bench()
    reference.identifier.replace(loaded)
    for number in range(2):
        reference.identifier.add_windows([window(number)])
    assert results(b.work_off()) == results(reference.work_off())


@pytest.mark.parametrize(("switch", "fitted"), [(Identifier.reset, []), (None, [0])])
def test_a_window_is_fitted_again_at_most_once(switch: Any, fitted: list[int]) -> None:
    b = bench()
    b.identifier.add_windows([window(0)])
    (switch or (lambda made: made.replace(INITIAL)))(b.identifier)
    b.identifier.replace(INITIAL)
    assert starts(b.work_off()) == fitted


def test_a_window_that_makes_room_takes_its_looks_along() -> None:
    b = bench(waiting_windows=1)
    for number in range(4):
        b.identifier.add_windows([window(number)])
        b.identifier.add_windows([replace(window(number), look=200)])
    assert (b.identifier.waiting_windows, b.identifier.dropped_windows) == (1, 2)
    assert starts(b.work_off()) == [0, 3]


def test_a_set_is_given_out_once_it_is_on_disk() -> None:
    disk = StateByHand()
    b = bench(disk=disk)
    b.identifier.add_windows([window(0)])
    assert b.work_off() == []
    assert (disk.given, disk.done) == (1, 0)
    disk.write()
    (found,) = b.identifier.poll()
    assert isinstance(found, Publication)
    assert found.parameters is not None
    assert b.identifier.take_notices() == []


@pytest.mark.parametrize(
    "switch", [Identifier.reset, lambda made: made.replace(INITIAL)], ids=["reset", "load"]
)
def test_another_set_forgets_what_runs_and_is_kept(switch: Callable[[Identifier], str]) -> None:
    disk = StateByHand()
    b = bench(disk=disk)
    b.identifier.add_windows([window(0)])
    b.work_off()
    b.identifier.flush()
    searches = Search(QUICK_SEARCH), Search()
    for search in searches:
        b.identifier.add_search(search)
    assert switch(b.identifier) == ""
    ended = [event for event in b.work_off() if isinstance(event, SearchEnded)]
    assert {each.search: each.outcome for each in ended} == dict.fromkeys(searches)
    assert b.tracker.parameters is INITIAL
    assert (disk.given, disk.done) == (2, 2)
