"""Conversion of laboratory files to bags: all number formats and all errors in files."""

import argparse
import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.io import savemat

import mr_damper_ros as mr
from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.io.columns import UNITS, ColumnError, parse_columns
from mr_damper_ros.io.records import read_record, read_runs
from mr_damper_ros.tools import check, import_, watch
from mr_damper_ros.tools.console import program

COLUMNS = "time:s,displacement:mm,force:N"
TIME = np.arange(40) * 0.01
DISPLACEMENT_MM = 5.0 * np.sin(20.0 * TIME)
FORCE = 900.0 * np.cos(20.0 * TIME) + 3.0

WRITTEN_FORCE = 1e-6
"""[N]: six decimals are written."""

ROUNDING_OF_TIMES = 1e-12
"""Relative: a period is the mean of up to two thousand differences of times."""


def rows(separator: str = " ", decimal: str = ".") -> list[str]:
    return [
        separator.join(f"{value:.6f}".replace(".", decimal) for value in row)
        for row in zip(TIME, DISPLACEMENT_MM, FORCE, strict=True)
    ]


@pytest.fixture
def write(tmp_path: Path) -> Any:
    def write(text: str | bytes | list[str], name: str = "run.txt") -> Path:
        path = tmp_path / name
        if isinstance(text, list):
            text = "\n".join(text) + "\n"
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return path

    return write


