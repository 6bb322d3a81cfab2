"""Convert a text, CSV, MAT, XLSX, TDMS or MF4 file to a bag.

With nothing but a text file or a sheet, show its headings, units and first rows, and propose the
command.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mr_damper_ros.api.identification import identify
from mr_damper_ros.data_check.findings import NOTE, Finding, Kind, labelled
from mr_damper_ros.data_check.recordings import check_run, usable_run
from mr_damper_ros.io.bag_writer import write_bag
from mr_damper_ros.io.columns import UNITS, RecordError
from mr_damper_ros.io.proposals import Proposal, propose_columns, reversed_force, unit_text
from mr_damper_ros.io.records import RunsOfFile, read_record
from mr_damper_ros.io.text_tables import TextOptions
from mr_damper_ros.processes.exits import DOUBTFUL
from mr_damper_ros.processes.files import irregularity
from mr_damper_ros.report.status_line import StatusLine
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.tools.console import add_arguments, add_path, arguments_of, program

_EPILOG = f"""\
columns: QUANTITY:UNIT for each column from the left; - skips a column, ... at the end skips all
further columns. Or QUANTITY=HEADER:UNIT for each column, where HEADER is its heading (in a MAT
file: a variable). 980.665*N-12N multiplies by 980.665, then subtracts 12 N; a negative factor
reverses the sign. Extension and tension are positive. Without a displacement column, the velocity
is integrated.
{chr(10).join(f"  {name:<13} {', '.join(units)}" for name, units in UNITS.items())}

examples:
  mr-damper import run.txt --columns time:s,displacement:mm,velocity:mm/s,force:N --current 0.5 \\
      --output bags/run
  mr-damper import run.csv --output bags/run \\
      --columns "time=Time:s,displacement=Stroke:mm,force=Load:kN,current=I:A"
  mr-damper import logger.txt --columns -,time:datetime,force:980.665*N,displacement:10*mm \\
      --split --currents 0,0.25,0.5,0.75,1 --output bags/logger
  mr-damper import quake.mat --variable data --columns displacement:mm,-,force:N,... \\
      --period 0.001 --current 0.6 --output bags/quake
