"""Kill -9 of programs that keep what they finish: identify_many and a campaign, at random moments.

A program is called again and again on the same folder. After each kill, what had been kept must be
whole; at the end, nothing that was kept may be gone or have been written again.
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
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.figure import Figure
from mr_damper_ros.campaign.folder import read_campaign_runs, read_steps
from mr_damper_ros.emulation.emulator import ConstantDamper, EmulatedRig, RigSettings, scaled
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.models.published import THESIS_28_CELSIUS

_PATH = f"import sys\nsys.path[:] = {sys.path!r}\n"

_MANY = """
from pathlib import Path
from mr_damper_ros.lots.many_dampers import identify_many

if __name__ == "__main__":
    results = Path(sys.argv[1])
    lot = results.parent / "lot"
    identify_many(lot, folder=results, method="least_squares", workers=2, **{reading!r})
"""

_CAMPAIGN = """
import mr_damper_ros as mr
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.emulation.emulator import ConstantDamper, CurrentSchedule, EmulatedRig
from mr_damper_ros.emulation.emulator import RigSettings
from mr_damper_ros.emulation.motions import SineMotion

def perform(run):
    schedule = CurrentSchedule(
        [place * run.stretch for place in range(len(run.currents))], run.currents
    )
    motion = SineMotion(run.amplitude, run.frequency)
    settings = RigSettings(sample_rate=500.0)
    damper = ConstantDamper(THESIS_28_CELSIUS)
    return EmulatedRig(damper, motion, schedule, settings=settings).record(run.duration)

goal = mr.ForceGoal(0.05, (0.02, 0.2), (0.0, 1.5), speeds=3, currents=4)
limits = mr.MachineLimits(0.01, 0.2, 5000.0, 1.5, 2.0, sample_rate=500.0)
mr.run_campaign(goal, limits, perform, most_runs=5, folder=sys.argv[1])
"""

_PATIENCE = 1800.0
"""Seconds in which the last call must end."""


@dataclass
class _KeptFiles:
    """The files that a program has kept in a folder, each with the time at which it was written."""

    folder: Path
    patterns: tuple[str, ...]
    check: Callable[[Path, list[Path]], list[str]]
    """What is wrong with the folder and the files that are new in it."""

    def __post_init__(self) -> None:
        self.seen: dict[Path, int] = {}

    def faults(self) -> list[str]:
        """What is wrong since the last look."""
        now = {
            path: path.stat().st_mtime_ns
            for pattern in self.patterns
            for path in self.folder.glob(pattern)
        }
        faults = self.check(self.folder, [path for path in now if path not in self.seen])
        for path, written in self.seen.items():
            if path not in now:
                faults.append(f"{path.name} is gone")
            elif now[path] != written:
                faults.append(f"{path.name} was made again")
        self.seen.update(now)
        return faults


def _results_faults(_: Path, new: list[Path]) -> list[str]:
    faults = []
    for path in new:
        try:
            json.loads(path.read_text(encoding="utf-8"))
        except ValueError:
            faults.append(f"{path.name} is damaged")
    return faults


def _campaign_faults(folder: Path, _: list[Path]) -> list[str]:
    if not (folder / "campaign.json").exists():
        return []
    try:
        too_many = len(read_steps(folder)) > len(read_campaign_runs(folder))
    except ValueError as error:
        return [str(error)]
    return ["there are more steps than runs"] if too_many else []


@contextmanager
def _script(text: str) -> Iterator[tuple[Path, list[str]]]:
    """A folder, and the command that runs the script on the folder that is appended."""
    Path("build").mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir="build") as place:
        script = Path(place, "program.py")
        script.write_text(_PATH + text)
        yield Path(place).absolute(), [sys.executable, str(script.absolute())]


def many_kills(kills: int = 50, dampers: int = 300, seed: int = 0) -> list[Figure]:
    """So many kills of identify_many, half of the program and half of one of its processes.

    Each comes up to four seconds after the one before; starting takes a part of that.
    """
    chance = random.Random(seed)
    faults: list[str] = []
    with _script(_MANY.replace("{reading!r}", repr(_READING))) as (place, command):
        _write_lot(place / "lot", dampers, 1)
        kept = _KeptFiles(place / "results", ("dampers/[!.]*.json",), _results_faults)
        command.append(str(kept.folder))
        program = subprocess.Popen(command)
        for number in range(kills):
            if program.poll() is not None:
                program = subprocess.Popen(command)
            time.sleep(chance.uniform(0.0, 4.0))
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
    what = "kill -9 of identify_many and of its processes, in turn, at random moments"
    return _figures("many_kills", kills, what, "results", faults)


def campaign_kills(kills: int = 50, seed: int = 0) -> list[Figure]:
    """So many kills of a program that makes campaigns, each within its first eight seconds."""
    chance = random.Random(seed)
    faults: list[str] = []
    done, campaigns = 0, 1
    patterns = ("runs/run_*/*", "steps/step_*.json")
    with _script(_CAMPAIGN) as (place, command):
        kept = _KeptFiles(place / "1", patterns, _campaign_faults)
        while done < kills:
            program = subprocess.Popen([*command, str(kept.folder)])
            try:
                code = program.wait(chance.uniform(0.0, 8.0))
            except subprocess.TimeoutExpired:
                program.kill()
                program.wait()
                done += 1
                faults += kept.faults()
                continue
            faults += kept.faults()
            if code:
                faults.append(f"the program ended with exit code {code}")
            campaigns += 1
            kept = _KeptFiles(place / f"{campaigns}", patterns, _campaign_faults)
        subprocess.run([*command, str(kept.folder)], check=True, timeout=_PATIENCE)
        faults += kept.faults()
    what = f"kill -9 of a program that makes campaigns, at random moments, in {campaigns} of them"
    return _figures("campaign_kills", kills, what, "runs or steps", faults)


def _figures(key: str, kills: int, what: str, files: str, faults: list[str]) -> list[Figure]:
    damaged = f"{files} that were damaged, gone, or made again although they had been kept"
    return [
        Figure(key, kills, what, (kills, kills)),
        Figure(f"{key}_faults", len(faults), damaged, (0.0, 0.0), "; ".join(faults[:3])),
    ]


def _children(process: int) -> list[int]:
    """Processes of the pool, without the one that counts shared resources (Linux only)."""
    try:
        text = Path(f"/proc/{process}/task/{process}/children").read_text()
        return [
            int(word)
            for word in text.split()
            if b"spawn_main" in Path(f"/proc/{word}/cmdline").read_bytes()
        ]
    except OSError:
        return []


# -- a lot of dampers ------------------------------------------------------------

_COLUMNS = "displacement:mm,force:N,current:A"
_RATE = 500.0
_SPREAD = 0.03
"""Standard deviation of the force over the lot."""

_READING: dict[str, Any] = {"columns": _COLUMNS, "period": 1.0 / _RATE}
"""How the recordings are read."""


def _write_lot(folder: Path, dampers: int, recordings: int, seed: int = 0) -> None:
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
