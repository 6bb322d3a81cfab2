"""Gain and offset per record: estimated with known truth, and reported."""

import json
from functools import cache

import known
import numpy as np
import pytest

import mr_damper_ros as mr
from benchmarks.dampers import DAMPERS
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import GlobalFit, identify_global
from mr_damper_ros.estimation.record_levels import LevelledProblem, LevelPrior, counted_samples
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.misfit import Misfit
from mr_damper_ros.models.parameter_set import start_set
from mr_damper_ros.signals.recording import Recording

LAW = MODELS["hyperbolic_tangent"]
TRUTH = known.EXAMPLES[LAW.name]

SCALES = (0.93, 1.08, 0.97, 1.02)
"""Gains of the four records; their mean is 1."""

ZEROS = (400.0, -300.0, 150.0, -250.0)
"""[N], with mean 0; the force reaches some 800 N."""

AMPLITUDES = (3e-3, 5e-3, 7e-3, 9e-3)

HONEST = 3.0
"""Largest error of the yield force, a gain or an offset in standard errors."""


def record(place: int, scale: float, zero: float) -> Recording:
    run = known.run(amplitude=AMPLITUDES[place], seed=place, samples=1000, frequency=2.0)
    motion = run.window.motion
    force = LAW.force(TRUTH, motion, 1.0, run.period)
    noise = np.random.default_rng(place).normal(0.0, 5.0, force.size)
    return Recording(
        name=f"record {place}",
        start_ns=known.T0,
        period=run.period,
        displacement=run.displacement,
        force=scale * force + zero + noise,
        current=np.ones(force.size),
    )


def records() -> list[Recording]:
    return [record(place, *level) for place, level in enumerate(zip(SCALES, ZEROS, strict=True))]


@cache
def identified(spread: float) -> mr.Identification:
    return mr.identify(records(), model=LAW.name, level_per_record=spread)


def levels() -> list[tuple[float, float, float, float]]:
    found = [run.level for run in identified(0.1).runs]
    return [level[:4] for level in found if level is not None]


def test_the_levels_of_the_records_are_found() -> None:
    scales, _, zeros, _ = np.array(levels()).T
    # An effect common to all records goes into the law. 1000 samples with 5 N of noise determine a
    # gain relative to the mean to 0.0005.
    np.testing.assert_allclose(scales / scales.mean(), SCALES, atol=0.005)
    offset = identified(0.1).parameters["f0"].value - TRUTH[LAW.parameter_names.index("f0")]
    # Error [N] of an offset relative to the mean; the noise leaves 0.2 N.
    np.testing.assert_allclose(zeros + scales * offset, ZEROS, atol=10.0 * 2.0)


def test_levels_are_told_line_by_line_and_in_json() -> None:
    result = identified(0.1)
    # A gain and an offset in the row of every record.
    assert str(result).count(" ± ") == 2 * len(SCALES)
    entries = json.loads(json.dumps(result.document()))["bags"]
    assert [entry["level"]["scale"] for entry in entries] == [
        run.level.scale for run in result.runs if run.level is not None
    ]
    assert result.success


def windows() -> list[Window]:
    return [Window.from_samples(r.displacement, r.force, r.current, r.period) for r in records()]


def problem(law: str, spread: float = 0.1) -> LevelledProblem:
    pooled = Misfit(MODELS[law], windows(), [20.0, 30.0, 15.0, 25.0])
    return LevelledProblem(pooled, LevelPrior((0, 0, 1, 2), spread))


