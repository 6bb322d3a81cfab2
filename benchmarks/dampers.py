"""Windows of re-synthesised runs that the figures are measured on."""

from __future__ import annotations

from mr_damper_ros.emulation.emulator import ConstantDamper, EmulatedRig, RigSettings
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.published import CONDITIONS, Condition, is_clean
from mr_damper_ros.signals.arrays import Array
from studies.recordings import window_of
from studies.thesis.published_runs import DISPLACEMENT_NOISE, PHASE, synthesise


def steady_window(parameters: Array, condition: Condition, *, samples: int, seed: int) -> Window:
    """Steady run of a damper of known parameters (16,) in a condition, at 1 kHz.

    The force has the noise of the thesis, the displacement that of
    :mod:`studies.thesis.published_runs`.
    """
    rig = EmulatedRig(
        ConstantDamper(parameters),
        SineMotion(condition.amplitude, condition.frequency, phase=PHASE),
        condition.current,
        settings=RigSettings(displacement_noise=DISPLACEMENT_NOISE, seed=seed),
    )
    return window_of(rig.record(samples * rig.settings.period))


def clean_windows() -> list[Window]:
    """The 30 clean conditions of the thesis, 7001 samples each."""
    return [window_of(synthesise(condition)) for condition in CONDITIONS if is_clean(condition)]
