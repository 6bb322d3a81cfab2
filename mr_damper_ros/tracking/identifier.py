"""Identification from a stream: windows are cut, fitted in a worker and judged; sets are stored.

This is the identifier node without ROS. It takes samples and returns events when polled. The worker
runs one job at a time, windows in the order of their data. Each job is created after the previous
one is complete, so the accepted sets depend on the data alone and not on its rate of arrival. A
publication waits until its set is on disk, so that a power failure never revokes a published set.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings, GlobalProgress
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.processes.files import Outbox
from mr_damper_ros.processes.worker import GRACE, Failed, Progress, TaskRunner
from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.signals.blocks import SampleBlock
from mr_damper_ros.tracking.acceptance import Judgement, Verdict
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.tracker import Job, Outcome, WindowTracker, refused, run
from mr_damper_ros.tracking.tracker_state import TrackerState
from mr_damper_ros.tracking.window_assembler import RawWindow, WindowAssembler


@dataclass(frozen=True)
class PipelineSettings(CheckedSettings):
    """Time limits of the jobs, and the length of the queue."""

    fit_time_budget: float = option(
        30.0,
        "Time limit of a fit [s]; then the best result so far is judged. The limit is "
        "generous, so that results depend on the data and not on the load of the computer.",
        within=(0.01, 3600.0),
    )
    waiting_windows: int = option(
        1000,
        "Largest number of windows that wait for their fit; beyond it, the oldest is dropped "
        "and counted in the diagnostics. 1 keeps only the newest window, which suits a live "
        "rig; a large number suits a bag that is played faster than it can be fitted. A "
        "window takes 32 bytes per sample.",
        within=(1, 1_000_000),
    )
    search_time_budget: float = option(
        600.0,
        "Time limit of a global identification [s]; then the best result so far is judged.",
        within=(0.01, 86_400.0),
    )


@dataclass(frozen=True, eq=False)
class Search:
    """A global identification: requested with ``settings``, or periodic with None."""

    settings: EvolutionSettings | None = None


@dataclass(frozen=True, eq=False)
class SearchProgress:
    """Progress of the running search."""

    search: Search
    progress: GlobalProgress


@dataclass(frozen=True, eq=False)
class SearchEnded:
    """End of a search; ``outcome`` is None if it never ran or was superseded."""

    search: Search
    outcome: Outcome | None = None


@dataclass(frozen=True, eq=False)
class Publication:
    """A report to publish, the ``duration`` [s] of its job, and the new set or None."""

    report: Report
    duration: float
    parameters: ParameterSet | None


Event = Publication | SearchProgress | SearchEnded


class Identifier:
    """Identifies from samples, supply current and temperature; returns reports and sets."""

    def __init__(
        self,
        assembler: WindowAssembler,
        tracker: WindowTracker,
        worker: TaskRunner,
        settings: PipelineSettings,
        state: TrackerState | None = None,
    ) -> None:
        """Without a ``state`` nothing is stored on disk."""
        self.assembler = assembler
        self.tracker = tracker
        self.worker = worker
        self.state = state or TrackerState()
        self.last_report: Report | None = None
        self.dropped_windows = 0
        self._settings = settings
        self._windows: deque[RawWindow] = deque()
        self._searches: deque[Search] = deque()
        # The job in the worker, and its search (None for a window).
        self._job: Job | None = None
        self._search: Search | None = None
        self._given_up: list[Event] = []
        self._outbox: Outbox[Publication] = Outbox(GRACE)
        self._late = 0

    @property
    def waiting_windows(self) -> int:
        """Number of windows that wait for the worker, not counting change checks."""
        return sum(not window.look for window in self._windows)

    @property
    def running(self) -> str:
        """The kind of the running job: "fit", "search", or "" for none."""
        if self._job is None:
            return ""
        return "fit" if self._search is None else "search"

    def add_block(self, block: SampleBlock) -> list[str]:
        """Add samples; returns messages on gaps, repeats and other faults of the sequence."""
        self.add_windows(self.assembler.add_block(block))
        return self.assembler.take_events()

    def add_current(self, stamp_ns: int, current: float) -> None:
        """Add a value of the supply current [A]; raises CurrentError if it is not finite."""
        self.add_windows(self.assembler.add_current(stamp_ns, current))

    def add_temperature(self, celsius: float) -> None:
        """Set the temperature [°C] for the windows completed from now on."""
        self.assembler.add_temperature(celsius)

    def add_windows(self, windows: list[RawWindow]) -> None:
        """Queue windows and change checks.

        A full queue drops the oldest window, with all change checks up to the next window.
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
        """Queue a search; it runs before the waiting windows."""
        self._searches.append(search)
        self._next()

    def cancel_search(self, search: Search) -> None:
        """End a search early, with the best result so far; its end is reported as an event."""
        if self._search is search:
            self.worker.cancel()
        elif search in self._searches:
            self._searches.remove(search)
            self._given_up.append(SearchEnded(search))

    def poll(self) -> list[Event]:
        """Return the events since the last call. Never blocks."""
        events, self._given_up = self._given_up, []
        for told in self.worker.poll():
            if self._job is None:  # it was given up
                continue
            if isinstance(told, Failed):
                events += self._end(refused(self._job, Judgement(Verdict.FAILED, told.reason)))
            elif not isinstance(told, Progress):
                events += self._end(told.result)
            elif self._search is not None:
                events.append(SearchProgress(self._search, told.value))
        self._next()
        return [*self._outbox.take(self.state.writer.done), *events]

    def _end(self, outcome: Outcome) -> list[Event]:
        """Take over the outcome of the job."""
        search = self._search
        self._job = self._search = None
        step = self.tracker.memory.step
        report = self.tracker.complete(outcome)
        if report is not None:
            if report.global_due:
                self._searches.append(Search())
            self.last_report = report
            if outcome.parameters is not None or outcome.memory.step != step:
                self.state.keep(self.tracker)
            publication = Publication(report, outcome.duration, outcome.parameters)
            self._outbox.add(publication, self.state.writer.given)
        return [] if search is None else [SearchEnded(search, outcome)]

    def _next(self) -> None:
        # A job that was given up keeps the worker busy until it has stopped.
        if self._job is not None or self.worker.busy:
            return
        if self._searches:
            self._search = search = self._searches.popleft()
            self._job = self.tracker.search(search.settings, asked=search.settings is not None)
            budget = self._settings.search_time_budget
        elif self._windows:
            self._job = self.tracker.job_of(self._windows.popleft())
            budget = self._settings.fit_time_budget
        else:
            return
        self.worker.submit(run, self._job, budget=budget)

    def take_notices(self) -> list[str]:
        """Return messages on faults of worker and disk since the last call."""
        notices = self.worker.take_notices()
        if self._outbox.late > self._late:
            notices.append(
                f"saving to state_dir takes more than {GRACE:g} s: "
                "sets are published before they are saved"
            )
        self._late = self._outbox.late
        return notices

    def flush(self) -> list[Publication]:
        """Return the publications that still wait for the disk."""
        return self._outbox.take_all()

    def reset(self) -> str:
        """Return to the initial set; returns why it could not be stored on disk, empty if it was.

        Waiting windows are discarded.
        """
        self.assembler.reset()
        self._windows.clear()
        self._supersede()
        self.tracker.reset()
        self.last_report = None
        return self.state.keep_now(self.tracker)

    def replace(self, parameters: ParameterSet) -> str:
        """Use this set from now on; returns why it could not be stored on disk, empty if it was.

        The window in the worker is fitted again, starting from this set. Raises ParameterError if
        the set belongs to another law.
        """
        self.tracker.replace(parameters)
        if self._job is not None and self._job.raw is not None:
            self._windows.appendleft(self._job.raw)
        self._supersede()
        return self.state.keep_now(self.tracker)

    def acknowledge(self) -> str:
        """Accept a step of the load cell; returns what was accepted, empty for nothing."""
        if taken := self.tracker.acknowledge():
            if self._job is not None and self._job.raw is not None:
                self._windows.appendleft(self._job.raw)
            self._supersede()
            taken = "; ".join(filter(None, (taken, self.state.keep_now(self.tracker))))
        return taken

    def _supersede(self) -> None:
        """Give up the running job and the waiting searches, whose windows are no longer known."""
        running = [] if self._search is None else [self._search]
        self._given_up += map(SearchEnded, (*running, *self._searches))
        self._searches.clear()
        self._job = self._search = None
        self.worker.cancel()

    def close(self) -> None:
        """Write the states that wait for the disk, and end."""
        self.state.close()
