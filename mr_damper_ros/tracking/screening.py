"""Checks of a window before it is fitted: faults of the data, and too little motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mr_damper_ros.data_check.channels import longest, stretches
from mr_damper_ros.data_check.findings import Kind
from mr_damper_ros.data_check.samples import Samples, check_window, drives
from mr_damper_ros.kinematics.motion import DataError
from mr_damper_ros.kinematics.window import MOST_UNUSED, holds_cycle
from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.signals.arrays import NOISE_SPAN, Array, white_noise

_STUCK = (
    "the force changes as in a motion, but the displacement does not: is the displacement sensor "
    "stuck?"
)

_MOVING = 0.3
"""The damper moves during an apparent rest if the standard deviation of its force exceeds this
fraction of the standard deviation in the whole window, or if its force spans more than this
fraction of the largest known force. The displacement is then at fault."""

_RESTING = 0.02
"""The machine rests while its speed is below this fraction of the top speed."""


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


def lack_of_motion(displacement: Array, limits: Screening) -> str:
    """Why the amplitude of a displacement (n,) [m] is too small, in one sentence, or empty."""
    span = float(np.ptp(displacement))
    if 0.5 * span >= limits.minimum_amplitude:
        return ""
    return (
        f"an amplitude of {500.0 * span:.3g} mm is below the minimum of "
        f"{1000.0 * limits.minimum_amplitude:.3g} mm: move the damper more"
    )


def screened(given: Samples, limits: Screening, largest_force: float) -> Samples:
    """The samples of a window, with mended faults, before their motion is computed.

    ``largest_force`` [N] is the largest known force of the damper, NaN if unknown. Raises DataError
    for a fault that cannot be mended, and TooLittleMotionError for too small an amplitude.
    """
    displacement, force = given.displacement, given.force
    lack = lack_of_motion(displacement, limits)
    checked = check_window(given, moves=not lack)
    if checked.refused:
        raise DataError(checked.refused.sentence)
    if lack:
        still = float(np.ptp(displacement)) <= NOISE_SPAN * white_noise(displacement)
        low, high = np.quantile(force, (0.01, 0.99))
        if still and high - low > _MOVING * largest_force and holds_cycle(force):
            raise DataError(_STUCK)
        raise TooLittleMotionError(lack)
    return checked.samples


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
    if drives(velocity, force):
        raise DataError(Kind.INVERTED.found().sentence)


def long_rest(velocity: Array) -> slice | None:
    """The longest rest of the machine in a window (n,) [m/s] if it is too long for a fit."""
    speed = np.abs(velocity)
    rest = longest(stretches(speed < _RESTING * speed.max()))
    return rest if rest.stop - rest.start > MOST_UNUSED * velocity.size else None
