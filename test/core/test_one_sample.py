"""The sigmoid laws sample by sample, in scalars, against the arrays."""

from __future__ import annotations

import known
import numpy as np
import pytest

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models import MODELS
from mr_damper_ros.signals.arrays import Array

PERIOD = 1e-3

ROUNDING = 1e-9


def motion(size: float = 1.0) -> Motion:
    """A motion that turns often, within its peak velocity or far beyond all measure."""
    time = np.arange(300) * PERIOD
    rate = 2.0 * np.pi * 7.0
    u, v, a = (
        size * factor * wave(rate * time)
        for factor, wave in ((2e-3, np.sin), (2e-3 * rate, np.cos), (-2e-3 * rate**2, np.sin))
    )
    return Motion(u, v, a, np.linspace(0.05, 0.1, time.size) * size, None)


def currents() -> Array:
    return np.where(np.arange(300) % 120 < 60, 0.3, 1.1)


@pytest.mark.parametrize("model_name", ["sigmoid", "sigmoid_lag"])
@pytest.mark.parametrize("coil", [0.0, 0.02])
def test_one_by_one_is_all_at_once(model_name: str, coil: float) -> None:
    model = MODELS[model_name].continuous
    values = known.EXAMPLES[model_name].copy()
    if model_name == "sigmoid_lag":
        values[-1] = coil
    whole, pieces = model.stream(PERIOD), model.stream(PERIOD)
    expected = whole.follow(values, motion(), currents())
    found = [
        pieces.follow(values, motion().part(slice(k, k + 1)), currents()[k : k + 1])[0]
        for k in range(300)
    ]
    np.testing.assert_allclose(found, expected, rtol=ROUNDING, atol=ROUNDING)
