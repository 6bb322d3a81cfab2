"""The order in which windows and searches go through the worker to the tracker.

One job at a time, windows in the order of their data, and each task built only once the one before
it is complete: what is accepted then depends on the data alone, never on how fast they came.
"""

from __future__ import annotations

import math
import time
from collections import deque
from dataclasses import dataclass

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings, GlobalProgress
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.processes.worker import Control, Done, Failed, Progress, TaskRunner
from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.tracking.acceptance import Judgement, Verdict
from mr_damper_ros.tracking.global_task import run_global
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.tasks import FitResult, FitTask, GlobalResult, GlobalTask
from mr_damper_ros.tracking.tracker import WindowTracker
from mr_damper_ros.tracking.window_assembler import RawWindow
from mr_damper_ros.tracking.window_task import run_fit


@dataclass(frozen=True)
class PipelineSettings(CheckedSettings):
    """How long the work may take, and how much of it may wait."""

    fit_time_budget: float = option(
        30.0,
        "A fit that takes longer [s] is stopped, and the best so far is judged like any other. The "
        "limit is generous, so that the result depends on the data and not on how busy the "
        "computer is.",
        minimum=0.01,
        maximum=3600.0,
    )
    waiting_windows: int = option(
        1000,
        "Windows that may wait for their fit; when there are more, the oldest is dropped and "
        "counted in the diagnostics. With 1 the newest window replaces the waiting one, which is "
        "right for a live rig; a large number is right for a bag that is replayed faster than it "
        "can be fitted. A window takes 32 bytes per sample.",
        minimum=1,
        maximum=1_000_000,
    )
    search_time_budget: float = option(
        600.0,
        "A global identification that takes longer [s] is stopped, and the best so far is judged.",
        minimum=0.01,
        maximum=86_400.0,
    )


@dataclass(frozen=True, eq=False)
class Search:
    """A global identification that somebody asked for, or (``settings`` None) that fell due."""

    settings: EvolutionSettings | None = None


@dataclass(frozen=True, eq=False)
class SearchProgress:
    """How far the running search is."""

    search: Search
    progress: GlobalProgress


@dataclass(frozen=True, eq=False)
class SearchEnded:
    """A search is over; ``result`` and ``report`` are None where it never ran or does not count."""

    search: Search
    result: GlobalResult | None = None
    report: Report | None = None
    duration: float = math.nan


@dataclass(frozen=True, eq=False)
class WindowEnded:
    """The fit of a window is over, after ``duration`` seconds of work (NaN: it failed)."""

    report: Report
    duration: float


Event = SearchProgress | SearchEnded | WindowEnded


@dataclass(frozen=True, eq=False)
class _WindowJob:
    """The window that the worker is at, with the number of its task there."""

    number: int
    task: FitTask


@dataclass(frozen=True, eq=False)
class _SearchJob:
    """The search that the worker is at, with the number of its task there."""

    number: int
    task: GlobalTask
    search: Search