@pytest.mark.parametrize("law", ["hyperbolic_tangent", "sigmoid", "sigmoid_lag"])
def test_the_gradient_is_that_of_differences(law: str) -> None:
    misfit = problem(law)
    values = 1.05 * known.EXAMPLES[law]
    places = MODELS[law].places(MODELS[law].scale_names)
    gradient = 2.0 * misfit.jacobian(values, places).T @ misfit.residual(values)
    expected = np.empty(places.size)
    for number, place in enumerate(places.tolist()):
        step = 1e-5 * max(abs(float(values[place])), 1e-3) * np.eye(values.size)[place]
        above, below = (misfit.mean_square(values + s * step) for s in (0.5, -0.5))
        expected[number] = misfit.sample_count * (above - below) / step[place]
    # Relative, of derivatives by differences.
    np.testing.assert_allclose(gradient, expected, rtol=1e-3, atol=1e-6 * gradient.max())


OTHER_CURRENTS = (0.2, 0.6, 1.0, 0.6)

OTHER_SCALES = (0.95, 1.05, 1.02, 0.98)

OTHER_ZEROS = (40.0, -30.0, 15.0, -25.0)
"""Offsets [N] for forces that reach 300 to 1500 N."""


def records_of_another_law(damper: str, zeros: tuple[float, ...]) -> list[Window]:
    law, values = DAMPERS[damper].law, DAMPERS[damper].values
    found = []
    for place, (amplitude, current) in enumerate(zip(AMPLITUDES, OTHER_CURRENTS, strict=True)):
        run = known.run(
            amplitude=amplitude, seed=place, samples=1000, frequency=(1.0, 3.0)[place % 2]
        )
        plain = Window.from_samples(run.displacement, np.zeros(1000), current, run.period)
        noise = np.random.default_rng(place).normal(0.0, 5.0, 1000)
        force = OTHER_SCALES[place] * law.window_force(plain, values) + zeros[place] + noise
        found.append(Window.from_samples(run.displacement, force, current, run.period))
    return found


@cache
def sixteen_of(damper: str, zeros: tuple[float, ...], levels: bool) -> GlobalFit:
    prior = LevelPrior((0, 1, 2, 3)) if levels else None
    windows = records_of_another_law(damper, zeros)
    start = start_set("sigmoid").values
    return identify_global(MODELS["sigmoid"], windows, start, EvolutionSettings(), levels=prior)


NO_ZEROS = (0.0, 0.0, 0.0, 0.0)


def test_levels_of_a_damper_of_another_law_are_found_and_make_nothing_up() -> None:
    damper = "modified_bouc_wen"
    with_levels, without = (sixteen_of(damper, NO_ZEROS, levels) for levels in (True, False))
    # Error in the worst record relative to that without gains and offsets: 0.5 to 1.3; it would be
    # 4 to 11 if each sample counted as independent.
    assert with_levels.nrmse.max() < 2.0 * without.nrmse.max()
    fit = sixteen_of(damper, OTHER_ZEROS, True)
    found = fit.record_levels(records_of_another_law(damper, OTHER_ZEROS))
    off = [
        ((level.scale - scale) / level.scale_error, (level.zero - zero) / level.zero_error)
        for level, scale, zero in zip(found, OTHER_SCALES, OTHER_ZEROS, strict=True)
    ]
    assert np.abs(off).max() < HONEST


@pytest.mark.parametrize("alpha", [1e200, np.inf])
def test_a_set_far_from_any_damper_tells_nothing_of_levels(alpha: float) -> None:
    beyond = TRUTH.copy()
    beyond[LAW.parameter_names.index("alpha")] = alpha
    pooled = Misfit(LAW, windows(), [5.0] * 4)
    with np.errstate(over="ignore", invalid="ignore"):
        assert problem(LAW.name).mean_square(beyond) == np.inf
        assert 0.0 < counted_samples(pooled, LevelPrior((0, 0, 1, 2)), beyond) < 1e-3


def test_the_square_of_a_large_force_overflows_without_a_warning() -> None:
    large = TRUTH.copy()
    large[0] *= 1e200
    with np.errstate(over="raise"):
        assert np.isfinite(problem(LAW.name).residual(large)).all()


def test_a_spread_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match=r"level_per_record .* is -0.1: give the expected"):
        mr.identify(records(), model=LAW.name, level_per_record=-0.1)
