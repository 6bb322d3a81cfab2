"""The text of the control study's report for invented results."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mr_damper_ros.processes.files import write_bytes
from mr_damper_ros.report import document
from studies.__main__ import main
from studies.control import car


def invented(text: str) -> float:
    """A number between 0.5 and 1.5, determined by a text."""
    return 0.5 + (sum(map(ord, text)) % 97) / 97.0


def series(duration: float, every: float, size: float) -> Any:
    time = np.arange(every, duration, every)
    wave = size * np.sin(9.0 * time)
    return np.stack([time, wave, 1e3 * wave, np.abs(wave)])


def driven(strategy: str, road: str, lag: float, duration: float) -> Any:
    size = invented(strategy + road)
    return {
        "comfort": size,
        "holding": 0.3 * size,
        "travel": 0.01 * size,
        "power": 100.0,
        "coil": 0.1,
        "met": 0.5,
        "highest": 3.0 * size,
        "furthest": 0.03,
        "series": series(6.0, 0.005, size),
    }


def drive_heated(learns: bool, duration: float) -> Any:
    time = 5.0 * np.arange(1, 9)
    missed = np.linspace(50.0, 50.0 if learns else 150.0, 8)
    ones = np.ones(8)
    values = np.stack([time, 28.0 + time, ones, 0.2 * ones, missed, 500.0 * ones, ones])
    return {"series": values, "accepted": 7}


def sketched(folder: Path, picture: document.Picture) -> bytes:
    """An empty file for a figure: it is drawn, but not rendered."""
    write_bytes(folder / f"{picture.name}.svg", b"<svg/>")
    return b"<svg/>"


@pytest.fixture
def written(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setattr(car, "drive", driven)
    monkeypatch.setattr(car, "drive_heated", drive_heated)
    monkeypatch.setattr(document, "write_picture", sketched)
    assert main(["control", "--quick", "--workers", "1", "--output", str(tmp_path)]) == 0
    return tmp_path


def test_the_report_holds_all_chapters_figures_and_tables(written: Path) -> None:
    page = (written / "report.html").read_text(encoding="utf-8")
    for chapter in ("damper", "roads", "bump", "lag", "heated"):
        assert f'<section id="{chapter}">' in page
    assert "Quick variant" in page
    assert "with the set identified on line, 1.00 times" in page
    assert len(list((written / "figures").glob("*.svg"))) == 6
