"""Identification of a stream: windows are cut, fitted in a worker, judged, and kept on disk.

This is all that the identifier node does, without the node: it is given samples and asked for what
has come of them. One job at a time is in the worker, windows in the order of their data, and each
job is made only once the one before it is complete: what is accepted depends on the data alone,
never on how fast they came. What is given out waits until it is on disk, so that nobody hears of a
set that a power failure could take back.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings, GlobalProgress
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.processes.deferred import Outbox
from mr_damper_ros.processes.worker import Failed, Progress, TaskRunner
from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.signals.blocks import SampleBlock
from mr_damper_ros.tracking.acceptance import Judgement, Verdict
from mr_damper_ros.tracking.jobs import Job, Kind, Outcome, run
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.tracker import WindowTracker
from mr_damper_ros.tracking.tracker_state import DISK_PATIENCE, TrackerState
from mr_damper_ros.tracking.window_assembler import RawWindow, WindowAssembler


@dataclass(frozen=True)
class PipelineSettings(CheckedSettings):
    """How long the work may take, and how much of it may wait."""

    fit_time_budget: float = option(
        30.0,
        "Time limit of a fit [s]; then the best result so far is judged. The limit is "
        "generous, so that results depend on the data and not on the load of the computer.",
        minimum=0.01,
        maximum=3600.0,
    )
    waiting_windows: int = option(
        1000,
        "Largest number of windows that wait for their fit; beyond it, the oldest is dropped "
        "and counted in the diagnostics. 1 keeps only the newest window, which suits a live "
        "rig; a large number suits a bag that is played faster than it can be fitted. A "
        "window takes 32 bytes per sample.",
        minimum=1,
        maximum=1_000_000,
    )
    search_time_budget: float = option(
        600.0,
        "Time limit of a global identification [s]; then the best result so far is judged.",
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
    """A search is over; ``outcome`` and ``report`` are None where it never ran or is overtaken."""

    search: Search
    outcome: Outcome | None = None
    report: Report | None = None


@dataclass(frozen=True, eq=False)
class Publication:
    """A report to give out, after ``duration`` seconds of work, and the set that it brought."""

    report: Report
    duration: float
    parameters: ParameterSet | None


Event = Publication | SearchProgress | SearchEnded


@dataclass(eq=False)
class _Running:
    """The job that the worker is at, with its number there, and the search that it is."""

    number: int
    job: Job
    search: Search | None
    overtaken: bool = False
    """Whether it started from a set that is no longer in use."""


class Identifier:
    """Takes in samples, supply current and temperature; gives out reports and sets."""

    def __init__(
        self,
        assembler: WindowAssembler,
        tracker: WindowTracker,
        worker: TaskRunner,
        settings: PipelineSettings,
        state: TrackerState,
    ) -> None:
        self.assembler = assembler
        self.tracker = tracker
        self.worker = worker
        self.state = state
        self.last_report: Report | None = None
        self.dropped_windows = 0
        self._settings = settings
        self._windows: deque[RawWindow] = deque()
        self._searches: deque[Search] = deque()
        self._running: _Running | None = None
        self._given_up: list[Event] = []
        self._outbox: Outbox[Publication] = Outbox(DISK_PATIENCE)
        self._late = 0

    @property
    def waiting_windows(self) -> int:
        """Number of windows, looks not counted, that wait for the worker."""
        return sum(not window.look for window in self._windows)

    @property
    def running(self) -> str:
        """What runs now: "fit", "search", or "" for nothing."""
        if self._running is None:
            return ""
        return Kind.WINDOW.value if self._running.search is None else Kind.SEARCH.value

    def add_block(self, block: SampleBlock) -> list[str]:
        """Add samples; returns what is wrong with how they follow each other, in sentences."""
        self.add_windows(self.assembler.add_block(block))
        return self.assembler.take_events()

    def add_current(self, stamp_ns: int, current: float) -> None:
        """Add a value of the supply current [A]; raises CurrentError where it is not finite."""
        self.add_windows(self.assembler.add_current(stamp_ns, current))

    def add_temperature(self, celsius: float) -> None:
        """Set the temperature [°C] for the windows that become complete from now on."""
        self.assembler.add_temperature(celsius)

    def add_windows(self, windows: list[RawWindow]) -> None:
        """Queue windows and looks.

        When more wait than may, the oldest window is dropped, with the looks before the next.
        """
        for window in windows:
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
        if self._running is not None and self._running.search is search:
            self.worker.cancel()
        elif search in self._searches:
            self._searches.remove(search)
            self._given_up.append(SearchEnded(search))

    def poll(self) -> list[Event]:
        """What has come of it since the last call. Never blocks."""
        events, self._given_up = self._given_up, []
        for told in self.worker.poll():
            running = self._running
            if running is None or running.number != told.task:
                continue
            if isinstance(told, Progress):
                if running.search is not None:
                    events.append(SearchProgress(running.search, told.value))
                continue
            self._running = None
            outcome = (
                Outcome(Judgement(Verdict.FAILED, told.reason))
                if isinstance(told, Failed)
                else told.result
            )
            events += self._end(running, outcome)
        self._next()
        return [*self._outbox.take(self.state.written), *events]

    def _end(self, ended: _Running, outcome: Outcome) -> list[Event]:
        """Let the tracker decide on an outcome, unless another set is in use by now."""
        search = ended.search
        if ended.overtaken:
            return [] if search is None else [SearchEnded(search)]
        before = self.tracker.parameters
        report = self.tracker.complete(ended.job, outcome)
        if report is not None:
            if report.global_due and ended.job.kind is Kind.WINDOW:
                self._searches.append(Search())
            self.last_report = report
            found = None if self.tracker.parameters is before else self.tracker.parameters
            if found is not None:
                self.state.keep()
            self._outbox.add(Publication(report, outcome.duration, found), self.state.given)
        return [] if search is None else [SearchEnded(search, outcome, report)]

    def _next(self) -> None:
        if self._running is not None:
            return
        budgets, search = self._settings, None
        if self._searches:
            search = self._searches.popleft()
            job = self.tracker.search(search.settings, asked=search.settings is not None)
            budget = budgets.search_time_budget
        elif self._windows:
            job, budget = self.tracker.job_of(self._windows.popleft()), budgets.fit_time_budget
        else:
            return
        self._running = _Running(self.worker.submit(run, job, budget=budget), job, search)

    def take_notices(self) -> list[str]:
        """What went wrong besides the data since the last call, in sentences."""
        notices = self.worker.take_notices()
        if self._outbox.late > self._late:
            notices.append(
                f"state_dir takes more than {DISK_PATIENCE:g} s to be written: "
                "publishing what is not kept yet"
            )
        self._late = self._outbox.late
        return notices

    def flush(self) -> list[Publication]:
        """What still waits for the disk, to be given out all the same."""
        return self._outbox.take_all()

    def reset(self) -> str:
        """Back to the initial set; returns why that is not kept on disk, empty where it is.

        Windows that wait belong to the past and are forgotten.
        """
        self.assembler.reset()
        self._windows.clear()
        self._overtake()
        self.tracker.reset()
        self.last_report = None
        return self.state.keep_now()

    def replace(self, parameters: ParameterSet) -> str:
        """Run with this set from now on; returns why it is not kept on disk, empty where it is.

        A window that is being fitted starts again from it.
        """
        if self._running is not None and self._running.search is None:
            self._windows.appendleft(self._running.job.samples)
        self._overtake()
        self.tracker.replace(parameters)
        return self.state.keep_now()

    def _overtake(self) -> None:
        if self._running is not None:
            self._running.overtaken = True
            self.worker.cancel()

    def close(self) -> None:
        """Keep on disk what waits for it."""
        self.state.close()
