"""Checks of a window before it is fitted: faults of the data, and too little motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mr_damper_ros.kinematics.motion import DataError
from mr_damper_ros.kinematics.window import MOST_UNUSED, TURN, holds_cycle
from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.signals.arrays import NOISE_SPAN, Array, Mask, white_noise
from mr_damper_ros.signals.recording import wrong_unit

_CLIPPED = 0.02
"""Smallest fraction of samples at its extreme for which a signal counts as clipped."""

_STUCK = (
    "the force changes as in a motion, but the displacement does not: is the displacement sensor "
    "stuck?"
)

_MOVING = 0.3
"""The damper moves during an apparent rest if the standard deviation of its force exceeds this
fraction of the standard deviation in the whole window, or if its force spans more than this
fraction of the largest known force. The displacement is then at fault."""

_APPROACH = 8
"""If a signal stays at its extreme for n samples, the n / 4 samples on either side are its
approach. Its two halves of n / 8 samples are compared; n is at least 8."""

_ARRIVAL_PART = 0.37
"""A signal is clipped if it covers more than this fraction of the approach in the second half. At
constant speed this fraction is a half; if the rod comes to rest, it is a quarter."""

_SMALLEST_APPROACH = 3.0
"""Shortest approach that is judged, in steps of the finest digit."""

_RESTING = 0.02
"""The machine rests while its speed is below this fraction of the top speed."""

NEGATIVE_POWER = 0.1
"""If the correlation of force and velocity is below minus this value, one of the signs is wrong."""


class TooLittleMotionError(Exception):
    """A window that contains too little motion; the message says why."""


@dataclass(frozen=True)
class Screening(CheckedSettings):
    """Limits that a window must meet to be fitted."""

    minimum_amplitude: float = option(
        0.5e-3,
        "Smallest amplitude of the motion [m], half the span of the displacement. Below it "
        "the force contains little information on the damper.",
        within=(0.0, 1.0),
    )
    current_tolerance: float = option(
        0.05,
        "Largest change of the current [A] within a window of one operating point. With a larger "
        "change the samples are grouped by current.",
        within=(0.0, 100.0),
    )


def fault_of_samples(displacement: Array, force: Array, current: Array, limits: Screening) -> str:
    """Why samples of shape (n,) [m, N, A] cannot be used, in one sentence; empty if they can.

    The samples are finite, because recordings, blocks and windows check this on entry. Too little
    motion is not a fault here.
    """
    if wrong := wrong_unit(displacement, force, current):
        return wrong
    if lack_of_motion(displacement, limits):
        return ""
    if np.ptp(force) == 0.0:
        return "the force does not change: is the load cell connected?"
    for name, array in (("force", force), ("displacement", displacement)):
        if clipped_at(array):
            return f"the {name} is clipped at the end of its range: is the sensor overloaded?"
    if _is_stuck(displacement, force):
        return "the force is constant although the motion reverses: is the load cell connected?"
    return ""


def lack_of_motion(displacement: Array, limits: Screening) -> str:
    """Why the amplitude of a displacement (n,) [m] is too small, in one sentence, or empty."""
    span = float(np.ptp(displacement))
    if 0.5 * span >= limits.minimum_amplitude:
        return ""
    return (
        f"an amplitude of {500.0 * span:.3g} mm is below the minimum of "
        f"{1000.0 * limits.minimum_amplitude:.3g} mm: move the damper more"
    )


def check_samples(
    displacement: Array, force: Array, current: Array, limits: Screening, largest_force: float
) -> None:
    """Check the samples (n,) [m, N, A] of a window before their motion is computed.

    ``largest_force`` [N] is the largest known force of the damper, NaN if unknown. Raises DataError
    for a fault, and TooLittleMotionError for too small an amplitude.
    """
    if fault := fault_of_samples(displacement, force, current, limits):
        raise DataError(fault)
    if lack := lack_of_motion(displacement, limits):
        still = float(np.ptp(displacement)) <= NOISE_SPAN * white_noise(displacement)
        low, high = np.quantile(force, (0.01, 0.99))
        if still and high - low > _MOVING * largest_force and holds_cycle(force):
            raise DataError(_STUCK)
        raise TooLittleMotionError(lack)


def check_motion(displacement: Array, velocity: Array, force: Array) -> None:
    """Check the motion (n,) [m, m/s] of a window and its force (n,) [N].

    Raises DataError if they contradict each other, and TooLittleMotionError if the machine rests
    too long or the window contains less than a cycle.
    """
    if (rest := long_rest(velocity)) is not None:
        if float(np.std(force[rest])) > _MOVING * float(np.std(force)):
            raise DataError(_STUCK)
        share = (rest.stop - rest.start) / velocity.size
        raise TooLittleMotionError(f"the machine rests for {share:.0%} of the window")
    if not holds_cycle(displacement):
        raise TooLittleMotionError(
            "the window contains less than a cycle of the motion: it is extended, up to "
            "longest_window"
        )
    if fault := fault_of_sign(velocity, force):
        raise DataError(fault)


def long_rest(velocity: Array) -> slice | None:
    """The longest rest of the machine in a window (n,) [m/s] if it is too long for a fit."""
    speed = np.abs(velocity)
    rest = _longest(_runs(speed < _RESTING * speed.max()))
    return rest if rest.stop - rest.start > MOST_UNUSED * velocity.size else None


def _runs(mask: Mask) -> list[slice]:
    """The runs of consecutive true values of a mask (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], mask.view(np.int8), [0])))).tolist()
    return [slice(*ends) for ends in zip(edges[::2], edges[1::2], strict=True)]


