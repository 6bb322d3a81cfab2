"""Where the samples of a text file begin and end: headers, blocks, summaries, incomplete rows."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mr_damper_ros.io.columns import ColumnError, RecordError, parse_columns
from mr_damper_ros.io.records import read_record, read_runs

COLUMNS = "time:s,displacement:mm,force:N"
UNTIMED = "displacement:mm,force:N"

TIME = np.arange(200) * 0.01
STROKE = 5.0 * np.sin(9.0 * TIME + 0.3)
FORCE = 700.0 * np.cos(9.0 * TIME + 0.3)


def rows(first: int = 0, last: int = 200, start: float = 0.0) -> list[str]:
    part = slice(first, last)
    values = zip(TIME[part] + start, STROKE[part], FORCE[part], strict=True)
    return [",".join(f"{value:.4f}" for value in row) for row in values]


def untimed(first: int = 0, last: int = 200) -> list[str]:
    return [row.split(",", 1)[1] for row in rows(first, last)]


def saved(tmp_path: Path, lines: list[str], end: str = "\n") -> Path:
    path = tmp_path / "run.csv"
    path.write_text("\n".join(lines) + end, encoding="utf-8")
    return path


def note_of(path: Path, columns: str = COLUMNS, samples: int = 200, **options: Any) -> str:
    """The note of a record whose samples are all right."""
    run = read_record(path, columns, **{"current": 0.5, **options})
    assert run.sample_count == samples
    np.testing.assert_allclose(run.force, FORCE[:samples], rtol=0.0, atol=1e-4)
    np.testing.assert_allclose(run.displacement, 1e-3 * STROKE[:samples], rtol=0.0, atol=1e-7)
    return run.details.get("note", "")


def refused(path: Path, columns: str = COLUMNS, **options: Any) -> str:
    with pytest.raises(RecordError) as caught:
        read_record(path, columns, **{"current": 0.5, **options})
    assert "\n" not in str(caught.value)
    return str(caught.value)


# -- the start of the table ------------------------------------------------------------------------


def test_rows_of_a_header_with_numbers_are_no_samples(tmp_path: Path) -> None:
    head = ["Stroke,Load", "Channels,2", "Samples,200,200", "Date,2024/05/02", "Delta_X,0.01,0.01"]
    lines = [*head, "X_Value,Stroke,Load", *(f",{row}" for row in untimed())]
    assert note_of(saved(tmp_path, lines), f"-,{UNTIMED}", period=0.01) == ""


@pytest.mark.parametrize("row", ["1,2", "0.5,10", "7,8"])
def test_a_row_of_channel_numbers_or_factors_is_left_out(tmp_path: Path, row: str) -> None:
    path = saved(tmp_path, ["Stroke,Load", row, *untimed()])
    note = note_of(path, UNTIMED, period=0.01)
    assert f"line 2 of run.csv ('{row.replace(',', '; ')}') has another form" in note


def test_numbers_of_varying_length_are_samples_from_the_first_row_on(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    table = np.column_stack((TIME, np.round(STROKE, 3), np.round(FORCE, 1)))
    table[0] = 0.0, 1.0, 2.0
    np.savetxt(path, table, fmt="%g", delimiter=",")
    assert read_record(path, COLUMNS, current=0.5).sample_count == 200


def test_whole_numbers_are_samples_from_the_first_row_on(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    table = np.column_stack((np.arange(1, 201), np.round(1e3 * STROKE), np.round(FORCE)))
    np.savetxt(path, table, fmt="%d", delimiter=",")
    run = read_record(path, "time:ms,displacement:um,force:N", current=0.5)
    assert run.sample_count == 200


# -- between and below the samples -----------------------------------------------------------------

HEAD = ["Time,Stroke,Load", "s,mm,N"]


def test_blocks_with_repeated_headings_are_runs(tmp_path: Path) -> None:
    lines = [line for k in range(3) for line in ("", f"Block {k}", *HEAD, *rows(0, 150, 10.0 * k))]
    path = saved(tmp_path, lines)
    runs = read_runs(path, COLUMNS, currents=0.5)
    assert [run.sample_count for run in runs] == [150, 150, 150]
    assert "--split" in refused(path)


def test_cycles_whose_time_goes_on_stay_together(tmp_path: Path) -> None:
    lines = [*HEAD, *rows(0, 70), "", "Cycle 2", *HEAD, *rows(70, 140), *HEAD, *rows(140)]
    assert note_of(saved(tmp_path, lines)) == ""


def test_blocks_without_a_time_are_runs(tmp_path: Path) -> None:
    lines = [line for _ in range(2) for line in ("Stroke,Load", "mm,N", *untimed(0, 150))]
    path = saved(tmp_path, lines)
    assert "run.csv holds 2 blocks of samples, the second from line 155 on" in refused(
        path, UNTIMED, period=0.01
    )
    runs = read_runs(path, UNTIMED, currents=0.5, period=0.01)
    assert [run.sample_count for run in runs] == [150, 150]


def lvm_segment(first: int, last: int, period: str) -> list[str]:
    head = ["Channels\t2", f"Samples\t{last - first}\t{last - first}", "X0\t0.0\t0.0"]
    head += [f"Delta_X\t{period}\t{period}", "***End_of_Header***", "X_Value\tStroke\tLoad"]
    return [*head, *("\t" + row.replace(",", "\t") for row in untimed(first, last)), ""]


def test_segments_of_a_labview_file_are_runs(tmp_path: Path) -> None:
    head = ["LabVIEW Measurement", "***End_of_Header***"]
    segments = lvm_segment(0, 150, "0.01"), lvm_segment(0, 150, "0.01")
    path = saved(tmp_path, [*head, *segments[0], *segments[1]])
    columns = f"-,{UNTIMED}"
    assert "holds 2 blocks of samples" in refused(path, columns)
    runs = read_runs(path, columns, currents=0.5)
    assert [run.sample_count for run in runs] == [150, 150]
    np.testing.assert_allclose(runs[1].force, FORCE[:150], rtol=0.0, atol=1e-4)
    other = saved(tmp_path, [*head, *segments[0], *lvm_segment(0, 150, "0.02")])
    assert "('Delta_X; 0.02; 0.02') differs from the one above" in refused(other, columns)


@pytest.mark.parametrize(
    "summary",
    [
        ["", "Maximum,5.0,700", "Minimum,-5.0,-700"],
        ["End of test"],
        ["", "Cycle,Peak (mm),Peak (N)", "1,5.0,700", "2,5.0,699"],
    ],
)
def test_a_summary_below_the_samples_is_left_out(tmp_path: Path, summary: list[str]) -> None:
    note = note_of(saved(tmp_path, [*HEAD, *rows(), *summary]))
    assert "the lines of run.csv from 20" in note
    assert "hold no samples and were left out" in note


def test_a_second_table_is_refused(tmp_path: Path) -> None:
    lines = [*HEAD, *rows(), "Time,Load,Stroke", "s,N,mm", *rows()]
    sentence = refused(saved(tmp_path, lines))
    assert "run.csv holds a second table from line 203 on ('Time; Load; Stroke')" in sentence


def test_units_that_change_between_blocks_are_refused(tmp_path: Path) -> None:
    lines = [*HEAD, *rows(), HEAD[0], "s,mm,kN", *rows(start=10.0)]
    assert "second table from line 203 on" in refused(saved(tmp_path, lines))


@pytest.mark.parametrize("line", [3, 8, 100])
@pytest.mark.parametrize("text", ["0.5000,oops,1.0000", "0.5000,,1.0000", "0.5000,1.0000"])
def test_a_broken_row_between_samples_is_refused(tmp_path: Path, line: int, text: str) -> None:
    lines = rows()
    lines[line - 1] = text
    assert f"line {line} of run.csv" in refused(saved(tmp_path, lines))


# -- the end of the file ---------------------------------------------------------------------------


@pytest.mark.parametrize("cut", [1, 3, 6, 9, 14])
@pytest.mark.parametrize("form", ["%.4f", "%.6g", "%.5e"])
def test_a_cut_file_says_that_its_last_row_is_left_out(tmp_path: Path, cut: int, form: str) -> None:
    path = tmp_path / "run.csv"
    np.savetxt(path, np.column_stack((TIME, STROKE, FORCE)), fmt=form, delimiter=",")
    text = path.read_text(encoding="utf-8")
    path.write_text(text[: -cut - 1], encoding="utf-8")
    run = read_record(path, COLUMNS, current=0.5)
    assert run.sample_count == 199
    np.testing.assert_allclose(run.force, FORCE[:199], rtol=1e-5, atol=1e-4)
    assert "line 200" in run.details["note"]
    assert "the file is cut" in run.details["note"]


@pytest.mark.parametrize("cut", [1, 2])
def test_a_whole_number_may_be_cut_too(tmp_path: Path, cut: int) -> None:
    pairs = zip(rows(), FORCE, strict=True)
    lines = [f"{row.rpartition(',')[0]},{force:.0f}" for row, force in pairs]
    path = saved(tmp_path, lines, end="")
    path.write_text(path.read_text(encoding="utf-8")[:-cut], encoding="utf-8")
    assert read_record(path, COLUMNS, current=0.5).sample_count == 199


def test_a_whole_last_row_needs_no_line_break(tmp_path: Path) -> None:
    assert note_of(saved(tmp_path, [*HEAD, *rows()], end="")) == ""


def test_a_column_below_which_others_follow_is_not_cut(tmp_path: Path) -> None:
    lines = [f"{row},{k // 7}" for k, row in enumerate(rows())]
    assert note_of(saved(tmp_path, lines, end=""), f"{COLUMNS},-") == ""


@pytest.mark.parametrize("segments", [1, 4])
def test_short_steps_at_the_ends_of_segments_are_interpolated(
    tmp_path: Path, segments: int
) -> None:
    ends = np.linspace(0.0, 10.0, segments + 1)[1:] + 0.0037
    time = np.union1d(np.arange(1001) * 0.01, ends)
    path = tmp_path / "run.csv"
    table = np.column_stack((time, 5.0 * np.sin(4.0 * time), 700.0 * np.cos(4.0 * time)))
    np.savetxt(path, table, fmt="%.5f", delimiter=",")
    run = read_record(path, COLUMNS, current=0.5)
    uniform = np.arange(run.sample_count) * 0.01
    assert run.period == pytest.approx(0.01, rel=1e-6)
    # [N]: linear interpolation over 10 ms at 4 rad/s.
    np.testing.assert_allclose(run.force, 700.0 * np.cos(4.0 * uniform), rtol=0.0, atol=0.2)
    assert "the samples were interpolated to uniform times" in run.details["note"]


# -- headings --------------------------------------------------------------------------------------


def test_a_heading_may_hold_a_comma_in_quotes(tmp_path: Path) -> None:
    head = '"Total Time (s)","Position(8800 (0,1):Position) (mm)","Load(8800 (0,1):Load) (N)"'
    columns = (
        'time=Total Time (s):s,displacement="Position(8800 (0,1):Position) (mm)":mm,'
        'force="Load(8800 (0,1):Load) (N)":N'
    )
    assert note_of(saved(tmp_path, [head, *rows()]), columns) == ""


@pytest.mark.parametrize(
    ("entry", "header"),
    [
        ('force="a,b":N', "a,b"),
        ("force=a=b:N", "a=b"),
        ("force=a:b:N", "a:b"),
        ('force="a:b=c,d":N', "a:b=c,d"),
        ('force=5" cell:N', '5" cell'),
    ],
)
def test_headings_with_the_marks_of_a_description(entry: str, header: str) -> None:
    columns = parse_columns(f"displacement=x:mm,{entry}")
    assert [column.header for column in columns.wanted] == ["x", header]


def test_a_comma_that_ends_an_entry_is_explained() -> None:
    with pytest.raises(ColumnError, match="a comma ends an entry, unless it stands in double"):
        parse_columns("displacement=x:mm,force=Load (0,1):N")


def test_the_same_heading_above_several_columns_is_refused(tmp_path: Path) -> None:
    lines = ["Time,Stroke,Load,Time,Stroke,Load", *(f"{row},{row}" for row in rows())]
    path = saved(tmp_path, lines)
    sentence = refused(path, "time=Time:s,displacement=Stroke:mm,force=Load:N")
    assert (
        "has the heading 'Time' 2 times (columns 1, 4): select the columns by position" in sentence
    )
    note = note_of(path, f"{COLUMNS},...")
    assert "columns 4, 5, 6 have the same headings and were not read" in note


@pytest.mark.parametrize(
    ("head", "separator", "sentence"),
    [
        ("Time,Stroke,Load", ",", "3 headings: commas separate the columns"),
        ("Time;Stroke;Load", ";", "3 headings: a column has no heading"),
        ("Time Stroke Load cell No", " ", "5 headings: spaces separate the columns"),
    ],
)
def test_headings_that_do_not_belong_to_the_columns_are_refused(
    tmp_path: Path, head: str, separator: str, sentence: str
) -> None:
    data = [separator.join([f"{k}", *row.split(",")]) for k, row in enumerate(rows())]
    path = saved(tmp_path, [head, *data])
    columns = "time=Time:s,displacement=Stroke:mm,force=Load:N"
    assert sentence in refused(path, columns)
    assert note_of(path, f"-,{COLUMNS}") == ""


def test_a_row_of_several_words_does_not_hinder_columns_by_position(tmp_path: Path) -> None:
    assert note_of(saved(tmp_path, ["Damper 7,0.5 A", *rows()])) == ""


# -- units of the headings -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("head", "columns", "sentence"),
    [
        (["Time (s),Stroke (mm),Load (kN)"], COLUMNS, "'Load (kN)' and has the unit kN"),
        (["Time (s),Stroke (mm),Load [kN]"], COLUMNS, "write force:kN, or, if the heading is"),
        (["t,x,F", "s,mm,kN"], COLUMNS, "write force:kN"),
        (["t,x,F", "[s],[mm],[N]"], "time:ms,displacement:mm,force:N", "write time:s"),
        (["t,x,F", "Sec,inch,lbf"], COLUMNS, "write displacement:in"),
        (["t,x,F", "s,mm,N"], "time:s,displacement:um,force:N", "write displacement:mm"),
        (["t,x,F", "s,N,mm"], COLUMNS, "unit N, but the columns say displacement:mm: describe"),
        (["Time/s,Stroke/mm,Force/daN"], COLUMNS, "write force:10*N"),
        (["Time_s,Stroke_mm,Force_kN"], COLUMNS, "write force:kN"),
        (["t,x,F", "s,mm,kN"], "time=t:s,displacement=x:mm,force=F:N", "write force:kN"),
        (["t,x,F", "s,mm,kN"], "time:s,displacement:mm,force:-1*N", "write force:kN"),
    ],
)
def test_a_unit_that_contradicts_the_heading_is_refused(
    tmp_path: Path, head: list[str], columns: str, sentence: str
) -> None:
    assert sentence in refused(saved(tmp_path, [*head, *rows()]), columns)


@pytest.mark.parametrize(
    ("head", "columns"),
    [
        (["Time (s),Stroke (mm),Load (N)"], COLUMNS),
        (["t,x,F", "s,mm,kN"], "time:s,displacement:mm,force:1*N"),
        (["Time (s),Stroke (V),Load (Missus)"], COLUMNS),
        (["Time (s),Channel A,Load (A)"], COLUMNS),
        (["t,s,F"], COLUMNS),
        (["Time in s,Stroke in mm,Min. load"], COLUMNS),
        (["Time,Stroke,Load", "sec.,Millimeter,Newton"], COLUMNS),
        (["Damper 7", "2024", "-,-,-"], COLUMNS),
    ],
)
def test_units_that_agree_or_cannot_be_read_are_no_contradiction(
    tmp_path: Path, head: list[str], columns: str
) -> None:
    assert note_of(saved(tmp_path, [*head, *rows()]), columns) == ""


@pytest.mark.parametrize("head", ["Time [s],Stroke [mm],Load [N]", "Time,Stroke,Load\ns,mm,N"])
@pytest.mark.parametrize(("period", "right"), [(0.01, True), (0.02, False), (0.001, False)])
def test_a_period_is_compared_with_the_times_that_are_skipped(
    tmp_path: Path, head: str, period: float, right: bool
) -> None:
    lines = [*head.splitlines(), *(f"{k / 100:.2f},{row}" for k, row in enumerate(untimed()))]
    path, columns = saved(tmp_path, lines), f"-,{UNTIMED}"
    if right:
        assert read_record(path, columns, current=0.5, period=period).period == period
    else:
        with pytest.raises(RecordError, match=r"', of run.csv states a sample period of 0.01 s"):
            read_record(path, columns, current=0.5, period=period)


def test_rows_that_end_before_the_skipped_times_say_nothing_of_the_period(tmp_path: Path) -> None:
    rows_of_times = (f"{row},{k / 100:.2f}" for k, row in enumerate(untimed()))
    lines = [row if k != 3 else row.rsplit(",", 1)[0] for k, row in enumerate(rows_of_times)]
    path = saved(tmp_path, ["Stroke [mm],Load [N],Time [s]", *lines])
    assert read_record(path, f"{UNTIMED},-", current=0.5, period=0.01).period == 0.01


def test_another_period_than_the_file_states_is_refused(tmp_path: Path) -> None:
    head = ["LabVIEW Measurement", "Delta_X\t0.01\t0.01", "***End_of_Header***", "X_Value\tS\tL"]
    lines = [*head, *("\t" + row.replace(",", "\t") for row in untimed())]
    path = saved(tmp_path, lines)
    assert read_record(path, f"-,{UNTIMED}", current=0.5).period == 0.01
    with pytest.raises(RecordError, match=r"run.csv states a sample period of 0.01 s, but 0.02 s"):
        read_record(path, f"-,{UNTIMED}", current=0.5, period=0.02)
