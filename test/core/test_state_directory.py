"""Parameter sets on disk are read back exactly; damaged ones are rejected."""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest

from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import LITERATURE, THESIS_28_CELSIUS
from mr_damper_ros.tracking.state_directory import (
    StateDirectory,
    StateError,
    read_parameter_file,
    remove_unfinished,
    set_aside,
)

SET = ParameterSet(
    values=THESIS_28_CELSIUS,
    standard_errors=np.linspace(0.1, 1.0, 16),
    observable=np.arange(16) % 2 == 0,
    set_id="cold",
    source="nelder_mead",
    peak_velocity_range=(0.01, 0.3),
    current_range=(0.0, 1.5),
    nrmse=0.034,
    stamp_ns=1_700_000_000_123_456_789,
)


def same(a: ParameterSet, b: ParameterSet) -> bool:
    pairs = (
        (np.asarray(getattr(a, field.name)), np.asarray(getattr(b, field.name)))
        for field in dataclasses.fields(ParameterSet)
    )
    # Unknown values are NaN.
    return all(np.array_equal(x, y, equal_nan=x.dtype.kind == "f") for x, y in pairs)


def test_a_saved_set_comes_back_to_the_last_digit(tmp_path: Path) -> None:
    state = StateDirectory(tmp_path / "new" / "folder")
    path = state.save("cold", SET)
    assert path == tmp_path / "new" / "folder" / "cold.yaml"
    assert same(state.load("cold")[0], SET)
    assert same(state.load("cold.yaml")[0], SET)
    assert state.names() == ["cold"]


@pytest.mark.parametrize(
    "name",
    ["", "..", ".", "../other", "/etc/passwd", "a/b", ".hidden", "a\\b", "a b", "a\0b", "x" * 101]
    + ["\n", "ä", "a:b", "~root", ".yaml", "-rf"],
)
def test_only_plain_names_are_taken(tmp_path: Path, name: str) -> None:
    state = StateDirectory(tmp_path / "state")
    with pytest.raises(StateError, match="cannot be used: give one of letters"):
        state.save(name, SET)
    with pytest.raises(StateError, match="cannot be used: give one of letters"):
        state.load(name)
    assert os.listdir(tmp_path) == []


def test_what_a_killed_process_left_behind_is_removed(tmp_path: Path) -> None:
    state = StateDirectory(tmp_path)
    path = state.save("running", SET)
    for name in (".running.yaml.x1y2", ".running.yaml.z", ".other.yaml.x1y2"):
        (tmp_path / name).write_text("half a fi")
    remove_unfinished(path)
    assert sorted(os.listdir(tmp_path)) == [".other.yaml.x1y2", "running.yaml"]
    assert same(read_parameter_file(path), SET)


@pytest.mark.parametrize(
    "path", ["~nobody-of-this-name/x.yaml", "a\0b", "x" * 5000, "", "/dev/null"]
)
def test_a_path_that_cannot_be_is_said_so(path: str) -> None:
    with pytest.raises(StateError, match="cannot read"):
        read_parameter_file(path)


def test_a_link_out_of_the_folder_is_not_followed(tmp_path: Path) -> None:
    outside = tmp_path / "outside.yaml"
    outside.write_text(SET.to_yaml())
    state = StateDirectory(tmp_path / "state")
    state.save("other", SET)
    (tmp_path / "state" / "link.yaml").symlink_to(outside)
    with pytest.raises(StateError, match="link out of state_dir"):
        state.load("link")
    state.save("link", ParameterSet(LITERATURE))
    assert outside.read_text() == SET.to_yaml()


def test_without_a_folder_nothing_is_kept() -> None:
    state = StateDirectory("")
    for call in (lambda: state.save("a", SET), lambda: state.load("a")):
        with pytest.raises(StateError, match="set the parameter state_dir"):
            call()
    assert state.names() == []


def test_a_missing_set_is_named_with_those_that_exist(tmp_path: Path) -> None:
    state = StateDirectory(tmp_path)
    with pytest.raises(StateError, match=r"there is no .*warm.yaml: the stored names are \(none\)"):
        state.load("warm")
    state.save("cold", SET)
    with pytest.raises(StateError, match="the stored names are cold"):
        state.load("warm")


@pytest.mark.parametrize("memory", ["", '{"windows":3}'])
def test_every_damage_is_noticed(tmp_path: Path, memory: str) -> None:
    state = StateDirectory(tmp_path)
    path = state.save("cold", SET, memory)
    whole = path.read_bytes()
    first_line = whole.index(b"\n") + 1
    for position in (*range(first_line), *range(first_line, len(whole), 3)):
        # Every bit of the first line is tried; a checksum protects the rest.
        for bit in range(8) if position < first_line else (2,):
            damaged = bytearray(whole)
            damaged[position] ^= 1 << bit
            path.write_bytes(damaged)
            with pytest.raises(StateError):
                state.load("cold")
    for length in range(0, len(whole), 5):
        path.write_bytes(whole[:length])
        with pytest.raises(StateError):
            state.load("cold")


def test_a_damaged_file_is_set_aside(tmp_path: Path) -> None:
    state = StateDirectory(tmp_path)
    for expected in ("cold.aside", "cold.aside1"):
        path = state.save("cold", SET)
        path.write_text("half a fi")
        assert set_aside(path) == tmp_path / expected
        assert not path.exists()
    assert state.names() == []


@pytest.mark.parametrize("version", [1, 2, 4])
def test_a_file_of_another_format_is_refused(tmp_path: Path, version: int) -> None:
    state = StateDirectory(tmp_path)
    path = state.save("cold", SET)
    path.write_text(path.read_text().replace("version 3", f"version {version}"))
    with pytest.raises(StateError, match=f"has version {version} of the format"):
        state.load("cold")


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"\xff\xfe\x00", "not text"),
        (b"", "no mapping 'parameters'"),
        (b"parameters: {f0: 1}", "is missing"),
        (b"!!python/object/apply:os.system ['false']", "not valid YAML"),
        (b" " * (1 << 21), "too large"),
    ],
)
def test_other_files_are_refused_in_a_sentence(
    tmp_path: Path, content: bytes, sentence: str
) -> None:
    (tmp_path / "odd.yaml").write_bytes(content)
    with pytest.raises(StateError, match=sentence):
        StateDirectory(tmp_path).load("odd")


def test_a_folder_that_cannot_be_written_is_said_so(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StateError, match="set state_dir to a folder that can be written"):
        StateDirectory(tmp_path / "file").save("cold", SET)


def test_a_home_that_does_not_exist_is_said_so() -> None:
    with pytest.raises(StateError, match="cannot be used as state_dir"):
        StateDirectory("~nobody-of-this-name/state")
