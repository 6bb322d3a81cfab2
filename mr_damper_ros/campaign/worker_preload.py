"""What the worker of a campaign loads before its first task: SciPy takes the most of it."""

from __future__ import annotations

import scipy.optimize

from mr_damper_ros.campaign import course as campaign_work

__all__ = ["campaign_work", "scipy"]
