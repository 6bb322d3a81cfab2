"""XLSX and TDMS files give the same recording as a text file with the same numbers."""

import re
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


@with_openpyxl
@pytest.mark.parametrize("dimension", ["A1", "A1:B20", "A1:C203", "A1:ZZ5"])
def test_a_wrong_dimension_of_a_sheet_hides_nothing(tmp_path: Path, dimension: str) -> None:
    path = workbook(tmp_path / "run.xlsx", HEAD + ROWS)
    with ZipFile(path) as packed:
        parts = {name: packed.read(name) for name in packed.namelist()}
    sheet = "xl/worksheets/sheet1.xml"
    stated = b'<dimension ref="' + dimension.encode() + b'"'
    parts[sheet], count = re.subn(rb'<dimension ref="[^"]*"', stated, parts[sheet])
    assert count == 1
    with ZipFile(path, "w") as packed:
        for name, content in parts.items():
            packed.writestr(name, content)
    assert_is_the_run(path)


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


def waveforms(
    path: Path, delays: dict[str, float], by_offset: bool, increments: tuple[float, ...] = ()
) -> Path:
    """Displacement and force whose first samples are ``delays`` [sample periods] after a start."""
    from nptdms import ChannelObject, TdmsWriter

    start, period = np.datetime64("2024-05-02T10:00:00.000000"), 0.01
    made = []
    for (name, delay), increment in zip(
        delays.items(), increments or (period, period), strict=True
    ):
        time = period * (delay + np.arange(200))
        values = 5.0 * np.sin(2.0 * time) if name == "Stroke" else 900.0 * np.cos(2.0 * time)
        late = round(1e6 * period * delay)
        begins = start if by_offset else start + np.timedelta64(late, "us")
        offset = 1e-6 * late if by_offset else 0.0
        given = {"wf_start_time": begins, "wf_start_offset": offset, "wf_increment": increment}
        made.append(ChannelObject("Run", name, values, properties=given))
    with TdmsWriter(path) as writer:
        writer.write_segment(made)
    return path


@with_nptdms
@pytest.mark.parametrize("by_offset", [True, False])
@pytest.mark.parametrize("delays", [(0.0, 25.0), (25.0, 0.0), (0.0, 0.4), (3.7, 0.0), (7.3, 2.8)])
def test_channels_that_start_at_different_times_are_aligned(
    tmp_path: Path, delays: tuple[float, float], by_offset: bool
) -> None:
    path = waveforms(
        tmp_path / "run.tdms", dict(zip(("Stroke", "Load"), delays, strict=True)), by_offset
    )
    read = read_record(path, "displacement=Stroke:mm,force=Load:N", current=0.5)
    time = 0.01 * (max(delays) + np.arange(read.sample_count))
    assert read.sample_count >= 199 - abs(delays[0] - delays[1])
    np.testing.assert_allclose(read.displacement, 5e-3 * np.sin(2.0 * time), atol=1e-6)
    np.testing.assert_allclose(read.force, 900.0 * np.cos(2.0 * time), atol=0.1)
    assert "channels start later than others" in read.details["note"]


@with_nptdms
@pytest.mark.parametrize("late", [0.0, 0.25])
def test_a_start_that_is_not_set_is_no_start(tmp_path: Path, late: float) -> None:
    from nptdms import ChannelObject, TdmsWriter

    unset = {"wf_start_time": np.datetime64("1904-01-01T00:00:00"), "wf_increment": 0.01}
    offset = {**unset, "wf_start_offset": late}
    known = {**unset, "wf_start_time": np.datetime64("2024-05-02T10:00:00")}
    with TdmsWriter(tmp_path / "run.tdms") as writer:
        writer.write_segment(
            [
                ChannelObject("Run", name, values, properties=given)
                for name, values, given in (
                    ("Stroke", DISPLACEMENT, unset),
                    ("Load", FORCE, offset),
                    ("Current", np.ones(200), known if not late else offset),
                )
            ]
        )
    columns = "displacement=Stroke:mm,force=Load:N,current=Current:A"
    read = read_record(tmp_path / "run.tdms", columns)
    assert read.sample_count == 200 - round(late / 0.01)


@with_nptdms
def test_channels_of_different_rates_are_refused(tmp_path: Path) -> None:
    path = waveforms(tmp_path / "run.tdms", {"Stroke": 0.0, "Load": 0.0}, False, (0.01, 0.02))
    sentence = refused(path, "displacement=Stroke:mm,force=Load:N", period=0.01)
    assert "different sample periods: Stroke 0.01 s, Load 0.02 s" in sentence


@with_nptdms
def test_periods_that_differ_by_their_rounding_are_the_same(tmp_path: Path) -> None:
    rounded = float(np.float32(0.01))
    path = waveforms(tmp_path / "run.tdms", {"Stroke": 0.0, "Load": 0.0}, False, (0.01, rounded))
    read = read_record(path, "displacement=Stroke:mm,force=Load:N", current=0.5)
    assert read.sample_count == 200


@with_nptdms
def test_channels_without_a_common_time_are_refused(tmp_path: Path) -> None:
    path = waveforms(tmp_path / "run.tdms", {"Stroke": 0.0, "Load": 900.0}, False)
    assert "have no time in common" in refused(path, "displacement=Stroke:mm,force=Load:N")


@with_nptdms
@pytest.mark.parametrize("cut", [0, 8, 1000, 1500])
def test_a_file_that_was_not_closed_says_so(tmp_path: Path, cut: int) -> None:
    from nptdms import ChannelObject, TdmsWriter

    path = tmp_path / "run.tdms"
    with TdmsWriter(path) as writer:
        for rows in (slice(100), slice(100, None)):
            writer.write_segment([ChannelObject("Run", n, v[rows]) for n, v in GROUP.items()])
    content = bytearray(path.read_bytes())
    second = content.rindex(b"TDSm")
    content[second + 12 : second + 20] = b"\xff" * 8  # the length of a segment in progress
    path.write_bytes(content[: len(content) - cut])
    read = read_record(path, COLUMNS, current=0.5)
    np.testing.assert_allclose(read.force, FORCE[: read.sample_count])
    assert read.sample_count >= 100
    note = f"its last samples may be missing; {read.sample_count} samples were read"
    assert note in read.details["note"]


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


@pytest.mark.parametrize(
    ("ending", "library"), [("xlsx", "openpyxl"), ("tdms", "nptdms"), ("mf4", "asammdf")]
)
def test_a_missing_library_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str, library: str
) -> None:
    # A broken module of that name hides the real one.
    (tmp_path / f"{library}.py").write_text("raise ImportError", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    sentence = refused(damaged(tmp_path / f"run.{ending}"))
    assert "install it (pip install" in sentence
