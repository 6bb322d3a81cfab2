"""The same dampers without any trouble: how much of the force is called valid, and rightly so."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from typing import NamedTuple

import numpy as np

from benchmarks.figure import Figure
from benchmarks.other_dampers import DAMPERS, chirp, random_motion, stairs, stops
from benchmarks.stream_trial import StreamTrial, Stretch, TrialResult, TrialSettings
from mr_damper_ros.emulation.motions import Excitation, SineMotion
from mr_damper_ros.tracking.tracker import TrackerSettings

MODELS = ("sigmoid", "sigmoid_lag")
"""The laws that are identified: the default, and the one for any motion."""

PROCESSES = 2
CURRENT = 1.2

_TOP_SPEED, _LARGEST = 0.1, 0.01
"""What the machine can do: [m/s], [m]."""

_REST_SPEED, _REST_TIME = 0.01, 0.5
"""At rest: below this part of the top speed for so long [s]."""


@dataclass(frozen=True)
class Programme:
    """A motion for ``duration`` [s].

    ``known_from`` [s]: all of it has been there once by then; 0 where it is the same throughout.
    """

    name: str
    motion: Callable[[], Excitation]
    duration: float
    known_from: float = 0.0


def _sine(frequency: float) -> Programme:
    amplitude = min(_LARGEST, _TOP_SPEED / (2.0 * np.pi * frequency))
    # Long enough for the slow ones to be identified and to go on for a while.
    duration = max(15.0, 4.0 / frequency)
    return Programme(f"{frequency:g} Hz", partial(SineMotion, amplitude, frequency), duration)


PROGRAMMES: tuple[Programme, ...] = (
    *map(_sine, (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)),
    Programme("random 0.2-3 Hz", partial(random_motion, 3e-3, 0.2, 3.0, 40.0, 5), 40.0),
    Programme("random 0.5-8 Hz", partial(random_motion, 2e-3, 0.5, 8.0, 40.0, 6), 40.0),
    Programme("chirp 0.2-20 Hz", partial(chirp, _TOP_SPEED, 5e-3, 0.2, 20.0, 48.0), 48.0, 24.0),
    Programme(
        "amplitudes 5, 1, 8 mm",
        partial(stairs, 5e-3, 1.0, (1.0, 0.2, 1.6) * 3, 6.0),
        54.0,
        18.0,
    ),
    Programme("stops", lambda: stops(SineMotion(5e-3, 1.0), 8.0, 4.0, 3), 36.0),
)
"""All of them."""


class _Job(NamedTuple):
    """A programme with a damper, and the model that is identified."""

    damper: str
    programme: Programme
    model: str


@dataclass(frozen=True)
class Health:
    """What came of a programme with a damper: ``asked`` and ``valid`` in seconds."""

    programme: str
    damper: str
    model: str
    asked: float
    valid: float
    wrong: Stretch
    why: tuple[tuple[str, float], ...]

    @property
    def percent(self) -> float:
        """Share of the force that was valid."""
        return 100.0 * self.valid / self.asked if self.asked else 0.0


def at_rest(result: TrialResult) -> np.ndarray:
    """Mask (n,) of the samples at which the machine stands still."""
    speed = np.abs(np.gradient(result.displacement, result.period))
    slow = speed < _REST_SPEED * speed.max()
    edges = np.flatnonzero(np.diff(np.concatenate(([0], slow.view(np.int8), [0]))))
    rest = np.zeros(slow.size, dtype=bool)
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        if (end - begin) * result.period >= _REST_TIME:
            rest[begin:end] = True
    return rest


def _run(job: _Job) -> Health:
    damper, programme, model = job
    settings = TrialSettings(tracker=TrackerSettings(model=model))
    trial = StreamTrial(DAMPERS[damper], programme.motion(), CURRENT, settings=settings)
    result = trial.run(programme.duration)
    begin = max(result.first_valid(), programme.known_from)
    if math.isinf(begin):
        # Never: all of it counts against it.
        begin = programme.known_from
    asked = (result.time >= begin) & ~at_rest(result)
    return Health(
        programme.name,
        damper,
        model,
        float(np.count_nonzero(asked)) * result.period,
        float(np.count_nonzero(asked & result.valid)) * result.period,
        result.wrong_valid(),
        tuple(result.why_invalid(begin)[:3]),
    )


def measure(
    programmes: Sequence[Programme] = PROGRAMMES,
    dampers: Sequence[str] = tuple(DAMPERS),
    models: Sequence[str] = MODELS,
    processes: int = PROCESSES,
) -> list[Health]:
    """All programmes with all dampers, once for each model."""
    jobs = [
        _Job(damper, programme, model)
        for programme in programmes
        for damper in dampers
        for model in models
    ]
    if processes == 1:
        return [_run(job) for job in jobs]
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        return list(pool.map(_run, jobs))


def figures(
    programmes: Sequence[Programme] = PROGRAMMES,
    dampers: Sequence[str] = tuple(DAMPERS),
    models: Sequence[str] = MODELS,
) -> list[Figure]:
    """``healthy_valid_percent`` and ``healthy_wrong_valid_s``."""
    return figures_of(measure(programmes, dampers, models))


def _share(found: Sequence[Health]) -> float:
    """Share [%] of the time that was valid."""
    return 100.0 * sum(h.valid for h in found) / sum(h.asked for h in found)


def figures_of(found: Sequence[Health]) -> list[Figure]:
    """The figures of what came of the programmes."""
    least = sorted(found, key=lambda health: health.percent)
    worst = sorted(found, key=lambda health: -health.wrong.total)
    models = list(dict.fromkeys(health.model for health in found))
    return [
        Figure(
            "healthy_valid_percent",
            [_share([health for health in found if health.model == model]) for model in models],
            f"{len(found)} streams of healthy dampers of other laws (0.05 to 20 Hz, random, chirp, "
            "amplitudes, stops): share of the time for which the force is valid from the first "
            "valid one on, in programmes that repeat from the second round on, rest not counted; "
            f"by {', '.join(models)}.",
            (97.0, 100.0),
            "Least: "
            + "; ".join(f"{h.programme}, {h.damper}, {h.model}: {h.percent:.1f}" for h in least[:5])
            + ".",
        ),
        Figure(
            "healthy_wrong_valid_s",
            sum(health.wrong.total for health in found),
            "Time [s] for which a force wrong by more than 20 % of the peak of the last 10 s is "
            "called valid there, in all.",
            (0.0, 0.0),
            "Most: "
            + "; ".join(
                f"{h.programme}, {h.damper}, {h.model}: {h.wrong.total:.2f} s, "
                f"up to {h.wrong.worst:.0%}"
                for h in worst[:5]
            )
            + ".",
        ),
    ]
