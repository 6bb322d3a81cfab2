"""The observer whose bandwidth follows the motion and the noise."""

import math

import numpy as np
import pytest
from random_motion import BandLimitedRandom

from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.kinematics.observer import (
    AdaptiveObserver,
    CausalDifferentiator,
    noise_gains,
    possible_bandwidths,
)
from mr_damper_ros.signals.arrays import Array

AMPLITUDE, NOISE = 5e-3, 1e-6
"""[m]"""


def measured(frequency: float, period: float, count: int) -> tuple[Array, Array]:
    """Noisy displacement [m] and true acceleration [m/s²] of a sine."""
    time = np.arange(count) * period
    motion = SineMotion(AMPLITUDE, frequency).at(time)
    noise = np.random.default_rng(3).standard_normal(count)
    return motion.displacement + NOISE * noise, motion.acceleration


def error_after(observer: AdaptiveObserver | CausalDifferentiator, u: Array, a: Array) -> float:
    """Root mean square error of the acceleration over the second half, relative."""
    half = slice(u.size // 2, None)
    found = observer.follow(u)[2]
    return float(np.linalg.norm((found - a)[half]) / np.linalg.norm(a[half]))


@pytest.mark.parametrize(("frequency", "period"), [(0.05, 1e-3), (1.0, 1e-3), (20.0, 1e-3)])
def test_it_comes_near_to_the_best_fixed_bandwidth(frequency: float, period: float) -> None:
    u, a = measured(frequency, period, 40_000)
    fixed = np.geomspace(0.5, possible_bandwidths(period)[1], 12)
    best = min(error_after(CausalDifferentiator(period, b), u, a) for b in fixed)
    # The error may be up to four times that of the best fixed bandwidth, because for a pure sine
    # the best one is only just wide enough, and the observer keeps a margin.
    assert error_after(AdaptiveObserver(period), u, a) < 4.0 * best


def test_noise_that_is_not_white_does_not_widen_it() -> None:
    period, count = 1e-3, 40_000
    motion = BandLimitedRandom(rms=3e-3, low=0.2, high=3.0, seed=1).at(period * np.arange(count))
    white = 10 * NOISE * np.random.default_rng(3).standard_normal(count)
    filtered = np.convolve(white, np.ones(3) / math.sqrt(3.0), "same")
    errors = [
        error_after(AdaptiveObserver(period), motion.displacement + noise, motion.acceleration)
        for noise in (white, filtered)
    ]
    # Of the acceleration; with the bandwidth of a start from rest it would be 19 times as large.
    assert errors[1] < 8.0 * errors[0]


def test_it_widens_when_the_motion_becomes_faster() -> None:
    slow, _ = measured(0.2, 1e-3, 20_000)
    fast, _ = measured(15.0, 1e-3, 2_000)
    observer = AdaptiveObserver(1e-3)
    observer.follow(slow)
    before = observer.bandwidth
    observer.follow(fast + slow[-1] - fast[0])
    assert observer.bandwidth > 4.0 * before


def test_the_gain_of_noise_is_that_of_noise() -> None:
    noise = np.random.default_rng(5).standard_normal(200_000)
    u, _, a = CausalDifferentiator(1e-3, 60.0).follow(noise)
    to_acceleration, to_residual = noise_gains(1e-3, 60.0)
    left = slice(2000, None)
    assert np.std(a[left]) == pytest.approx(to_acceleration, rel=0.03)
    assert np.std((noise - u)[left]) == pytest.approx(to_residual, rel=0.03)


@pytest.mark.parametrize("end", [None, 4322, 4325])
def test_a_jump_or_a_spike_of_the_sensor_leaves_no_trace(end: int | None) -> None:
    u, a = measured(1.0, 1e-3, 8000)
    jumped, other, undisturbed = u.copy(), AdaptiveObserver(1e-3), AdaptiveObserver(1e-3)
    undisturbed.follow(u)
    jumped[4321:end] += AMPLITUDE
    found = other.follow(jumped)[2]
    assert other.bandwidth == pytest.approx(undisturbed.bandwidth)
    # A start transient lasts less than 500 samples at these bandwidths.
    settled = slice(4321 + 500, None)
    # Noise alone causes an acceleration error of less than half the peak.
    assert np.abs(found - a)[settled].max() < 0.5 * np.abs(a).max()


@pytest.mark.parametrize(("start", "settled"), [("hard", True), ("jump", False)])
def test_a_motion_that_starts_hard_is_no_jump(start: str, settled: bool) -> None:
    time = 1e-3 * np.arange(20)
    moved = AMPLITUDE * (1.0 - np.cos(2.0 * np.pi * 10.0 * time))  # 20 m/s² from the first sample
    noise = NOISE * np.random.default_rng(0).standard_normal(2020)
    observer = AdaptiveObserver(1e-3)
    observer.follow(noise[:2000])
    observer.follow(noise[2000:] + (moved if start == "hard" else AMPLITUDE))
    assert (observer.settled_count > 0) == settled


@pytest.mark.parametrize("rate", [200.0, 1000.0])
@pytest.mark.parametrize("frequency", [1.0, 2.0, 5.0])
def test_a_motion_after_a_rest_is_followed_at_once(frequency: float, rate: float) -> None:
    rest = round(5.0 * rate)
    time = np.arange(round(2.0 / frequency * rate)) / rate
    growth = np.clip(time * frequency, 0.0, 1.0) ** 2
    moving = AMPLITUDE * growth * np.sin(2.0 * np.pi * frequency * time)
    truth = np.concatenate([np.zeros(rest), moving])
    noise = 5e-6 * np.random.default_rng(1).standard_normal(truth.size)
    found = AdaptiveObserver(1.0 / rate).follow(truth + noise)[1][rest:]
    error = found - np.gradient(truth, 1.0 / rate)[rest:]
    # Over the first two cycles; with the bandwidth of the rest the error would be 20 to 60 %.
    assert np.sqrt(np.mean(error**2)) < 0.1 * np.abs(np.gradient(moving, 1.0 / rate)).max()