class Pipeline:
    """Windows and searches that wait, and the one that runs.

    When more windows wait than may, the oldest is dropped, and with it the looks before the next.
    """

    def __init__(
        self, tracker: WindowTracker, worker: TaskRunner, settings: PipelineSettings
    ) -> None:
        self.dropped_windows = 0
        self._tracker = tracker
        self._worker = worker
        self._settings = settings
        self._windows: deque[RawWindow] = deque()
        self._searches: deque[Search] = deque()
        self._given_up: list[Event] = []
        self._job: _WindowJob | _SearchJob | None = None
        self._overtaken = False

    @property
    def waiting_windows(self) -> int:
        """Number of windows, looks not counted, that wait for the worker."""
        return sum(not window.look for window in self._windows)

    @property
    def running(self) -> str:
        """What runs now: "fit", "search", or "" for nothing."""
        if self._job is None:
            return ""
        return "fit" if isinstance(self._job, _WindowJob) else "search"

    def add_window(self, window: RawWindow) -> None:
        """Queue a window or a look."""
        self._windows.append(window)
        if self.waiting_windows > self._settings.waiting_windows:
            while self._windows.popleft().look:
                pass
            self.dropped_windows += 1
            while self._windows[0].look:
                self._windows.popleft()
        self._next()

    def add_search(self, search: Search) -> None:
        """Queue a search; it goes before the windows that wait."""
        self._searches.append(search)
        self._next()

    def cancel_search(self, search: Search) -> None:
        """End a search soon, with the best so far; it still ends with an event."""
        if isinstance(self._job, _SearchJob) and self._job.search is search:
            self._worker.cancel()
        elif search in self._searches:
            self._searches.remove(search)
            self._given_up.append(SearchEnded(search))

    def reset(self) -> None:
        """Back to the initial set; windows that wait belong to the past and are forgotten."""
        self._windows.clear()
        self._overtake()
        self._tracker.reset()

    def replace(self, parameters: ParameterSet) -> None:
        """Run with this set from now on; a window that is being fitted starts again from it."""
        if isinstance(self._job, _WindowJob):
            self._windows.appendleft(self._job.task.window)
        self._overtake()
        self._tracker.replace(parameters)

    def poll(self) -> list[Event]:
        """What has happened since the last call. Never blocks."""
        events, self._given_up = self._given_up, []
        for outcome in self._worker.poll():
            job = self._job
            if job is None or job.number != outcome.task:
                continue
            if isinstance(outcome, Progress):
                if isinstance(job, _SearchJob):
                    events.append(SearchProgress(job.search, outcome.value))
                continue
            self._job = None
            overtaken, self._overtaken = self._overtaken, False
            if isinstance(job, _WindowJob):
                events += [] if overtaken else self._window_ended(job.task, outcome)
            else:
                events += self._search_ended(job, outcome, counts=not overtaken)
        self._next()
        return events

    def _overtake(self) -> None:
        """The result of what runs now was searched from a set that is no longer in use."""
        if self._job is not None:
            self._overtaken = True
            self._worker.cancel()

    def _window_ended(self, task: FitTask, outcome: Done | Failed) -> list[Event]:
        result, duration = FitResult(_failed(outcome)), math.nan
        if isinstance(outcome, Done):
            result, duration = outcome.result
        if task.window.look:
            early = self._tracker.complete_look(task, result)
            return [] if early is None else [WindowEnded(early, duration)]
        report = self._tracker.complete(task, result)
        if report.global_due:
            self._searches.append(Search())
        return [WindowEnded(report, duration)]

    def _search_ended(
        self, job: _SearchJob, outcome: Done | Failed, *, counts: bool
    ) -> list[Event]:
        if not counts:
            return [SearchEnded(job.search)]
        result, duration = GlobalResult(_failed(outcome)), math.nan
        if isinstance(outcome, Done):
            result, duration = outcome.result
        report = self._tracker.complete_global(job.task, result)
        return [SearchEnded(job.search, result, report, duration)]

    def _next(self) -> None:
        if self._job is not None:
            return
        if self._searches:
            search = self._searches.popleft()
            global_task = self._tracker.global_task(search.settings)
            number = self._worker.submit(
                _run_search, global_task, budget=self._settings.search_time_budget
            )
            self._job = _SearchJob(number, global_task, search)
        elif self._windows:
            fit_task = self._tracker.window_task(self._windows.popleft())
            number = self._worker.submit(_run_fit, fit_task, budget=self._settings.fit_time_budget)
            self._job = _WindowJob(number, fit_task)


def _failed(outcome: Done | Failed) -> Judgement | None:
    return Judgement(Verdict.FAILED, outcome.reason) if isinstance(outcome, Failed) else None


def _run_fit(task: FitTask, control: Control) -> tuple[FitResult, float]:
    began = time.perf_counter()
    return run_fit(task, control.should_stop), time.perf_counter() - began


def _run_search(task: GlobalTask, control: Control) -> tuple[GlobalResult, float]:
    began = time.perf_counter()
    return run_global(task, control.report), time.perf_counter() - began