def assert_is_the_run(path: Path, columns: str = COLUMNS, **options: Any) -> None:
    read = read_record(path, columns, **{"current": 0.5, **options})
    # [m]: six decimals of a millimetre are written.
    np.testing.assert_allclose(read.displacement, DISPLACEMENT_MM * 1e-3, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(read.force, FORCE, rtol=0.0, atol=WRITTEN_FORCE)
    np.testing.assert_array_equal(read.current, np.full(40, 0.5))
    assert read.period == pytest.approx(0.01, rel=ROUNDING_OF_TIMES, abs=0.0)


def refused(call: Any) -> str:
    with pytest.raises(ValueError, match=r".") as error:
        call()
    assert "\n" not in str(error.value)
    return str(error.value)


# ---- number formats ----------------


@pytest.mark.parametrize(
    ("separator", "decimal"),
    [(" ", "."), ("   ", ","), ("\t", "."), ("\t", ","), (";", "."), ("; ", ","), (",", ".")],
)
@pytest.mark.parametrize(
    "header",
    [[], ["time, displacement, force", "s, mm, N", ""], ["Rate:  100", "Name: run; 3 columns"]],
    ids=["bare", "header", "preamble"],
)
def test_separators_decimals_and_headers(
    write: Any, separator: str, decimal: str, header: list[str]
) -> None:
    assert_is_the_run(write(header + rows(separator, decimal)))


@pytest.mark.parametrize("encoding", ["utf-8-sig", "latin-1", "utf-16"])
def test_encodings(write: Any, encoding: str) -> None:
    text = "\r\n".join(["Zeit;Kolbenweg [µm·10³];Kraft", *rows(";")])
    assert_is_the_run(write(text.encode(encoding)))


def test_columns_are_found_by_their_headers(write: Any) -> None:
    lines = [f"{k},{row}" for k, row in enumerate(rows(","))]
    path = write(['No,"Time [s]",Stroke,Load cell', ",s,mm,N", *lines], "run.csv")
    assert_is_the_run(path, "force=Load cell:N,time=Time [s]:s,displacement=Stroke:mm")


@pytest.mark.parametrize("rest", [",-", ",..."])
def test_a_surplus_column_of_numbers_is_refused_unless_skipped(write: Any, rest: str) -> None:
    path = write([f"{row} 7" for row in rows()])
    sentence = refused(lambda: read_record(path, COLUMNS, current=0.5))
    assert "run.txt holds 4 columns of numbers, but 3 are described: say what column 4" in sentence
    assert_is_the_run(path, COLUMNS + rest)


def test_an_offset_is_added_in_its_unit(write: Any) -> None:
    lines = [
        f"{t} {u} {(force + 12.0) / 980.665}"
        for t, u, force in zip(TIME, DISPLACEMENT_MM, FORCE, strict=True)
    ]
    assert_is_the_run(write(lines), "time:s,displacement:mm,force:980.665*N-12N")
    assert_is_the_run(write(lines), "time:s,displacement:mm,force:0.980665*kN - 0.012 kN")


@pytest.mark.parametrize(
    "written",
    [
        "03/31/2022 11:59:{:09.6f} PM",
        "2022-03-31 23:59:{:09.6f}",
        "2022-03-31T23:59:{:09.6f}Z",
        "31.03.2022 23:59:{:09.6f}",
        "31/03/2022 23:59:{:09.6f}",
    ],
)
def test_dates_are_times(write: Any, written: str) -> None:
    lines = [f"{written.format(float(row[:8]))};{row[9:]}" for row in rows(";")]
    read = read_record(write(lines), "time:datetime,displacement:mm,force:N", current=0.5)
    assert read.period == 0.01
    assert read.start_ns == 1_648_771_140 * 10**9


def test_a_velocity_alone_is_integrated_and_it_is_said(write: Any) -> None:
    # Whole cycles, with an offset of the sensor.
    time = np.arange(1000) * 0.01
    angle = 2.0 * np.pi * time
    velocity = 5.0 * np.cos(angle) + 0.3
    path = write([f"{t} {v} {w}" for t, v, w in zip(time, velocity, np.cos(angle), strict=True)])
    read = read_record(path, "time:s,velocity:mm/s,force:kN", current=0.5)
    assert "the integral of the velocity" in read.details["note"]
    expected = 5e-3 / (2.0 * np.pi) * np.sin(angle)
    # Fraction of the amplitude: the ten cycles tilt the straight line that is subtracted.
    assert np.max(np.abs(read.displacement - expected)) < 0.2 * np.max(expected)


def test_current_and_temperature_columns(write: Any) -> None:
    lines = [f"{row} {k * 10} {300 + k}" for k, row in enumerate(rows())]
    read = read_record(write(lines), COLUMNS + ",current:mA,temperature:K")
    # [A]: rounding of the conversion from milliamperes.
    np.testing.assert_allclose(read.current, np.arange(40) * 0.01, rtol=0.0, atol=1e-14)
    # [degC]: rounding of the difference from 273.15 K.
    np.testing.assert_allclose(read.temperature, 26.85 + np.arange(40), rtol=0.0, atol=1e-11)


def test_rounded_times_are_taken_as_even_and_it_is_said(write: Any) -> None:
    # 1024 Hz, printed with four decimals.
    lines = [f"{k / 1024:.4f} {np.sin(k / 10)} {k}" for k in range(2049)]
    read = read_record(write(lines), COLUMNS, current=0.0)
    assert read.period == pytest.approx(1.0 / 1024, rel=ROUNDING_OF_TIMES, abs=0.0)
    assert "the times deviate by" in read.details["note"]


@settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    quantity_unit=st.sampled_from(
        [(q, u) for q in ("displacement", "force", "current") for u in UNITS[q]]
    ),
    factor=st.floats(0.01, 100.0),
)
def test_units_and_factors_multiply(
    write: Any, quantity_unit: tuple[str, str], factor: float
) -> None:
    quantity, unit = quantity_unit
    others = [f"{q}:1e-3*{u}" for q, u in (("displacement", "m"), ("force", "N")) if q != quantity]
    (column,) = (
        c
        for c in parse_columns(",".join([*others, f"{quantity}:{factor!r}*{unit}"])).wanted
        if c.quantity == quantity
    )
    scale = UNITS[quantity][unit]
    # Relative: a unit and a factor are one or two products.
    assert column.to_si(np.array([3.0]))[0] == pytest.approx(
        3.0 * factor * scale, rel=1e-13, abs=0.0
    )