"""

_OPTIONS = (
    *("columns", "current", "period", "start", "stop", "moving_average", "begins_in_motion"),
    *("force_lateness", "current_lateness", "variable", "decimal_mark", "maximum_samples"),
)
_BOTH = (
    "give both the columns (--columns) and the bag (--output); without either, the program "
    "proposes the command"
)
_FLAGS = {"start": "--from", "stop": "--to", "moving_average": "--undo-moving-average"}


def _options(parser: argparse.ArgumentParser) -> None:
    add_path(parser, "file", "FILE", "text, CSV, MAT, XLSX, TDMS or MF4 file")
    where = "bag to write; with --split, folder of the bags, one for each run"
    add_path(parser, "--output", "BAG", where)
    add_arguments(parser, read_record, _OPTIONS, flags=_FLAGS, without_default=("columns",))
    parser.add_argument(
        "--split",
        action="store_true",
        help="cut the file into its runs: at pauses of the logger, rests of the rod, and changes "
        "of a measured current or of the steady motion",
    )
    parser.add_argument(
        "--currents",
        metavar="A,A,...",
        help="with --split: coil current [A] of each run, - to omit a run; by default the program "
        "asks for the currents, unless a column contains them",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing bag")
    add_arguments(parser, identify, ["accept_doubtful"])


def _import(options: argparse.Namespace) -> int:
    if options.columns is None and options.output is None:
        return _propose(options)
    if options.columns is None or options.output is None:
        raise RecordError(_BOTH)
    if options.begins_in_motion and options.moving_average is None:
        raise RecordError("--begins-in-motion also needs --undo-moving-average")
    if options.split:
        return _import_runs(options)
    if options.currents is not None:
        raise RecordError("--currents needs --split: give --current for a single run")
    with StatusLine() as line:
        recording = read_record(
            options.file,
            **arguments_of(options, read_record),
            progress=_shown(line, f"reading {options.file.name}"),
        )
    return _write({options.output: recording}, options)


_CARRIED = ("current", "period", "variable", "decimal_mark")
"""Options that a proposed command takes over."""


def _propose(options: argparse.Namespace) -> int:
    """Show what a file holds, and print the command that imports it."""
    path: Path = options.file
    others = (options.start, options.stop, options.moving_average, options.currents)
    shifted = options.force_lateness or options.current_lateness
    if options.split or shifted or any(other is not None for other in others):
        raise RecordError(_BOTH)
    if kind := irregularity(path):
        raise RecordError(f"{path} is {kind}: give a text, CSV, MAT, XLSX, TDMS or MF4 file")
    given = {name: getattr(options, name) for name in _CARRIED}
    given = {name: value for name, value in given.items() if value is not None}
    proposal = propose_columns(path, options.variable, "period" in given)
    print("\n".join(_outline(path, proposal)))
    for remark in proposal.remarks:
        print(f"note: {remark}")
    if not proposal.usable:
        raise RecordError(
            f"no command can be proposed for {path.name}: {'; '.join(proposal.missing)} "
            "(--columns, see mr-damper import --help)"
        )
    unknown = "current" not in proposal.quantities and "current" not in given
    if unknown:
        given["current"] = 0.0
    reason, columns, more = "; ".join(proposal.missing), proposal.columns, list[str]()
    if not reason:
        reason, columns, more = _tried(path, columns, given)
    command = ["mr-damper", "import", str(path), "--columns", columns]
    for name, value in given.items():
        text = f"{value:.9g}" if isinstance(value, float) else value
        command += [f"--{name.replace('_', '-')}", text]
    command += [*more, "--output", str(Path("bags", path.stem))]
    print(f"the command{', to be completed' if reason else ''}:\n\n  {shlex.join(command)}\n")
    if reason:
        raise RecordError(f"{path.name} cannot be imported as it stands: {reason}")
    if unknown:
        print(
            "The file does not hold the coil current: replace the 0 of --current by the current "
            "[A] of the run (--currents: of each run)."
        )
    print("Extension and tension are positive: a factor of -1, such as force:-1*N, turns a sign.")
    return 0


def _tried(path: Path, columns: str, given: dict[str, Any]) -> tuple[str, str, list[str]]:
    """Why a file cannot be read; else the columns with the signs of a damper, and more options."""
    more: list[str] = []
    try:
        recordings = [read_record(path, columns, **given)]
    except ValueError as error:
        single = str(error)
        try:
            recordings = _runs_of(path, columns, given)
        except ValueError as other:
            return (str(other) if "--split" in single else single), columns, more
        more.append("--split")
    findings = _doubts(recordings)
    if any(finding.kind is Kind.INVERTED for finding in findings):
        print(
            "note: with the signs of the file the force drives the motion, so the command reverses "
            "the force: reverse the displacement instead if it is positive in compression"
        )
        columns = reversed_force(columns)
        recordings = [replace(each, force=-each.force) for each in recordings]
        findings = _doubts(recordings)
    for sentence in dict.fromkeys(str(finding.sentence) for finding in findings):
        print(f"the check of the data finds: {sentence}")
    if findings:
        print("The command accepts these findings (--accept-doubtful).")
        more.append("--accept-doubtful")
    for recording in recordings:
        if np.ptp(recording.displacement) == 0.0 or np.ptp(recording.force) == 0.0:
            return f"the displacement or the force of {recording.name} is constant", columns, more
    return "", columns, more


def _runs_of(path: Path, columns: str, given: dict[str, Any]) -> list[Recording]:
    """The runs of a file; prints a list of them."""
    text = TextOptions(given.get("decimal_mark"))
    runs = RunsOfFile(path, columns, given.get("period"), given.get("variable"), text=text)
    recordings = runs.recordings(given.get("current"))
    print(f"{path.name} holds {len(runs.summaries)} runs:")
    print("\n".join(f"  {number}: {text}" for number, text in enumerate(runs.summaries, start=1)))
    return recordings


def _doubts(recordings: list[Recording]) -> list[Finding]:
    """The findings on recordings that need acceptance."""
    return [f for each in recordings for f in check_run([each]).findings if f.severity > NOTE]


_SHOWN_ROWS = 3
"""Number of rows in the overview of a file."""

_SEPARATORS = {"": "spaces", "\t": "tabs", ",": "commas", ";": "semicolons"}


def _outline(path: Path, proposal: Proposal) -> list[str]:
    """An overview of a file: its columns with headings, units and first numbers."""
    outline = proposal.outline
    lines = [
        f"{path.name}: {outline.layout.name}; numbers from line {outline.first_line} on, columns "
        f"separated by {_SEPARATORS.get(outline.separator, outline.separator)}"
    ]
    rows = [fields for _, fields in outline.sample[:_SHOWN_ROWS]]
    table = [
        [
            f"{p + 1}",
            outline.heading(p),
            unit_text(outline.unit(p)),
            *(_cell(row, p) for row in rows),
        ]
        for p in range(outline.width)
    ]
    table.insert(0, ["column", "heading", "unit", "first rows"])
    widths = [max(len(row[k]) for row in table if k < len(row)) for k in range(len(table[-1]))]
    for row in table:
        cells = (text.ljust(width) for text, width in zip(row, widths, strict=False))
        lines.append("  " + "  ".join(cells).rstrip())
    return lines


def _cell(row: list[str], place: int) -> str:
    return row[place] if place < len(row) else ""


def _import_runs(options: argparse.Namespace) -> int:
    if options.start is not None or options.stop is not None:
        raise RecordError("--from and --to apply to a single run: omit them, or omit --split")
    if options.moving_average is not None or options.force_lateness or options.current_lateness:
        raise RecordError(
            "--undo-moving-average, --force-lateness and --current-lateness apply to a single run: "
            "omit them, or omit --split"
        )
    with StatusLine() as line:
        text = TextOptions(options.decimal_mark, _shown(line, f"reading {options.file.name}"))
        runs = RunsOfFile(
            options.file,
            options.columns,
            options.period,
            options.variable,
            options.maximum_samples,
            text,
        )
    print(f"{options.file.name} holds {len(runs.summaries)} runs:")
    print("\n".join(f"  {number}: {text}" for number, text in enumerate(runs.summaries, start=1)))
    recordings = runs.recordings(_currents(options, runs))
    return _write({options.output / each.name: each for each in recordings}, options)


def _currents(options: argparse.Namespace, runs: RunsOfFile) -> float | list[float | None] | None:
    """The current [A] of all runs or of each run, None for a run to omit.

    The whole result is None if a column of the file contains the current.
    """
    if options.currents is not None:
        return [_ampere(text) for text in options.currents.split(",")]
    if options.current is not None or not runs.asks or not sys.stdin.isatty():
        return options.current  # type: ignore[no-any-return]
    numbers = range(1, len(runs.summaries) + 1)
    return [_ampere(input(f"current of run {k} [A], - to omit it: ")) for k in numbers]


def _ampere(text: str) -> float | None:
    if text.strip() == "-":
        return None
    try:
        return float(text)
    except ValueError:
        raise RecordError(f"the current '{text}' is not a number: give it in amperes") from None


def _write(recordings: Mapping[Path, Recording], options: argparse.Namespace) -> int:
    """Check the recordings, and write each to its bag if none is refused."""
    accept, findings = options.accept_doubtful, list[Finding]()
    for recording in recordings.values():
        print(_summary(recording))
        checked = usable_run(recording.name, [recording], accept_doubtful=accept)
        findings += checked.findings
        for finding in checked.findings:
            print(labelled(finding))
    for place, recording in recordings.items():
        with StatusLine() as line:
            progress = _shown(line, f"writing {place.name}")
            write_bag(place, recording, overwrite=options.overwrite, progress=progress)
        print(f"written to {place}")
    doubtful = any(finding.severity > NOTE for finding in findings) and not accept
    return DOUBTFUL if doubtful else 0


def _shown(line: StatusLine, what: str) -> Callable[[float], None]:
    """Show a fraction on the status line."""
    return lambda fraction: line.show(f"{what}: {fraction:.0%}")


def _summary(recording: Recording) -> str:
    lines = [
        f"{recording.name}: {recording.sample_count} samples, {recording.period * 1e3:.6g} ms "
        f"apart ({1.0 / recording.period:.6g} Hz), {recording.duration:.6g} s",
        _range("displacement", recording.displacement * 1e3, "mm"),
        _range("velocity", np.gradient(recording.displacement, recording.period), "m/s"),
        _range("force", recording.force, "N"),
        _range("current", recording.current, "A"),
    ]
    if recording.temperature is not None:
        lines.append(_range("temperature", recording.temperature, "°C"))
    return "\n".join(lines)


def _range(name: str, values: Array, unit: str) -> str:
    low, high = float(np.min(values)), float(np.max(values))
    shown = f"{low:.6g}" if low == high else f"{low:.6g} to {high:.6g}"
    return f"  {name:<13} {shown} {unit}"


main = program("mr-damper import", __doc__, _options, _import, _EPILOG)
