"""Kill -9 of ``identify_many`` and of its processes at random moments: what is kept stays.

The program is called again and again on the same folder until all is done. After each kill, what
had been kept must be whole; at the end, nothing that was kept may have been written again.
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

from benchmarks.figure import Figure
from benchmarks.lot_of_dampers import READING, write_lot

_PROGRAM = """
import sys
sys.path[:] = {path!r}
from mr_damper_ros.lots.many_dampers import identify_many

if __name__ == "__main__":
    identify_many({lot!r}, folder={results!r}, method="least_squares", workers=2, **{reading!r})
"""

_LONGEST_LIFE = 4.0
"""The kill comes after a random time [s] of up to this much; starting takes a part of it."""

_PATIENCE = 1800.0
"""Seconds in which the last call must end."""


def figures(kills: int = 50, dampers: int = 300, seed: int = 0) -> list[Figure]:
    """So many kills, half of the program and half of one of its processes."""
    chance = random.Random(seed)
    faults: list[str] = []
    with tempfile.TemporaryDirectory(dir=_build()) as place:
        lot, results = Path(place, "lot"), Path(place, "results")
        write_lot(lot, dampers, 1)
        script = Path(place, "program.py")
        script.write_text(
            _PROGRAM.format(path=sys.path, lot=str(lot), results=str(results), reading=READING)
        )
        seen: dict[str, int] = {}
        program: subprocess.Popen[bytes] | None = None
        done = 0
        while done < kills:
            if program is None or program.poll() is not None:
                program = subprocess.Popen([sys.executable, str(script)])
            time.sleep(chance.uniform(0.0, _LONGEST_LIFE))
            children = _children(program.pid)
            victim = program.pid if done % 2 == 0 or not children else chance.choice(children)
            os.kill(victim, signal.SIGKILL)
            done += 1
            if victim == program.pid:
                program.wait()
            faults += _changed(results, seen)
        if program is not None and program.poll() is None:
            program.wait(_PATIENCE)
        subprocess.run([sys.executable, str(script)], check=True, timeout=_PATIENCE)
        faults += _changed(results, seen)
        if len(seen) != dampers:
            faults.append(f"{dampers - len(seen)} dampers are missing")
    return [
        Figure(
            "many_kills",
            kills,
            "kill -9 of identify_many and of its processes, in turn, at random moments",
            (kills, kills),
        ),
        Figure(
            "many_kills_faults",
            len(faults),
            "results that were damaged, gone, or made again although they had been kept",
            (0.0, 0.0),
            "; ".join(faults[:3]),
        ),
    ]


def _build() -> Path:
    folder = Path("build")
    folder.mkdir(exist_ok=True)
    return folder


def _children(process: int) -> list[int]:
    """Processes of the pool: Linux alone tells them so simply."""
    try:
        text = Path(f"/proc/{process}/task/{process}/children").read_text()
    except OSError:
        return []
    return [int(word) for word in text.split() if _works(int(word))]


def _works(process: int) -> bool:
    """Whether it is a process of the pool, and not that which counts shared resources."""
    try:
        return b"spawn_main" in Path(f"/proc/{process}/cmdline").read_bytes()
    except OSError:
        return False


def _changed(results: Path, seen: dict[str, int]) -> list[str]:
    """What is wrong with the kept files; ``seen`` has the time of each that was there before."""
    faults = []
    now = {}
    for path in sorted((results / "dampers").glob("[!.]*.json")):
        now[path.name] = path.stat().st_mtime_ns
        if path.name not in seen:
            try:
                json.loads(path.read_text(encoding="utf-8"))
            except ValueError:
                faults.append(f"{path.name} is damaged")
    faults += [f"{name} is gone" for name in seen if name not in now]
    faults += [f"{name} was made again" for name in seen if now.get(name, seen[name]) != seen[name]]
    seen.update(now)
    return faults