# ---- MAT files ----


def test_a_matrix_in_a_mat_file(tmp_path: Path) -> None:
    matrix = np.stack([TIME, DISPLACEMENT_MM, FORCE], axis=1)
    savemat(tmp_path / "run.mat", {"data": matrix, "rate": 100.0})
    assert_is_the_run(tmp_path / "run.mat")
    savemat(tmp_path / "lying.mat", {"data": matrix.T, "other": matrix})
    assert_is_the_run(tmp_path / "lying.mat", variable="data")


def test_vectors_in_a_mat_file(tmp_path: Path) -> None:
    savemat(tmp_path / "run.mat", {"t": TIME, "x": DISPLACEMENT_MM, "F": FORCE[:, np.newaxis]})
    assert_is_the_run(tmp_path / "run.mat", "time=t:s,displacement=x:mm,force=F:N")


@pytest.mark.parametrize(
    ("columns", "variable", "sentence"),
    [
        (COLUMNS, None, "choose one by the option variable; it holds a (40 x 3), b (40 x 3)"),
        (COLUMNS, "c", "has no variable 'c': it holds a (40 x 3)"),
        (COLUMNS + ",current:A", None, "holds 0 matrices with at least 4 columns; it holds a"),
        (COLUMNS + ",current:A", "a", "has no column '4'"),
        ("time=t:s,displacement=x:mm,force=F:N", None, "no variable 't': it holds a"),
        ("time=t:s,displacement=x:mm,force=F:N", "a", "omit the option variable"),
    ],
)
def test_what_a_mat_file_lacks_is_named(
    tmp_path: Path, columns: str, variable: str | None, sentence: str
) -> None:
    savemat(tmp_path / "run.mat", {"a": np.ones((40, 3)), "b": np.ones((40, 3))})
    current = None if "current" in columns else 0.5
    assert sentence in refused(
        lambda: read_record(tmp_path / "run.mat", columns, current=current, variable=variable)
    )


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + b"\0" * 400, "of version 7.3"),
        (
            b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + b"\x0f\0\0\0\xff",
            "cannot be read as a MAT file",
        ),
        (b"nothing", "cannot be read as a MAT file: save it again, or export it as CSV"),
    ],
)
def test_mat_files_that_cannot_be_read(write: Any, content: bytes, sentence: str) -> None:
    path = write(content, "run.mat")
    assert sentence in refused(lambda: read_record(path, COLUMNS, current=0.5))


# ---- wrong descriptions ----


@pytest.mark.parametrize(
    ("columns", "sentence"),
    [
        ("time,displacement:mm,force:N", "the column 'time' has no unit"),
        (
            "tme:s,displacement:mm,force:N",
            "'tme' is not a quantity of a record: use time, displace",
        ),
        ("time:s,displacement:mm,force:lb", "'lb' is not a known unit of force: use N, kN"),
        ("time:s,displacement:mm", "no column holds the force"),
        ("time:s,force:N,-", "no column holds the displacement"),
        ("displacement:mm,displacement:mm,force:N", "name displacement twice"),
        ("displacement:x*mm,force:N", "the factor 'x' in 'displacement:x*mm'"),
        ("displacement:0*mm,force:N", "is zero"),
        (
            "displacement:nan*mm,force:N",
            "the factor 'nan' in 'displacement:nan*mm' is not a number",
        ),
        ("time:-1*s,displacement:mm,force:N", "time must increase"),
        ("displacement=Stroke:mm,force:N", "select all by header"),
        ("displacement=:mm,force=F:N", "has no header name"),
    ],
)
def test_columns_that_cannot_be_meant(columns: str, sentence: str) -> None:
    with pytest.raises(ColumnError) as error:
        parse_columns(columns)
    assert sentence in str(error.value)


