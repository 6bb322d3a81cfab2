"""Parameter sets published in the thesis, in the order of ``PARAMETER_NAMES``.

Source: D. M. D. da Silva, University of Brasília, 2023. All are for a LORD RD-8041-1.
"""

from __future__ import annotations

import numpy as np

LITERATURE = np.array(
    [
        *(28.7, -0.199, 0.492, 22247.0, 6.02, -45.8, 1.450, 11.65),
        *(1638.0, 19.99, 37.71, 527.6, -67.9, -0.091, -0.260, 0.006),
    ]
)
"""Start of the thesis' searches (appendix D, from Santade 2017): 2.5 mm, 1 Hz, 0 A."""

THESIS_28_CELSIUS = np.array(
    [
        *(8.38, 0.34, 0.17, 236.94, -5.59, -4.04, 0.11, -7.22),
        *(0.28, 5.09, 6.63, -334.23, -5.0, -0.30, -0.07, 0.0),
    ]
)
"""Cold damper: 5 mm, 1 Hz, 1.5 A at 28 °C (tables 8 and 9, two decimals as printed)."""

THESIS_71_CELSIUS = np.array(
    [
        *(3.35, -0.51, -1.00, -247.9, 1.39, 5.00, 0.32, -17.42),
        *(-0.77, 5.14, 6.99, -118.52, -1.13, -0.22, 0.05, 0.02),
    ]
)
"""Warm damper: 5 mm, 1 Hz, 1.5 A at 71 °C (tables 8 and 9, two decimals as printed).

It lies in another basin than the cold set (signs differ): interpolate forces between the two,
never parameters.
"""
