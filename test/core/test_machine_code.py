"""Loops as machine code: the same law, only where samples are many, and not without Numba."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from fresh_python import alone

from mr_damper_ros.models import bouc_wen, machine_code, series_springs
from mr_damper_ros.models.machine_code import as_machine_code, run_loop

COUNT = 400
ALIKE = 1e-12
"""Of the largest value: the same steps, but the last digit of a hyperbolic tangent is another."""

PERIOD = 2e-3
RNG = np.random.default_rng(3)
VELOCITY = np.cumsum(RNG.normal(0.0, 0.01, COUNT))
SPRING = np.array([[600.0, 4e-3, 2500.0, 1e7]])
CHANGING = SPRING * RNG.uniform(0.5, 2.0, (COUNT, 1))
INNER = np.array([800.0, 60000.0, 900.0, 4e-4, 3e-4]) * RNG.uniform(0.5, 2.0, (COUNT, 1))
START = math.nan, math.nan, math.nan
FLOW = (series_springs.flow_of,)
LOOPS = [
    (series_springs.follow_path, FLOW, (VELOCITY, SPRING), 3, (PERIOD, *START)),
    (series_springs.follow_path, FLOW, (VELOCITY, CHANGING), 3, (PERIOD, *START)),
    (
        bouc_wen.follow_yield,
        (bouc_wen.hysteresis_step,),
        (VELOCITY, RNG.uniform(2e-4, 1e-3, COUNT)),
        1,
        (PERIOD, 0.4, 1.5, *START[:2]),
    ),
    (
        bouc_wen.follow_inner_point,
        (bouc_wen.hysteresis_step,),
        (VELOCITY, INNER),
        1,
        (PERIOD, 500.0, 0.4, 1.5, *START),
    ),
]


@pytest.fixture
def without_numba(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    machine_code.machine_code.cache_clear()
    monkeypatch.setitem(sys.modules, "numba", None)
    yield
    machine_code.machine_code.cache_clear()


def running_sum(values: Sequence[float], sums: Any, start: float) -> float:
    for k in range(len(values)):
        start += values[k]
        sums[k] = start
    return start


@pytest.mark.parametrize(("loop", "called", "given", "results", "numbers"), LOOPS)
def test_machine_code_gives_what_the_loop_gives(
    loop: Callable[..., Any], called: Any, given: Any, results: int, numbers: Any
) -> None:
    pytest.importorskip("numba")
    with as_machine_code():
        filled, last = run_loop(loop, called, given, results, *numbers)
    plain = [[0.0] * COUNT for _ in range(results)]
    plain_last = loop(*(values.tolist() for values in given), *plain, *numbers)
    for values, expected in zip([*filled, last], [*plain, plain_last], strict=True):
        size = np.max(np.abs(expected))
        np.testing.assert_allclose(values, expected, rtol=0.0, atol=ALIKE * size)


@pytest.mark.usefixtures("without_numba")
def test_without_numba_the_loop_runs_as_it_is() -> None:
    with as_machine_code():
        (sums,), last = run_loop(running_sum, (), (VELOCITY,), 1, 1.0)
    np.testing.assert_allclose(sums, 1.0 + np.cumsum(VELOCITY), rtol=ALIKE)
    assert last == sums[-1]


def test_a_stream_does_not_wait_for_a_compiler() -> None:
    code = """
import numpy as np
from mr_damper_ros.models import MODELS
from mr_damper_ros.kinematics.motion import Motion
for name in ("series_springs", "bouc_wen", "modified_bouc_wen"):
    model = MODELS[name]
    motion = Motion(*(np.linspace(0.0, 0.1, 3000) for _ in range(4)), sine=None)
    model.force(model.initial_values()[0], motion, 1.0, 1e-3)
print("numba" in sys.modules)
"""
    assert alone(code).strip() == "False"
