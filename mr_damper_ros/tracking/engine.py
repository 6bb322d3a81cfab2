"""The engine: samples and supply currents in; windows, verdicts, sets and the predicted force out.

One object without ROS and without a clock: it is driven by the stamps of the data, so that what it
gives depends on the data and the settings alone. It joins the two halves that the nodes run, the
:class:`Identifier` of the identifier node and the :class:`ForcePredictor` of the model node, as the
messages on damper/fit_report and damper/parameters join them. Recordings, benchmarks, studies and
tests are driven through it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

from mr_damper_ros.models.parameter_set import ParameterSet, start_set
from mr_damper_ros.processes.worker import InlineWorker
from mr_damper_ros.settings.option_table import CheckedSettings, group, option
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock
from mr_damper_ros.signals.recording import CurrentReading, StreamItem
from mr_damper_ros.signals.uniform_grid import GridSettings
from mr_damper_ros.tracking.identifier import Identifier, PipelineSettings, Publication
from mr_damper_ros.tracking.jobs import Job, Kind
from mr_damper_ros.tracking.predictor import ForcePredictor, Prediction, PredictorSettings
from mr_damper_ros.tracking.state_directory import StateDirectory
from mr_damper_ros.tracking.tracker import TrackerSettings, WindowTracker
from mr_damper_ros.tracking.tracker_state import TrackerState
from mr_damper_ros.tracking.window_assembler import WindowAssembler, WindowSettings


@dataclass(frozen=True)
class EngineSettings(CheckedSettings):
    """Settings of the identification and of the prediction; the defaults are those of the nodes."""

    windows: WindowSettings = group(WindowSettings, flat=True)
    tracking: TrackerSettings = group(TrackerSettings, flat=True)
    predictor: PredictorSettings = group(PredictorSettings, flat=True)
    grid: GridSettings = group(GridSettings, flat=True)
    work: PipelineSettings = group(PipelineSettings, flat=True)
    fit_delay: float = option(
        0.3,
        "Time [s] of data from the start of a window fit until its outcome takes effect.",
        minimum=0.0,
        maximum=3600.0,
    )
    search_delay: float = option(
        1.0,
        "Time [s] of data from the start of a global identification until its outcome takes "
        "effect.",
        minimum=0.0,
        maximum=3600.0,
    )

    def for_law(self, model: str) -> EngineSettings:
        """The settings for another force law."""
        return replace(self, tracking=replace(self.tracking, model=model))


class Engine:
    """Identifies a damper and predicts its force from one stream.

    ``start``: the set to begin with; None for that of the law in the settings, which is valid
    nowhere. ``identify``: whether windows are fitted; else the prediction runs alone. Jobs run in
    this process; their outcomes take effect after the delays in the settings.

    Raises ParameterError where the set is of another law than the settings.
    """

    def __init__(
        self,
        settings: EngineSettings | None = None,
        start: ParameterSet | None = None,
        *,
        identify: bool = True,
    ) -> None:
        self.settings = given = settings or EngineSettings()
        begin = start or start_set(given.tracking.law)
        tracker = WindowTracker(given.tracking, begin)
        self.worker = InlineWorker(self._seconds_until_outcome)
        self.identifier = Identifier(
            WindowAssembler(
                given.windows.window,
                given.windows.hop,
                given.windows.looks,
                given.windows.longest_window,
                given.grid,
            ),
            tracker,
            self.worker,
            given.work,
            TrackerState(tracker, StateDirectory(""), "engine"),
        )
        self.predictor = ForcePredictor(given.predictor, given.grid)
        self.predictor.set_parameters(begin)
        self._identifies = identify
        self._published: list[Publication] = []

    @property
    def tracker(self) -> WindowTracker:
        """What has been identified so far."""
        return self.identifier.tracker

    def _seconds_until_outcome(self, job: Job) -> float:
        if job.kind is Kind.LOOK:
            return 0.0  # milliseconds in the node: it is done before the next block
        settings = self.settings
        return settings.search_delay if job.kind is Kind.SEARCH else settings.fit_delay

    def add_current(self, stamp_ns: int, current: float) -> None:
        """Add a value of the supply current [A]; raises CurrentError where it is not finite."""
        self.predictor.add_current(stamp_ns, current)
        if self._identifies:
            self.identifier.add_current(stamp_ns, current)

    def add_temperature(self, celsius: float) -> None:
        """Set the temperature [°C] for the windows that become complete from now on."""
        self.identifier.add_temperature(celsius)

    def predict(self, block: SampleBlock, now_ns: int | None = None) -> Prediction:
        """Force of a block, by what has taken effect up to its end; then identify from it.

        ``now_ns``: the time on the clock of the stamps at which the block is there, see
        :meth:`ForcePredictor.predict`.
        """
        self.worker.now = block.end_ns / NANOSECONDS
        self._take_outcomes()
        prediction = self.predictor.predict(block, now_ns)
        self.predictor.catch_up()
        if self._identifies:
            self.identifier.add_block(block)
        return prediction

    def follow(
        self, stream: Iterable[StreamItem], *, live: bool = False
    ) -> Iterator[tuple[SampleBlock, Prediction]]:
        """Take in a stream; each block with its prediction, as it comes.

        ``live``: each block is there as soon as its last sample was taken, so that ages count;
        else the stamps are those of a recording. Jobs that still wait at the end are completed.
        """
        for item in stream:
            if isinstance(item, SampleBlock):
                yield item, self.predict(item, item.end_ns if live else None)
            elif isinstance(item, CurrentReading):
                self.add_current(*item)
            else:
                self.add_temperature(item.celsius)
        self.finish()

    def finish(self) -> None:
        """Complete the jobs that wait, as the nodes do where no more samples come."""
        while self.worker.busy:
            self.worker.now = math.inf
            self._take_outcomes()

    def take_publications(self) -> list[Publication]:
        """Reports and sets that have taken effect since the last call, in their order."""
        published, self._published = self._published, []
        return published

    def _take_outcomes(self) -> None:
        for event in self.identifier.poll():
            if not isinstance(event, Publication):
                continue
            self._published.append(event)
            # The identifier publishes the report before the set.
            self.predictor.follow_report(event.report)
            if event.parameters is not None:
                self.predictor.set_parameters(event.parameters, event.parameters.stamp_ns or None)
