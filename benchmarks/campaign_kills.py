"""Kill -9 of a campaign at random moments: what is finished stays, and is never done again.

The program is called again and again on the same folder, a new one when a campaign has ended. After
each kill, every run and every step that had been kept must be there as it was.
"""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.figure import Figure
from mr_damper_ros.campaign.folder import read_campaign_runs, read_steps

_PROGRAM = """
import sys
sys.path[:] = {path!r}
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

_LONGEST_LIFE = 8.0
"""The kill comes after a random time [s] of up to this much; starting takes a part of it."""

_PATIENCE = 1800.0
"""Seconds in which the last call must end."""


def figures(kills: int = 50, seed: int = 0) -> list[Figure]:
    """So many kills."""
    chance = random.Random(seed)
    faults: list[str] = []
    campaigns = 1
    Path("build").mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir="build") as place:
        script = Path(place, "program.py")
        script.write_text(_PROGRAM.format(path=sys.path))
        seen: dict[str, int] = {}
        done = 0
        while done < kills:
            folder = Path(place, f"campaign_{campaigns}")
            program = subprocess.Popen([sys.executable, str(script), str(folder)])
            try:
                code = program.wait(chance.uniform(0.0, _LONGEST_LIFE))
            except subprocess.TimeoutExpired:
                program.send_signal(signal.SIGKILL)
                program.wait()
                done += 1
                faults += _changed(folder, seen)
                continue
            faults += _changed(folder, seen)
            if code:
                faults.append(f"the program ended with exit code {code}")
            # That campaign is over: another begins.
            campaigns, seen = campaigns + 1, {}
        last = [sys.executable, str(script), str(folder)]
        subprocess.run(last, check=True, timeout=_PATIENCE)
        faults += _changed(folder, seen)
    return [
        Figure(
            "campaign_kills",
            kills,
            f"kill -9 of a program that makes campaigns, at random moments, in {campaigns} of them",
            (kills, kills),
        ),
        Figure(
            "campaign_kills_faults",
            len(faults),
            "runs or steps that were damaged, gone, or made again although they had been kept",
            (0.0, 0.0),
            "; ".join(faults[:3]),
        ),
    ]


def _changed(folder: Path, seen: dict[str, int]) -> list[str]:
    """What is wrong with the kept files; ``seen`` has the time of each that was there before."""
    faults = []
    now = {
        str(path.relative_to(folder)): path.stat().st_mtime_ns
        for kind in ("runs/run_*/*", "steps/step_*.json")
        for path in folder.glob(kind)
    }
    if (folder / "campaign.json").exists():
        try:
            runs, steps = read_campaign_runs(folder), read_steps(folder)
            if len(steps) > len(runs):
                faults.append("there are more steps than runs")
        except ValueError as error:
            faults.append(str(error))
    faults += [f"{name} is gone" for name in seen if name not in now]
    faults += [f"{name} was made again" for name in seen if now.get(name, seen[name]) != seen[name]]
    seen.update(now)
    return faults
