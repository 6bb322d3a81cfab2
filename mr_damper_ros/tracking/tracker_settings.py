"""Settings of the identification of windows."""

from __future__ import annotations

from dataclasses import dataclass, field

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.models.parameter_set import DEFAULT_MODEL, known_model
from mr_damper_ros.tracking.acceptance import AcceptanceSettings
from mr_damper_ros.tracking.screening import Screening
from mr_damper_ros.tracking.unscented_filter import METHOD

TRACKERS = ("window", METHOD)
"""How the scales are followed: each window on its own, or by a recursive filter."""


@dataclass(frozen=True)
class TrackerSettings:
    """Settings of the identification of windows.

    ``model``: name of the force law; ``tracker``: "window" fits every window; "unscented" is an
    unscented Kalman filter, which uses every sample once and starts from the fit of a window.
    ``method`` of that fit: "nelder_mead" or "least_squares"; ``robust``: bound the influence of
    outliers;
    ``drift_rate`` [1/sqrt(s)]: how fast the filter expects the force to change, see
    :class:`UnscentedFilter`; ``smallest_change`` [1]: a relative change of the force between two
    windows that is worth an early fit; ``global_period``: a global identification after this
    many accepted windows, 0 for never.

    Raises ValueError for an unknown model or tracker, a filter for another model than the sigmoid
    law, or a drift rate or smallest change that is not positive.
    """

    model: str = DEFAULT_MODEL
    tracker: str = "window"
    method: str = "nelder_mead"
    robust: bool = False
    drift_rate: float = 1e-3
    smallest_change: float = 0.02
    global_period: int = 20
    screening: Screening = field(default_factory=Screening)
    acceptance: AcceptanceSettings = field(default_factory=AcceptanceSettings)
    evolution: EvolutionSettings = field(default_factory=EvolutionSettings)

    def __post_init__(self) -> None:
        if self.tracker not in TRACKERS:
            raise ValueError(
                f"tracker '{self.tracker}' is unknown: use one of {', '.join(TRACKERS)}"
            )
        known_model(self.model)
        if self.tracker == METHOD and self.model != DEFAULT_MODEL:
            raise ValueError(
                f"tracker '{METHOD}' follows model '{DEFAULT_MODEL}' only: "
                f"choose tracker 'window' for model '{self.model}'"
            )
        for name in ("drift_rate", "smallest_change"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} is {getattr(self, name)}: it must be positive")
