"""No number of a text file is read as another one: decimal marks and thousands separators."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mr_damper_ros.io.columns import RecordError
from mr_damper_ros.io.records import read_record
from mr_damper_ros.signals.recording import Recording

COLUMNS = "time:s,displacement:mm,force:N"

TIME = np.arange(400) * 0.005

Writer = Callable[[float], str]


def motion(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Displacement [mm] and force [N], whose peak exceeds 1000 N at a few samples only."""
    chance = np.random.default_rng(seed)
    angle = 2.0 * np.pi * 1.7 * TIME + chance.uniform(0.0, 6.0)
    force = chance.uniform(1001.0, 1400.0) * np.cos(angle) + chance.normal(0.0, 2.0, TIME.size)
    return chance.uniform(3.0, 12.0) * np.sin(angle), force


def written(path: Path, separator: str, writers: tuple[Writer, Writer, Writer], seed: int) -> Path:
    displacement, force = motion(seed)
    rows = zip(TIME, displacement, force, strict=True)
    lines = [
        separator.join(write(x) for write, x in zip(writers, row, strict=True)) for row in rows
    ]
    path.write_text("\n".join(["t", *lines, ""]), encoding="utf-8")
    return path


def read(path: Path, **options: str) -> Recording:
    return read_record(path, COLUMNS, current=0.5, **options)  # type: ignore[arg-type]


def assert_is_the_motion(run: Recording, seed: int, decimals: int) -> None:
    displacement, force = motion(seed)
    np.testing.assert_allclose(run.displacement, 1e-3 * displacement, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(run.force, force, rtol=0.0, atol=0.5 * 10.0**-decimals + 1e-9)


def marked(form: str, decimal: str = ".", thousands: str = "") -> Writer:
    """A writer of numbers, such as 1.234,50 for ",.2f"."""
    swap = str.maketrans({".": decimal, ",": thousands})
    return lambda value: format(value, form).translate(swap)


def quoted(write: Writer) -> Writer:
    return lambda value: f'"{write(value)}"'


POINT, COMMA = marked(".4f"), marked(".4f", ",")

READABLE = {
    "english, whole numbers": ("\t", (POINT, POINT, marked(",.0f", ".", ",")), 0),
    "english, semicolons": (";", (POINT, POINT, marked(",.1f", ".", ",")), 1),
    "english, three decimals": ("\t", (POINT, POINT, marked(",.3f", ".", ",")), 3),
    "english in quotes": (",", (quoted(POINT), quoted(POINT), quoted(marked(",.2f", ".", ","))), 2),
    "german": (";", (COMMA, COMMA, marked(",.1f", ",", ".")), 1),
    "german, whole numbers": ("\t", (COMMA, COMMA, marked(",.0f", ",", ".")), 0),
    "german in quotes": (",", (quoted(COMMA), quoted(COMMA), quoted(marked(".2f", ","))), 2),
    "french": (";", (COMMA, COMMA, marked(",.2f", ",", "\u202f")), 2),
    "no-break spaces": ("\t", (COMMA, COMMA, marked(",.0f", ",", "\u00a0")), 0),
    "spaces in a tab-separated file": ("\t", (POINT, POINT, marked(",.0f", ".", " ")), 0),
    "swiss": (";", (POINT, POINT, marked(",.2f", ".", "'")), 2),
}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", READABLE)
def test_thousands_are_read_as_thousands(tmp_path: Path, kind: str, seed: int) -> None:
    separator, writers, decimals = READABLE[kind]
    run = read(written(tmp_path / "run.txt", separator, writers, seed))
    assert_is_the_motion(run, seed, decimals)


def test_it_is_said_that_a_mark_separates_thousands(tmp_path: Path) -> None:
    separator, writers, _ = READABLE["english, whole numbers"]
    note = read(written(tmp_path / "run.txt", separator, writers, 0)).details["note"]
    assert "commas in run.txt are thousands separators" in note


MILLISECONDS = marked(".0f")

AMBIGUOUS = {
    "whole numbers only": (
        "\t",
        (lambda t: MILLISECONDS(1e3 * t), marked(".0f"), marked(",.0f", ".", ",")),
        "with a comma as thousands separator",
    ),
    "points in whole numbers only": (
        ";",
        (lambda t: MILLISECONDS(1e3 * t), marked(".0f"), marked(",.0f", ",", ".")),
        "with a point as thousands separator",
    ),
    "two decimal marks": ("\t", (POINT, POINT, marked(".1f", ",")), "the same decimal mark"),
    "thousands between commas": (
        ",",
        (POINT, POINT, marked(",.0f", ".", ",")),
        "is a comma or a space in it a thousands separator",
    ),
    "thousands between spaces": (
        " ",
        (POINT, POINT, marked(",.0f", ".", " ")),
        "is a comma or a space in it a thousands separator",
    ),
}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", AMBIGUOUS)
def test_what_may_be_two_numbers_is_refused(tmp_path: Path, kind: str, seed: int) -> None:
    separator, writers, sentence = AMBIGUOUS[kind]
    path = written(tmp_path / "run.txt", separator, writers, seed)
    with pytest.raises(RecordError) as caught:
        read(path)
    assert sentence in str(caught.value)
    assert "thousands separators" in str(caught.value)


@pytest.mark.parametrize(("mark", "factor"), [(".", 1.0), (",", 1e-3)])
def test_a_stated_decimal_mark_decides(tmp_path: Path, mark: str, factor: float) -> None:
    rows = [f"{k}\t{10 * np.sin(k / 8):.0f}\t{1000 + k:,d}" for k in range(400)]
    path = tmp_path / "run.txt"
    path.write_text("\n".join([*rows, ""]), encoding="utf-8")
    run = read_record(path, "time:ms,displacement:mm,force:N", current=0.5, decimal_mark=mark)
    np.testing.assert_allclose(run.force, factor * (1000.0 + np.arange(400)), rtol=1e-12)


@pytest.mark.parametrize("cell", ["1,0190", "1_019", "1,01", "1.0.1", "12 34", "0x10", "1d3"])
def test_a_cell_of_another_form_is_named(tmp_path: Path, cell: str) -> None:
    displacement, force = motion(0)
    rows = [f"{t:.3f}\t{u:.4f}\t{f:.2f}" for t, u, f in zip(TIME, displacement, force, strict=True)]
    rows[200] = f"{TIME[200]:.3f}\t1.0\t{cell}"
    path = tmp_path / "run.txt"
    path.write_text("\n".join([*rows, ""]), encoding="utf-8")
    with pytest.raises(RecordError, match=r"run\.txt"):
        read(path)


def test_one_thousands_separator_far_below_the_first_rows_is_seen(tmp_path: Path) -> None:
    rows = [
        f"{k / 1000:.3f}\t{5 * np.sin(k / 50):.4f}\t{900 * np.cos(k / 50):.0f}"
        for k in range(60_000)
    ]
    rows[50_000] = "50.000\t1.0000\t1,019"
    path = tmp_path / "run.txt"
    path.write_text("\n".join([*rows, ""]), encoding="utf-8")
    assert read(path).force[50_000] == 1019.0


@pytest.mark.parametrize("digits", [3, 6, 9])
@pytest.mark.parametrize("decimal", [".", ","])
def test_plain_numbers_of_any_length_are_read(tmp_path: Path, digits: int, decimal: str) -> None:
    write = marked(f".{digits}g", decimal)
    path = written(tmp_path / "run.txt", ";", (POINT if decimal == "." else COMMA, write, write), 1)
    force = motion(1)[1]
    np.testing.assert_allclose(read(path).force, force, rtol=10.0 ** (1 - digits), atol=1e-9)
