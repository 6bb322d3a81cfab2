"""What makes a window unfit for identification, before anything is fitted to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mr_damper_ros.kinematics.window import holds_cycle
from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.signals.arrays import Array, Mask, white_noise

LARGEST_SPAN = 0.5
"""A displacement that spans more [m] is taken for millimetres: no damper has such a stroke."""

LARGEST_FORCE = 1e7
"""A force beyond this [N] is no damper's."""

LARGEST_CURRENT = 50.0
"""A coil current beyond this [A] is taken for milliamperes."""

_CLIPPED_PART = 0.02
_CLIPPED_RUN = 8

_STUCK_PART = 0.05
_STUCK_WAY = 0.05
"""A force that is the same to the last bit in 5 % of a window in a row, while the motion turns and
comes back by 5 % of its span, is no damper's."""

_STILL = 12.0
"""A displacement that spans fewer standard deviations of its noise does not move at all."""

_STUCK = (
    "the force follows a motion that the displacement does not show: is the displacement sensor "
    "stuck?"
)

_MOVING_AT_REST = 0.5
"""A force that spreads at rest by this part of what it does in the whole window is no rest's."""

_MOVING_FORCE = 0.3
"""Part of the largest known force that a force spans at least, to be that of a motion."""

_APPROACH = 8
_SHORTEST_APPROACH = 2
"""The way to an extreme is looked at over a quarter of the stay there, and half of that,"""

_EVEN_SPEED = 0.37
"""and is made at speed where more than this part of it lies in the latter half: half of it does at
an even speed, a quarter where the rod comes to rest."""

_DIGITS = 3.0
"""Steps of the finest digit that such a way takes at least."""

_RESTING = 0.02
_LONGEST_REST = 0.25
"""A machine is standing still below 2 % of its top speed for this part of a window in a row."""

_ROUGHER = 1.5
"""A velocity whose mean frequency is this many times that of the force was none."""

DRIVING = 0.1
"""Correlation of force and velocity below minus this: the sign of one of them is wrong."""


@dataclass(frozen=True)
class Screening(CheckedSettings):
    """Limits that a window must keep to be fitted at all."""

    minimum_amplitude: float = option(
        0.5e-3,
        "Smallest amplitude of the motion [m], half the span of the displacement. Below it "
        "the force contains little information on the damper.",
        minimum=0.0,
        maximum=1.0,
    )
    current_tolerance: float = option(
        0.05,
        "Largest change of the current [A] within a window that counts as one operating "
        "point; otherwise the samples are grouped by current.",
        minimum=0.0,
        maximum=100.0,
    )


def fault_of_samples(displacement: Array, force: Array, current: Array, limits: Screening) -> str:
    """Why samples of shape (n,) [m, N, A] cannot be used, in one sentence; empty where they can.

    Whether they are finite was asked where they came in: a recording, a block, a window is. Motion
    that is too small is no fault, but where the force says that there is one.
    """
    span = float(np.ptp(displacement))
    if span > LARGEST_SPAN:
        return f"the displacement spans {span:.3g} m: is it in millimetres? give it in metres"
    largest = float(np.max(np.abs(force)))
    if largest > LARGEST_FORCE:
        return f"the force reaches {largest:.3g} N: check its unit"
    largest = float(np.max(np.abs(current)))
    if largest > LARGEST_CURRENT:
        return f"the current reaches {largest:.3g} A: is it in milliamperes? give it in amperes"
    if lack_of_motion(displacement, limits):
        return ""
    if np.ptp(force) == 0.0:
        return "the force does not change: is the load cell connected?"
    for name, array in (("force", force), ("displacement", displacement)):
        if _is_clipped(array):
            return f"the {name} is clipped at the end of its range: is the sensor overloaded?"
    if _is_stuck(displacement, force):
        return "the force is constant although the motion reverses: is the load cell connected?"
    return ""


def fault_at_rest(displacement: Array, force: Array, largest_force: float) -> str:
    """Why a machine that stands still (n,) [m, N] cannot do so, in a sentence; empty where it can.

    ``largest_force`` [N] is the largest known of the damper, NaN where none is.
    """
    still = float(np.ptp(displacement)) <= _STILL * white_noise(displacement)
    low, high = np.quantile(force, (0.01, 0.99))
    if still and high - low > _MOVING_FORCE * largest_force and holds_cycle(force):
        return _STUCK
    return ""


def lack_of_motion(displacement: Array, limits: Screening) -> str:
    """Why a displacement (n,) [m] moves too little, in a sentence; empty where it does not."""
    span = float(np.ptp(displacement))
    if 0.5 * span >= limits.minimum_amplitude:
        return ""
    return (
        f"an amplitude of {500.0 * span:.3g} mm is below the minimum of "
        f"{1000.0 * limits.minimum_amplitude:.3g} mm: move the damper more"
    )


