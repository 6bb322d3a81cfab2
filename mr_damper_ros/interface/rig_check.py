"""What is wrong with the signals of a rig, in words, and what to begin with."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.interface.channel_checks import channel_findings, coarse_step
from mr_damper_ros.interface.channel_lag import ChannelLag, channel_lag
from mr_damper_ros.interface.rig_record import RigRecord
from mr_damper_ros.interface.rig_trouble import RigFinding, Trouble
from mr_damper_ros.interface.stream_checks import current_findings, stream_findings
from mr_damper_ros.kinematics.savitzky_golay import SavitzkyGolay
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.white_noise import white_noise

_ENOUGH = 200
"""Samples in a row from which on anything is said of the channels."""

_DISPLACEMENT, _FORCE = (5e-5, 0.5), (2.0, 5e5)
"""Half ranges [m] and [N] that a damper in a press has; below and above the unit is another."""

_OFFSET = 0.25
"""Mean of the force over half its range that is more than a gas pressure gives."""

_SMOOTHER = 0.9
"""A machine moves smoothly; a damper's force turns sharply: its steps are the larger ones."""

_SKEW, _SURE = 3e-4, 3.0
"""Skew [s] that costs something, and standard errors that it must have."""

_USUAL = 2e-3
"""Amplitude [m] to begin with."""


@dataclass(frozen=True)
class RigCheck:
    """``findings`` (none: nothing is wrong), the ``lag`` of the force, and what to begin with."""

    findings: tuple[RigFinding, ...]
    lag: ChannelLag | None
    advice: str

    def __str__(self) -> str:
        lines = [f"- {finding.sentence}" for finding in self.findings]
        return "\n".join([*(lines or ["Nothing is wrong with the signals."]), "", self.advice])


def check_rig(record: RigRecord) -> RigCheck:
    """Judge what was heard of a rig, best for half a minute of motion at changing frequency."""
    unusable = RigFinding(
        Trouble.UNUSABLE,
        f"{record.unusable} messages cannot be used: each needs a period above 0, and as many "
        "displacements as forces",
    )
    found = [unusable] if record.unusable else []
    if not record.blocks:
        silent = RigFinding(
            Trouble.SILENT,
            "no samples come on mts/samples: start the bridge, or your driver, and let it publish "
            "reliably",
        )
        return RigCheck((*found, silent, *current_findings(record)), None, "")
    found += stream_findings(record)
    displacement, force = record.stretch()
    lag = None
    if not (np.isfinite(displacement).all() and np.isfinite(force).all()):
        for name, values in (("displacement", displacement), ("force", force)):
            count = int(np.count_nonzero(~np.isfinite(values)))
            if count:
                found.append(
                    RigFinding(
                        Trouble.NOT_FINITE, f"{count} values of the {name} are no numbers", name
                    )
                )
    elif displacement.size >= _ENOUGH:
        of_channels, lag = _channels(displacement, force, record.period)
        found += of_channels
    found += current_findings(record)
    return RigCheck(tuple(found), lag, _advice(displacement, force, record.period))


def _channels(
    displacement: Array, force: Array, period: float
) -> tuple[list[RigFinding], ChannelLag | None]:
    still = [
        RigFinding(
            Trouble.STUCK, f"the {name} does not change at all: is its sensor connected?", name
        )
        for name, values in (("displacement", displacement), ("force", force))
        if np.ptp(values) == 0.0
    ]
    if still:
        return still, None
    at_rest = _half_range(displacement) < _DISPLACEMENT[0]
    if not at_rest and _exchanged(displacement, force):
        return [
            RigFinding(
                Trouble.SWAPPED,
                "the displacement is rougher than the force: are the two channels exchanged?",
            )
        ], None
    found = list(_unit_findings(displacement, force))
    if any(finding.trouble is Trouble.AT_REST for finding in found):
        return found, None
    frequency = _frequency(displacement, period)
    for name, unit, values in (("displacement", "m", displacement), ("force", "N", force)):
        found += channel_findings(name, unit, values, period, frequency)
    sound = not any(finding.trouble is Trouble.CLIPPED for finding in found)
    lag = channel_lag(displacement, force, period)
    if _power(displacement, force, period) < 0.0:
        found.append(
            RigFinding(
                Trouble.INVERTED,
                "the force drives the motion: reverse the sign of force or displacement; extension "
                "and tension are positive",
            )
        )
        lag = channel_lag(displacement, -force, period)
    if sound and lag.determined and abs(lag.skew) > max(_SKEW, _SURE * lag.standard_error):
        late, early = ("force", "displacement") if lag.skew > 0 else ("displacement", "force")
        found.append(
            RigFinding(
                Trouble.SKEW,
                f"the {late} comes {1e3 * abs(lag.skew):.2f} ± {1e3 * lag.standard_error:.2f} ms "
                f"later than the {early}: a filter, a multiplexer, or a compliant mount? Set the "
                f"bridge's force_lateness to {lag.skew:.5f}",
            )
        )
    return found, lag


