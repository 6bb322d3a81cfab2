"""Kill -9 of identify_many at random times: stored results stay intact and are not computed again.

The program is called repeatedly on the same folder.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.figure import Measured
from mr_damper_ros.emulation.emulator import EmulatedDamper, EmulatedRig, RigSettings, scaled
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.models.published import THESIS_28_CELSIUS

_RATE = 500.0

_READING: dict[str, Any] = {
    "columns": "displacement:mm,force:N,current:A",
    "period": 1.0 / _RATE,
}
"""Options for reading the recordings."""

_SCRIPT = f"""
import sys
sys.path[:] = {sys.path!r}
from pathlib import Path
from mr_damper_ros.lots.many_dampers import identify_many

if __name__ == "__main__":
    results = Path(sys.argv[1])
    lot = results.parent / "lot"
    identify_many(lot, folder=results, method="least_squares", workers=2, **{_READING!r})
"""

_SPREAD = 0.03
"""Standard deviation of the force scale over the lot."""

_LONGEST_WAIT = 4.0
"""Longest time [s] between two kills, which includes the start of the program."""

_PATIENCE = 1800.0
"""Time limit [s] of the last call."""


class _Kept:
    """The results in a folder and the time at which each was written."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.seen: dict[Path, int] = {}

    def faults(self) -> list[str]:
        """Failures since the last check."""
        now = {path: path.stat().st_mtime_ns for path in self.folder.glob("dampers/[!.]*.json")}
        faults = [f"{path.name} is gone" for path in self.seen.keys() - now.keys()]
        for path, written in now.items():
            if self.seen.get(path, written) != written:
                faults.append(f"{path.name} was made again")
            if path not in self.seen:
                try:
                    json.loads(path.read_text(encoding="utf-8"))
                except ValueError:
                    faults.append(f"{path.name} is damaged")
        self.seen.update(now)
        return faults


def figures(kills: int = 50, seed: int = 0, dampers: int = 300) -> Measured:
    """Run a number of kills, half of the program and half of one of its processes."""
    chance = random.Random(seed)
    faults: list[str] = []
    Path("build").mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir="build") as folder:
        place = Path(folder).absolute()
        (place / "program.py").write_text(_SCRIPT)
        _write_lot(place / "lot", dampers)
        kept = _Kept(place / "results")
        command = [sys.executable, str(place / "program.py"), str(kept.folder)]
        program = subprocess.Popen(command)
        for number in range(kills):
            if program.poll() is not None:
                program = subprocess.Popen(command)
            time.sleep(chance.uniform(0.0, _LONGEST_WAIT))
            children = _children(program.pid)
            victim = program.pid if number % 2 == 0 or not children else chance.choice(children)
            os.kill(victim, signal.SIGKILL)
            if victim == program.pid:
                program.wait()
            faults += kept.faults()
        program.wait(_PATIENCE)
        subprocess.run(command, check=True, timeout=_PATIENCE)
        faults += kept.faults()
        if len(kept.seen) != dampers:
            faults.append(f"{dampers - len(kept.seen)} dampers are missing")
    return {"many_kills_faults": (len(faults), f"{kills} kills. " + "; ".join(faults[:3]))}


def _children(process: int) -> list[int]:
    """Processes of the pool, without the resource tracker (Linux only)."""
    try:
        text = Path(f"/proc/{process}/task/{process}/children").read_text()
        return [
            int(word)
            for word in text.split()
            if b"spawn_main" in Path(f"/proc/{word}/cmdline").read_bytes()
        ]
    except OSError:
        return []


def _write_lot(folder: Path, dampers: int) -> None:
    """A number of dampers with a recording of half a second each."""
    rng = np.random.default_rng(0)
    for number in range(dampers):
        values = scaled(THESIS_28_CELSIUS, 1.0 + _SPREAD * rng.standard_normal())
        settings = RigSettings(sample_rate=_RATE, seed=(0, number))
        rig = EmulatedRig(EmulatedDamper(values), SineMotion(5e-3, 4.0), 0.5, settings=settings)
        run = rig.record(0.5)
        rows = np.column_stack((1e3 * run.displacement, run.force, run.current))
        path = folder / f"D{number:04}" / "run.csv"
        path.parent.mkdir(parents=True)
        np.savetxt(path, rows, fmt="%.7g", delimiter=",")
