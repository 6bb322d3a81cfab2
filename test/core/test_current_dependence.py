"""Laws of one current extended to all currents, with a coil lag, and the mass before the cell."""

import math
from collections.abc import Sequence
from functools import cache
from types import SimpleNamespace
from typing import Any, cast

import known
import numpy as np
import pytest
from fresh_python import alone

import mr_damper_ros as mr
from mr_damper_ros.api.identification import _fitted_mass
from mr_damper_ros.data_check.findings import Kind
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import GlobalFit, identify_global
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.peak_velocity import peak_velocity_of_period
from mr_damper_ros.kinematics.periodic_motion import MotionKind, PeriodicMotion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS, current_dependence
from mr_damper_ros.models.current_dependence import COIL, CurrentDependentModel
from mr_damper_ros.models.misfit import Misfit
from mr_damper_ros.models.quantities import Coefficient, LoopReading, State
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.operating_point import thinned_to_keep

FOLLOWING = [name for name, model in MODELS.items() if isinstance(model, CurrentDependentModel)]

CURRENTS = (0.0, 0.5, 1.0, 1.5)

AT_THE_NOISE = 1.1
"""Cost, 1 = noise, which eight windows of 500 samples determine to 2 % and their weights to 3 %."""

STANDARD_ERRORS = 5.0
"""Largest error of an estimate in standard errors; never exceeded by chance in some fifty."""

LAG = 0.02
"""A time constant [s] of the coil that is observable."""


class SawTooth(CurrentDependentModel):
    """An invented law, such as a user might add: one class, and one line in the registry."""

    name = "saw_tooth"
    title = "saw tooth"
    source = "this test"
    equation = r"F = c v + f_y \frac{v}{|v| + w}"
    at_one_current = (
        Coefficient("c", "N s/m", 0.0, degree=1),
        Coefficient("f_y", "N", 0.0, degree=2),
        Coefficient("w", "m/s", 1e-6),
    )

    def force_at(
        self, coefficients: Sequence[Array], motion: Motion, period: float, state: State | None
    ) -> tuple[Array, State]:
        c, f_y, w = coefficients
        return c * motion.velocity + f_y * motion.velocity / (np.abs(motion.velocity) + w), ()

    def starts_at_one_current(self, reading: LoopReading) -> Array:
        return np.array([[0.2 * reading.force / reading.speed, reading.force, 0.1 * reading.speed]])


def truth(name: str) -> Array:
    """Parameters of a damper whose coefficients use the full polynomial of the current."""
    model = MODELS[name]
    values = known.EXAMPLES[name].copy() if name in known.EXAMPLES else np.zeros(7)
    growth = {"1/A": 0.8, "1/A²": -0.1, "1/A³": -0.02}
    for place, parameter in enumerate(model.parameters):
        if parameter.name in model.shape_names and parameter.name != COIL:
            base = abs(values[model.parameter_names.index(parameter.name.rsplit("_", 1)[0])])
            values[place] = growth.get(parameter.unit, 0.3 * base)
    return values


def moved(
    name: str, values: Array, current: Array | float, *, amplitude: float = 5e-3, seed: int = 0
) -> Window:
    """Two seconds at 2 Hz and 250 Hz, with noise, after a lead-in of one second."""
    period = 4e-3
    time = np.arange(750) * period
    amperes = np.broadcast_to(np.asarray(current, float), time.shape)
    whole = Window.from_samples(amplitude * np.sin(4.0 * np.pi * time + 0.3), time, amperes, period)
    force = MODELS[name].force(values, whole.motion, amperes, period)
    # Standard deviation of the force noise [N].
    force = force + np.random.default_rng(seed).normal(0.0, 5.0, time.size)
    late = slice(250, None)
    return Window.from_samples(whole.motion.displacement[late], force[late], amperes[late], period)


@cache
def identified(name: str) -> GlobalFit:
    model = MODELS[name]
    runs = [(current, amplitude) for current in CURRENTS for amplitude in (3e-3, 8e-3)]
    windows = [
        moved(name, truth(name), current, amplitude=amplitude, seed=seed)
        for seed, (current, amplitude) in enumerate(runs)
    ]
    return identify_global(model, windows, model.initial_values()[0], EvolutionSettings())