@pytest.mark.parametrize(
    ("columns", "options", "sentence"),
    [
        (COLUMNS, {}, "the coil current is unknown"),
        (COLUMNS, {"current": float("nan")}, "the current is nan A"),
        (COLUMNS, {"current": 1.0, "period": 0.01}, "the time is given twice"),
        (COLUMNS + ",current:A", {"current": 1.0}, "the current is given twice"),
        ("-,displacement:mm,force:N", {"current": 1.0}, "time between samples is unknown"),
        ("-,displacement:mm,force:N", {"current": 1.0, "period": 0.0}, "must be positive"),
        ("-,displacement:mm,force:N", {"current": 1.0, "period": -0.1}, "must be positive"),
        (COLUMNS, {"current": 1.0, "start": 2.0}, "0 samples from 2 s to its end: it lasts 0.39 s"),
        (COLUMNS, {"current": 1.0, "start": 0.2, "stop": 0.1}, "give the earlier time first"),
        (COLUMNS, {"current": 1.0, "variable": "data"}, "is a text file and has no variables"),
        (COLUMNS + ",-,temperature:K", {"current": 1.0}, "columns 1, 2, 3, 5: its line"),
    ],
)
def test_options_that_contradict_the_record(
    write: Any, columns: str, options: dict[str, Any], sentence: str
) -> None:
    path = write(rows())
    assert sentence in refused(lambda: read_record(path, columns, **options))


def test_samples_at_uneven_times_are_interpolated_to_uniform_ones(write: Any) -> None:
    rng = np.random.default_rng(0)
    time = np.cumsum(0.001 * rng.uniform(0.3, 3.0, 2000))
    displacement, force = 5.0 * np.sin(20.0 * time), 900.0 * np.cos(20.0 * time)
    table = zip(time, displacement, force, strict=True)
    path = write([f"{t:.6f} {u:.6f} {f:.6f}" for t, u, f in table])
    read = read_record(path, COLUMNS, current=0.5)
    assert "interpolated to uniform times" in read.details["note"]
    true = 5e-3 * np.sin(20.0 * (read.time + time[0]))
    # [m]: a chord of three milliseconds of this sine.
    np.testing.assert_allclose(read.displacement, true, rtol=0.0, atol=3e-6)


def test_lost_samples_leave_a_gap_that_a_bag_does_not_hold(write: Any, tmp_path: Path) -> None:
    lines = [f"{t:.6f} {5 * np.sin(t):.9f} {9 * np.cos(t):.9f}" for t in np.arange(200) * 0.01]
    read = read_record(write(lines[:50] + lines[80:]), COLUMNS, current=0.5)
    assert (read.sample_count, read.gaps) == (200, (slice(50, 80),))
    assert read.part(slice(60, 150)).gaps == (slice(0, 20),)
    mr.write_bag(tmp_path / "bag", read)
    sections = read_bag(tmp_path / "bag")
    assert [each.sample_count for each in sections] == [50, 120]
    np.testing.assert_array_equal(sections[1].force, read.force[80:])


@pytest.mark.parametrize("late", [0.03, -0.03])
def test_a_late_column_is_moved_back_and_it_is_said(write: Any, late: float) -> None:
    shifted = np.roll(FORCE, round(late / 0.01))
    table = zip(TIME, DISPLACEMENT_MM, shifted, strict=True)
    path = write([" ".join(f"{value:.6f}" for value in row) for row in table])
    read = read_record(path, COLUMNS, current=0.5, force_lateness=late)
    kept = slice(None, -3) if late > 0.0 else slice(3, None)
    np.testing.assert_allclose(read.force, FORCE[kept], rtol=0.0, atol=WRITTEN_FORCE)
    np.testing.assert_allclose(read.displacement, 1e-3 * DISPLACEMENT_MM[kept], atol=1e-9)
    assert f"the force, {late:g} s late, was moved back" in read.details["note"]


