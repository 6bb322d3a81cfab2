"""Recordings in folders, patterns and lists, each with the name of its damper."""

from __future__ import annotations

import csv
import glob
import math
import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from mr_damper_ros.io.columns import parse_columns
from mr_damper_ros.io.records import read_record
from mr_damper_ros.models.parameter_set import UserError
from mr_damper_ros.signals.recording import Recording

RECORD_ENDINGS = frozenset(
    {".txt", ".csv", ".tsv", ".dat", ".asc", ".mat", ".xlsx", ".xlsm", ".tdms"}
)
"""Endings of record files; reading them needs a description of their columns."""

_BAG_FILE = ".mcap"
_METADATA = "metadata.yaml"
_PATTERN_SIGNS = frozenset("*?[")


class ListError(UserError):
    """Recordings that cannot be found or assigned; the message says what to change."""


@dataclass(frozen=True)
class RecordFormat:
    """Format of record files, as in :func:`mr_damper_ros.read_record`.

    ``columns`` describes the columns. ``current`` [A] and ``period`` [s] apply if no column holds
    them. ``variable`` is the name of a matrix, a sheet or a group.
    """

    columns: str
    current: float | None = None
    period: float | None = None
    variable: str | None = None

    def __post_init__(self) -> None:
        """Raise ColumnError if the columns cannot be read."""
        parse_columns(self.columns)

    def read(self, path: Path, current: float | None) -> Recording:
        """The recording in a file; ``current`` [A] overrides the current of the format."""
        return read_record(
            path,
            self.columns,
            current=self.current if current is None else current,
            period=self.period,
            variable=self.variable,
        )


@dataclass(frozen=True)
class ListedRecording:
    """A recording of ``damper`` at ``path``; ``current`` [A] is None if it is not given."""

    path: Path
    damper: str
    current: float | None = None


@dataclass(frozen=True)
class LeftOut:
    """An unused file at ``path``, and the reason in words."""

    path: Path
    reason: str


def find_recordings(
    sources: Iterable[str | os.PathLike[str]],
    *,
    pattern: str | None = None,
    with_records: bool = False,
) -> tuple[list[ListedRecording], list[LeftOut]]:
    """The recordings in the sources, and the unused files.

    A source is a folder, a pattern with ``*``, or a path. A bag is a folder with metadata.yaml, or
    a .mcap file; record files are included with ``with_records``. ``pattern`` is a regular
    expression for the path below the source: its group ``damper``, or its first group, is the name
    of the damper, and a group ``current`` is the current [A]. Without a pattern, all recordings in
    one folder belong to one damper.

    Raises ListError if a source has no recording, or the pattern is invalid.
    """
    expression = None if pattern is None else _compiled(pattern)
    found: dict[Path, ListedRecording] = {}
    left_out: list[LeftOut] = []
    for source in sources:
        roots = _roots(os.fspath(source))
        paths = [(path, root) for root in roots for path in _recordings(root, with_records)]
        if not paths:
            raise ListError(
                f"there is no recording in {os.fspath(source)}: give folders or .mcap files of "
                "bags, or describe the columns of the record files"
            )
        for path, root in paths:
            base = root if root.is_dir() and root != path else path.parent
            try:
                found.setdefault(path, _named(path, base, expression))
            except ListError as error:
                left_out.append(LeftOut(path, str(error)))
    return list(found.values()), left_out


def read_list(path: str | os.PathLike[str]) -> tuple[list[ListedRecording], list[LeftOut]]:
    """The recordings in a CSV list, and the unusable entries.

    The list has the columns ``path``, ``damper`` and optionally ``current`` [A]. Paths are relative
    to the folder of the list. Raises ListError if a column is missing, the list is empty or
    a recording has two dampers, and OSError.
    """
    place = Path(path)
    try:
        with place.open(encoding="utf-8-sig", newline="") as file:
            rows = list(csv.DictReader(file, skipinitialspace=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise ListError(f"{place} is not a list: give a CSV file in UTF-8 ({error})") from error
    for column in ("path", "damper"):
        if not rows or rows[0].get(column) is None:
            raise ListError(
                f"{place} has no column '{column}': its first line must name path, damper and, "
                "optionally, current"
            )
    found = []
    left_out = []
    for row in rows:
        recording = place.parent / (row["path"] or "")
        try:
            if not (row["damper"] or "").strip():
                raise ListError("the list does not name its damper")
            current = _current(row.get("current"))
            found.append(ListedRecording(recording, row["damper"].strip(), current))
        except ListError as error:
            left_out.append(LeftOut(recording, str(error)))
    return without_repeats(found), left_out


def without_repeats(recordings: Iterable[ListedRecording]) -> list[ListedRecording]:
    """Each recording once; raises ListError for one with two dampers or currents."""
    found: dict[Path, ListedRecording] = {}
    for each in recordings:
        first = found.setdefault(each.path.resolve(), each)
        if first.damper != each.damper or first.current != each.current:
            raise ListError(
                f"{each.path} is given twice, for the dampers {first.damper} and {each.damper}, or "
                "with two currents: remove one of the two"
            )
    return list(found.values())


def _roots(source: str) -> list[Path]:
    if Path(source).exists():
        return [Path(source)]
    if not _PATTERN_SIGNS & set(source):
        raise ListError(f"there is no {source}")
    return [Path(name) for name in sorted(glob.glob(source, recursive=True))]


def _recordings(root: Path, with_records: bool) -> Iterator[Path]:
    if not root.is_dir():
        if _is_recording(root, with_records):
            yield root
        return
    for folder, below, files in os.walk(root):
        if _METADATA in files:
            below.clear()
            yield Path(folder)
            continue
        below.sort()
        paths = (Path(folder, name) for name in sorted(files))
        yield from (path for path in paths if _is_recording(path, with_records))


def _is_recording(path: Path, with_records: bool) -> bool:
    ending = path.suffix.lower()
    return ending == _BAG_FILE or (with_records and ending in RECORD_ENDINGS)


def _compiled(pattern: str) -> re.Pattern[str]:
    try:
        expression = re.compile(pattern)
    except re.error as error:
        raise ListError(f"the pattern {pattern!r} is not a regular expression: {error}") from error
    if not expression.groups:
        raise ListError(
            f"the pattern {pattern!r} has no group: put the name of the damper in brackets, as in "
            "(D[0-9]+)_"
        )
    return expression


def _named(path: Path, base: Path, pattern: re.Pattern[str] | None) -> ListedRecording:
    if pattern is None:
        below = path.parent.relative_to(base).as_posix()
        return ListedRecording(path, base.resolve().name if below == "." else below)
    found = pattern.search(path.relative_to(base).as_posix())
    damper = found and found["damper" if "damper" in pattern.groupindex else 1]
    if not found or not damper:
        raise ListError(f"the pattern {pattern.pattern!r} does not match its path")
    current = found["current"] if "current" in pattern.groupindex else None
    return ListedRecording(path, damper, _current(current))


def _current(text: str | None) -> float | None:
    if text is None or not text.strip():
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ListError(f"its current is {text!r}: give a number of amperes")
    return value
