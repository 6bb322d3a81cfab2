"""Structures and outputs of Simulink in MAT files are read; everything else is named."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from mr_damper_ros.io.columns import RecordError
from mr_damper_ros.io.records import read_record

TIME = np.arange(200) * 0.01
DISPLACEMENT = 5.0 * np.sin(20.0 * TIME)
FORCE = 900.0 * np.cos(20.0 * TIME)

BY_PLACE = "time:s,displacement:mm,force:N"
BY_NAME = "time=t:s,displacement=disp:mm,force=force:N"

FIELDS = {"t": TIME, "disp": DISPLACEMENT, "force": FORCE}
COLUMN_FIELDS = {name: values[:, None] for name, values in FIELDS.items()}
OTHERS = {"Fs": 1000.0, "name": "damper 7", "gains": np.ones(3)}


def array_of(structures: list[dict[str, Any]]) -> np.ndarray:
    """A structure array."""
    made = np.empty((1, len(structures)), dtype=[(name, object) for name in structures[0]])
    for place, fields in enumerate(structures):
        made[0, place] = tuple(fields.values())
    return made


def assert_is_the_run(path: Path, columns: str, **options: Any) -> None:
    read = read_record(path, columns, current=0.5, **options)
    np.testing.assert_allclose(read.displacement, 1e-3 * DISPLACEMENT, rtol=1e-12)
    np.testing.assert_allclose(read.force, FORCE, rtol=1e-12)


def refused(path: Path, columns: str = BY_PLACE, **options: Any) -> str:
    with pytest.raises(RecordError) as caught:
        read_record(path, columns, current=0.5, **options)
    sentence = str(caught.value)
    assert "\n" not in sentence
    assert "__" not in sentence
    return sentence


def saved(folder: Path, **variables: Any) -> Path:
    savemat(folder / "run.mat", variables)
    return folder / "run.mat"


@pytest.mark.parametrize("fields", [FIELDS, COLUMN_FIELDS])
@pytest.mark.parametrize(
    "columns",
    [BY_PLACE, BY_NAME, "time=data.t:s,displacement=data.disp:mm,force=data.force:N"],
)
def test_a_structure_of_columns_is_read(
    tmp_path: Path, fields: dict[str, Any], columns: str
) -> None:
    assert_is_the_run(saved(tmp_path, data=fields, **OTHERS), columns)


def test_other_fields_must_be_skipped(tmp_path: Path) -> None:
    path = saved(tmp_path, data={**FIELDS, **OTHERS})
    assert "say what column 4 holds" in refused(path)
    assert_is_the_run(path, f"{BY_PLACE},...")
    assert_is_the_run(path, BY_NAME)


def test_nested_structures_are_read_by_their_paths(tmp_path: Path) -> None:
    nested = {"time": TIME, "moved": {"disp": DISPLACEMENT}, "load": {"cell": {"force": FORCE}}}
    path = saved(tmp_path, run=nested)
    names = "time=run.time:s,displacement=run.moved.disp:mm,force=run.load.cell.force:N"
    assert_is_the_run(path, names)


def test_several_structures_are_chosen_between(tmp_path: Path) -> None:
    other = {**FIELDS, "force": 2.0 * FORCE}
    path = saved(tmp_path, runs=array_of([other, FIELDS]))
    assert "2 matrices with the columns t, disp, force: choose one" in refused(path, BY_NAME)
    assert_is_the_run(path, BY_NAME, variable="runs(2)")
    assert_is_the_run(path, BY_PLACE, variable="runs(2)")


def output(signals: Any, **more: Any) -> dict[str, Any]:
    return {"time": TIME[:, None], "signals": signals, "blockName": "model/Scope", **more}


@pytest.mark.parametrize(
    ("signals", "names"),
    [
        ({"values": np.c_[DISPLACEMENT, FORCE], "label": ""}, ("signals(1)(1)", "signals(1)(2)")),
        ({"values": np.c_[DISPLACEMENT, FORCE], "label": "rig"}, ("rig(1)", "rig(2)")),
        (
            array_of(
                [
                    {"values": DISPLACEMENT[:, None], "dimensions": 1, "label": "Stroke"},
                    {"values": FORCE[:, None], "dimensions": 1, "label": "Load"},
                ]
            ),
            ("Stroke", "Load"),
        ),
    ],
)
def test_outputs_of_simulink_are_read(tmp_path: Path, signals: Any, names: tuple[str, str]) -> None:
    path = saved(tmp_path, simout=output(signals))
    assert_is_the_run(path, BY_PLACE)
    assert_is_the_run(path, f"time=time:s,displacement={names[0]}:mm,force={names[1]}:N")
    sentence = refused(path, "time=time:s,displacement=x:mm,force=y:N")
    assert f"simout (a structure of time, {names[0]}, {names[1]})" in sentence


def element(kind: int, content: bytes) -> bytes:
    """An element of a MAT file of version 5."""
    return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)


def with_object(path: Path, name: str, kind: str) -> Path:
    """Add a MATLAB object to a file, as MATLAB 2008 and newer save it."""
    flags = element(6, struct.pack("<II", 17, 0))
    numbers = element(6, struct.pack("<II", 13, 0)) + element(5, struct.pack("<ii", 6, 1))
    numbers += element(1, b"") + element(6, struct.pack("<6I", 0xDD000000, 2, 1, 1, 1, 1))
    texts = b"".join(element(1, text.encode()) for text in (name, "MCOS", kind))
    with path.open("ab") as file:
        file.write(element(14, flags + texts + element(14, numbers)))
    return path


@pytest.mark.parametrize("kind", ["timeseries", "table", "timetable", "Simulink.Timeseries"])
def test_matlab_objects_are_named_with_a_remedy(tmp_path: Path, kind: str) -> None:
    path = with_object(saved(tmp_path, Fs=1000.0, note="x"), "run", kind)
    sentence = refused(path)
    assert f"run (a MATLAB object of class {kind}: save its fields as variables)" in sentence
    assert "Fs (1 x 1), note (a text)" in sentence
    assert kind in refused(path, BY_NAME)


def test_an_object_beside_the_data_hides_nothing(tmp_path: Path) -> None:
    path = with_object(saved(tmp_path, **COLUMN_FIELDS), "settings", "containers.Map")
    assert_is_the_run(path, BY_NAME)


def test_what_cannot_be_read_is_named(tmp_path: Path) -> None:
    cells = np.empty((1, 2), dtype=object)
    cells[0, 0], cells[0, 1] = TIME, "text"
    path = saved(tmp_path, c=cells, z=TIME + 1j, cube=np.zeros((2, 3, 4)))
    assert "it holds c (a cell array), z (complex numbers), cube (an array)" in refused(path)
