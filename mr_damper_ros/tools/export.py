"""Write an identified set as code for a controller, with test vectors."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

from mr_damper_ros.control.export.exported_law import ExportedLaw, ExportSettings, Vectors
from mr_damper_ros.control.export.fmu import fmu
from mr_damper_ros.control.export.source_code import functions, header
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.processes.files import write_bytes
from mr_damper_ros.settings.option_table import options
from mr_damper_ros.tools.console import add_arguments, add_path, arguments_of, program


def _options(parser: argparse.ArgumentParser) -> None:
    add_path(parser, "parameters", "PARAMETERS.yaml", "file of identify --output")
    parser.add_argument(
        "--format",
        choices=list(_FORMATS),
        required=True,
        help="a C99 header, an FMU (FMI 2.0, co-simulation), or M-code for MATLAB and Octave",
    )
    add_path(parser, "--output", "FOLDER", "folder of the files", required=True)
    parser.add_argument(
        "--name", default="mr_damper", help="prefix of the names in C (default %(default)s)"
    )
    add_arguments(parser, ExportSettings, [item.name for item in options(ExportSettings)])


def _export(chosen: argparse.Namespace) -> int:
    settings = ExportSettings(**arguments_of(chosen, ExportSettings))
    law = ExportedLaw(ParameterSet.load(chosen.parameters), settings)
    if law.parameters.doubt_over_current:
        print(f"WARNING: {law.parameters.doubt_over_current}", file=sys.stderr)
    chosen.output.mkdir(parents=True, exist_ok=True)
    files = _FORMATS[chosen.format](law, chosen.name)
    files["vectors.csv"] = Vectors.of(law, 1000).csv()
    for name, content in files.items():
        write_bytes(chosen.output / name, content.encode() if isinstance(content, str) else content)
    print("written: " + ", ".join(str(chosen.output / name) for name in files))
    return 0


_FORMATS: dict[str, Callable[[ExportedLaw, str], dict[str, str | bytes]]] = {
    "c": lambda law, name: {f"{name}.h": header(law, name)},
    "fmu": lambda law, name: {f"{name}.fmu": fmu(law, name)},
    "matlab": lambda law, name: {**functions(law)},
}
"""The files of each format, by their names."""


main = program("mr-damper export", __doc__, _options, _export)
