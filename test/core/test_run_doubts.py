"""Currents that the heights of the loops contradict are said, and nothing else is."""

from __future__ import annotations

import known
import numpy as np
import pytest

from mr_damper_ros.api.measured_runs import measured_runs, remarks_on
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import Recording

SAMPLES = 4000


def recording(name: str, current: float, force: Array | None = None, **options: float) -> Recording:
    run = known.run(current=current, frequency=2.0, samples=SAMPLES, **options)
    force = run.force if force is None else force
    return Recording(name, 0, run.period, run.displacement, force, np.full(SAMPLES, current))


def remarks(*runs: Recording) -> list[str]:
    return list(remarks_on(measured_runs(runs)))


def test_runs_of_one_damper_at_the_currents_they_were_made_at_are_in_order() -> None:
    assert remarks(*(recording(f"{i} A", i) for i in (0.0, 0.5, 1.0, 1.5))) == []


def test_a_run_that_holds_two_currents_is_said_to() -> None:
    low, high = (known.run(current=i, frequency=2.0, samples=SAMPLES).force for i in (0.0, 1.5))
    force = np.where(np.arange(SAMPLES) < SAMPLES // 2, low, high)
    (remark,) = remarks(recording("both", 1.0, force))
    assert remark.startswith("both: at 1 A and the same speed the force reaches")


@pytest.mark.parametrize(("first", "second"), [(1.5, 0.0), (0.5, 0.5)], ids=["mixed up", "equal"])
def test_two_runs_that_contradict_each_other_are_named(first: float, second: float) -> None:
    weak, strong = (known.run(current=i, frequency=2.0, samples=SAMPLES).force for i in (0.0, 1.5))
    (remark,) = remarks(recording("a", first, weak), recording("b", second, strong))
    assert remark.startswith("a and b: the force reaches")
