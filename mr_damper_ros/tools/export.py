"""``export``: writes a parameter set as code for a controller: C, an FMU, M-code."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from mr_damper_ros.control.export.exported_law import ExportedLaw, ExportSettings, Vectors
from mr_damper_ros.control.export.fmu import write_fmu
from mr_damper_ros.control.export.source_code import functions, header
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.processes.files import write_text
from mr_damper_ros.settings.option_table import Option, options
from mr_damper_ros.tools.console import program

_POINTS = 1000
"""Number of points in the table of test vectors."""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="export",
        description="Write an identified set as code for a controller, with test vectors.",
    )
    parser.add_argument(
        "parameters", type=Path, metavar="PARAMETERS.yaml", help="as written by identify --output"
    )
    parser.add_argument(
        "--format",
        choices=list(_FORMATS),
        required=True,
        help="a C99 header, an FMU (FMI 2.0, co-simulation), or M-code for MATLAB and Octave",
    )
    parser.add_argument("--output", type=Path, required=True, metavar="FOLDER")
    parser.add_argument(
        "--name", default="mr_damper", help="of what the C code defines (default %(default)s)"
    )
    for item in options(ExportSettings):
        parser.add_argument(_flag(item), type=float, default=item.default, help=_help(item))
    return parser


def _flag(item: Option) -> str:
    return "--" + item.name.replace("_", "-")


def _help(item: Option) -> str:
    return item.description.rstrip(".") + " (default %(default)s)"


def _export(chosen: argparse.Namespace) -> int:
    settings = ExportSettings(
        **{item.name: getattr(chosen, item.name) for item in options(ExportSettings)}
    )
    law = ExportedLaw.of(ParameterSet.load(chosen.parameters), settings)
    if law.parameters.doubt_over_current:
        print(f"WARNING: {law.parameters.doubt_over_current}", file=sys.stderr)
    chosen.output.mkdir(parents=True, exist_ok=True)
    written = _FORMATS[chosen.format](law, chosen.name, chosen.output)
    vectors = chosen.output / "vectors.csv"
    write_text(vectors, Vectors.of(law, _POINTS).csv())
    print("written: " + ", ".join(str(path) for path in (*written, vectors)))
    return 0


def _c(law: ExportedLaw, name: str, folder: Path) -> list[Path]:
    path = folder / f"{name}.h"
    write_text(path, header(law, name))
    return [path]


def _fmu(law: ExportedLaw, name: str, folder: Path) -> list[Path]:
    path = folder / f"{name}.fmu"
    write_fmu(law, name, path)
    return [path]


def _matlab(law: ExportedLaw, name: str, folder: Path) -> list[Path]:
    paths = []
    for file, text in functions(law).items():
        paths.append(folder / file)
        write_text(paths[-1], text)
    return paths


_FORMATS: dict[str, Callable[[ExportedLaw, str, Path], list[Path]]] = {
    "c": _c,
    "fmu": _fmu,
    "matlab": _matlab,
}


main = program(_parser, _export)
