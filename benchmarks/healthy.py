"""Valid and correct fraction of the force for the same dampers without faults."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np

from benchmarks.figure import PROCESSES, Measured, in_processes
from benchmarks.other_dampers import DAMPERS, chirp, random_motion, stairs, stops
from benchmarks.stream_trial import StreamTrial, Stretch, TrialSettings, at_rest
from mr_damper_ros.emulation.motions import Excitation, SineMotion
from mr_damper_ros.tracking.tracker import TrackerSettings

MODELS = ("sigmoid", "sigmoid_lag")
"""Identified laws: the default, and the law for any motion."""

CURRENT = 1.2

_TOP_SPEED, _LARGEST = 0.1, 0.01
"""Limits of the machine: velocity [m/s] and displacement [m]."""


@dataclass(frozen=True)
class Programme:
    """A motion for ``duration`` [s].

    ``known_from`` [s] is the time by which every part of the motion has occurred once; 0 for a
    motion that is the same throughout.
    """

    name: str
    motion: Callable[[], Excitation]
    duration: float
    known_from: float = 0.0


def _sine(frequency: float) -> Programme:
    amplitude = min(_LARGEST, _TOP_SPEED / (2.0 * np.pi * frequency))
    # Long enough to identify the slow motions and continue for some time.
    duration = max(15.0, 4.0 / frequency)
    return Programme(f"{frequency:g} Hz", partial(SineMotion, amplitude, frequency), duration)


_AMPLITUDES = partial(stairs, 5e-3, 1.0, (1.0, 0.2, 1.6) * 3, 6.0)

PROGRAMMES: tuple[Programme, ...] = (
    *map(_sine, (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)),
    Programme("random 0.2-3 Hz", partial(random_motion, 3e-3, 0.2, 3.0, 40.0, 5), 40.0),
    Programme("random 0.5-8 Hz", partial(random_motion, 2e-3, 0.5, 8.0, 40.0, 6), 40.0),
    Programme("chirp 0.2-20 Hz", partial(chirp, _TOP_SPEED, 5e-3, 0.2, 20.0, 48.0), 48.0, 24.0),
    Programme("amplitudes 5, 1, 8 mm", _AMPLITUDES, 54.0, 18.0),
    Programme("stops", lambda: stops(SineMotion(5e-3, 1.0), 8.0, 4.0, 3), 36.0),
)
"""All of them."""


@dataclass(frozen=True)
class Health:
    """Result of a programme with a damper: ``asked`` and ``valid`` in seconds."""

    name: str
    model: str
    asked: float
    valid: float
    wrong: Stretch


def _run(job: tuple[int, str, str]) -> Health:
    place, damper, model = job
    programme = PROGRAMMES[place]
    settings = TrialSettings(tracker=TrackerSettings(model=model))
    trial = StreamTrial(DAMPERS[damper], programme.motion(), CURRENT, settings=settings)
    result = trial.run(programme.duration)
    begin = max(result.first_valid(), programme.known_from)
    if math.isinf(begin):
        # Nothing was ever valid: all of the time counts as a failure.
        begin = programme.known_from
    asked = (result.time >= begin) & ~at_rest(result)
    return Health(
        f"{programme.name}, {damper}, {model}",
        model,
        float(np.count_nonzero(asked)) * result.period,
        float(np.count_nonzero(asked & result.valid)) * result.period,
        result.wrong_valid(),
    )


def figures(
    programmes: Sequence[int] = range(len(PROGRAMMES)),
    dampers: Sequence[str] = tuple(DAMPERS),
    processes: int = PROCESSES,
) -> Measured:
    """Run these programmes with these dampers, once for each model."""
    found = in_processes(_run, list(product(programmes, dampers, MODELS)), processes)

    def share(healths: Sequence[Health]) -> float:
        return 100.0 * sum(h.valid for h in healths) / sum(h.asked for h in healths)

    least = sorted((share([health]) if health.asked else 0.0, health.name) for health in found)
    worst = sorted(found, key=lambda health: -health.wrong.total)
    return {
        "healthy_valid_percent": (
            [share([health for health in found if health.model == model]) for model in MODELS],
            f"{len(found)} streams. Least: "
            + "; ".join(f"{name}: {percent:.1f}" for percent, name in least[:5]),
        ),
        "healthy_wrong_valid_s": (
            sum(health.wrong.total for health in found),
            "Most: "
            + "; ".join(
                f"{h.name}: {h.wrong.total:.2f} s, up to {h.wrong.worst:.0%}" for h in worst[:5]
            ),
        ),
    }
