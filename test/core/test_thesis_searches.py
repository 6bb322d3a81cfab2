"""Optimisers, one set for a run, the cells of a report, and the report."""

import re

import numpy as np
import pytest

from mr_damper_ros.emulation.emulator import THESIS_FORCE_NOISE
from mr_damper_ros.report.document import Chapter, Table, shown, styled, with_error, write_report
from studies.program import Campaign
from studies.thesis import facts, laws, optimisers, sensitivity
from studies.thesis.optimisers import available


@pytest.mark.parametrize("method", available())
def test_an_optimiser_keeps_budget_and_bounds_and_ends_between_the_noise_and_the_force(method):
    result = optimisers.run(method, (1, 2), 0, 1500)
    assert 0 < result["evaluations"] <= 1500
    # RMSE [N]: the fit of 7 parameters to 7001 samples lowers it slightly; without a law it is 1069
    # N.
    assert result["floor"] / 1.001 <= result["rmse"] < 1069.0
    trace = result["trace"][~np.isnan(result["trace"])]
    assert np.all(np.diff(trace) <= 0.0)
    if not method.endswith("_7"):
        inside = np.array(result["parameters"])
        assert np.all((inside >= facts.SEARCH_LOW) & (inside <= facts.SEARCH_HIGH))


@pytest.mark.parametrize("law", laws.LAWS)
def test_one_set_for_one_run_leaves_the_noise(law):
    fit = laws.fit_runs(law, [optimisers.CONDITION], 0, 4)
    # Relative: three standard errors of a standard deviation from 1750 samples.
    assert fit["rmse"][0] == pytest.approx(THESIS_FORCE_NOISE, rel=0.05)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (3, "3"),
        (0.0, "0"),
        (-0.5, "−0.5000"),
        (999.96, "1000"),
        (23456.7, "23457"),
        (1234567.0, "1.23·10⁶"),
        (-1.5e-12, "−1.50·10⁻¹²"),
        (float("nan"), "–"),
        ("as it is", "as it is"),
    ],
)
def test_cells(value, text):
    assert shown(value) == text


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (586.73, 6.72, "586.7 ± 6.7"),
        (-1.8449, 0.0131, "−1.845 ± 0.013"),
        (1234.0, 350.0, "1234 ± 350"),
        (-2.273e-7, 7.5e-9, "(−2.273 ± 0.075)·10⁻⁷"),
        (3.02822805e11, 2.97288e12, "(0.3 ± 3.0)·10¹²"),
        (0.0, 4e-6, "(0.0 ± 4.0)·10⁻⁶"),
    ],
)
def test_values_with_errors(value, error, text):
    assert with_error(value, error) == text


def test_report_needs_nothing_from_outside_and_shows_the_numbers(tmp_path):
    with styled():
        (chapter,) = sensitivity.sensitivity_part(Campaign(tmp_path))
        chapters = [Chapter("s", "S", "found", ["a < b", *chapter.blocks])]
        page = write_report(tmp_path, "Title", "not original", chapters)
    text = page.read_text("utf-8")
    assert "a &lt; b" in text
    assert "prefers-color-scheme:dark" in text
    assert "@media print" in text
    sources = re.findall(r'(?:src|href)="([^"]{0,30})', text)
    assert sources
    assert all(source.startswith(("data:image/svg+xml;base64,", "#")) for source in sources)
    table = (tmp_path / "tables" / "sensitivity.csv").read_text("utf-8").splitlines()
    first = dict(zip(table[0].split(","), table[1].split(","), strict=False))
    assert first["Quantity"] == "f0"
    sums = sensitivity.squared_change(sensitivity.CONDITION, 0)
    assert float(first["Ours"]) == sums["f0"][-1]
    assert float(first["Thesis"]) == 16e5
    assert any(isinstance(block, Table) for block in chapter.blocks)
