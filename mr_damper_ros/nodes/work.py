"""What the worker loads before its first task: else it would be loaded in the time of a fit."""

import scipy.optimize
import scipy.signal

from mr_damper_ros.nodes import pipeline

__all__ = ["pipeline", "scipy"]
