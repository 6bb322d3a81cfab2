"""Each of many windows fitted by itself: what a set for all of them is measured by."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mr_damper_ros.estimation.adaptation import no_search
from mr_damper_ros.estimation.differential_evolution import ProgressClock
from mr_damper_ros.estimation.local_search import StopRequestedError
from mr_damper_ros.estimation.observability import current_varies, varied_parameters
from mr_damper_ros.estimation.record_levels import LevelledProblem, LevelPrior
from mr_damper_ros.estimation.window_fit import WindowFit, fit_window
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.operating_points import CoefficientTable, PooledProblem
from mr_damper_ros.signals.arrays import Array

_SEARCH_SAMPLES = 8000
_FEWEST_SEARCH_SAMPLES = 250
"""The search thins the windows to so many samples in all, and each to no fewer than that; the
last polish uses all samples."""

_STAGE = "each run by itself"


class SeparateFits:
    """Fits of the windows one by one, thinned; what they leave of the force is the noise of each.

    ``pooled``: the misfit of one set to all of the thinned windows, weighed by their noise, with
    the ``levels`` of their records if they have any.
    """

    pooled: PooledProblem

    def __init__(
        self,
        model: Model,
        windows: Sequence[Window],
        clock: ProgressClock,
        levels: LevelPrior | None = None,
    ) -> None:
        self._model = model
        self._levels = levels
        self._thinned = thinned_for_search(windows)
        self._clock = clock
        self.fits: list[WindowFit] = []
        self.evaluations = 0

    def fit(self, start: Array, known: Array | None = None) -> None:
        """Fit each window from ``start``; that of varying current from ``known``, if it is better.

        Without its dependence on the current no law comes near to the force of such a window.
        Raises StopRequestedError where the clock has stopped it; what was known before then stays.
        """
        found = []
        for window in self._thinned:
            starts = [start]
            if known is not None and current_varies(window):
                starts.append(known)
            fits = [
                fit_window(
                    self._model, window, each, method="least_squares", should_stop=self._stops
                )
                for each in starts
            ]
            found.append(min(fits, key=lambda fit: fit.rmse))
        self.evaluations += sum(fit.evaluations for fit in found)
        if not (self._clock.stopped and self.fits):
            self.fits = found
            self.pooled = self.misfit(self._thinned)
        if self._clock.stopped:
            raise StopRequestedError

    def _stops(self) -> bool:
        return self._clock.poll(_STAGE, math.nan)

    def misfit(self, windows: Sequence[Window], known: Array | None = None) -> PooledProblem:
        """The misfit of one set to these windows, the same ones, thinned or not."""
        noise = [fit.rmse for fit in self.fits]
        return levelled(self._model.pooled_problem(windows, noise, known), self._levels)

    @property
    def operating_points(self) -> tuple[list[float], list[float]]:
        """Peak velocities [m/s] and currents [A] of the windows."""
        return _points(self.fits)

    def table(self) -> CoefficientTable:
        """The coefficients of all windows."""
        return _table(self.fits)

    def without_search(self, start: Array) -> list[Array]:
        """Parameters (p,) from those windows that were fitted before a stop, as far as they go.

        Those of one of them, and the laws over all as far as they are linear.
        """
        fitted = [fit for fit in self.fits if fit.success] or self.fits[:1]
        free = varied_parameters(self._model, *_points(fitted))
        laws = self._model.fit_laws(_table(fitted), start, free, no_search)
        return [fitted[0].parameters, laws]


def _points(fits: Sequence[WindowFit]) -> tuple[list[float], list[float]]:
    speeds, currents = zip(*(fit.operating_point for fit in fits), strict=True)
    return list(speeds), list(currents)


def _table(fits: Sequence[WindowFit]) -> CoefficientTable:
    speeds, currents = _points(fits)
    return CoefficientTable(
        peak_velocity=np.array(speeds),
        current=np.array(currents),
        coefficients=np.array([fit.coefficients for fit in fits]),
        errors=np.array([np.sqrt(np.diag(fit.coefficient_covariance)) for fit in fits]),
    )


def levelled(pooled: PooledProblem, levels: LevelPrior | None) -> PooledProblem:
    """The problem with the levels of its records integrated out, or as it is where None."""
    return pooled if levels is None else LevelledProblem(pooled, levels)


def thinned_for_search(windows: Sequence[Window]) -> list[Window]:
    """The windows with as many samples as a search needs."""
    most = max(_SEARCH_SAMPLES // len(windows), _FEWEST_SEARCH_SAMPLES)
    return [window.thinned(most) for window in windows]
