"""What the worker loads before its first task: else it would be loaded in the time of a fit.

Of SciPy no more than most fits need: a worker that was killed should be back soon.
"""

import scipy.optimize

from mr_damper_ros.tracking import jobs

__all__ = ["jobs", "scipy"]