def test_derivatives_by_no_parameter_leave_the_memory_of_the_process_intact():
    alone("""
import numpy as np
from mr_damper_ros.models.first_order_lag import solve_recursion
for _ in range(2000):
    assert solve_recursion(np.ones((1, 1, 300)), np.empty((300, 0))).shape == (300, 0)
""")


@pytest.mark.parametrize("name", ["bouc_wen", "modified_bouc_wen", "series_springs"])
def test_derivatives_do_not_depend_on_their_division(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = np.where(np.array(MODELS[name].parameter_names) == COIL, LAG, truth(name))
    window = moved(name, truth(name), np.repeat([0.2, 1.0, 0.5], 250))
    misfit = Misfit(MODELS[name], [window], [1.0])
    at_once = misfit.jacobian(values)
    monkeypatch.setattr(current_dependence, "ROWS_AT_ONCE", 77)
    np.testing.assert_allclose(misfit.jacobian(values), at_once, rtol=1e-9)


@pytest.mark.parametrize("name", FOLLOWING)
def test_one_set_for_all_currents_is_identified(name: str) -> None:
    assert identified(name).cost < AT_THE_NOISE
    found = identified(name).parameter_set
    seen = found.observable
    missed = np.abs(found.values - truth(name))[seen]
    allowed = STANDARD_ERRORS * found.standard_errors[seen]
    if MODELS[name].remembers:
        # Relative: the internal time steps differ from those of the record (4 ms against 3 ms).
        allowed += 0.05 * np.abs(truth(name)[seen])
    assert np.all(missed < allowed)
    determined = dict(zip(MODELS[name].parameter_names, seen, strict=True))
    assert all(determined[n] for n in MODELS[name].shape_names if n != COIL)
    assert not determined[COIL]


@pytest.mark.parametrize("name", ["hyperbolic_tangent", "bouc_wen"])
def test_the_lag_of_the_coil_is_found_where_the_current_switches(name: str) -> None:
    model = MODELS[name]
    values = truth(name)
    place = model.parameter_names.index(COIL)
    values[place] = LAG
    switched = np.where(np.arange(750) // 50 % 2, 1.2, 0.2)
    windows = [
        moved(name, values, switched, amplitude=amplitude, seed=seed)
        for seed, amplitude in enumerate((3e-3, 8e-3))
    ]
    windows += [moved(name, values, current, seed=9) for current in CURRENTS]
    start = truth(name)
    found = identify_global(model, windows, start, EvolutionSettings()).parameter_set
    assert found.observable[place]
    # Relative: the noise in two seconds of a switching current.
    assert found.values[place] == pytest.approx(LAG, rel=0.05)


def test_a_law_of_a_users_own_is_identified_over_currents(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(MODELS, SawTooth.name, SawTooth())
    values = np.array([1500.0, 300.0, 5e-3, 0.5, 1.5, -0.3, 0.0])
    windows = [
        moved(SawTooth.name, values, current, seed=seed) for seed, current in enumerate(CURRENTS)
    ]
    model = MODELS[SawTooth.name]
    fit = identify_global(model, windows, model.initial_values()[0], EvolutionSettings())
    assert fit.cost < AT_THE_NOISE
    seen = fit.parameter_set.observable
    assert list(seen) == [True] * 6 + [False]
    missed = np.abs(fit.parameter_set.values - values)[seen]
    assert np.all(missed < STANDARD_ERRORS * fit.parameter_set.standard_errors[seen])


@pytest.mark.parametrize("name", FOLLOWING)
def test_a_window_kept_without_its_past_has_a_force_whatever_the_coil(name: str) -> None:
    model, values = MODELS[name], truth(name)
    values[-1] = LAG
    current = 1.0 + 1e-3 * np.sin(np.arange(750))
    here = moved(name, truth(name), current)
    kept = thinned_to_keep(here, with_past=model.remembers)
    assert np.all(np.isfinite(model.window_force(kept, values)))
    assert model.settled(kept, values).any()


# -- the mass between load cell and damper is estimated, and its inertia subtracted ----------------

MASS, NOISE, PERIOD = 2.0, 0.03, 0.01
"""Mass [kg], noise relative to the standard deviation of the force, sampling period [s]."""

WEAK = known.PLAUSIBLE.copy()
WEAK[known.index("f0")] *= 0.2
"""A damper whose force is weak enough for the inertia to be seen."""


RIGID = np.array([959.0, 0.0, 4.23e5, 2100.0, -109.0, 39.8, 7.13e-4, 0.428, 1.995])
RIGID = np.append(RIGID, [-0.0388, 14.2, 21.43, -8.03, -0.00666, 0.00709])
"""A modified Bouc-Wen damper without inner spring; its damper in series is nearly rigid."""


@cache
def shaken(law: str = "sigmoid", top: float = 0.01, duration: int = 30) -> dict[str, Any]:
    """Random motion up to 12 Hz with a stepped current, measured at 100 Hz."""
    fine = PERIOD / 10
    time = np.arange(1000 * duration) * fine
    u, v, a = PeriodicMotion(MotionKind.RANDOM, top, 0.5, 12.0, duration, 1).at(time)
    motion = Motion(u, v, a, peak_velocity_of_period(v, a, fine), sine=None)
    rng = np.random.default_rng(0)
    current = np.repeat(rng.uniform(0.0, 1.5, duration // 2), 2000)
    damper = MODELS[law].continuous.force(
        WEAK if law == "sigmoid" else RIGID, motion, current, fine
    )
    force = (damper + MASS * a)[::10]
    force += NOISE * force.std() * rng.standard_normal(force.size)
    measured = {"displacement": u[::10], "force": force, "current": current[::10]}
    return {**measured, "period": PERIOD}


def test_the_mass_is_found_with_the_law() -> None:
    found = mr.identify(**shaken(), fit_mass=True)
    assert found.mass.value == pytest.approx(MASS, rel=0.1)
    assert abs(found.mass.value - MASS) < 3.0 * found.mass.standard_error
    assert "kg between load cell and damper" in str(found)


def test_undetermined_springs_do_not_make_up_for_the_mass() -> None:
    run = shaken("modified_bouc_wen", 0.02, 60)
    fitted = RIGID.copy()
    fitted[[1, 2, 3, 10]] = 4000.0, 1e7, -2000.0, 0.0  # the springs are known as a sum only
    observable = np.arange(fitted.size) != 10
    known_set = mr.ParameterSet(fitted, model="modified_bouc_wen", observable=observable)
    fit = SimpleNamespace(parameter_set=known_set, noise=np.array([NOISE * np.std(run["force"])]))
    found = _fitted_mass(cast(GlobalFit, fit), [Window.from_samples(**run)])
    assert found.value == pytest.approx(MASS, rel=0.1)


def test_a_variance_that_is_negative_by_rounding_is_unknown(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    name = "mr_damper_ros.api.identification.least_squares_covariance"
    monkeypatch.setattr(name, lambda jacobian, *_: -np.eye(jacobian.shape[1]))
    found = mr.identify(**shaken(), model="bingham", fit_mass=True)
    assert math.isnan(found.mass.standard_error)
    assert found.mass.value == 0.0
    assert Kind.UNDETERMINED_MASS in [finding.kind for finding in found.findings]


def test_a_known_mass_is_taken_off_the_force() -> None:
    truth = mr.ParameterSet(WEAK)
    with_it, without = (mr.validate(truth, **shaken(), mass=mass).nrmse for mass in (MASS, 0.0))
    assert with_it < without


@pytest.mark.parametrize("mass", [-1.0, math.nan, math.inf])
def test_a_mass_that_cannot_be_is_refused(mass: float) -> None:
    with pytest.raises(ValueError, match="number of kilograms"):
        mr.identify(**shaken(), mass=mass)
