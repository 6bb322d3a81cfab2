"""Motions and current schedules of the emulated streams."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise

import numpy as np

from mr_damper_ros.control.linear_plant import IsoRoad, QuarterCar
from mr_damper_ros.emulation.emulator import CurrentSchedule
from mr_damper_ros.emulation.motions import ChangedMotion, Excitation, SampledMotion, SineMotion
from mr_damper_ros.signals.arrays import Array

_GRID = 5e-3
"""Sample period [s] of a motion up to about 20 Hz; a spline interpolates the samples."""

_RAMP = 0.5
"""Time [s] in which an irregular motion grows and fades: an abrupt stop causes a large force."""

DURATION, SLOW_DURATION = 24.0, 40.0
"""Duration [s] of the :data:`MOTIONS`, and of the slow one among them."""


def random_motion(rms: float, low: float, high: float, duration: float, seed: int) -> SampledMotion:
    """Gaussian motion of ``rms`` [m] with a flat spectrum from ``low`` to ``high`` [Hz].

    It begins at rest and returns to rest by the end of the ``duration`` [s].
    """
    rng = np.random.default_rng(seed)
    tones = 60
    rates = 2.0 * np.pi * (low + (high - low) * (np.arange(tones) + rng.random(tones)) / tones)
    end = duration + _RAMP
    time = np.arange(round(end / _GRID) + 1) * _GRID
    sines, cosines = (rms / math.sqrt(tones) * rng.standard_normal(tones) for _ in range(2))
    angles = np.outer(time, rates)
    return SampledMotion(_ramp(time) * (np.sin(angles) @ sines + np.cos(angles) @ cosines), _GRID)


def chirp(top_speed: float, most: float, low: float, high: float, duration: float) -> SampledMotion:
    """A repeated logarithmic sweep from ``low`` to ``high`` [Hz] and back.

    One direction takes a quarter of the ``duration`` [s]. The amplitude keeps the speed at
    ``top_speed`` [m/s], but does not exceed ``most`` [m].
    """
    grid = 1e-3
    time = np.arange(round(duration / grid) + 1) * grid
    way = 4.0 * time / duration
    height = 1.0 - np.abs(way % 2.0 - 1.0)
    frequency = low * (high / low) ** height
    phase = 2.0 * np.pi * np.cumsum(frequency) * grid
    amplitude = np.minimum(top_speed / (2.0 * np.pi * frequency), most)
    return SampledMotion(amplitude * np.sin(phase), grid)


def stairs(amplitude: float, frequency: float, factors: Sequence[float], each: float) -> Excitation:
    """A sine whose amplitude changes every ``each`` [s] to a multiple of ``amplitude`` [m]."""
    motion: Excitation = SineMotion(amplitude * factors[0], frequency)
    for place, (before, after) in enumerate(pairwise(factors), start=1):
        motion = ChangedMotion(motion, place * each, math.inf, 0.1, after / before)
    return motion


def stops(motion: Excitation, moving: float, resting: float, times: int) -> Excitation:
    """The motion with a rest of ``resting`` [s] after each ``moving`` [s]."""
    for place in range(times):
        begin = place * (moving + resting) + moving
        motion = ChangedMotion(motion, begin, begin + resting, 0.1, tempo=0.0)
    return motion


def _ramp(time: np.ndarray) -> Array:
    """Factor (n,) that grows and fades at the ends of the times [s]."""
    to_edge = np.minimum(time, time[-1] - time)
    return np.asarray(np.sin(0.5 * np.pi * np.clip(to_edge / _RAMP, 0.0, 1.0)) ** 2)


def _simulated(dynamics: Array, forcing: Array, period: float) -> Array:
    """States (n, m) from rest, by the trapezoidal rule; ``forcing`` has shape (n, m)."""
    half, unit = 0.5 * period * dynamics, np.eye(len(dynamics))
    step = np.linalg.solve(unit - half, unit + half)
    enters = np.linalg.inv(unit - half) * period
    states = np.zeros(forcing.shape)
    for place in range(1, len(forcing)):
        mean = 0.5 * (forcing[place - 1] + forcing[place])
        states[place] = step @ states[place - 1] + enters @ mean
    return states


def _from_rest(displacement: Array, peak: float, period: float) -> Array:
    """The motion scaled to ``peak`` [m], beginning and ending at rest."""
    factor = peak / float(np.max(np.abs(displacement)))
    return np.asarray(factor * displacement * _ramp(period * np.arange(displacement.size)))


def _car_travel(seed: int) -> Excitation:
    """Suspension stroke of a quarter car with a passive damper on a road of class B."""
    plant = QuarterCar().plant
    # The damper's force opposes the travel: F = c v.
    dynamics = plant.dynamics + 1200.0 * np.outer(plant.by_force, plant.velocity)
    grid = _GRID * np.arange(round(DURATION / _GRID) + 1, dtype=np.float64)
    forcing = np.outer(IsoRoad("B", 15.0, seed).at(grid), plant.by_input)
    states = _simulated(dynamics, forcing, _GRID)
    return SampledMotion(_from_rest(states @ plant.displacement, 0.015, _GRID), _GRID)


def skyhook_car(seed: int) -> tuple[Excitation, CurrentSchedule]:
    """Suspension stroke of a quarter car on a road of class B, and the current of its skyhook.

    The current is on while a damper between body and wheel brakes the body.
    """
    plant, unit = QuarterCar().plant, np.eye(4)
    steps = []
    for damping in (400.0, 3000.0):
        dynamics = plant.dynamics + damping * np.outer(plant.by_force, plant.velocity)
        half = 0.5 * _GRID * dynamics
        inverse = np.linalg.inv(unit - half)
        steps.append((inverse @ (unit + half), _GRID * inverse @ plant.by_input))
    grid = _GRID * np.arange(round(DURATION / _GRID) + 1, dtype=np.float64)
    states, on = np.zeros((grid.size, 4)), np.zeros(grid.size, dtype=bool)
    for place, road in enumerate(IsoRoad("B", 15.0, seed).at(grid)[1:].tolist(), start=1):
        before = states[place - 1]
        on[place] = before[1] * (before @ plant.velocity) > 0.0
        dynamics, forcing = steps[int(on[place])]
        states[place] = dynamics @ before + forcing * road
    changed = np.concatenate([[True], np.diff(on)])
    current = scheduled(grid[changed], np.where(on[changed], HIGHEST_CURRENT, 0.0))
    return SampledMotion(_from_rest(states @ plant.displacement, 0.015, _GRID), _GRID), current


def _shaken(seed: int) -> Array:
    """Ground acceleration of an earthquake, for a peak of 1, at intervals of :data:`_GRID`.

    It is noise with the Kanai-Tajimi spectrum (Tajimi, 2nd World Conference on Earthquake
    Engineering, 1960) within an envelope; its low frequencies are removed as Clough and Penzien
    propose.
    """
    frequency, damping, rise, strong, decay = 2.0, 0.4, 1.5, 3.0, 1.8
    count = round((rise + strong + 3.0 * decay) / _GRID)
    rates = np.fft.rfftfreq(count, _GRID)
    square = (rates / frequency) ** 2
    damped = 4.0 * damping**2 * square
    low = (rates / (0.1 * frequency)) ** 2
    power = (1.0 + damped) / ((1.0 - square) ** 2 + damped)
    power *= low**2 / ((1.0 - low) ** 2 + 4.0 * damping**2 * low)
    power[rates > 25.0] = 0.0
    noise = np.fft.rfft(np.random.default_rng(seed).standard_normal(count))
    time = _GRID * np.arange(count)
    envelope = np.minimum(time / rise, 1.0) ** 2
    envelope *= np.exp(-np.maximum(time - rise - strong, 0.0) / decay)
    shaken = np.fft.irfft(noise * np.sqrt(power), count) * envelope
    return np.asarray(shaken / float(np.max(np.abs(shaken))))


def _earthquakes(seed: int) -> Excitation:
    """Storey drift of a building at 1.4 Hz under a series of earthquakes."""
    rate = 2.0 * math.pi * 1.4
    dynamics = np.array([[0.0, 1.0], [-(rate**2), -0.5 * rate]])
    drifts = []
    for place, peak in enumerate((0.012, 0.006, 0.009)):
        ground = _shaken(10 * seed + place)
        states = _simulated(dynamics, np.outer(-ground, [0.0, 1.0]), _GRID)
        drifts.append(_from_rest(states[:, 0], peak, _GRID))
    return SampledMotion(np.concatenate(drifts), _GRID)


SLOW = "sine 0.05-0.2 Hz"

MOTIONS: dict[str, Callable[[int], Excitation]] = {
    SLOW: lambda seed: SineMotion(0.015, (0.05, 0.1, 0.2)[seed % 3]),
    "sine 0.4 Hz": lambda _: SineMotion(0.011, 0.4),
    "sine 2 Hz": lambda _: SineMotion(0.006, 2.0),
    "sine 10 Hz": lambda _: SineMotion(0.0015, 10.0),
    "chirp 0.3-8 Hz": lambda _: chirp(0.12, 0.009, 0.3, 8.0, DURATION),
    "amplitudes 4, 1, 8 mm": lambda _: stairs(4e-3, 1.5, (1.0, 0.25, 2.0) * 2, 5.0),
    "random 0.2-3 Hz": lambda seed: random_motion(4e-3, 0.2, 3.0, DURATION, seed),
    "random 0.5-8 Hz": lambda seed: random_motion(2e-3, 0.5, 8.0, DURATION, seed),
    "earthquakes": _earthquakes,
    "quarter car": _car_travel,
}
"""Motions of the foreign dampers by name, made from a seed."""


# -- currents --------------------------------------------------------------------------------------

HIGHEST_CURRENT = 1.5


def scheduled(times: np.ndarray, currents: np.ndarray) -> CurrentSchedule:
    """Each of the currents [A] from its time [s] on."""
    return CurrentSchedule(times.tolist(), currents.tolist())


def switched(seed: int, count: int = 400) -> CurrentSchedule:
    """Random currents, each for 0.2 to 1 s."""
    rng = np.random.default_rng(seed)
    times = np.concatenate([[0.0], np.cumsum(rng.uniform(0.2, 1.0, count))])
    return scheduled(times, rng.uniform(0.0, HIGHEST_CURRENT, times.size))


def _stepped(seed: int) -> CurrentSchedule:
    """Four currents in a random order, each for 4 s."""
    rng = np.random.default_rng(seed)
    levels = np.concatenate([rng.permutation([0.0, 0.4, 0.9, 1.5]) for _ in range(6)])
    return scheduled(4.0 * np.arange(levels.size), levels)


def _wandering(seed: int) -> CurrentSchedule:
    """A random current with a correlation time of 0.5 s, set every 50 ms."""
    rng = np.random.default_rng(seed)
    kept, value, levels = math.exp(-0.05 / 0.5), 0.0, []
    for draw in rng.standard_normal(1200):
        value = kept * value + math.sqrt(1.0 - kept**2) * draw
        levels.append(min(max(0.7 + 0.4 * value, 0.0), HIGHEST_CURRENT))
    return scheduled(0.05 * np.arange(len(levels)), np.array(levels))


def _commanded(
    on: Callable[[Array, Array], Array], motion: Excitation, seed: int
) -> CurrentSchedule:
    """The current of a controller that uses displacement and velocity, every 10 ms."""
    grid = 0.01 * np.arange(round(SLOW_DURATION / 0.01), dtype=np.float64)
    found = motion.at(grid)
    levels = on(found.displacement - motion.centre, found.velocity)
    changed = np.concatenate([[True], np.diff(levels) != 0.0])
    return scheduled(grid[changed], levels[changed])


def _bang_bang(displacement: Array, velocity: Array) -> Array:
    """Current on while the damper moves away from its centre."""
    return np.asarray(HIGHEST_CURRENT * (displacement * velocity > 0.0))


def _skyhook(displacement: Array, velocity: Array) -> Array:
    """Current of a skyhook controller for a body that follows the slow part of the motion."""
    body = np.zeros(velocity.size)
    for place in range(1, body.size):
        body[place] = body[place - 1] + 0.01 / 0.15 * (velocity[place - 1] - body[place - 1])
    wanted = body / max(float(np.std(velocity)), 1e-6)
    level = np.where(wanted * velocity > 0.0, 0.7 * np.abs(wanted), 0.0)
    return np.asarray(np.round(np.minimum(level, HIGHEST_CURRENT), 2))


CURRENTS: dict[str, Callable[[Excitation, int], CurrentSchedule]] = {
    "0.8 A": lambda _, __: CurrentSchedule.constant(0.8),
    "steps": lambda _, seed: _stepped(seed),
    "switched 0.2-1 s": lambda _, seed: switched(seed),
    "bang-bang": partial(_commanded, _bang_bang),
    "skyhook": partial(_commanded, _skyhook),
    "wandering": lambda _, seed: _wandering(seed),
}
"""Currents of the foreign dampers by name, made from a motion and a seed."""
