"""XLSX and TDMS files give the same recording as a text file with the same numbers."""

from importlib.util import find_spec
from pathlib import Path
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
import pytest

from mr_damper_ros.io.columns import RecordError
from mr_damper_ros.io.records import read_record

COLUMNS = "time:s,displacement:mm,force:N"
TIME = np.arange(200) * 0.01
DISPLACEMENT = 5.0 * np.sin(20.0 * TIME)
FORCE = 900.0 * np.cos(20.0 * TIME)
TABLE = np.stack([TIME, DISPLACEMENT, FORCE], axis=1)

with_openpyxl = pytest.mark.skipif(find_spec("openpyxl") is None, reason="openpyxl is missing")
with_nptdms = pytest.mark.skipif(find_spec("nptdms") is None, reason="npTDMS is missing")


def assert_is_the_run(path: Path, columns: str = COLUMNS, **options: Any) -> None:
    read = read_record(path, columns, current=0.5, **options)
    np.testing.assert_allclose(read.displacement, 1e-3 * DISPLACEMENT, rtol=1e-12)
    np.testing.assert_allclose(read.force, FORCE, rtol=1e-12)
    assert read.period == pytest.approx(0.01, rel=1e-9)


def refused(path: Path, columns: str = COLUMNS, **options: Any) -> str:
    with pytest.raises(RecordError) as caught:
        read_record(path, columns, current=0.5, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def workbook(path: Path, *sheets: list[list[Any]]) -> Path:
    from openpyxl import Workbook

    book = Workbook()
    book.remove(book.active)
    for number, rows in enumerate(sheets, start=1):
        sheet = book.create_sheet(f"Run {number}")
        for row in rows:
            sheet.append(row)
    book.save(path)
    return path


HEAD: list[list[Any]] = [["Damper 7; 0,5 A"], [], ["t [s]", "Stroke", "Load cell"]]
ROWS: list[list[Any]] = TABLE.tolist()


@with_openpyxl
def test_a_sheet_is_a_record(tmp_path: Path) -> None:
    path = workbook(tmp_path / "run.xlsx", HEAD + ROWS)
    assert_is_the_run(path)
    assert_is_the_run(path, "force=Load cell:N,time=t [s]:s,displacement=Stroke:mm")


@with_openpyxl
def test_a_sheet_is_chosen_by_its_name(tmp_path: Path) -> None:
    path = workbook(tmp_path / "run.xlsx", [[1, 2, 3]], HEAD + ROWS)
    assert_is_the_run(path, variable="Run 2")
    assert "several sheets: choose one of Run 1, Run 2 by the option" in refused(path)
    assert "no sheet 'Run 3'" in refused(path, variable="Run 3")


@with_openpyxl
def test_what_is_wrong_in_a_sheet_is_named(tmp_path: Path) -> None:
    rows = [list(row) for row in ROWS]
    rows[20][2] = "broken"
    path = workbook(tmp_path / "run.xlsx", HEAD + rows)
    assert "column 3 in line 24 of run.xlsx is 'broken', not a number" in refused(path)
    assert "cannot be read as a spreadsheet" in refused(damaged(tmp_path / "other.xlsx"))
    whole = workbook(tmp_path / "whole.xlsx", HEAD + ROWS)
    assert "holds more than 100 samples" in refused(whole, maximum_samples=100)


@with_openpyxl
def test_a_sheet_that_unpacks_to_more_than_the_limit_is_refused(tmp_path: Path) -> None:
    # Sixty megabytes of text in sixty kilobytes.
    path = workbook(tmp_path / "run.xlsx", [["text"], *ROWS])
    with ZipFile(path) as packed:
        parts = {name: packed.read(name) for name in packed.namelist()}
    sheet = "xl/worksheets/sheet1.xml"
    parts[sheet] = parts[sheet].replace(b">text<", b">" + b"x" * 60_000_000 + b"<")
    with ZipFile(path, "w", ZIP_DEFLATED) as packed:
        for name, content in parts.items():
            packed.writestr(name, content)
    assert path.stat().st_size < 1_000_000
    assert "holds more than 1000 samples" in refused(path, maximum_samples=1000)


def damaged(path: Path) -> Path:
    path.write_bytes(b"PK\x03\x04" + bytes(1000))
    return path


def channels(path: Path, *groups: dict[str, np.ndarray], **properties: Any) -> Path:
    from nptdms import ChannelObject, TdmsWriter

    with TdmsWriter(path) as writer:
        writer.write_segment(
            [
                ChannelObject(f"Run {number}", name, values, properties=properties)
                for number, group in enumerate(groups, start=1)
                for name, values in group.items()
            ]
        )
    return path


GROUP = {"Time": TIME, "Stroke": DISPLACEMENT, "Load": FORCE}


@with_nptdms
def test_channels_are_columns(tmp_path: Path) -> None:
    path = channels(tmp_path / "run.tdms", GROUP)
    assert_is_the_run(path)
    assert_is_the_run(path, "force=Load:N,time=Time:s,displacement=Stroke:mm")


@with_nptdms
def test_a_waveform_tells_the_time_between_samples(tmp_path: Path) -> None:
    waveforms = {name: GROUP[name] for name in ("Stroke", "Load")}
    path = channels(tmp_path / "run.tdms", waveforms, wf_increment=0.01)
    assert_is_the_run(path, "displacement:mm,force:N")
    without = channels(tmp_path / "without.tdms", waveforms)
    assert "the time between samples is unknown" in refused(without, "displacement:mm,force:N")


@with_nptdms
def test_a_group_is_chosen_by_its_name(tmp_path: Path) -> None:
    path = channels(tmp_path / "run.tdms", GROUP, GROUP)
    assert_is_the_run(path, variable="Run 2")
    sentence = refused(path)
    assert "holds 2 groups of numbers with at least 3 columns: choose one" in sentence
    assert "it holds Run 1, Run 2" in sentence
    sentence = refused(path, "time=Zeit:s,displacement=Stroke:mm,force=Load:N")
    assert "holds 0 groups of numbers with the columns Zeit, Stroke, Load; it" in sentence
    # A group without these columns is not a candidate.
    assert_is_the_run(channels(tmp_path / "one.tdms", {"Other": TIME}, GROUP))


@with_nptdms
def test_what_is_wrong_in_a_tdms_file_is_named(tmp_path: Path) -> None:
    path = channels(tmp_path / "run.tdms", GROUP)
    sentence = refused(path, "time=Zeit:s,displacement=Stroke:mm,force=Load:N")
    assert "has no channel 'Zeit': it holds Time, Stroke, Load" in sentence
    assert "holds more than 100 samples" in refused(path, maximum_samples=100)
    assert "say what column 3 holds" in refused(path, "displacement:mm,force:N", period=0.01)
    other = tmp_path / "other.tdms"
    other.write_bytes(b"TDSm" + bytes(1000))
    assert "cannot be read as a TDMS file" in refused(other)


@pytest.mark.parametrize(("ending", "library"), [("xlsx", "openpyxl"), ("tdms", "nptdms")])
def test_a_missing_library_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str, library: str
) -> None:
    # A broken module of that name hides the real one.
    (tmp_path / f"{library}.py").write_text("raise ImportError", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    sentence = refused(damaged(tmp_path / f"run.{ending}"))
    assert "install it (pip install" in sentence