def test_a_current_that_no_column_holds_cannot_be_late(write: Any) -> None:
    path = write(rows())
    sentence = refused(lambda: read_record(path, COLUMNS, current=0.5, current_lateness=0.1))
    assert "no column holds the current" in sentence


def test_a_header_that_is_not_there_is_named_with_those_that_are(write: Any) -> None:
    path = write(["t;x;F", *rows(";")])
    sentence = refused(
        lambda: read_record(path, "time=t:s,displacement=x:mm,force=Force:N", current=0.0)
    )
    assert "'t; x; F' lacks Force" in sentence


@pytest.mark.parametrize(
    ("factor", "wrong"), [(1.0, True), (1e-3, False), (-1e-3, True), (1e-6, True)]
)
def test_a_velocity_that_contradicts_the_displacement_is_said(
    write: Any, factor: float, wrong: bool
) -> None:
    velocity = np.gradient(DISPLACEMENT_MM, TIME) * 1e-3
    lines = [f"{row} {v}" for row, v in zip(rows(), velocity, strict=True)]
    columns = f"{COLUMNS},velocity:{factor * 1e3:g}*m/s"
    if wrong:
        sentence = refused(lambda: read_record(write(lines), columns, current=0.5))
        assert "times the derivative of the displacement" in sentence
    else:
        read_record(write(lines), columns, current=0.5)


# ---- wrong files ----


def with_line(index: int, text: str) -> list[str]:
    lines = rows()
    lines[index] = text
    return lines


@pytest.mark.parametrize(
    ("lines", "sentence"),
    [
        (with_line(7, "0.070000 nan 3"), "the displacement in line 8 of run.txt is nan"),
        (with_line(7, "0.070000 1 inf"), "the force in line 8 of run.txt is inf"),
        (with_line(7, "nan 1 2"), "the time in line 8 of run.txt is nan"),
        (with_line(7, "0.070000 oops 3"), "column 2 in line 8 of run.txt is 'oops'"),
        (with_line(7, "0.070000 1"), "line 8 of run.txt has 2 columns, but column 3 is needed"),
        (with_line(7, "0.060000 1 2"), "the time in line 8 of run.txt does not increase"),
        (
            [*rows()[:5], "1.200000 1 2"],
            "the time in line 6 of run.txt increases by 1.16 s instead of 0.01 s",
        ),
        (rows()[:1], "holds one row of numbers"),
        (["time displacement force"], "holds no row with numbers in columns 1, 2, 3"),
        (["", "  "], "holds no row with numbers in columns 1, 2, 3: it is empty"),
        (["2022-03-31T23:59:01 1 2"] * 3, "the unit of a date is time:datetime"),
    ],
)
def test_rows_that_cannot_be_used_are_named(write: Any, lines: list[str], sentence: str) -> None:
    assert sentence in refused(lambda: read_record(write(lines), COLUMNS, current=0.5))


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"", "is empty"),
        (b"PK\x03\x04 and so on", "first save it as XLSX or CSV"),
        (b"\x7fELF\0\0\0", "is not a text file"),
    ],
)
def test_files_that_are_no_records(write: Any, content: bytes, sentence: str) -> None:
    assert sentence in refused(lambda: read_record(write(content), COLUMNS, current=0.5))


# ---- the program ----


