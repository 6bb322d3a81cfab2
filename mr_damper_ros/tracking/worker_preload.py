"""Modules that the worker loads before its first task, outside the time of a fit.

Of SciPy it loads only the part that most fits need, so that a killed worker restarts quickly.
"""

import scipy.optimize

from mr_damper_ros.tracking import jobs

__all__ = ["jobs", "scipy"]
