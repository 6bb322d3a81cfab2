"""Exports of test machines as they are: `mr-damper import FILE` proposes a command that works.

The inputs are made here in the layouts of the makers; test/README.md lists where they were seen.
"""

import shlex
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.tools import import_

RATE = 100.0
TIME = np.arange(400) / RATE
STROKE = 8.0 * np.sin(2.0 * np.pi * 1.5 * TIME + 0.4)
"""[mm]"""
FORCE = 700.0 * np.tanh(3.0 * np.cos(2.0 * np.pi * 1.5 * TIME + 0.4))
"""[N]"""


def rows(
    *columns: Sequence[float] | np.ndarray,
    separator: str = ",",
    form: str = ".6f",
    decimal: str = ".",
    quote: str = "",
) -> list[str]:
    return [
        separator.join(f"{quote}{value:{form}}{quote}".replace(".", decimal) for value in row)
        for row in zip(*columns, strict=True)
    ]


def bluehill() -> list[str]:
    head = ['Text Inputs : Specimen label,"22L.3"', "General : Start Date,13/11/2018 5:14 PM", ""]
    head += ["Time,Extension,Load,Segment ID,Total Cycle Count", "(sec),(mm),(N),,"]
    data = zip(rows(TIME, STROKE, FORCE), np.arange(400) // 67, strict=True)
    return head + [f"{row},{22476 - cycle},{cycle}" for row, cycle in data]


def bluehill_quoted() -> list[str]:
    head = ['Specimen properties : Specimen label,"run 1"', 'Maximum Load : Load,"131.1",lbf', ""]
    data = rows(TIME, STROKE / 25.4, FORCE / 4.4482216152605, quote='"', form=".8f")
    return [*head, "Time,Extension,Load", "(s),(in),(lbf)", *data]


def bluehill_one_row_of_headings() -> list[str]:
    return [
        "Time (s),Displacement (mm),Force (kN),AVE2 (%)",
        *rows(TIME, STROKE, FORCE / 1e3, TIME),
    ]


def wavematrix() -> list[str]:
    head = (
        'Total Time (s),Cycle Elapsed Time (s),Total Cycles,"Position(8800 (0,1):Position) (mm)",'
        '"Load(8800 (0,1):Load) (kN)","Strain(8800 (0,1):Axial Strain) (%)",width,thickness'
    )
    data = rows(TIME, TIME % 0.7, TIME // 0.7, STROKE, FORCE / 1e3, STROKE / 50.0)
    return [head, data[0] + ",13,5", *(row + ",," for row in data[1:])]


def zwick() -> list[str]:
    head = ['"Epaisseur",1,"mm"', '"Date/heure",43173.4,""', '"Capteur de force",""']
    head += ['"Temps","Traverse absolue","Force standard","Course standard"', '"s","mm","N","mm"']
    return head + rows(TIME, STROKE - 794.0, FORCE, STROKE)


def zwick_german() -> list[str]:
    head = [
        "Probe;AWA_3",
        "Prüfer;N. N.",
        "Prüfzeit;Standardkraft;Traversenweg absolut;Standardweg",
    ]
    data = rows(TIME, FORCE, STROKE + 300.0, STROKE, separator=";", decimal=",")
    return [*head, "s;N;mm;mm", *data]


def mpt() -> list[str]:
    lines = ["MTS***|MPT|**|*|*|*|*|*|*|*|*|*", ""]
    for block in range(4):
        part = slice(100 * block, 100 * block + 100)
        lines += [
            f"Adquisición cíclica\t\t\tTiempo\t{20.0 + block:f}\tSec\t13/12/2021 10:22:42".replace(
                ".", ","
            ),
            f"Parado en: \t{100 * block}\tcycle\t\t\tParado para: \t1\tcycles",
            "Puntos: \t100",
            "Tiempo\tChannel 1 Displacement\tChannel 1 Force\tChannel 1 Recuento",
            "Sec\tmm\tkgf\tcycles",
        ]
        values = TIME[part] + 9.0 * block, STROKE[part], FORCE[part] / 9.80665, TIME[part] // 0.7
        lines += [*rows(*values, separator="\t", decimal=","), ""]
    return lines


def trapezium() -> list[str]:
    data = rows(TIME, FORCE, STROKE, quote='"')
    return ['"C35",,', '"Temps","Force","Stroke"', '"sec","N","mm"', *data]


LVM_HEAD = ["LabVIEW Measurement\t", "Writer_Version\t2", "Separator\tTab", "Decimal_Separator\t{}"]


def lvm_with_period() -> list[str]:
    head = [*LVM_HEAD, "X_Columns\tNo", "***End_of_Header***\t", "\t", "Channels\t2\t\t"]
    head += ["Samples\t400\t400\t", "Date\t2024/05/02\t2024/05/02\t"]
    head += ["Y_Unit_Label\tNewtons\tmm\t", "X_Dimension\tTime\tTime\t"]
    head += ["X0\t0,0000000000000000E+0\t0,0000000000000000E+0\t", "Delta_X\t0,010000\t0,010000\t"]
    head += ["***End_of_Header***\t\t\t", "X_Value\tLoad\tStroke\tComment"]
    return head + ["\t" + row for row in rows(FORCE, STROKE, separator="\t", decimal=",")]


def lvm_with_time() -> list[str]:
    head = [*LVM_HEAD, "X_Columns\tOne", "***End_of_Header***\t", "", "Channels\t2\t\t"]
    head += ["Samples\t1\t1\t", "Y_Unit_Label\tmm\tkN\t", "Delta_X\t1.000000\t1.000000\t"]
    head += ["***End_of_Header***\t\t\t", "X_Value\tStroke (mm)\tLoad (kN)\tComment"]
    data = rows(TIME, STROKE, FORCE / 1e3, separator="\t")
    return [*head, data[0] + "\tstart", *data[1:200], data[200] + "\tOK", *data[201:]]


def walter_bai() -> list[str]:
    head = "S/No;C_1_Temps[s];C_1_Force[kN];C_1_Déform1[mm];C_1_Déplacement[mm];"
    data = rows(TIME, FORCE / 1e3, 0.1 * STROKE, STROKE, separator=";", form=".9f")
    return [head, *(f"{k};{row};" for k, row in enumerate(data, start=1))]


def dyno_in_volts() -> list[str]:
    head = "Timestamp,Force (V),Force (N),Displacement (V),Displacement (mm),Temperature (C)"
    data = rows(FORCE / 200.0, FORCE, STROKE / 10.0, STROKE, 25.0 + TIME)
    return [head, *(f"2025-11-14 19:25:{t:09.6f},{row}" for t, row in zip(TIME, data, strict=True))]


def units_below_headings_of_several_words() -> list[str]:
    head = ["Data Header: creep", "Data Acquisition: Timed", "Station Name: one.cfg"]
    head += ["Time      Axial Force Axial Displacement", "s         N         mm"]
    return head + rows(TIME, FORCE, STROKE, separator="    ")


READ: dict[str, tuple[Callable[[], list[str]], str]] = {
    "Instron Bluehill": (bluehill, "run.csv"),
    "Instron Bluehill, quoted": (bluehill_quoted, "run.csv"),
    "Instron Bluehill, one row": (bluehill_one_row_of_headings, "run.csv"),
    "Instron WaveMatrix": (wavematrix, "run.csv"),
    "Zwick testXpert": (zwick, "run.TRA"),
    "Zwick testXpert, German": (zwick_german, "run.csv"),
    "Shimadzu TRAPEZIUM": (trapezium, "run.csv"),
    "LabVIEW, period": (lvm_with_period, "run.lvm"),
    "LabVIEW, time": (lvm_with_time, "run.lvm"),
    "walter+bai": (walter_bai, "run.csv"),
    "damper dyno": (dyno_in_volts, "run.csv"),
    "MTS 793": (units_below_headings_of_several_words, "run.dat"),
}


def saved(folder: Path, lines: list[str], name: str, encoding: str = "utf-8") -> Path:
    path = folder / name
    path.write_text("\r\n".join([*lines, ""]), encoding=encoding, newline="")
    return path


def proposed(path: Path, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """The arguments of the proposed command."""
    assert import_.main([str(path)]) == 0
    shown = capsys.readouterr().out
    line = next(text for text in shown.splitlines() if text.startswith("  mr-damper import"))
    return shlex.split(line)[2:]


@pytest.mark.parametrize("encoding", ["utf-8-sig", "latin-1"])
@pytest.mark.parametrize("kind", READ)
def test_the_proposed_command_reads_the_export(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    kind: str,
    encoding: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    lines, name = READ[kind]
    path = saved(tmp_path, lines(), name, encoding)
    assert import_.main(proposed(path, capsys)) == 0
    (run,) = read_bag(tmp_path / "bags" / "run")
    assert run.period == pytest.approx(1.0 / RATE, rel=1e-6)
    # [m], [N]: six decimals of a millimetre, of an inch and of a kilonewton are written.
    np.testing.assert_allclose(run.displacement, 1e-3 * STROKE, rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(run.force, FORCE, rtol=0.0, atol=1e-3)
    assert "note" not in run.details


def test_blocks_with_repeated_headings_are_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    command = proposed(saved(tmp_path, mpt(), "run.dat"), capsys)
    assert "--split" in command
    assert import_.main(command) == 0
    for number in range(4):
        (run,) = read_bag(tmp_path / "bags" / "run" / f"run_{number + 1}")
        part = slice(100 * number, 100 * number + 100)
        np.testing.assert_allclose(run.force, FORCE[part], rtol=0.0, atol=1e-4)


def side_by_side() -> list[str]:
    head = ["Brut 1,,,Brut 2,,", "Temps,Force,Course_Traverse,Temps,Force,Course_Traverse"]
    data = rows(TIME, FORCE, STROKE, TIME, 0.5 * FORCE, STROKE)
    return [*head, "sec,N,mm,sec,N,mm", *data]


def without_time() -> list[str]:
    index = [float(k) for k in range(1, 401)]
    return ["Index,Force [ kN ],Déplacement [ mm ]", *rows(index, FORCE / 1e3, STROKE)]


def peaks() -> list[str]:
    head = [f'"{name}(8800 (0,1):{name}):Maximum' for name in ("Position", "Load")]
    head = ["Total Cycles", f'{head[0]} (mm)"', f'{head[1]} (kN)"']
    return [",".join(head), *rows(100.0 * TIME + 1.0, STROKE, FORCE)]


def without_units() -> list[str]:
    return ["Machine_Time,Machine_Displacement,Machine_Load", *rows(TIME, STROKE, FORCE)]


def in_volts() -> list[str]:
    return ["Time (s),Displacement (V),Force (V)", *rows(TIME, STROKE, FORCE)]


def bare() -> list[str]:
    return rows(TIME, STROKE, FORCE)


def mixed_marks() -> list[str]:
    data = rows(TIME, STROKE, FORCE, separator=";", decimal=",")
    data[300:] = [row.replace("-5,", "2,110,") for row in data[300:]]
    return ["Time;Displacement;Force", "(s);(mm);(kN)", *data]


REFUSED: dict[str, tuple[Callable[[], list[str]], str]] = {
    "two specimens": (side_by_side, "holds 2 sets of columns with the same headings side by side"),
    "no time": (without_time, "does not state the time between samples: give it (--period)"),
    "peaks": (peaks, "no heading names the displacement"),
    "no units": (without_units, "states no known unit of the force (column 3 'Machine_Load')"),
    "volts": (in_volts, "states no known unit of the displacement (column 2 'Displacement (V)')"),
    "no headings": (bare, "no heading names the force"),
    "mixed marks": (mixed_marks, "write the numbers without thousands separators"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_a_file_does_not_say_is_not_guessed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    lines, sentence = REFUSED[kind]
    assert import_.main([str(saved(tmp_path, lines(), "run.csv"))]) == 2
    said = capsys.readouterr()
    assert sentence in said.err
    assert said.err.count("\n") == 1
    assert "column  heading" in said.out


def test_a_force_of_the_other_sign_is_reversed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    head = 'Time (s),Stroke (mm),"Load(8800 (0,1):Load) (kN)"'
    path = saved(tmp_path, [head, *rows(TIME, STROKE, -FORCE / 1e3)], "run.csv")
    command = proposed(path, capsys)
    assert command[2].endswith('force="Load(8800 (0,1):Load) (kN)":-1*kN')
    assert import_.main(command) == 0
    (run,) = read_bag(tmp_path / "bags" / "run")
    np.testing.assert_allclose(run.force, FORCE, rtol=0.0, atol=1e-3)


def test_findings_on_the_data_are_shown_and_accepted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    data = rows(TIME, 0.003 * STROKE, FORCE, form=".8f")
    path = saved(tmp_path, ["Time (s),Stroke (mm),Load (N)", *data], "run.csv")
    assert import_.main([str(path)]) == 0
    shown = capsys.readouterr().out
    assert "the check of the data finds: the displacement spans only" in shown
    line = next(text for text in shown.splitlines() if text.startswith("  mr-damper import"))
    assert "--accept-doubtful" in line
    assert import_.main(shlex.split(line)[2:]) == 0


def test_a_column_of_the_current_is_proposed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = rows(TIME, STROKE, FORCE, 0.5 + 0.0 * TIME)
    path = saved(tmp_path, ["Time (s),Stroke (mm),Load (N),Coil current (A)", *data], "run.csv")
    command = proposed(path, capsys)
    assert "--current" not in command
    assert "current=Coil current (A):A" in command[command.index("--columns") + 1]


def test_a_given_period_goes_into_the_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = saved(tmp_path, without_time(), "run.csv")
    assert import_.main([str(path), "--period", "0.01", "--current", "0.5"]) == 0
    shown = capsys.readouterr().out
    line = next(text for text in shown.splitlines() if text.startswith("  mr-damper import"))
    assert "replace the 0 of --current" not in shown
    assert import_.main(shlex.split(line)[2:]) == 0
    (run,) = read_bag(tmp_path / "bags" / "run")
    assert run.current[0] == 0.5
    np.testing.assert_allclose(run.force, FORCE, rtol=0.0, atol=1e-3)


@pytest.mark.skipif(find_spec("openpyxl") is None, reason="openpyxl is missing")
def test_a_sheet_is_described_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from openpyxl import Workbook

    monkeypatch.chdir(tmp_path)
    book = Workbook()
    for row in (["Zeit", "Weg", "Kraft"], ["s", "mm", "N"]):
        book.active.append(row)
    for numbers in zip(TIME.tolist(), STROKE.tolist(), FORCE.tolist(), strict=True):
        book.active.append(numbers)
    path = tmp_path / "run.xlsx"
    book.save(path)
    assert import_.main(proposed(path, capsys)) == 0
    (run,) = read_bag(tmp_path / "bags" / "run")
    np.testing.assert_allclose(run.force, FORCE, rtol=1e-12)


def test_a_file_of_matrices_is_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "run.mat"
    savemat(path, {"data": np.ones((40, 3))})
    assert import_.main([str(path)]) == 2
    assert "is a MAT file and holds data (40 x 3): describe its columns" in capsys.readouterr().err


@pytest.mark.parametrize(
    "given",
    [
        ["--split"],
        ["--from", "1"],
        ["--columns", "time:s,displacement:mm,force:N"],
        ["--output", "x"],
    ],
)
def test_half_a_command_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], given: list[str]
) -> None:
    assert import_.main([str(saved(tmp_path, bluehill(), "run.csv")), *given]) == 2
    assert "give both the columns (--columns) and the bag (--output)" in capsys.readouterr().err
