"""A lot of emulated dampers whose recordings lie in a folder, as a test bench leaves them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mr_damper_ros.emulation.emulator import ConstantDamper, EmulatedRig, RigSettings, scaled
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.models.published import THESIS_28_CELSIUS

COLUMNS = "displacement:mm,force:N,current:A"
_RATE = 500.0
_SPREAD = 0.03
"""Standard deviation of the force over the lot."""

READING: dict[str, Any] = {"columns": COLUMNS, "period": 1.0 / _RATE}
"""How the recordings are read."""


def write_lot(folder: Path, dampers: int, recordings: int, seed: int = 0) -> None:
    """So many dampers with so many recordings of half a second each, at rising currents."""
    rng = np.random.default_rng(seed)
    for number in range(dampers):
        values = scaled(THESIS_28_CELSIUS, 1.0 + _SPREAD * rng.standard_normal())
        (folder / f"D{number:04}").mkdir(parents=True)
        for place in range(recordings):
            rig = EmulatedRig(
                ConstantDamper(values),
                SineMotion(5e-3, 4.0),
                0.5 * (place + 1),
                settings=RigSettings(sample_rate=_RATE, seed=(seed, number, place)),
            )
            run = rig.record(0.5)
            rows = np.column_stack((1e3 * run.displacement, run.force, run.current))
            path = folder / f"D{number:04}" / f"run{place}.csv"
            np.savetxt(path, rows, fmt="%.7g", delimiter=",")
