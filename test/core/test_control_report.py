"""The report of the control study: what it says of results, which are invented here."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from studies.control import report as control_report
from studies.control.buildings import BANG_BANG, ON, WEIGHTED, BuildingResult, BuildingRun
from studies.control.car_drives import Drive, DriveResult
from studies.control.heated import HeatedDrive, HeatedResult
from studies.control.hybrid import HybridResult, HybridRun


def invented(text: str) -> float:
    """A number between 0.5 and 1.5 that belongs to a text."""
    return 0.5 + (sum(map(ord, text)) % 97) / 97.0


def series(duration: float, every: float, size: float) -> Any:
    time = np.arange(every, duration, every)
    wave = size * np.sin(9.0 * time)
    return np.stack([time, wave, 1e3 * wave, np.abs(wave)])


def driven(task: Drive) -> DriveResult:
    size = invented(task.strategy + task.road)
    return DriveResult(
        comfort=size,
        holding=0.3 * size,
        travel=0.01 * size,
        power=100.0,
        coil=0.1,
        met=0.5,
        doubted=0.0,
        highest=3.0 * size,
        furthest=0.03,
        series=series(6.0, 0.005, size),
    )


def heated(task: HeatedDrive) -> HeatedResult:
    time = 5.0 * np.arange(1, 9)
    missed_force = np.linspace(50.0, 50.0 if task.learns else 150.0, time.size)
    return HeatedResult(
        time,
        28.0 + time,
        missed_force,
        wanted=np.full(8, 500.0),
        share=np.ones(8),
        comfort=np.ones(8),
        holding=0.2 * np.ones(8),
        accepted=7,
    )


def shaken(task: BuildingRun) -> BuildingResult:
    size = {WEIGHTED: 0.2, ON: 0.3, BANG_BANG: 0.25}.get(task.strategy, 1.0)
    return BuildingResult(
        displacement=size,
        acceleration=size,
        farthest=size,
        highest=size,
        reversals=10.0,
        force=1e3,
        doubted=0.0,
        series=series(8.0, 0.01, size),
    )


def reckoned(task: HybridRun) -> HybridResult:
    time = np.arange(0.0, 6.0, 0.01)
    wave = (1.1 if task.machine else 1.0) * np.sin(9.0 * time)
    return HybridResult(time, wave, wave, wave, wave)


@pytest.fixture
def report(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    for name, function in (
        ("drive", driven),
        ("drive_heated", heated),
        ("simulate", shaken),
        ("hybrid", reckoned),
    ):
        monkeypatch.setattr(control_report, name, function)
    words = ["--quick", "--workers", "1", "--output", str(tmp_path)]
    assert control_report.main(words) == 0
    return tmp_path


def test_the_report_holds_all_chapters_figures_and_tables(report: Path) -> None:
    page = (report / "report.html").read_text(encoding="utf-8")
    for chapter in ("damper", "roads", "bump", "lag", "heated", "buildings", "hybrid"):
        assert f'<section id="{chapter}">' in page
    assert "Quick variant" in page
    assert "9 of 9 cases" in page
    assert "1.00 times with the set identified on line" in page
    assert len(list((report / "figures").glob("*.svg"))) == 9
    with (report / "tables" / "buildings.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 9 * 5
    weighted = [row for row in rows if row["controller"] == WEIGHTED]
    assert {float(row["RMS displ."]) for row in weighted} == {20.0}
