"""What travels to the worker and back: tasks made by the tracker, and what was found."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import GlobalFit
from mr_damper_ros.estimation.window_fit import WindowFit
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import Model
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.acceptance import Evidence, Judgement
from mr_damper_ros.tracking.current_parts import PartsByCurrent
from mr_damper_ros.tracking.cusum import ChangeWatch
from mr_damper_ros.tracking.force_scale import ForceScale
from mr_damper_ros.tracking.reservoir import Kept
from mr_damper_ros.tracking.tracker_settings import TrackerSettings
from mr_damper_ros.tracking.unscented_filter import FilterState
from mr_damper_ros.tracking.window_assembler import RawWindow


@dataclass(frozen=True, eq=False)
class FitTask:
    """One window, or a look, and the ``running`` set, from which a fit starts.

    ``baselines`` are those of the force scale; ``state`` is where the filter stood and ``watch``
    that of the detector of changes, if they run; samples stamped before ``changed_ns`` are of the
    damper before its last sudden change; ``elsewhere``: windows at the operating points of the last
    seconds before this one.
    """

    window: RawWindow
    running: ParameterSet
    settings: TrackerSettings
    state: FilterState | None = None
    watch: ChangeWatch | None = None
    changed_ns: int = 0
    baselines: tuple[WindowFit, ...] = ()
    elsewhere: tuple[Window, ...] = ()

    @property
    def model(self) -> Model:
        """The force law."""
        return self.running.law

    @property
    def start(self) -> Array:
        """The parameters (p,) of the running set."""
        return self.running.values

    @property
    def known(self) -> bool:
        """Whether the running set was identified, and so is one of this very damper."""
        return bool(self.running.observable.any())


@dataclass(frozen=True)
class WindowSummary:
    """What is reported of a window that was fitted, and the range that it covers.

    ``amplitude`` [m]; ``frequency`` [Hz], NaN where the motion is no sine; the ranges of the peak
    velocity [m/s], without its outermost twentieths, and of the current [A]; the ``largest_force``
    and the ``spread`` (standard deviation) of the force [N].
    """

    amplitude: float
    frequency: float
    peak_velocity_range: tuple[float, float]
    current_range: tuple[float, float]
    largest_force: float
    spread: float

    @classmethod
    def of(cls, window: Window) -> WindowSummary:
        """The summary of a window."""
        current = window.current
        return cls(
            amplitude=window.motion.amplitude,
            frequency=window.motion.frequency,
            peak_velocity_range=window.peak_velocity_range,
            current_range=(float(current.min()), float(current.max())),
            largest_force=window.largest_force,
            spread=float(np.std(window.force)),
        )


@dataclass(frozen=True, eq=False)
class FitResult:
    """What a task found; ``refusal`` says why nothing was fitted, None where something was.

    It takes home no sample that the tracker has: the task stays with who gave it. ``kept`` is the
    window as the reservoir keeps it, thinned, or its parts, if the current changes; nothing of a
    look. They are made where the window is, next to the fit, because finding the motion of a window
    takes longer than sending what is kept of it, and the process that receives the samples must
    stay free. ``parts`` is what they say of the dependence on the current; None where it is
    constant.
    """

    refusal: Judgement | None = None
    fit: WindowFit | None = None
    evidence: Evidence | None = None
    summary: WindowSummary | None = None
    kept: tuple[Kept, ...] = ()
    parts: PartsByCurrent | None = None
    state: FilterState | None = None
    watch: ChangeWatch | None = None
    scale: ForceScale = field(default_factory=ForceScale)


@dataclass(frozen=True, eq=False)
class GlobalTask:
    """The reservoir's windows, the last of them up to ``stamp_ns``, and the set to start from.

    The last ``recent`` of them are at the operating points of late.
    """

    windows: tuple[Window, ...]
    start: ParameterSet
    settings: EvolutionSettings
    stamp_ns: int = 0
    recent: int = 1


@dataclass(frozen=True, eq=False)
class GlobalResult:
    """What a global identification found; ``refusal`` says why nothing, else it is None.

    ``nrmse_before`` and ``nrmse_after`` are those of the set before and of that found, over the
    samples of all windows together that were held back; ``lead`` is that of the set found, see
    :class:`Evidence`; ``recent`` are the NRMSE of both over the operating points of late.
    """

    refusal: Judgement | None = None
    fit: GlobalFit | None = None
    nrmse_before: float = math.nan
    nrmse_after: float = math.nan
    lead: float = math.inf
    recent: tuple[float, float] = (math.nan, math.nan)
