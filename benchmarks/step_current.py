"""The first second after a step of the current within the known range, against steady current.

Emulated dampers of several laws go through a programme of currents; every level but the ones in
between has been there before it counts. How well a second is predicted depends on its motion more
than on the step: so each is also held against itself, with a current that has been there for a
whole level already. The earthquake records, all three of one motion, are put
together to a damper whose current steps between theirs: there the same seconds at a current that
never stepped are what is compared with.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.figure import Figure
from benchmarks.other_dampers import DAMPERS
from benchmarks.stream_trial import StreamTrial, TrialSettings
from benchmarks.switched_current import SIXTEEN, excitation
from mr_damper_ros.emulation.emulator import CurrentSchedule
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.tracking.tracker import TrackerSettings
from studies import earthquake, recordings

LEARNT = (0.2, 0.8, 1.4, 0.5, 1.1, 0.2, 1.4, 0.8)
"""Currents [A] that are gone through before steps count, ..."""

STEPS = (0.2, 1.4, 0.5, 0.95, 0.35, 1.1, 0.2, 0.8, 1.25, 0.5)
"""... and after, some of them never met before."""

EACH = 6.0
"""Seconds at one current: a window after the step is fitted well before they are over."""

AFTER_STEP = 1.0
STEADY = 2.0
"""The first second of a level, and its last two."""

_EACH_REAL = 8.0
_LEFT_OUT = 5.0


class StepStream(NamedTuple):
    """A damper and the law that is identified, and how it is moved (sine or random)."""

    damper: ParameterSet
    model: str
    motion: str


CASES = (
    StepStream(SIXTEEN, "sigmoid", "sine"),
    StepStream(SIXTEEN, "sigmoid", "random"),
    StepStream(DAMPERS["viscous_tanh"], "sigmoid_lag", "sine"),
    StepStream(DAMPERS["viscous_tanh"], "sigmoid_lag", "random"),
    StepStream(DAMPERS["modified_bouc_wen"], "sigmoid_lag", "sine"),
    StepStream(DAMPERS["modified_bouc_wen"], "sigmoid_lag", "random"),
)
"""All of them."""


@dataclass(frozen=True)
class StepError:
    """NRMSE [1] of the force in the first second after the steps, and what it is held against.

    ``steady``: later; ``unstepped``: in the same seconds of the motion without the steps.
    """

    after: float
    steady: float
    unstepped: float

    @property
    def ratio(self) -> float:
        """Over that later."""
        return self.after / self.steady

    @property
    def paired_ratio(self) -> float:
        """Over that without the steps."""
        return self.after / self.unstepped


def nrmse(error: Array, force: Array) -> float:
    """Error [N] over the standard deviation of the force [N], both (n,)."""
    return float(np.sqrt(np.mean(error**2)) / np.std(force))


def _seconds(time: Array, begins: Iterable[float], first: float, last: float) -> np.ndarray:
    """Mask (n,) of the samples from ``first`` to ``last`` [s] after one of the begins [s]."""
    chosen = np.zeros(time.size, dtype=bool)
    for begin in begins:
        chosen |= (time >= begin + first) & (time < begin + last)
    return chosen


def emulated(
    case: StepStream,
    learnt: Sequence[float] = LEARNT,
    steps: Sequence[float] = STEPS,
    seed: int = 0,
) -> StepError:
    """What comes of a case, from a cold start; currents [A] that are learnt and stepped through."""
    levels = (*learnt, *steps)
    times = (EACH * np.arange(len(levels))).tolist()
    duration = EACH * len(levels)
    settings = TrialSettings(seed=seed, block_size=20, tracker=TrackerSettings(model=case.model))
    schedule = CurrentSchedule(times, list(levels))
    motion = excitation(case.motion, duration, seed)
    trial = StreamTrial(case.damper, motion, schedule, settings=settings)
    trial.advance(EACH * (len(learnt) - 1))
    unstepped = []
    for level in range(len(learnt), len(levels)):
        unstepped.append(_already_there(trial, times[:level], levels[: level + 1]))
        trial.advance(EACH)
    result = trial.run(EACH)
    error = result.predicted - result.measured
    begins = times[len(learnt) :]
    after = _seconds(result.time, begins, 0.0, AFTER_STEP)
    steady = _seconds(result.time, begins, EACH - STEADY, EACH)
    same_error, same_force = np.concatenate(unstepped, axis=1)
    return StepError(
        nrmse(error[after], result.measured[after]),
        nrmse(error[steady], result.measured[steady]),
        nrmse(same_error, same_force),
    )


def _already_there(
    trial: StreamTrial, times: Sequence[float], levels: Sequence[float]
) -> tuple[Array, Array]:
    """Error and force [N] (n,) of the second in which the last level [A] would begin.

    It comes a level earlier, in place of the one before: now.
    """
    other = trial.branch(current=CurrentSchedule(list(times), [*levels[:-2], levels[-1]]))
    other.advance(EACH + AFTER_STEP)
    result = other.result()
    same = _seconds(result.time, [times[-1] + EACH], 0.0, AFTER_STEP)
    return (result.predicted - result.measured)[same], result.measured[same]


def stepped(records: Sequence[Recording], each: float = _EACH_REAL) -> Recording:
    """A record whose current goes from that of one record to that of the next, and so on.

    All records are of one motion.
    """
    first = records[0]
    time = np.arange(first.force.size) * first.period
    place = (time // each).astype(int) % len(records)
    force, current = (
        np.choose(place, [getattr(record, name) for record in records])
        for name in ("force", "current")
    )
    return replace(first, force=force, current=current)


def recorded(utfsm: Path, model: str) -> StepError:
    """What comes of the earthquake, from the set for the sinusoid records on."""
    records = earthquake.unsmoothed_records(utfsm)
    start = earthquake.sinusoid_set(utfsm, model)
    together = stepped(records)

    def predicted(record: Recording) -> Array:
        return earthquake.predicted(record, start, identify=True)

    constant = stepped([replace(record, force=predicted(record)) for record in records])
    error = predicted(together) - together.force
    reference = constant.force - together.force
    time = np.asarray(np.arange(error.size) * together.period, dtype=np.float64)
    moves = np.abs(together.displacement - together.displacement[0]) > 1e-4
    begin = float(time[int(np.argmax(moves))]) + _LEFT_OUT
    ends = np.arange(_EACH_REAL, time[-1] - AFTER_STEP, _EACH_REAL)
    steps = [float(end) for end in ends if end >= begin]
    after = _seconds(time, steps, 0.0, AFTER_STEP)
    force = together.force[after]
    unstepped = nrmse(reference[after], force)
    return StepError(nrmse(error[after], force), unstepped, unstepped)


def figures(
    cases: Sequence[StepStream] = CASES,
    learnt: Sequence[float] = LEARNT,
    steps: Sequence[float] = STEPS,
) -> list[Figure]:
    """``step_current_nrmse_ratio``, that of pairs, and what they are made of."""
    found = {
        f"{case.damper.set_id} by {case.model}, {case.motion}": emulated(case, learnt, steps)
        for case in cases
    }
    place = recordings.folder()
    note = recordings.NONE if place is None else ""
    if place is not None:
        for model in ("sigmoid", "sigmoid_lag"):
            found[f"earthquake by {model}"] = recorded(place, model)
    names = "; ".join(found)
    return [
        Figure(
            "step_current_nrmse_ratio",
            [each.ratio for each in found.values()],
            f"NRMSE in the first second after a step of the current within the known range over "
            f"that in the last {STEADY:g} s before the next, every {EACH:g} s, after "
            f"{EACH * len(learnt):g} s from a cold start; of the earthquakes, put together of "
            f"records at 0.2, 0.6 and 1.0 A, over that of the same seconds at constant current: "
            f"{names}.",
            (0.0, 1.2),
            note,
        ),
        Figure(
            "step_current_paired_ratio",
            [each.paired_ratio for each in found.values()],
            f"NRMSE in these first seconds over that in the very same seconds of the motion, "
            f"predicted where the current has been at the new value for {EACH:g} s already.",
            (0.0, 1.2),
            note,
        ),
        Figure(
            "step_current_nrmse",
            [100.0 * each.after for each in found.values()],
            "NRMSE [%] in these first seconds.",
            None,
            f"Later {', '.join(f'{100.0 * each.steady:.3g}' for each in found.values())}; without "
            f"the steps {', '.join(f'{100.0 * each.unstepped:.3g}' for each in found.values())}.",
        ),
    ]
