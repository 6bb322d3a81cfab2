"""The conditions of the thesis, re-synthesised from its published parameter sets.

The recordings behind D. M. D. da Silva, "Comparative study of optimization algorithms for
parameter identification of the sigmoid model in MR dampers", University of Brasília, 2023, were
not published. Its tables 17-40 were: 34 conditions, each identified by two methods. A run made
here is the force of the Nelder-Mead set of a condition on the sinusoid that the thesis fitted to
its motion, with noise of the size that the thesis reports. It is not an original recording, and
says so.

Stated assumptions, where the thesis is silent: 1 ms between samples; white noise of 1 micrometre
on the displacement, what a laboratory's displacement transducer resolves.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from importlib import resources

import numpy as np

from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES
from mr_damper_ros.rig.emulator import (
    THESIS_FORCE_NOISE,
    ConstantDamper,
    EmulatedRig,
    RigSettings,
)
from mr_damper_ros.rig.excitation import SineMotion
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import Recording

SAMPLE_COUNT = 7001
"""Samples 3000 to 10000 of each run were used (appendix D)."""

SAMPLE_RATE = 1000.0
"""Assumed [Hz]; the thesis does not state the sampling period."""

PHASE = 4.481
"""Phase of the fitted sinusoid [rad] (appendix D)."""

DISPLACEMENT_NOISE = 1e-6
"""Assumed standard deviation [m]; the thesis states none."""

PUBLISHED_METHODS = ("nelder_mead", "differential_evolution")
"""The two methods of the tables; runs are made from the first."""

PROVENANCE = "re-synthesised from the published parameter sets; not the original recordings"


class ConditionError(ValueError):
    """A condition that the thesis does not have; the message lists those it has."""


@dataclass(frozen=True, order=True)
class Condition:
    """One test: ``amplitude`` [m], ``frequency`` [Hz], ``current`` [A]."""

    current: float
    amplitude: float
    frequency: float

    @property
    def name(self) -> str:
        """Such as ``2.5mm_1Hz_0.0A``."""
        return f"{self.amplitude * 1e3:.1f}mm_{self.frequency:g}Hz_{self.current:.1f}A"


def _read_table() -> dict[tuple[Condition, str], Array]:
    text = resources.files(__package__).joinpath("published_parameters.csv").read_text("utf-8")
    rows = csv.DictReader(line for line in text.splitlines() if not line.startswith("#"))
    table = {}
    for row in rows:
        condition = Condition(
            amplitude=float(row["amplitude_mm"]) / 1e3,
            frequency=float(row["frequency_hz"]),
            current=float(row["current_a"]),
        )
        values = np.array([float(row[name]) for name in PARAMETER_NAMES])
        values.flags.writeable = False
        table[condition, row["method"]] = values
    return table


_TABLE = _read_table()

CONDITIONS = tuple(dict.fromkeys(condition for condition, _ in _TABLE))
"""The 34 conditions in the order of the tables."""


def _named(name: str) -> Condition:
    return next(condition for condition in CONDITIONS if condition.name == name)


_COPIED = (
    "tables 31 and 32 (5.0 mm, 1.0 A) repeat tables 19 and 20 (5.0 mm, 0 A) digit for digit: "
    "these are not data for 1.0 A"
)
_MIRRORED = "the loop is the mirror image of the other method's, or far from it: a sign is lost"

ROW_ERRATA = {
    (_named(name), method): reason
    for name, method, reason in (
        *(
            (f"5.0mm_{f}Hz_1.0A", method, _COPIED)
            for f in (1, 3, 5)
            for method in PUBLISHED_METHODS
        ),
        (
            "7.5mm_3Hz_1.5A",
            "nelder_mead",
            "k4 is +0.1405 where every other row has it negative",
        ),
        ("7.5mm_3Hz_1.5A", "differential_evolution", _MIRRORED),
        (
            "2.5mm_5Hz_0.0A",
            "differential_evolution",
            "the force peaks at 544 and -727 N against 134 and -170 N by the other method",
        ),
        ("7.5mm_5Hz_1.0A", "differential_evolution", _MIRRORED),
        (
            "7.5mm_1Hz_1.5A",
            "differential_evolution",
            "the offset has the wrong sign: k5 should very likely be -0.1231",
        ),
    )
}
"""Why a row of the tables must not be used: (condition, method) to the reason."""

ERRATA = {
    condition: reason
    for (condition, method), reason in ROW_ERRATA.items()
    if method == PUBLISHED_METHODS[0]
}
"""Conditions whose Nelder-Mead row, from which runs are made, must not be used, and why."""


def is_clean(condition: Condition) -> bool:
    """Whether a run of the condition may be compared with others."""
    return condition not in ERRATA


def parameters(condition: Condition, method: str = PUBLISHED_METHODS[0]) -> Array:
    """Published parameters (16,) of a condition; read-only. Raises ConditionError."""
    try:
        return _TABLE[condition, method]
    except KeyError as error:
        raise ConditionError(
            f"the tables have no row for {condition.name} by {method}: "
            f"the methods are {' and '.join(PUBLISHED_METHODS)}"
        ) from error


def find(name: str) -> Condition:
    """Condition by its name; raises ConditionError, which lists all, where there is none."""
    for condition in CONDITIONS:
        if condition.name == name:
            return condition
    raise ConditionError(
        f"the thesis has no condition '{name}'; it has "
        f"{', '.join(condition.name for condition in CONDITIONS)}"
    )


def recording_name(condition: Condition) -> str:
    """Name of the run of a condition; errata are marked in it."""
    return condition.name if is_clean(condition) else f"{condition.name}_erratum"


def synthesise(condition: Condition, *, seed: int = 0) -> Recording:
    """Run of a condition: 7001 samples; the same condition and seed give the same samples.

    Raises ConditionError where the thesis does not have the condition.
    """
    values = parameters(condition)
    rig = EmulatedRig(
        ConstantDamper(values),
        SineMotion(condition.amplitude, condition.frequency, phase=PHASE),
        condition.current,
        settings=RigSettings(
            sample_rate=SAMPLE_RATE,
            force_noise=THESIS_FORCE_NOISE,
            displacement_noise=DISPLACEMENT_NOISE,
            # Each condition has noise of its own.
            seed=(seed, CONDITIONS.index(condition)),
        ),
    )
    details = {
        "condition": condition.name,
        "provenance": PROVENANCE,
        "source": "D. M. D. da Silva, University of Brasília, 2023, tables 17-40",
        "method": PUBLISHED_METHODS[0],
        "parameters": ", ".join(
            f"{name}={value}" for name, value in zip(PARAMETER_NAMES, values, strict=True)
        ),
        "force_noise_standard_deviation": f"{THESIS_FORCE_NOISE} N",
        "displacement_noise_standard_deviation": f"{DISPLACEMENT_NOISE} m",
        "seed": str(seed),
        "assumed": "1 ms between samples; white noise on the displacement",
    }
    if not is_clean(condition):
        details["erratum"] = ERRATA[condition]
    return rig.record(SAMPLE_COUNT / SAMPLE_RATE, name=recording_name(condition), details=details)
