"""Units of recorded quantities, as users write them."""

from __future__ import annotations

DATE_AND_TIME = "datetime"
"""Stands for a unit of time where the cells hold date and time of day; read as s since 1970."""

_G = 9.80665
_INCH = 0.0254
_POUND_FORCE = 0.45359237 * _G

# Factor and offset: SI value (temperature: °C) = factor * value + offset.
UNITS: dict[str, dict[str, tuple[float, float]]] = {
    "time": {
        "s": (1.0, 0.0),
        "ms": (1e-3, 0.0),
        "us": (1e-6, 0.0),
        "min": (60.0, 0.0),
        DATE_AND_TIME: (1.0, 0.0),
    },
    "displacement": {
        "m": (1.0, 0.0),
        "cm": (1e-2, 0.0),
        "mm": (1e-3, 0.0),
        "um": (1e-6, 0.0),
        "in": (_INCH, 0.0),
    },
    "velocity": {
        "m/s": (1.0, 0.0),
        "cm/s": (1e-2, 0.0),
        "mm/s": (1e-3, 0.0),
        "in/s": (_INCH, 0.0),
    },
    "force": {
        "N": (1.0, 0.0),
        "kN": (1e3, 0.0),
        "kgf": (_G, 0.0),
        "lbf": (_POUND_FORCE, 0.0),
    },
    "current": {"A": (1.0, 0.0), "mA": (1e-3, 0.0)},
    "temperature": {
        "degC": (1.0, 0.0),
        "K": (1.0, -273.15),
        "degF": (5.0 / 9.0, -160.0 / 9.0),
    },
}
"""Quantities that a column may hold, and the units known for each."""
