"""``import_record``: a laboratory's text, CSV or MAT file becomes a bag."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mr_damper_ros.io.bag_writer import write_bag
from mr_damper_ros.io.raw_table import MAXIMUM_SAMPLES
from mr_damper_ros.io.records import read_record
from mr_damper_ros.io.units import UNITS
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.tools.console import run_tool

_EPILOG = f"""\
columns: QUANTITY:UNIT for each column from the left, - to skip one; or QUANTITY=HEADER:UNIT for
all, where HEADER is the name at the head of the column (in a MAT file: a variable). A factor may
stand before the unit; a negative one turns the sign. Extension and tension are positive.
{chr(10).join(f"  {name:<13} {', '.join(units)}" for name, units in UNITS.items())}

examples:
  import_record run.txt --columns time:s,displacement:mm,velocity:mm/s,force:N --current 0.5 \\
      --output bags/run
  import_record run.csv --columns "time=Time:s,displacement=Stroke:mm,force=Load:kN,current=I:A" \\
      --output bags/run
  import_record logger.txt --columns time:0.005*s,-,force:980.665*N,displacement:10*mm \\
      --from 12 --to 27 --current 0.25 --output bags/part_2
  import_record quake.mat --variable data --columns displacement:mm,-,force:N --period 0.001 \\
      --current 0.6 --output bags/quake
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    return run_tool(_parser(), _import, argv)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="import_record",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Turn a text, CSV or MAT file into a bag.",
        epilog=_EPILOG,
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="text, CSV or MAT file")
    parser.add_argument(
        "--columns", required=True, help="what the columns hold, and their units (see below)"
    )
    parser.add_argument("--output", required=True, type=Path, metavar="BAG", help="bag to make")
    parser.add_argument(
        "--current", type=float, metavar="A", help="coil current [A], if no column holds it"
    )
    parser.add_argument(
        "--period", type=float, metavar="S", help="time between samples [s], if no column holds it"
    )
    parser.add_argument(
        "--from", dest="start", type=float, metavar="S", help="begin here [s from the first sample]"
    )
    parser.add_argument(
        "--to", dest="stop", type=float, metavar="S", help="end here [s from the first sample]"
    )
    parser.add_argument(
        "--variable", metavar="NAME", help="matrix in a MAT file, if it has several"
    )
    parser.add_argument(
        "--maximum-samples",
        type=int,
        default=MAXIMUM_SAMPLES,
        metavar="N",
        help=f"refuse a file with more samples (default {MAXIMUM_SAMPLES})",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace a bag that exists")
    return parser


def _import(options: argparse.Namespace) -> int:
    recording = read_record(
        options.file,
        options.columns,
        current=options.current,
        period=options.period,
        start=options.start,
        stop=options.stop,
        variable=options.variable,
        maximum_samples=options.maximum_samples,
    )
    print(_summary(recording))
    write_bag(options.output, recording, overwrite=options.overwrite)
    print(f"written to {options.output}")
    return 0


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
    if "note" in recording.details:
        lines.append(f"note: {recording.details['note']}")
    return "\n".join(lines)


def _range(name: str, values: Array, unit: str) -> str:
    low, high = float(np.min(values)), float(np.max(values))
    shown = f"{low:.6g}" if low == high else f"{low:.6g} to {high:.6g}"
    return f"  {name:<13} {shown} {unit}"


if __name__ == "__main__":
    sys.exit(main())