def lack_of_cycle(displacement: Array, velocity: Array) -> str:
    """Why motion of shape (n,) [m, m/s] shows too little of the damper; empty where it does not.

    A machine that stops within a window leaves a stretch that says nothing of the damper.
    """
    resting = part_at_rest(velocity)
    if rests_too_long(resting):
        return f"the machine rests for {resting:.0%} of the window"
    if not holds_cycle(displacement):
        return (
            "the window contains less than a cycle of the motion: it is extended, up to "
            "longest_window"
        )
    return ""


def part_at_rest(velocity: Array) -> float:
    """Part of the samples (n,) [m/s] in a row in which the machine stands still at most."""
    if not velocity.size:
        return 1.0
    rest = _longest_rest(velocity)
    return (rest.stop - rest.start) / velocity.size


def fault_of_rest(velocity: Array, force: Array) -> str:
    """Why a machine cannot have stopped within a window (n,) [m/s, N]; empty where it can."""
    rest = _longest_rest(velocity)
    long = rests_too_long((rest.stop - rest.start) / velocity.size)
    if long and float(np.std(force[rest])) > _MOVING_AT_REST * float(np.std(force)):
        return _STUCK
    return ""


def _longest_rest(velocity: Array) -> slice:
    speed = np.abs(velocity)
    return _longest(_runs(speed < _RESTING * speed.max()))


def _runs(mask: Mask) -> list[slice]:
    """The stretches of a mask (n,) in which it is true."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], mask.view(np.int8), [0])))).tolist()
    return [slice(*ends) for ends in zip(edges[::2], edges[1::2], strict=True)]


def _longest(runs: list[slice]) -> slice:
    return max(runs, key=lambda run: run.stop - run.start, default=slice(0, 0))


def rests_too_long(part: float) -> bool:
    """Whether a machine that stands still for this part of a window spoils it."""
    return part > _LONGEST_REST


def fault_of_sign(velocity: Array, force: Array) -> str:
    """Why the signs of motion and force (n,) cannot both be right; empty where they can.

    A damper takes power out of the motion, over any stretch of time that holds some cycles.
    """
    centred = force - force.mean()
    power = float(centred @ velocity)
    if power < -DRIVING * float(np.linalg.norm(centred) * np.linalg.norm(velocity)):
        if _mean_frequency(velocity) > _ROUGHER * _mean_frequency(force):
            return (
                "displacement and force seem to be exchanged: the displacement is rougher than "
                "the force"
            )
        return (
            "the force is not dissipative: reverse the sign of the force or of the displacement "
            "(extension and tension are positive)"
        )
    return ""


def _is_stuck(displacement: Array, force: Array) -> bool:
    """Whether a force stays exactly the same for long, though the motion turns there."""
    same = _longest(_runs(np.diff(force) == 0.0))
    start, stop = same.start, same.stop + 1
    if stop - start < _STUCK_PART * force.size:
        return False
    stretch = displacement[start:stop]
    way_back = max(
        float(np.min(np.abs(stretch[[0, -1]] - extreme)))
        for extreme in (stretch.max(), stretch.min())
    )
    return way_back > _STUCK_WAY * float(np.ptp(displacement))


def _mean_frequency(values: Array) -> float:
    """Mean of the frequencies in a signal (n,), each with its power, in lines of the spectrum.

    The force of a damper is about as rough as the velocity, or rougher: it saturates.
    """
    power = np.abs(np.fft.rfft((values - values.mean()) * np.hanning(values.size))) ** 2
    return float(power @ np.arange(power.size)) / float(power.sum())


def _is_clipped(array: Array) -> bool:
    """Whether a signal is cut off at one of its extremes: it stays there, and gets there at speed.

    A machine that rests at its dead centre, and digits too coarse for the turn of a sine, come to
    the extreme slowly: there is nothing beyond it.
    """
    steps = np.abs(np.diff(array))
    finest = float(np.min(steps[steps > 0.0], initial=np.inf))
    for extreme in (array.max(), array.min()):
        at_extreme = array == extreme
        if at_extreme.mean() < _CLIPPED_PART:
            continue
        stays = [run for run in _runs(at_extreme) if run.stop - run.start >= _CLIPPED_RUN]
        if stays and _arrives_at_speed(np.abs(array - extreme), stays, finest):
            return True
    return False


def _arrives_at_speed(below: Array, stays: list[slice], finest: float) -> bool:
    """Whether a signal, so far ``below`` its extreme (n,), does not slow down before its stays."""
    near, far, count = 0.0, 0.0, 0
    for stay in stays:
        reach = max((stay.stop - stay.start) // _APPROACH, _SHORTEST_APPROACH)
        for edge, way in ((stay.start - 1, -1), (stay.stop, 1)):
            if 0 <= edge + way * 2 * reach < below.size:
                near += float(below[edge + way * reach])
                far += float(below[edge + way * 2 * reach])
                count += 1
    return count > 0 and far > _DIGITS * finest * count and near > _EVEN_SPEED * far
