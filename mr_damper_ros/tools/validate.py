"""Report the error of a parameter set on each bag."""

from __future__ import annotations

import argparse
from pathlib import Path

from mr_damper_ros.api.comparison import validate
from mr_damper_ros.api.identification import identify
from mr_damper_ros.tools.console import (
    add_arguments,
    add_result_options,
    add_run_options,
    arguments_of,
    program,
    write_result,
)


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "parameters", type=Path, metavar="PARAMETERS.yaml", help="file of identify --output"
    )
    add_run_options(parser)
    add_arguments(parser, identify, ["mass"])
    add_result_options(parser, "the errors")


def _validate(options: argparse.Namespace) -> int:
    result = validate(
        options.parameters, options.bags, **arguments_of(options, validate, "parameters")
    )
    print(result)
    write_result(options, result.document(), result.runs)
    return 0


main = program(__name__, __doc__, _options, _validate)
