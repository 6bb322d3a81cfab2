"""The error of a parameter set on windows, as it would be in a prediction."""

from __future__ import annotations

from collections.abc import Iterable

from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.error_sums import ErrorSums, pooled


def error_of_set(found: ParameterSet, windows: Iterable[Window]) -> ErrorSums:
    """Error of a set of any model on the samples of all windows together."""
    return pooled(ErrorSums.of(found.force(window), window.force) for window in windows)
