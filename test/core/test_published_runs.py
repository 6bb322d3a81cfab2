"""The thesis' conditions, and that runs are made from the right rows and say what they are."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES, force
from mr_damper_ros.rig.excitation import SineMotion
from mr_damper_ros.thesis.published_runs import (
    CONDITIONS,
    ERRATA,
    PHASE,
    PUBLISHED_METHODS,
    ROW_ERRATA,
    Condition,
    ConditionError,
    find,
    is_clean,
    parameters,
    recording_name,
    synthesise,
)


def steady_force(condition: Condition, method: str) -> np.ndarray:
    time = np.arange(1000) / 1000.0 / condition.frequency
    motion = SineMotion(condition.amplitude, condition.frequency, phase=PHASE).at(time)
    return force(parameters(condition, method), *motion, condition.current)


def difference(condition: Condition) -> float:
    """Relative norm of the difference between the loops of the two methods."""
    one, two = (steady_force(condition, method) for method in PUBLISHED_METHODS)
    return float(np.linalg.norm(one - two) / np.linalg.norm(one))


def test_there_are_34_conditions_of_which_30_are_clean() -> None:
    assert len(CONDITIONS) == 34
    assert sum(map(is_clean, CONDITIONS)) == 30
    assert {condition.name for condition in ERRATA} == {
        "5.0mm_1Hz_1.0A",
        "5.0mm_3Hz_1.0A",
        "5.0mm_5Hz_1.0A",
        "7.5mm_3Hz_1.5A",
    }


def test_the_two_methods_agree_where_neither_row_is_an_erratum() -> None:
    marked = {condition for condition, _ in ROW_ERRATA}
    differences = [difference(condition) for condition in CONDITIONS if condition not in marked]
    assert len(differences) == 27
    assert max(differences) <= 0.075
    assert np.median(differences) == pytest.approx(0.012, abs=0.002)


def test_the_copied_tables_are_copies() -> None:
    for frequency in (1, 3, 5):
        for method in PUBLISHED_METHODS:
            np.testing.assert_array_equal(
                parameters(find(f"5.0mm_{frequency}Hz_1.0A"), method),
                parameters(find(f"5.0mm_{frequency}Hz_0.0A"), method),
            )


def test_the_loop_of_the_lost_sign_runs_the_wrong_way_round() -> None:
    k4 = PARAMETER_NAMES.index("k4")
    positive = {
        condition.name
        for condition in CONDITIONS
        if parameters(condition, PUBLISHED_METHODS[0])[k4] > 0.0
    }
    assert positive == {"7.5mm_3Hz_1.5A"}


@pytest.mark.parametrize("name", ["2.5mm_5Hz_0.0A", "7.5mm_5Hz_1.0A", "7.5mm_1Hz_1.5A"])
def test_rows_marked_as_errata_contradict_the_other_method(name: str) -> None:
    assert (find(name), "differential_evolution") in ROW_ERRATA
    assert is_clean(find(name))
    assert difference(find(name)) > 0.075


def test_a_run_is_the_published_force_with_the_published_noise() -> None:
    condition = find("5.0mm_1Hz_0.5A")
    run = synthesise(condition)
    assert run.sample_count == 7001
    assert run.period == 1e-3
    motion = SineMotion(0.005, 1.0, phase=PHASE).at(run.time)
    residual = run.force - force(parameters(condition), *motion, 0.5)
    # The standard error of a standard deviation from 7001 values is 0.85 %.
    assert np.std(residual) == pytest.approx(5.53, rel=0.03)
    assert np.mean(residual) == pytest.approx(0.0, abs=0.25)
    assert np.std(run.displacement - motion.displacement) == pytest.approx(1e-6, rel=0.03)
    assert set(run.current) == {0.5}


@pytest.mark.parametrize("condition", CONDITIONS, ids=lambda condition: condition.name)
def test_every_run_is_plausible_and_says_what_it_is(condition: Condition) -> None:
    run = synthesise(condition)
    run.check_plausible()
    assert run.name == recording_name(condition)
    assert "not the original recordings" in run.details["provenance"]
    assert run.details["condition"] == condition.name
    assert ("erratum" in run.details) == (not is_clean(condition))
    assert run.name.endswith("_erratum") == (not is_clean(condition))


def test_a_run_can_be_made_again_and_every_condition_has_noise_of_its_own() -> None:
    one, same, other_seed = (synthesise(CONDITIONS[0], seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.force, same.force)
    assert not np.array_equal(one.force, other_seed.force)
    noises = []
    for condition in CONDITIONS[:2]:
        run = synthesise(condition)
        motion = SineMotion(condition.amplitude, condition.frequency, phase=PHASE).at(run.time)
        noises.append(run.force - force(parameters(condition), *motion, condition.current))
    assert abs(np.corrcoef(noises)[0, 1]) < 0.1


@pytest.mark.parametrize(
    "call",
    [lambda: find("2.5mm_2Hz_0.0A"), lambda: parameters(Condition(0.0, 0.0025, 2.0))],
)
def test_unknown_conditions_are_refused(call: Any) -> None:
    with pytest.raises(ConditionError, match=r"2.5mm_2Hz_0.0A"):
        call()
