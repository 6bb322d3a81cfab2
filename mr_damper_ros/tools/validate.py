"""Report the error of a parameter set on each bag."""

from __future__ import annotations

import argparse

from mr_damper_ros.api.comparison import validate
from mr_damper_ros.api.identification import identify
from mr_damper_ros.processes.exits import DOUBTFUL
from mr_damper_ros.tools import console


def _options(parser: argparse.ArgumentParser) -> None:
    console.add_path(parser, "parameters", "PARAMETERS.yaml", "file of identify --output")
    console.add_run_options(parser)
    console.add_arguments(parser, identify, ["mass"])
    console.add_result_options(parser, "the errors")


def _validate(options: argparse.Namespace) -> int:
    result = validate(
        options.parameters, options.bags, **console.arguments_of(options, validate, "parameters")
    )
    print(result)
    console.write_result(options, result.document(), result.runs)
    return DOUBTFUL if result.warnings else 0


main = console.program("mr-damper validate", __doc__, _options, _validate)
