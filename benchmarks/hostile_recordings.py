"""Identification from unsuitable recordings, which must end in a set or a clear error.

The recordings show emulated dampers of several laws in motions with little information (rest,
steps, hundredths of a millimetre, a burst), with changing currents and with faults of the rig. An
identification passes if it returns a set with a finite error or raises a ValueError of this
package. An error of a library fails, because its message does not help the user.
"""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np

import mr_damper_ros as mr
from benchmarks.figure import Measured
from benchmarks.other_dampers import DAMPERS, stairs, stops
from mr_damper_ros.emulation.emulator import (
    CurrentSchedule,
    EmulatedDamper,
    EmulatedRig,
    RigSettings,
)
from mr_damper_ros.emulation.faults import Instruments, faults_of
from mr_damper_ros.emulation.motions import (
    BandLimitedMotion,
    Excitation,
    SineMotion,
    chirp,
    stepped,
)
from mr_damper_ros.models import MODELS
from mr_damper_ros.signals.recording import Recording

_PACKAGE = Path(mr.__file__).parent

_RATES = (100.0, 200.0, 500.0, 1000.0)  # [Hz]
_LENGTHS = (300, 800, 2000)
_FORCE_NOISES = (0.0, 0.5, 5.0, 30.0)  # [N]
_DISPLACEMENT_NOISES = (0.0, 1e-6, 1e-5)  # [m]
_MOST_RUNS = 3

MOTIONS: Mapping[str, Excitation] = {
    "sine": SineMotion(5e-3, 1.3),
    "slow": SineMotion(2e-2, 0.05),
    "tiny": SineMotion(2e-5, 1.0),
    "random": BandLimitedMotion(1e-2, 0.3, 6.0, 1),
    "chirp": chirp(4e-3, 0.5, 4.0, 10.0),
    "stepped": stepped(4e-3, 0.5, 4.0, 10.0),
    "resting": stops(SineMotion(6e-3, 1.5), 0.3, 3.0, 6),
    "burst": stairs(2e-2, 3.0, (1.0, 0.2, 0.01), 0.5),
}

FAULTS = (
    *("", "swapped", "backlash", "friction"),
    *("force_gain:-1", "force_gain:1000", "force_offset:800", "force_clip:300"),
    *("force_stuck@0.2", "force_spikes:500", "force_delay:0.003", "force_hum:20"),
    *("displacement_coarse:0.0005", "displacement_stuck@1", "displacement_delay:0.01"),
)
"""Faults as text; the first entry means no fault."""


def figures(cases: int = 100, seed: int = 0) -> Measured:
    """Run a number of identifications."""
    ends, failures = campaign(cases, seed)
    return {"identify_failures": (len(failures), "; ".join([str(dict(ends)), *failures[:3]]))}


def campaign(cases: int, seed: int) -> tuple[Counter[str], list[str]]:
    """Numbers of identifications that ended in a set and in an error message, and the failures."""
    ends: Counter[str] = Counter()
    failures = []
    for number in range(cases):
        rng = np.random.default_rng((seed, number))
        law, levels = _one_of(rng, MODELS), float(rng.choice([0.0, 0.1]))
        damper = _one_of(rng, DAMPERS)
        recordings = [_recording(damper, rng) for _ in range(rng.integers(1, _MOST_RUNS + 1))]
        try:
            found = mr.identify(recordings, model=law, level_per_record=levels)
            end = "a set" if np.isfinite(found.parameter_set.nrmse) and str(found) else "no number"
        except Exception as error:  # a failure, except a ValueError of the package
            place = Path(traceback.extract_tb(error.__traceback__)[-1].filename)
            ours = isinstance(error, ValueError) and place.is_relative_to(_PACKAGE)
            end = "a sentence" if ours else f"{type(error).__name__}: {error}"
        if end.startswith("a "):
            ends[end] += 1
        else:
            told = "; ".join(each.name for each in recordings)
            failures.append(f"case {number}, {law}, {damper}: {told}: {end}")
    return ends, failures


def _recording(damper: str, rng: np.random.Generator) -> Recording:
    rate, count = float(rng.choice(_RATES)), int(rng.choice(_LENGTHS))
    motion, fault = _one_of(rng, MOTIONS), str(rng.choice(FAULTS))
    each = float(rng.choice([0.2, 1e3]))  # seconds of a current, or one for all
    times = np.arange(0.0, count / rate, each)
    faults = faults_of(fault.split())
    rig = EmulatedRig(
        EmulatedDamper(DAMPERS[damper]),
        MOTIONS[motion],
        CurrentSchedule(times.tolist(), rng.uniform(0.0, 2.0, times.size).tolist()),
        settings=RigSettings(
            sample_rate=rate,
            force_noise=float(rng.choice(_FORCE_NOISES)),
            displacement_noise=float(rng.choice(_DISPLACEMENT_NOISES)),
        ),
        faults=faults,
    )
    ((block, _),) = Instruments(faults).read(rig.next_block(count))
    return Recording(
        name=f"{motion} {fault or 'sound'} ({count} samples, {rate:g} Hz, {times.size} currents)",
        start_ns=block.start_ns,
        period=block.period,
        displacement=block.displacement,
        force=block.force,
        current=block.current,
    )


def _one_of(rng: np.random.Generator, names: Mapping[str, object]) -> str:
    return list(names)[int(rng.integers(len(names)))]
