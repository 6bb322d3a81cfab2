"""A window weighed against the running set."""

from __future__ import annotations

import known
import numpy as np
import pytest
from known import SIGMOID
from random_motion import BandLimitedRandom

from benchmarks.other_dampers import DAMPERS
from mr_damper_ros.emulation.emulator import EmulatedDamper, EmulatedRig, RigSettings
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.estimation.window_fit import WindowFit, WindowPrior, fit_window
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.signals.arrays import Array

RUNNING = known.PLAUSIBLE
RANDOM = BandLimitedRandom(rms=4e-3, low=0.2, high=2.0, seed=2)


def random_window(
    first: int,
    samples: int,
    *,
    name: str = "sigmoid",
    size: float = 1.0,
    unmodelled: float = 0.2,
    seed: int = 0,
) -> Window:
    """A window of random motion of an example of a law, ``size`` [1] of the usual one.

    ``unmodelled`` [1]: a slow part of the force that no law has.
    """
    # Samples that go on after a window, so that its motion has no end.
    time = np.arange(first + samples + 500) * 1e-3
    whole = size * RANDOM.at(time).displacement
    window = Window.from_samples(whole, np.zeros(whole.size), 1.0, 1e-3)
    clean = MODELS[name].window_force(window, known.EXAMPLES[name])
    slow = BandLimitedRandom(rms=1.0, low=0.2, high=4.0, seed=10 + seed)
    rest = unmodelled * np.std(clean) * slow.at(time).displacement
    force = clean + rest + np.random.default_rng(seed).normal(0.0, known.NOISE, clean.size)
    return Window(window.motion, force, window.current, 1e-3).part(slice(first, first + samples))


def own(window: Window) -> WindowFit:
    return fit_window(SIGMOID, window, RUNNING, method="least_squares")


def weigh(
    window: Window, running: Array = RUNNING, name: str = "sigmoid", fastest: float = np.inf
) -> WindowFit:
    prior = WindowPrior(running, fastest)
    return fit_window(MODELS[name], window, running, method="least_squares", prior=prior)


def test_what_a_short_window_of_random_motion_leaves_open_stays() -> None:
    elsewhere = random_window(10_000, 8000, unmodelled=0.0)
    errors = []
    for seed in range(5):
        window = random_window(1000 * seed, 1000, seed=seed)
        alone = own(window)
        weighed = weigh(window)
        errors.append(
            [
                known.rms(SIGMOID.window_force(elsewhere, fit.parameters) - elsewhere.force)
                for fit in (alone, weighed)
            ]
        )
    alone_error, weighed_error = np.median(errors, axis=0)
    # Most that the error elsewhere may be of that of the fit to a short window alone.
    assert weighed_error < 0.5 * alone_error


def test_a_running_set_from_part_of_a_cycle_is_given_up_where_a_cycle_refutes_it() -> None:
    # A damper of another law: what the fit leaves of it is smooth, and counts for few samples.
    rig = EmulatedRig(
        EmulatedDamper(DAMPERS["modified_bouc_wen"]),
        SineMotion(0.01, 0.1),
        1.2,
        settings=RigSettings(1000.0, seed=0),
    )
    made = rig.record(13.0)

    def window(begin: float, end: float) -> Window:
        part = slice(round(1000 * begin), round(1000 * end))
        return Window.from_samples(
            made.displacement[part], made.force[part], 1.2, made.period
        ).thinned(2000)

    cycle = window(2.3, 12.3)
    poor = own(window(0.3, 7.0)).parameters
    alone = own(cycle)
    weighed = weigh(cycle, poor)
    # The same of a window that refutes the running set, which may cost it a quarter.
    assert weighed.rmse < 1.3 * alone.rmse


@pytest.mark.parametrize("name", sorted(known.EXAMPLES))
def test_a_motion_that_dies_away_spoils_no_law(name: str) -> None:
    model, running = MODELS[name], known.EXAMPLES[name]
    elsewhere = random_window(3000, 4000, name=name, unmodelled=0.0)
    window = random_window(1500, 1500, name=name, size=0.15, seed=1)
    weighed = weigh(window, running, name)
    error = known.rms(model.window_force(elsewhere, weighed.parameters) - elsewhere.force)
    # Least NRMSE in the usual motion of what a window of a small one has spoilt.
    assert error < 0.1 * np.std(elsewhere.force)