def _unit_findings(displacement: Array, force: Array) -> Iterator[RigFinding]:
    for name, unit, other, values, (low, high) in (
        ("displacement", "m", "millimetres", displacement, _DISPLACEMENT),
        ("force", "N", "kilonewtons", force, _FORCE),
    ):
        half = _half_range(values)
        if half > high:
            yield RigFinding(
                Trouble.UNIT, f"the {name} goes to ±{half:.3g} {unit}: is it in {other}?", name
            )
        elif half < low:
            trouble = Trouble.AT_REST if name == "displacement" else Trouble.UNIT
            question = "does the machine move?" if name == "displacement" else f"is it in {other}?"
            yield RigFinding(
                trouble, f"the {name} goes to ±{half:.3g} {unit} only: {question}", name
            )
    half = _half_range(force)
    if _half_range(displacement) < _DISPLACEMENT[0]:
        return
    # Half of the way between the extremes: a mean over parts of a cycle would not do.
    middle = 0.5 * float(np.quantile(force, 0.99) + np.quantile(force, 0.01))
    if abs(middle) > _OFFSET * half:
        yield RigFinding(
            Trouble.OFFSET,
            f"the force goes about {middle:.3g} N, not zero: set the zero of the load cell with "
            "the rod free",
            "force",
        )


def _half_range(values: Array) -> float:
    """Half the range of nearly all values: what happened once does not count."""
    low, high = np.quantile(values, (0.01, 0.99))
    return 0.5 * float(high - low)


def _exchanged(displacement: Array, force: Array) -> bool:
    """Whether the one channel is what the other should be: rough, and noisy for its size."""
    if coarse_step(displacement):
        return False  # a converter of few steps is rough, too
    noises = [white_noise(values) / float(np.std(values)) for values in (displacement, force)]
    rougher = _roughness(displacement) * _SMOOTHER > _roughness(force)
    return rougher and noises[0] > noises[1]


def _frequency(displacement: Array, period: float) -> float:
    """About how many times a second the rod goes to and fro [Hz]."""
    half = max(round(5e-3 / period), 2)
    if displacement.size < 2 * half + 1:
        return 0.0
    velocity = SavitzkyGolay(2 * half + 1, 2).derivative(displacement, 1, period)
    return float(np.std(velocity) / np.std(displacement) / (2.0 * np.pi))


def _roughness(values: Array) -> float:
    """Size of the steps between samples, without their noise, over the standard deviation."""
    steps = float(np.mean(np.diff(values) ** 2)) - 2.0 * white_noise(values) ** 2
    return float(np.sqrt(max(steps, 0.0)) / np.std(values))


def _power(displacement: Array, force: Array, period: float) -> float:
    """Mean power [W] that the damper takes."""
    half = max(round(2e-3 / period), 2)
    velocity = SavitzkyGolay(2 * half + 1, 2).derivative(displacement, 1, period)
    return float(np.mean(velocity * (force - force.mean())))


def _advice(displacement: Array, force: Array, period: float) -> str:
    """What amplitude and frequency to begin with, from the noise and the rate."""
    if displacement.size < _ENOUGH or not np.isfinite(displacement).all():
        return ""
    smallest = max(500.0 * white_noise(displacement), 1e-4)
    fastest = 1.0 / (200.0 * period)
    frequency = min(1.0, fastest)
    return (
        f"Begin with a sine of ±{1e3 * max(smallest, _USUAL):.2g} mm at {frequency:.2g} Hz and no "
        f"current, then half and all of it, then {min(2.0 * frequency, fastest):.2g} Hz. At least "
        f"±{1e3 * smallest:.2g} mm stand out of the noise; up to {fastest:.3g} Hz a cycle has at "
        "least 200 samples."
    )
