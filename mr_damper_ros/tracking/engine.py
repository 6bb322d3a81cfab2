"""The engine: turns samples and supply currents into verdicts, parameter sets and predicted force.

It uses neither ROS nor a clock. The stamps of the data drive it, so its results depend on the data
and the settings alone. It connects the :class:`Identifier` of the identifier node with the
:class:`ForcePredictor` of the model node, as the messages on damper/fit_report and
damper/parameters do. Recordings, benchmarks, studies and tests run through it.
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
from mr_damper_ros.tracking.predictor import ForcePredictor, Prediction, PredictorSettings
from mr_damper_ros.tracking.tracker import Job, TrackerSettings, WindowTracker
from mr_damper_ros.tracking.window_assembler import WindowAssembler, WindowSettings


@dataclass(frozen=True)
class EngineSettings(CheckedSettings):
    """Settings of identification and prediction; the nodes have the same defaults."""

    windows: WindowSettings = group(WindowSettings, flat=True)
    tracking: TrackerSettings = group(TrackerSettings, flat=True)
    predictor: PredictorSettings = group(PredictorSettings, flat=True)
    grid: GridSettings = group(GridSettings, flat=True)
    work: PipelineSettings = group(PipelineSettings, flat=True)
    fit_delay: float = option(
        0.3,
        "Time [s] of data from the start of a window fit until its outcome takes effect.",
        within=(0.0, 3600.0),
    )
    search_delay: float = option(
        1.0,
        "Time [s] of data from the start of a global identification until its outcome takes "
        "effect.",
        within=(0.0, 3600.0),
    )

    def for_law(self, model: str) -> EngineSettings:
        """The settings for another force law."""
        return replace(self, tracking=replace(self.tracking, model=model))


class Engine:
    """Identifies a damper and predicts its force from one stream.

    ``start`` is the initial set; with None the law starts from default values, and their force is
    never valid. With ``identify`` False no windows are fitted and only the prediction runs. Jobs
    run in this process; their outcomes take effect after the delays in the settings.

    Raises ParameterError if the set belongs to another law than the settings.
    """

    def __init__(
        self,
        settings: EngineSettings | None = None,
        start: ParameterSet | None = None,
        *,
        identify: bool = True,
    ) -> None:
        self.settings = given = settings or EngineSettings()
        begin = start_set(given.tracking.law) if start is None else start
        tracker = WindowTracker(given.tracking, begin)
        self.worker = InlineWorker(self._seconds_until_outcome)
        assembler = WindowAssembler(given.windows, given.grid)
        self.identifier = Identifier(assembler, tracker, self.worker, given.work)
        self.predictor = ForcePredictor(given.predictor, given.grid)
        self.predictor.set_parameters(begin)
        self._identifies = identify
        self._published: list[Publication] = []

    @property
    def tracker(self) -> WindowTracker:
        """The tracker, with the running set and its records."""
        return self.identifier.tracker

    def _seconds_until_outcome(self, job: Job) -> float:
        if job.raw is None:
            return self.settings.search_delay
        # A change check takes milliseconds in the node and ends before the next block.
        return 0.0 if job.raw.look else self.settings.fit_delay

    def add_current(self, stamp_ns: int, current: float) -> None:
        """Add a value of the supply current [A]; raises CurrentError if it is not finite."""
        self.predictor.add_current(stamp_ns, current)
        if self._identifies:
            self.identifier.add_current(stamp_ns, current)

    def add_temperature(self, celsius: float) -> None:
        """Set the temperature [°C] for the windows that become complete from now on."""
        self.identifier.add_temperature(celsius)

    def predict(self, block: SampleBlock, now_ns: int | None = None) -> Prediction:
        """Predict the force of a block, then identify from the block.

        All outcomes due by the end of the block take effect first. ``now_ns`` is the time at which
        the block arrives, by the clock of the stamps, see :meth:`ForcePredictor.predict`.
        """
        self.worker.set_time(block.end_ns / NANOSECONDS)
        self._take_outcomes()
        prediction = self.predictor.predict(block, now_ns)
        self.predictor.catch_up()
        if self._identifies:
            self.identifier.add_block(block)
        return prediction

    def follow(
        self, stream: Iterable[StreamItem], *, live: bool = False
    ) -> Iterator[tuple[SampleBlock, Prediction]]:
        """Process a stream, and yield each block with its prediction.

        With ``live`` each block arrives at the stamp of its last sample, and the age of samples,
        current and parameters is checked; without it, the stream is a recording. At the end,
        waiting jobs are completed.
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
        """Complete the waiting jobs, as the nodes do when no more samples arrive."""
        while self.worker.busy:
            self.worker.set_time(math.inf)
            self._take_outcomes()

    def take_publications(self) -> list[Publication]:
        """Return the reports and sets that took effect since the last call, oldest first."""
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
                self.predictor.follow_set(event.parameters)
