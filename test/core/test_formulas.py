"""Formulas compiled for scalars, for arrays, in stages and to machine code; derivatives."""

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fresh_python import alone

from mr_damper_ros.models import bouc_wen, machine_code, series_springs
from mr_damper_ros.models.formulas import Formulas, gradient, staged
from mr_damper_ros.models.machine_code import as_machine_code, run_loop

FORMULAS: Formulas = (
    ("grown", "exp(clip(-a * x, -2.0, 2.0))"),
    ("bent", "tanh(grown + b / y)"),
    ("result", "sat(3.0 * bent * where(x < 0.0, a, b) + number(y / x))"),
)

STAGES = [("a", "b"), ("x",), ("y",)]


def by_hand(a: float, b: float, x: float, y: float) -> float:
    grown = math.exp(min(max(-a * x, -2.0), 2.0))
    return 3.0 * math.tanh(grown + b / y) * (a if x < 0.0 else b) + y / x


POINTS = [(0.3, 0.7, 1.5, 0.4), (0.3, 0.7, -1.5, 0.4), (5.0, -2.0, 1.0, -3.0)]


def test_scalars_and_arrays_give_what_is_written() -> None:
    expected = [by_hand(*point) for point in POINTS]
    law = staged(FORMULAS, STAGES, ["result"], scalars=len(STAGES))
    assert [law(a, b)(x)(y) for a, b, x, y in POINTS] == pytest.approx(expected, rel=1e-14)
    law = staged(FORMULAS, [("a", "b", "x", "y")], ["result", "grown"])
    result, _ = law(*np.array(POINTS).T)
    np.testing.assert_allclose(result, expected, rtol=1e-14)


def test_a_formula_may_be_given() -> None:
    law = staged(FORMULAS, [("bent", "a", "b", "x", "y")], ["result"], scalars=1)
    assert law(0.5, 2.0, 1.0, -1.0, 3.0) == 0.0


@pytest.mark.parametrize(
    ("numerator", "expected"), [(2.0, 1e100), (-2.0, -1e100), (0.0, 0.0), (math.nan, 0.0)]
)
def test_scalars_overflow_as_arrays_do(numerator: float, expected: float) -> None:
    formulas = (("result", "sat(number(y / x))"),)
    scalar, array = (staged(formulas, [("x", "y")], ["result"], scalars=s) for s in (1, 0))
    with np.errstate(all="ignore"):
        assert array(np.zeros(1), np.full(1, numerator))[0] == scalar(0.0, numerator) == expected


@pytest.mark.parametrize("point", POINTS[:2])
@pytest.mark.parametrize("place", range(4))
def test_derivatives_are_those_of_differences(point: tuple[float, ...], place: int) -> None:
    names = ("a", "b", "x", "y")
    lines = gradient(FORMULAS, "result", names)
    law = staged(lines, [names], [f"result_by_{names[place]}"], scalars=1)
    step = 1e-6 * np.eye(4)[place]
    above, below = by_hand(*(point + step)), by_hand(*(point - step))
    assert law(*point) == pytest.approx((above - below) / 2e-6, rel=1e-7)


def test_what_is_given_does_not_move() -> None:
    lines = gradient(FORMULAS, "result", ["a"], given=["bent"])
    law = staged(lines, [("bent", "a", "b", "x", "y")], ["result_by_a"], scalars=1)
    assert law(0.5, 2.0, 1.0, -1.0, 3.0) == 1.5


@pytest.mark.parametrize("text", ["1.0 + exp(x)", "larger(x, 1.0)", "abs(x)"])
def test_what_has_no_derivative_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="in the formula of result has no derivative by x"):
        gradient((("result", text),), "result", ["x"])


# -- loops as machine code: the same law, used only for many samples and with Numba ----------------

COUNT = 400
ALIKE = 1e-12
"""Of the largest value: the hyperbolic tangents differ in the last digit."""

PERIOD = 2e-3
RNG = np.random.default_rng(3)
VELOCITY = np.cumsum(RNG.normal(0.0, 0.01, COUNT))
SPRING = np.array([[600.0, 4e-3, 2500.0, 1e7]])
CHANGING = SPRING * RNG.uniform(0.5, 2.0, (COUNT, 1))
INNER = np.array([800.0, 60000.0, 900.0, 3e-4]) * RNG.uniform(0.5, 2.0, (COUNT, 1))
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
        3,
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


def test_a_damaged_cache_of_machine_code_is_repaired(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = pytest.importorskip("numba").config
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))

    def sizes(last: float) -> dict[Path, int]:
        machine_code.machine_code.cache_clear()
        with as_machine_code():
            assert run_loop(running_sum, (), (np.ones(3),), 1, last)[1] == last + 3.0
        return {path: path.stat().st_size for path in tmp_path.rglob("*.nb?")}

    whole = sizes(0.0)
    for path in whole:
        path.write_bytes(path.read_bytes()[:-100])
        assert sizes(1.0) == whole


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
