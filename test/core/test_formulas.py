"""Formulas compiled for scalars and for arrays, in stages, and their derivatives."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mr_damper_ros.models.formulas import Formulas, gradient, staged

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


@pytest.mark.parametrize("point", POINTS)
def test_scalars_give_what_is_written(point: tuple[float, ...]) -> None:
    a, b, x, y = point
    law = staged(FORMULAS, STAGES, ["result"], scalars=len(STAGES))
    assert law(a, b)(x)(y) == pytest.approx(by_hand(*point), rel=1e-14)


def test_arrays_give_what_scalars_give() -> None:
    columns = np.array(POINTS).T
    law = staged(FORMULAS, [("a", "b", "x", "y")], ["result", "grown"])
    result, _ = law(*columns)
    np.testing.assert_allclose(result, [by_hand(*point) for point in POINTS], rtol=1e-14)


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
