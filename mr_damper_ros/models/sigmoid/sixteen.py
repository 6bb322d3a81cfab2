"""The sixteen parameters of the sigmoid law: their units, and what it takes to tell them apart."""

from __future__ import annotations

from mr_damper_ros.models.quantities import Parameter
from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES

_UNITS = {
    **dict.fromkeys(("a0", "a1", "a4", "k0", "k1c", "k1e"), "s/m"),
    **dict.fromkeys(("k2", "k3", "k4", "k5", "k6"), "1"),
    # The thesis prints (m/s)^-1 for a3, which multiplies a current.
    **dict.fromkeys(("a2", "a3"), "1/A"),
    **dict.fromkeys(("I0", "I1"), "A"),
    "f0": "N",
}

_PEAK_VELOCITIES = dict.fromkeys(("a1", "k0", "a4"), 2)
_CURRENTS = {
    **dict.fromkeys(("k2", "k3"), 2),
    **dict.fromkeys(("a2", "a3"), 3),
    **dict.fromkeys(("I0", "I1"), 4),
}

SIXTEEN = tuple(
    Parameter(
        name,
        _UNITS[name],
        peak_velocities=_PEAK_VELOCITIES.get(name, 1),
        currents=_CURRENTS.get(name, 1),
    )
    for name in PARAMETER_NAMES
)
