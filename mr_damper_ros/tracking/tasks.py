"""What travels to the worker and back: tasks made by the tracker, and what was found."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import GlobalFit
from mr_damper_ros.estimation.window_fit import WindowFit
from mr_damper_ros.models import MODELS, Model
from mr_damper_ros.models.parameter_set import DEFAULT_MODEL
from mr_damper_ros.models.sigmoid.scale_misfit import Window
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.acceptance import Evidence
from mr_damper_ros.tracking.cusum import ChangeWatch
from mr_damper_ros.tracking.force_scale import ForceScale
from mr_damper_ros.tracking.tracker_settings import TrackerSettings
from mr_damper_ros.tracking.unscented_filter import FilterState
from mr_damper_ros.tracking.window_assembler import RawWindow


@dataclass(frozen=True, eq=False)
class FitTask:
    """One window, or a look, and the parameters (p,) to start from.

    ``baselines`` are those of the force scale; ``state`` is where the filter stood and ``watch``
    that of the detector of changes, if they run; samples stamped before ``changed_ns`` are of the
    damper before its last sudden change. ``known``: the start is a set of this very damper, and
    holds up to the peak velocity ``fastest`` [m/s], infinite where that is not known.
    """

    window: RawWindow
    start: Array
    settings: TrackerSettings
    state: FilterState | None = None
    watch: ChangeWatch | None = None
    changed_ns: int = 0
    baselines: tuple[WindowFit, ...] = ()
    known: bool = False
    fastest: float = math.inf

    @property
    def model(self) -> Model:
        """The force law."""
        return MODELS[self.settings.model]


@dataclass(frozen=True, eq=False)
class FitResult:
    """What the fit of a task found: ``fault`` says why nothing was fitted, else it is empty."""

    task: FitTask
    fault: str
    window: Window | None = None
    fit: WindowFit | None = None
    evidence: Evidence | None = None
    state: FilterState | None = None
    watch: ChangeWatch | None = None
    scale: ForceScale = field(default_factory=ForceScale)


@dataclass(frozen=True, eq=False)
class GlobalTask:
    """The reservoir's windows and the parameters (p,) of a model to start from."""

    windows: tuple[Window, ...]
    start: Array
    settings: EvolutionSettings
    stamp_ns: int
    model: str = DEFAULT_MODEL


@dataclass(frozen=True, eq=False)
class GlobalResult:
    """What a global identification found; ``fault`` says why nothing, else it is empty."""

    task: GlobalTask
    fault: str
    fit: GlobalFit | None = None
    nrmse_before: float = math.nan
