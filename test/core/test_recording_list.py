"""Which recordings there are, and of which damper each one is."""

from __future__ import annotations

from pathlib import Path

import pytest

from mr_damper_ros.io.recording_list import ListError, find_recordings, read_list


def touch(*paths: Path) -> None:
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


@pytest.fixture
def lot(tmp_path: Path) -> Path:
    """Two dampers with a folder each, bags as folders and as files, and what is no recording."""
    root = tmp_path / "lot"
    touch(
        root / "D1" / "slow" / "metadata.yaml",
        root / "D1" / "slow" / "data.mcap",
        root / "D1" / "D1_fast.mcap",
        root / "D2" / "D2_0.5A.mcap",
        root / "D2" / "D2_1.0A.csv",
        root / "notes.txt",
    )
    return root


def names(*sources: Path | str, **options: object) -> dict[str, list[str]]:
    found, _ = find_recordings(sources, **options)  # type: ignore[arg-type]
    groups: dict[str, list[str]] = {}
    for recording in found:
        groups.setdefault(recording.damper, []).append(recording.path.name)
    return groups


def test_recordings_are_found_and_named_as_asked(lot: Path) -> None:
    assert names(lot) == {"D1": ["D1_fast.mcap", "slow"], "D2": ["D2_0.5A.mcap"]}
    assert names(lot / "D2", with_records=True) == {"D2": ["D2_0.5A.mcap", "D2_1.0A.csv"]}
    assert names(str(lot / "*" / "*.mcap")) == {"D1": ["D1_fast.mcap"], "D2": ["D2_0.5A.mcap"]}
    assert names(lot, pattern=r"D(\d)/") == {"1": ["D1_fast.mcap", "slow"], "2": ["D2_0.5A.mcap"]}
    pattern = r"(?P<damper>D\d)_(?P<current>[\d.]+)A"
    found, left_out = find_recordings([lot], pattern=pattern, with_records=True)
    assert {r.path.name: r.current for r in found} == {"D2_0.5A.mcap": 0.5, "D2_1.0A.csv": 1.0}
    assert {entry.path.name for entry in left_out} == {"D1_fast.mcap", "slow", "notes.txt"}
    assert names(lot, lot / "D2") == names(lot)


@pytest.mark.parametrize(
    ("source", "options", "sentence"),
    [
        ("nowhere", {}, "there is no "),
        ("lot/*/none*", {}, "there is no recording in"),
        ("lot/notes.txt", {}, "there is no recording in"),
        ("lot", {"pattern": "(D"}, "is not a regular expression"),
        ("lot", {"pattern": "D."}, "has no group"),
    ],
)
def test_what_finds_nothing_is_refused_in_a_sentence(
    lot: Path, source: str, options: dict[str, str], sentence: str
) -> None:
    with pytest.raises(ListError, match=sentence.replace("(", r"\(")):
        find_recordings([lot.parent / source], **options)  # type: ignore[arg-type]


def test_a_list_names_paths_dampers_and_currents(tmp_path: Path) -> None:
    file = tmp_path / "runs.csv"
    file.write_text(
        "damper,path,current\nA,one.csv,0.5\nB,two,\nA,sub/three.csv,1\nA,four,much\n,five,1\n"
    )
    found, left_out = read_list(file)
    assert [entry.path.name for entry in left_out] == ["four", "five"]
    assert [(r.damper, r.path, r.current) for r in found] == [
        ("A", tmp_path / "one.csv", 0.5),
        ("B", tmp_path / "two", None),
        ("A", tmp_path / "sub" / "three.csv", 1.0),
    ]


@pytest.mark.parametrize("text", ["", "path\n1\n", "damper\nA\n", "\x00", "path,damper\n"])
def test_a_file_that_is_no_list_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "runs.csv"
    file.write_text(text)
    with pytest.raises(ListError):
        read_list(file)
