"""Settings of the identification of windows."""

from __future__ import annotations

from dataclasses import dataclass, replace

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.window_fit import WINDOW_METHODS
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import DEFAULT_MODEL, ParameterSet
from mr_damper_ros.settings.option_table import CheckedSettings, group, option
from mr_damper_ros.tracking.acceptance import AcceptanceSettings
from mr_damper_ros.tracking.scale_tracker import EachWindow
from mr_damper_ros.tracking.screening import Screening
from mr_damper_ros.tracking.trackers import TRACKERS

OF_THE_SET = "auto"
"""The law is that of the set to start from."""


@dataclass(frozen=True)
class TrackerSettings(CheckedSettings):
    """Settings of the identification of windows.

    Raises ValueError, in one sentence, for values out of range and for a tracker that
    cannot follow the model.
    """

    model: str = option(
        OF_THE_SET,
        f"Force law that is identified; {OF_THE_SET}: that of the parameters to start from, "
        f"{DEFAULT_MODEL} where none are given.",
        choices=(OF_THE_SET, *MODELS),
    )
    smallest_change: float = option(
        0.02,
        "Relative change of the force that calls for an early fit (see looks). False alarms come "
        "hours apart where the force hardly rises above its noise, and practically never "
        "otherwise.",
        minimum=0.001,
        maximum=1.0,
    )
    tracker: str = option(
        EachWindow.name,
        "How the damper is followed: window (the fit of each window on its own) or unscented (an "
        "unscented Kalman filter, which uses every sample once and starts from the fit of a "
        "window; it follows model sigmoid only).",
        choices=tuple(TRACKERS),
    )
    drift_rate: float = option(
        1e-3,
        "For tracker unscented: the random walk of the force [1/sqrt(s)] that the filter expects, "
        "relative to the force. Larger follows faster and averages less.",
        minimum=1e-9,
        maximum=1.0,
    )
    method: str = option(
        "nelder_mead",
        "How a window is fitted: nelder_mead (simplex search, as in the thesis, then a "
        "least-squares polish) or least_squares (Levenberg-Marquardt alone: the same minimum, "
        "about five times faster).",
        choices=WINDOW_METHODS,
    )
    robust: bool = option(
        False,
        "Whether the influence of outliers in the force is bounded (Huber's weights). Costs some "
        "milliseconds per window; without outliers it changes nothing that matters.",
    )
    global_period: int = option(
        20,
        "A global identification runs after this many windows that fit, the first ones sooner "
        "(after 1, 2, 3, 4, 6, 9 and so on); 0 for never. It needs windows at two operating points "
        "at least. Windows whose force does not follow the current as the set has it lead to one "
        "sooner. With model sigmoid_lag it also runs after the first accepted window, since "
        "without it nothing is known of the lag.",
        minimum=0,
        maximum=1_000_000,
    )
    evolution: EvolutionSettings = group(EvolutionSettings)
    screening: Screening = group(Screening)
    acceptance: AcceptanceSettings = group(AcceptanceSettings)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.model != OF_THE_SET:
            objection = TRACKERS[self.tracker].objection(MODELS[self.model])
            if objection:
                raise ValueError(objection)

    @property
    def law(self) -> str:
        """Name of the force law where nothing is known of the damper."""
        return DEFAULT_MODEL if self.model == OF_THE_SET else self.model

    def following(self, initial: ParameterSet) -> TrackerSettings:
        """The settings with the law of the set to start from.

        Raises ParameterError where another law is asked for, ValueError where the tracker cannot
        follow this one.
        """
        if self.model != OF_THE_SET:
            initial.of_model(self.model)
            return self
        return replace(self, model=initial.model)
