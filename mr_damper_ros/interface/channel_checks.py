"""What is wrong with one channel by itself: cut off, stuck, noisy, humming, coarse, wild."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mr_damper_ros.interface.rig_trouble import RigFinding, Trouble
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.white_noise import white_noise

_CUT, _ROW = 0.01, 5
"""Part of the samples, and how many in a row, that have exactly the largest or smallest value."""

_COARSE = 0.02
"""Step of a converter, in standard deviations of the channel."""

_NOISY = {"displacement": (0.002, 1e-5), "force": (0.03, 10.0)}
"""White noise that is much, in standard deviations of the channel and in its unit: both, for
without current a damper's force is small."""

_WILD, _JUMP = 12.0, 0.1
"""A single value that is so many times the noise, and such a part of the range, off its neighbours.
"""

_MAINS = (50.0, 60.0)
_NEAR, _BESIDE = 0.5, 6.0
"""Hertz around a frequency of the mains that belong to it, and that it is compared with."""

_HARMONICS = 2.2
"""Frequencies of the motion that it is compared with: odd harmonics lie two apart."""

_STANDS_OUT, _HUMS = 3.0, {"displacement": 1e-3, "force": 5e-3}
"""Times the lines beside it, and standard deviations of the channel, that a line is hum from."""


def channel_findings(
    name: str, unit: str, values: Array, period: float, frequency: float
) -> Iterator[RigFinding]:
    """What is wrong with the values (n,) of a channel of a motion of about this frequency [Hz]."""
    spread = float(np.std(values))
    step = coarse_step(values)
    cut = "" if step else _cut_off(values)
    if cut:
        yield RigFinding(
            Trouble.CLIPPED,
            f"the {name} is cut off at {cut}: choose a larger range, or a smaller motion",
            name,
        )
    if step:
        yield RigFinding(
            Trouble.COARSE,
            f"the {name} comes in steps of {step:.3g} {unit}: choose a smaller range or more bits",
            name,
        )
    noise = white_noise(values)
    part, least = _NOISY[name]
    if noise > max(part * spread, least) and not step:
        yield RigFinding(
            Trouble.NOISE,
            f"the {name} has {noise:.3g} {unit} of noise ({noise / spread:.1%} of its standard "
            "deviation): look at shields, earth and filter",
            name,
        )
    wild = _wild_values(values, noise)
    if wild:
        yield RigFinding(
            Trouble.SPIKES,
            f"{wild} single values of the {name} are far off their neighbours: a loose plug, or a "
            "disturbance?",
            name,
        )
        return
    for mains in _MAINS:
        beside = max(_BESIDE, _HARMONICS * frequency)
        amplitude = _hum(values, period, mains, beside, _HUMS[name] * spread)
        if amplitude > 0.0:
            yield RigFinding(
                Trouble.HUM,
                f"the {name} has {amplitude:.3g} {unit} of hum at {mains:g} Hz: look at shields "
                "and earth",
                name,
            )


def coarse_step(values: Array) -> float:
    """The step that values come in, where that is coarse; else 0."""
    steps = np.abs(np.diff(values))
    steps = steps[steps > 1e-9 * float(np.ptp(values))]
    step = float(steps.min()) if steps.size else 0.0
    return step if step > _COARSE * float(np.std(values)) else 0.0


def _cut_off(values: Array) -> str:
    """Where the values are cut off, in words; empty where they are not."""
    places = []
    for limit in (float(values.min()), float(values.max())):
        there = values == limit
        # The longest row of equal values.
        ends = np.flatnonzero(np.diff(np.concatenate([[0], there.astype(int), [0]])))
        longest = int(np.diff(ends)[::2].max())
        if longest >= _ROW and np.count_nonzero(there) >= _CUT * values.size:
            places.append(f"{limit:.4g}")
    return " and ".join(places)


def _wild_values(values: Array, noise: float) -> int:
    middle = np.median(np.stack([values[:-2], values[1:-1], values[2:]]), axis=0)
    off = np.abs(values[1:-1] - middle)
    least = max(_WILD * noise, _JUMP * float(np.quantile(values, 0.99) - np.quantile(values, 0.01)))
    return int(np.count_nonzero(off > least))


def _hum(values: Array, period: float, mains: float, reach: float, least: float) -> float:
    """Amplitude of a line at the mains' frequency that stands out; 0 where none does."""
    if mains + reach > 0.5 / period or values.size * period < 2.0 / _NEAR:
        return 0.0
    weights = np.hanning(values.size)
    lines = np.abs(np.fft.rfft((values - values.mean()) * weights)) * 2.0 / weights.sum()
    away = np.abs(np.fft.rfftfreq(values.size, period) - mains)
    here = float(lines[away <= _NEAR].max())
    beside = float(lines[(away > 2.0 * _NEAR) & (away <= reach)].max())
    return here if here > max(_STANDS_OUT * beside, least) else 0.0
