"""The thesis' conditions, the runs made from them, and the bags of the package."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_contents import messages

from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.io.bag_writer import write_bag
from mr_damper_ros.models.published import (
    CONDITIONS,
    PUBLISHED_METHODS,
    Condition,
    ConditionError,
    find,
    parameters,
)
from mr_damper_ros.models.sigmoid.law import sine_force
from studies.thesis import bags as thesis_bags
from studies.thesis.facts import ERRATA, ROW_ERRATA, is_clean
from studies.thesis.runs import PHASE, synthesise


def test_a_run_is_the_published_force_with_the_published_noise() -> None:
    condition = find("5.0mm_1Hz_0.5A")
    run = synthesise(condition)
    assert run.sample_count == 7001
    assert run.period == 1e-3
    motion = SineMotion(0.005, 1.0, phase=PHASE).at(run.time)
    residual = run.force - sine_force(parameters(condition), *motion, 0.5)
    # The standard error of a standard deviation from 7001 values is 0.85 %.
    assert np.std(residual) == pytest.approx(5.53, rel=0.03)
    assert np.mean(residual) == pytest.approx(0.0, abs=0.25)
    assert np.std(run.displacement - motion.displacement) == pytest.approx(1e-6, rel=0.03)
    assert set(run.current) == {0.5}


def test_a_run_can_be_made_again_and_every_condition_has_noise_of_its_own() -> None:
    one, same, other_seed = (synthesise(CONDITIONS[0], seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.force, same.force)
    assert not np.array_equal(one.force, other_seed.force)
    noises = []
    for condition in CONDITIONS[:2]:
        run = synthesise(condition)
        motion = SineMotion(condition.amplitude, condition.frequency, phase=PHASE).at(run.time)
        noises.append(run.force - sine_force(parameters(condition), *motion, condition.current))
    assert abs(np.corrcoef(noises)[0, 1]) < 0.1


# -- the thesis' table of parameter sets: conditions, and the rows that must not be used -----------


def difference(condition: Condition) -> float:
    """Relative norm of the difference between the loops of the two methods."""
    time = np.arange(1000) / 1000.0 / condition.frequency
    motion = SineMotion(condition.amplitude, condition.frequency, phase=1.0).at(time)
    sets = (parameters(condition, method) for method in PUBLISHED_METHODS)
    one, two = (sine_force(each, *motion, condition.current) for each in sets)
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


@pytest.mark.parametrize(
    "call", [lambda: find("2.5mm_2Hz_0.0A"), lambda: parameters(Condition(0.0, 0.0025, 2.0))]
)
def test_unknown_conditions_are_refused(call: Any) -> None:
    with pytest.raises(ConditionError, match=r"2.5mm_2Hz_0.0A"):
        call()


# -- the program that makes the thesis' runs, and the bags of the package --------------------------

COMMITTED = Path(__file__).resolve().parents[2] / "bags"
NAMES = ["5.0mm_1Hz_0.0A", "5.0mm_1Hz_0.5A", "5.0mm_1Hz_1.5A", "7.5mm_1Hz_1.0A"]

ROUNDING_FORCE, ROUNDING_DISPLACEMENT = 1e-9, 1e-15
"""[N] and [m]: processors differ in the last digit of a sine or a hyperbolic tangent."""


@pytest.mark.parametrize("name", NAMES)
def test_a_committed_bag_is_what_the_program_makes(name: str, tmp_path: Path) -> None:
    fresh = synthesise(find(name))
    write_bag(tmp_path / name, fresh)
    (committed,) = read_bag(COMMITTED / name)
    assert committed.name == fresh.name
    assert committed.start_ns == fresh.start_ns
    assert committed.period == fresh.period
    assert committed.details == fresh.details
    np.testing.assert_array_equal(committed.current, fresh.current)
    np.testing.assert_allclose(committed.force, fresh.force, rtol=0.0, atol=ROUNDING_FORCE)
    np.testing.assert_allclose(
        committed.displacement, fresh.displacement, rtol=0.0, atol=ROUNDING_DISPLACEMENT
    )
    a, b = (
        [(m.topic, m.message_type, m.time_ns, len(m.data)) for m in messages(folder)]
        for folder in (COMMITTED / name, tmp_path / name)
    )
    assert a == b


def test_an_erratum_is_marked_in_name_and_metadata(tmp_path: Path) -> None:
    assert thesis_bags.main([str(tmp_path), "--conditions", "7.5mm_3Hz_1.5A", "--errata"]) == 0
    (folder,) = (entry for entry in tmp_path.iterdir() if entry.is_dir())
    assert folder.name == "7.5mm_3Hz_1.5A_erratum"
    (marked,) = read_bag(folder)
    assert "k4 is +0.1405" in marked.details["erratum"]