def test_a_file_becomes_a_bag_and_its_ranges_are_shown(
    write: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, bag = write(rows()), tmp_path / "bags" / "run"
    code = import_.main([str(path), "--columns", COLUMNS, "--current", "0.5", "--output", str(bag)])
    assert code == 0
    shown = capsys.readouterr().out
    assert "40 samples, 10 ms apart (100 Hz), 0.4 s" in shown
    assert f"displacement  {DISPLACEMENT_MM.min():.6g} to {DISPLACEMENT_MM.max():.6g} mm" in shown
    (read,) = read_bag(bag)
    np.testing.assert_allclose(read.force, FORCE, rtol=0.0, atol=WRITTEN_FORCE)
    assert read.details["provenance"] == "imported from run.txt"


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["{path}", "--columns", COLUMNS], "the coil current is unknown"),
        (["{path}.not", "--columns", COLUMNS, "--current", "1"], "No such file or directory"),
        (["{folder}", "--columns", COLUMNS, "--current", "1"], "is a folder"),
    ],
)
def test_a_failure_is_one_sentence_and_leaves_no_bag(
    write: Any,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    sentence: str,
) -> None:
    path = write(rows())
    filled = [a.format(path=path, folder=tmp_path) for a in arguments]
    assert import_.main([*filled, "--output", str(tmp_path / "bag")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("mr-damper import: ")
    assert sentence in error
    assert error.count("\n") == 1
    assert not (tmp_path / "bag").exists()


@pytest.mark.parametrize(
    ("raised", "code"),
    [
        (ValueError("so it is"), 2),
        (OSError(28, "No space left"), 2),
        (MemoryError(), 2),
        (KeyboardInterrupt(), 130),
    ],
)
def test_expected_failures_have_exit_codes(
    raised: BaseException, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(options: argparse.Namespace) -> int:
        raise raised

    assert program("tool", None, lambda parser: None, run)([]) == code
    assert capsys.readouterr().err.strip().startswith("tool: ")


@pytest.mark.parametrize(("factor", "code"), [(1.0, 0), (-1.0, 2)])
def test_a_bag_is_checked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], factor: float, code: int
) -> None:
    time = np.arange(1000) * 1e-3
    displacement, force = 5e-3 * np.sin(20.0 * time), factor * 900.0 * np.cos(20.0 * time)
    run = mr.Recording("run", 0, 1e-3, displacement, force, np.ones(time.size))
    bag = tmp_path / "bag"
    mr.write_bag(bag, run)
    assert check.main([str(bag)]) == code
    assert ("No fault found" in capsys.readouterr().out) == (code == 0)


@pytest.mark.parametrize("tool", [check, watch])
def test_without_ros_a_program_that_needs_it_says_so(
    tool: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in [name for name in sys.modules if name.startswith("mr_damper_ros.nodes.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "rclpy", None)
    assert tool.main([]) == 2
    # The first failed import is named; which one it is depends on the installation.
    assert "it needs ROS 2, but Python does not find " in capsys.readouterr().err


@pytest.fixture(scope="module")
def laboratory() -> Path:
    folder = os.environ.get("MR_DAMPER_DATA")
    if not folder:
        pytest.skip("MR_DAMPER_DATA does not name the folder of the recordings")
    return Path(folder) / "utfsm"


@pytest.mark.parametrize(
    "columns",
    [
        "-,time:datetime,force:980.665*N,displacement:10*mm",
        "time:0.005*s,-,force:980.665*N,displacement:10*mm",
    ],
    ids=["pauses are seen", "rests are seen"],
)
@pytest.mark.parametrize(("name", "amplitude"), [("ME25mm0x25Hz", 24.8e-3), ("ME2mm5Hz", 1.65e-3)])
def test_raw_records_come_apart_into_their_five_runs(
    laboratory: Path, name: str, amplitude: float, columns: str
) -> None:
    path = laboratory / "raw" / f"{name}.txt"
    currents = (0.0, 0.25, 0.5, 0.75, 1.0)
    runs = read_runs(path, columns, currents=currents)
    assert [run.current[0] for run in runs] == list(currents)
    assert {run.period for run in runs} == {0.005}
    reached = [np.ptp(run.displacement) / 2.0 for run in runs]
    # Relative: the machine repeats its stroke, and the limits here have three digits.
    assert reached == pytest.approx([amplitude] * 5, rel=0.01)
    assert np.all(np.diff([np.ptp(run.force) for run in runs]) > 0.0)
