"""The tracker: the running set and its memory, which each job turns into those of the next one."""

from __future__ import annotations

from dataclasses import replace

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.models.parameter_set import ParameterSet, start_set
from mr_damper_ros.processes.blas_threads import one_thread
from mr_damper_ros.tracking.jobs import (
    OF_THE_SET,
    TRACKERS,
    Job,
    Outcome,
    TrackerMemory,
    TrackerSettings,
    run,
)
from mr_damper_ros.tracking.operating_point import KnownPoints
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.window_assembler import RawWindow

__all__ = ["OF_THE_SET", "TrackerMemory", "TrackerSettings", "WindowTracker"]


class WindowTracker:
    """The running set ``parameters``, and the ``memory`` that the jobs need.

    Jobs are created one after another, each from the state after the previous one.
    """

    def __init__(
        self, settings: TrackerSettings | None = None, initial: ParameterSet | None = None
    ) -> None:
        """Start with the set ``initial``; None takes the start set of the law in the settings.

        Raises ParameterError as :meth:`TrackerSettings.following` does.
        """
        settings = settings or TrackerSettings()
        initial = initial or start_set(settings.law)
        self._settings = settings.following(initial)
        self.parameters = self._initial = initial.as_given()
        self.memory = TrackerMemory()

    def resume(self, parameters: ParameterSet, memory: TrackerMemory) -> None:
        """Continue from the state of a tracker, which may have had other settings.

        Raises ParameterError if the set belongs to another law.
        """
        self.parameters = parameters.of_model(self._settings.model)
        self.memory = memory = replace(memory)
        if TRACKERS[self._settings.tracker] is None:
            memory.state = None
        if memory.watch and memory.watch.smallest_change != self._settings.smallest_change:
            memory.watch = None

    @property
    def accepted_windows(self) -> int:
        """Windows accepted since the start or the last reset."""
        return self.memory.accepted

    @property
    def points(self) -> KnownPoints:
        """The records of the operating points, with the windows for the global identification."""
        return self.memory.points

    def reset(self) -> None:
        """Return to the initial set; baselines and reservoir are discarded."""
        # The names of sets contain the number of windows, so the count continues. The damper may
        # have been replaced.
        self.parameters = self._initial
        self.memory = TrackerMemory(windows=self.memory.windows, other_damper=True)

    def replace(self, parameters: ParameterSet) -> None:
        """Use this set, loaded by the user, from now on; records and baselines are deleted.

        Raises ParameterError if the set belongs to another law.
        """
        self.parameters = parameters.of_model(self._settings.model).as_given()
        self.memory = TrackerMemory(windows=self.memory.windows)

    @one_thread()
    def follow(self, window: RawWindow) -> Report | None:
        """Fit a window, or run a change check, in this process.

        Returns None for a change check without an early fit.
        """
        return self.complete(run(self.job_of(window)))

    @one_thread()
    def identify(self, evolution: EvolutionSettings | None = None) -> Report:
        """Run a global identification of the reservoir in this process; see :meth:`search`."""
        report = self.complete(run(self.search(evolution)))
        assert report is not None
        return report

    def job_of(self, window: RawWindow) -> Job:
        """The job of a window fit or a change check, starting from the running set."""
        # Only the windows that the job compares with need to be sent.
        recent = () if window.look else self.points.recent(window.start_ns)
        points = self.points.with_samples(lambda each: any(each.window is one for one in recent))
        return Job(self.parameters, self._settings, replace(self.memory, points=points), window)

    def search(self, evolution: EvolutionSettings | None = None, *, asked: bool = True) -> Job:
        """The job of a global identification of the reservoir, with other settings if given.

        An accepted set of a requested search (``asked``) is used at once. Otherwise, while the
        running set is good, the next window must confirm it.
        """
        self.memory = memory = replace(self.memory)
        memory.accepted_since_global = memory.unexplained_windows = 0
        memory.global_patience += max(memory.global_patience // 2, 1)
        memory.searched_points = len(self.points.kept)
        return Job(self.parameters, self._settings, memory, evolution=evolution, asked=asked)

    def complete(self, outcome: Outcome) -> Report | None:
        """Take over the outcome of the newest job; returns its report."""
        points = self.points.updated(outcome.memory.points)
        self.memory = replace(outcome.memory, points=points)
        self.parameters = outcome.parameters or self.parameters
        return outcome.report
