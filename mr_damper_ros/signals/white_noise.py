"""The white noise of a measured signal."""

from __future__ import annotations

import math

import numpy as np

from mr_damper_ros.signals.arrays import Array

_NORMAL_MEDIAN = 0.6745
"""Median size of a normal number over its standard deviation."""


def white_noise(values: Array) -> float:
    """Standard deviation of the white part of a signal (n,), in its unit; 0 for n < 5.

    From fourth differences, which a smooth signal leaves almost nothing of; the median makes it
    robust against kinks and jumps.
    """
    if values.size < 5:
        return 0.0
    # The sum of the squared binomial coefficients of the fourth difference is 70.
    return float(np.median(np.abs(np.diff(values, 4))) / _NORMAL_MEDIAN / math.sqrt(70.0))
