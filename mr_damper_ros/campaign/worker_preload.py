"""Modules that the worker of a campaign loads before its first task; SciPy takes the longest."""

from __future__ import annotations

import scipy.optimize

from mr_damper_ros.campaign import course as campaign_work

__all__ = ["campaign_work", "scipy"]
