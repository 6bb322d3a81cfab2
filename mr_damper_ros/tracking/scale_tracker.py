"""How what is identified is followed from window to window: what every tracker says of itself."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from mr_damper_ros.estimation.window_fit import WindowFit
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.tracking.acceptance import Evidence
from mr_damper_ros.tracking.unscented_filter import FilterState

if TYPE_CHECKING:
    from mr_damper_ros.tracking.tasks import FitTask


@dataclass(frozen=True, eq=False)
class Followed:
    """What a tracker makes of a window without a fit of its own, and its state after it."""

    fit: WindowFit
    evidence: Evidence
    state: FilterState


class ScaleTracker(ABC):
    """A tracker: one class in one file, and one line in :data:`TRACKERS`.

    ``remembers``: whether it has a state that goes from window to window.
    """

    name: ClassVar[str]
    remembers: ClassVar[bool]

    @abstractmethod
    def objection(self, model: Model) -> str:
        """Why it cannot follow this model, in words; empty where it can."""

    @abstractmethod
    def follow(self, task: FitTask, window: Window) -> Followed | None:
        """Go on from the state of the task into its window; None where a fit must come first."""

    @abstractmethod
    def begin(self, fit: WindowFit, stamp_ns: int) -> FilterState | None:
        """The state after the fit of a window that ends at the stamp, if there is one to keep."""


class EachWindow(ScaleTracker):
    """Every window is fitted by itself, from the running set."""

    name = "window"
    remembers = False

    def objection(self, model: Model) -> str:
        """None: any model has a fit."""
        return ""

    def follow(self, task: FitTask, window: Window) -> Followed | None:
        """Always a fit."""
        return None

    def begin(self, fit: WindowFit, stamp_ns: int) -> FilterState | None:
        """Nothing is kept."""
        return None