def _longest(runs: list[slice]) -> slice:
    return max(runs, key=lambda run: run.stop - run.start, default=slice(0, 0))


def fault_of_sign(velocity: Array, force: Array) -> str:
    """Why the signs of motion and force (n,) cannot both be right; empty if they can.

    A damper is dissipative over any time that contains some cycles.
    """
    centred = force - force.mean()
    power = float(centred @ velocity)
    if power < -NEGATIVE_POWER * float(np.linalg.norm(centred) * np.linalg.norm(velocity)):
        return (
            "the force is not dissipative, it drives the motion: reverse the sign of the force or "
            "of the displacement (extension and tension are positive), or exchange the two "
            "channels if they are swapped"
        )
    return ""


def _is_stuck(displacement: Array, force: Array) -> bool:
    """Whether the force is exactly constant for a long time while the motion reverses."""
    same = _longest(_runs(np.diff(force) == 0.0))
    start, stop = same.start, same.stop + 1
    if stop - start < TURN * force.size:
        return False
    stretch = displacement[start:stop]
    ends, extremes = stretch[[0, -1]], (stretch.max(), stretch.min())
    way_back = max(float(np.min(np.abs(ends - extreme))) for extreme in extremes)
    return way_back > TURN * float(np.ptp(displacement))


def clipped_at(array: Array) -> list[float]:
    """The extremes of a signal (n,) at which it stays, and where it arrives without slowing down.

    A machine that rests at a dead centre, or a sine with a coarse resolution, approaches its
    extreme slowly and is not clipped.
    """
    steps = np.abs(np.diff(array))
    finest = float(np.min(steps[steps > 0.0], initial=np.inf))
    found = []
    for extreme in (float(array.min()), float(array.max())):
        at_extreme = array == extreme
        if at_extreme.mean() < _CLIPPED:
            continue
        stays = [run for run in _runs(at_extreme) if run.stop - run.start >= _APPROACH]
        if stays and _arrives_at_speed(np.abs(array - extreme), stays, finest):
            found.append(extreme)
    return found


def _arrives_at_speed(below: Array, stays: list[slice], finest: float) -> bool:
    """Whether a signal reaches its extreme, at which it ``stays``, without slowing down.

    ``below`` (n,) is the distance from the extreme; ``finest`` is the finest digit of the signal.
    """
    near, far, count = 0.0, 0.0, 0
    for stay in stays:
        reach = max((stay.stop - stay.start) // _APPROACH, 2)
        for edge, way in ((stay.start - 1, -1), (stay.stop, 1)):
            if 0 <= edge + way * 2 * reach < below.size:
                near += float(below[edge + way * reach])
                far += float(below[edge + way * 2 * reach])
                count += 1
    return count > 0 and far > _SMALLEST_APPROACH * finest * count and near > _ARRIVAL_PART * far
