"""Ways to velocity and acceleration of a stream from the past alone, on the same motions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.signal import savgol_coeffs

from benchmarks.figure import Figure
from mr_damper_ros.api.replay import replay
from mr_damper_ros.emulation.motions import SampledMotion, SineMotion
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.motion_follower import MotionFollower
from mr_damper_ros.kinematics.observer import CausalDifferentiator
from mr_damper_ros.kinematics.peak_velocity import MEMORY, PeakVelocity
from mr_damper_ros.models import MODELS, published
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import LITERATURE
from mr_damper_ros.models.sigmoid.law import sine_force
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.predictor import PredictorSettings
from studies import recordings
from studies.earthquake import records
from studies.thesis import published_runs

PERIOD = 1e-3
NOISE = published_runs.DISPLACEMENT_NOISE
_BLOCK = 10
_SETTLED = 5.0
"""Seconds of a motion after which it is judged."""

Follow = Callable[[Array], tuple[Array, Array]]
"""Displacement (n,) [m] to velocity [m/s] and acceleration [m/s²], each of the past alone."""


def observer(bandwidth: float) -> Follow:
    """The steady state of a Kalman filter of piecewise constant jerk."""

    def follow(u: Array) -> tuple[Array, Array]:
        _, v, a = CausalDifferentiator(PERIOD, bandwidth).follow(u)
        return v, a

    return follow


def one_sided_polynomial(length: int) -> Follow:
    """Cubic through the latest samples (Savitzky and Golay, at the end of the window)."""

    def follow(u: Array) -> tuple[Array, Array]:
        padded = np.concatenate((np.full(length - 1, u[0]), u))
        found = [
            np.convolve(
                padded, savgol_coeffs(length, 3, deriv=k, delta=PERIOD, pos=length - 1), "valid"
            )
            for k in (1, 2)
        ]
        return found[0], found[1]

    return follow


def product(u: Array) -> tuple[Array, Array]:
    """What the nodes use: the fitted sine where there is one, else the observer."""
    follower = MotionFollower(PERIOD, PredictorSettings().bandwidth, MEMORY)
    parts = [follower.follow(block) for block in np.split(u, range(_BLOCK, u.size, _BLOCK))]
    return (
        np.concatenate([part.velocity for part in parts]),
        np.concatenate([part.acceleration for part in parts]),
    )


METHODS: dict[str, Follow] = {
    "observer, 20 Hz": observer(20.0),
    "observer, 40 Hz": observer(40.0),
    "observer, 80 Hz": observer(80.0),
    "one-sided cubic, 31 samples": one_sided_polynomial(31),
    "one-sided cubic, 61 samples": one_sided_polynomial(61),
    "sine follower and observer": product,
}


@dataclass(frozen=True)
class MotionCase:
    """A motion with exact derivatives, and the displacement (n,) [m] as measured."""

    truth: Motion
    measured: Array

    @classmethod
    def of(cls, excitation: SineMotion | SampledMotion, duration: float) -> MotionCase:
        """``duration`` [s] of a motion, with the noise of the thesis' runs."""
        time: Array = np.arange(round(duration / PERIOD), dtype=float) * PERIOD
        u, v, a = excitation.at(time)
        v_m = PeakVelocity(PERIOD).follow(v, a)
        noise = NOISE * np.random.default_rng(0).standard_normal(u.size)
        return cls(Motion(u - excitation.centre, v, a, v_m, None), u + noise)


@dataclass(frozen=True)
class Quality:
    """Of one method on one motion.

    ``delay`` [s] of the velocity; ``velocity`` and ``force``: RMS error over the RMS of the truth
    [1]; ``start`` [s]: when the velocity is within 2 % of its RMS for good (NaN: never).
    """

    delay: float
    velocity: float
    force: float
    start: float


def quality(case: MotionCase, follow: Follow) -> Quality:
    """Errors after the first seconds; the force is that of the literature's set at 1 A."""
    truth = case.truth
    v, a = follow(case.measured)
    late = slice(round(_SETTLED / PERIOD), None)
    error = v - truth.velocity
    size = float(np.sqrt(np.mean(truth.velocity[late] ** 2)))
    delay = -float(error[late] @ truth.acceleration[late]) / float(
        truth.acceleration[late] @ truth.acceleration[late]
    )
    forces = [_force(truth.velocity, truth), _force(v, truth, a)]
    spread = float(np.std(forces[0][late]))
    wrong = np.flatnonzero(np.abs(error) > 0.02 * np.sqrt(2.0) * size)
    last = int(wrong[-1]) + 1 if wrong.size else 0
    return Quality(
        delay,
        float(np.sqrt(np.mean(error[late] ** 2))) / size,
        float(np.sqrt(np.mean((forces[1] - forces[0])[late] ** 2))) / spread,
        last * PERIOD if last < v.size else float("nan"),
    )


def _force(velocity: Array, truth: Motion, acceleration: Array | None = None) -> Array:
    a = truth.acceleration if acceleration is None else acceleration
    motion = Motion(truth.displacement, velocity, a, truth.peak_velocity, None)
    return MODELS["sigmoid"].force(LITERATURE, motion, 1.0, PERIOD)


def stream_nrmse_ratio(runs: int | None = None) -> float:
    """Error of the predicted force on the clean thesis runs, over that with exact kinematics."""
    errors = []
    for condition in [c for c in published.CONDITIONS if published.is_clean(c)][:runs]:
        run = published_runs.synthesise(condition)
        values = published.parameters(condition)
        said = replay(run, ParameterSet(values), identify=False)
        made, valid = said.predicted, said.valid
        time: Array = np.arange(run.force.size, dtype=float) * run.period
        sine = SineMotion(condition.amplitude, condition.frequency, phase=published_runs.PHASE)
        exact = sine_force(values, *sine.at(time), condition.current)
        errors.append(
            [np.mean((f - run.force)[valid] ** 2) / np.var(run.force) for f in (made, exact)]
        )
    streamed, exact_error = np.mean(errors, axis=0)
    return float(np.sqrt(streamed / exact_error))


def cases() -> dict[str, MotionCase]:
    """Sines at 0.5, 1 and 3 Hz, and where there are recordings the earthquake's motion."""
    found = {
        f"{f:g} Hz": MotionCase.of(SineMotion(5e-3, f, phase=1.0), 12.0) for f in (0.5, 1.0, 3.0)
    }
    place = recordings.folder()
    if place is not None:
        record = records(place)[0]
        found["earthquake"] = MotionCase.of(SampledMotion(record.displacement, record.period), 60.0)
    return found


def figures(runs: int | None = None) -> list[Figure]:
    """``stream_nrmse_ratio``; of all clean ``runs`` or the first so many."""
    return [
        Figure(
            "stream_nrmse_ratio",
            stream_nrmse_ratio(runs),
            "Predicted force on the 30 clean thesis runs, streamed in blocks of 10, where it is "
            "valid: NRMSE over that with noise-free kinematics (root mean squares).",
            (0.0, 1.15),
        )
    ]


def main() -> None:
    """Print the table of doc/kinematics.md: ``python -m benchmarks.kinematics``."""
    print("| motion | method | delay [ms] | velocity [%] | force [%] | start [s] |")
    print("|---|---|---|---|---|---|")
    for motion, case in cases().items():
        for name, follow in METHODS.items():
            q = quality(case, follow)
            print(
                f"| {motion} | {name} | {1e3 * q.delay:.2f} | {100.0 * q.velocity:.2f} | "
                f"{100.0 * q.force:.2f} | {q.start:.2f} |"
            )


if __name__ == "__main__":
    main()
