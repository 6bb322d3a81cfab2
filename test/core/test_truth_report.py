"""The report on the force laws, and the hysteretic benchmark that it re-creates."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.io import savemat
from scipy.signal import lfilter

from mr_damper_ros.models import MODELS
from studies.__main__ import main
from studies.truth import oscillator, records
from studies.truth.oscillator import PERIOD, STEPS, TRUTH, multisine

LAWS = ("bingham", "hyperbolic_tangent")


def test_the_steps_follow_the_equations() -> None:
    step, count = PERIOD / STEPS, 3000
    force = multisine(3, 512)[:count]
    time = step * np.arange(count)

    def right(t: float, state: np.ndarray) -> list[float]:
        y, v, z = state
        u = np.interp(t, time, force)
        # As published: with the three constants instead of their products.
        rate = 5e4 * v - 1e3 * (0.8 * abs(v) * z - 1.1 * v * abs(z))
        return [v, (u - 10.0 * v - 5e4 * y - z) / 2.0, rate]

    exact = solve_ivp(
        right, (0.0, time[-1]), [0.0, 0.0, 0.0], t_eval=time, rtol=1e-8, atol=1e-10, max_step=step
    ).y
    found = TRUTH.simulate(force, step)
    for simulated, expected in zip((found.displacement, found.hysteretic), exact[::2], strict=True):
        off = np.max(np.abs(simulated - expected)) / np.ptp(expected)
        # Of the span: (omega h)² / 12 for one step at the highest frequency, 150 Hz, and 15 kHz.
        assert off < 2e-4


def write_recordings(folder: Path) -> None:
    """Six short records of a viscous damper with friction, and an earthquake of seven seconds."""
    processed = folder / "utfsm" / "processed"
    processed.mkdir(parents=True)
    time = 5e-3 * np.arange(600)
    for motion, amplitude, frequency in (("5mm1Hz", 5.0, 1.0), ("2mm2Hz", 2.0, 2.0)):
        for current in ("0", "0x5", "1"):
            w = 2.0 * np.pi * frequency
            u, v = amplitude * np.sin(w * time), amplitude * w * np.cos(w * time)
            force = 5.0 * v + (100.0 + 300.0 * float(current.replace("x", "."))) * np.tanh(v)
            np.savetxt(processed / f"{motion}{current}A.txt", np.stack([time, u, v, force], axis=1))
    time = 1e-3 * np.arange(7000)
    # At rest at first, so that the moving average can be reversed.
    motion = 4.0 * np.sin(9.0 * time) * np.clip(time - 0.5, 0.0, 1.0)
    columns = [motion] + [(k + 1.0) * np.gradient(motion, 1e-3) for k in range(3)]
    columns = [lfilter(np.full(300, 1.0 / 300.0), [1.0], column) for column in columns]
    savemat(folder / "utfsm" / "earthquake.mat", {"data": np.stack(columns, axis=1)})


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(records, "QUICK_LAWS", LAWS)
    monkeypatch.setattr(oscillator, "QUICK_LAWS", LAWS)
    monkeypatch.setattr(records, "QUICK_ONLINE", LAWS[:1])
    monkeypatch.setattr(oscillator, "QUICK", {"count": 128, "steps": 5, "sweep": 0.5})


@pytest.mark.usefixtures("tiny")
def test_the_report_holds_every_law_and_figure(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    write_recordings(tmp_path)
    monkeypatch.setenv("MR_DAMPER_DATA", str(tmp_path))
    out = tmp_path / "out"
    assert main(["truth", "--quick", "--workers", "1", "--output", str(out)]) == 0
    page = (out / "report.html").read_text(encoding="utf-8")
    for chapter in ("sinusoids", "earthquakes", "parameters", "oscillator"):
        assert f'<section id="{chapter}">' in page
    assert "Quick variant" in page
    assert len(list((out / "figures").glob("*.svg"))) == 3
    figures = json.loads((out / "truth.json").read_text(encoding="utf-8"))
    assert set(figures["recordings"]) == set(LAWS) == set(figures["oscillator"]["laws"])
    law = figures["recordings"]["hyperbolic_tangent"]
    assert len(law["one_set_nrmse"]) == len(law["left_out_nrmse"]) == 2
    assert law["us_per_sample"] > 0.0
    assert set(law["parameters"]) == set(MODELS["hyperbolic_tangent"].parameter_names)
    assert None not in law["earthquake_static_fit"]
    assert law["earthquake_online_fit"] == [None]
    assert None not in figures["recordings"]["bingham"]["earthquake_online_fit"]
