"""What the worker of a campaign loads before its first task: SciPy takes the most of it."""

import scipy.optimize

from mr_damper_ros.interface import campaign_work

__all__ = ["campaign_work", "scipy"]
