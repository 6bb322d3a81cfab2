"""Identification of a stream: windows are cut, fitted in a worker, judged, and kept on disk.

This is all that the identifier node does, without the node: it is given samples and asked for what
has come of them. The tracker's sets depend on the data alone; what is given out waits until it is
on disk, so that nobody hears of a set that a power failure could take back.
"""

from __future__ import annotations

from dataclasses import dataclass

from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.processes.deferred import Outbox
from mr_damper_ros.processes.worker import TaskRunner
from mr_damper_ros.signals.blocks import SampleBlock
from mr_damper_ros.tracking.pipeline import Pipeline, PipelineSettings, SearchEnded, SearchProgress
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.tracker import WindowTracker
from mr_damper_ros.tracking.tracker_state import DISK_PATIENCE, TrackerState
from mr_damper_ros.tracking.window_assembler import RawWindow, WindowAssembler


@dataclass(frozen=True, eq=False)
class Publication:
    """A report to give out, after ``duration`` seconds of work, and the set that it brought."""

    report: Report
    duration: float
    parameters: ParameterSet | None


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
        self.pipeline = Pipeline(tracker, worker, settings)
        self.last_report: Report | None = None
        self._outbox: Outbox[Publication] = Outbox(DISK_PATIENCE)
        self._late = 0

    def add_block(self, block: SampleBlock) -> list[str]:
        """Add samples; returns what is wrong with how they follow each other, in sentences."""
        self._add_windows(self.assembler.add_block(block))
        return self.assembler.take_events()

    def add_current(self, stamp_ns: int, current: float) -> None:
        """Add a value of the supply current [A]; raises CurrentError where it is not finite."""
        self._add_windows(self.assembler.add_current(stamp_ns, current))

    def add_temperature(self, celsius: float) -> None:
        """Set the temperature [°C] for the windows that become complete from now on."""
        self.assembler.add_temperature(celsius)

    def _add_windows(self, windows: list[RawWindow]) -> None:
        for window in windows:
            self.pipeline.add_window(window)

    def poll(self) -> list[Publication | SearchProgress | SearchEnded]:
        """What has come of it since the last call. Never blocks."""
        searches: list[Publication | SearchProgress | SearchEnded] = []
        for event in self.pipeline.poll():
            if not isinstance(event, SearchProgress) and event.report is not None:
                self._take(event.report, event.duration)
            if isinstance(event, (SearchProgress, SearchEnded)):
                searches.append(event)
        return [*self._outbox.take(self.state.written), *searches]

    def _take(self, report: Report, duration: float) -> None:
        self.last_report = report
        if report.accepted:
            self.state.keep()
        found = self.tracker.parameters if report.accepted else None
        self._outbox.add(Publication(report, duration, found), self.state.given)

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
        """Back to the initial set; returns why that is not kept on disk, empty where it is."""
        self.assembler.reset()
        self.pipeline.reset()
        self.last_report = None
        return self.state.keep_now()

    def replace(self, parameters: ParameterSet) -> str:
        """Run with this set from now on; returns why it is not kept on disk, empty where it is."""
        self.pipeline.replace(parameters)
        return self.state.keep_now()

    def close(self) -> None:
        """Keep on disk what waits for it."""
        self.state.close()
