"""``validate``: the error of a parameter set on each bag."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from mr_damper_ros.tools.bag_windows import bag_windows, metrics
from mr_damper_ros.tools.console import run_tool, write_text
from mr_damper_ros.tracking.state_directory import read_parameter_file


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    return run_tool(_parser(), _validate, arguments)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="validate", description="Report the error of a parameter set on each bag."
    )
    parser.add_argument(
        "parameters", type=Path, metavar="PARAMETERS.yaml", help="as written by identify --output"
    )
    parser.add_argument(
        "bags", nargs="+", type=Path, metavar="BAG", help="bag folder or .mcap file"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the errors as JSON")
    return parser


def _validate(options: argparse.Namespace) -> int:
    found = read_parameter_file(options.parameters)
    entries = []
    for path in options.bags:
        error = asdict(metrics(found, bag_windows(path).windows))
        entries.append({"bag": str(path), "metrics": error})
        print(
            f"{path}: RMSE {error['rmse']:.4g} N, NRMSE {error['nrmse']:.2%}, "
            f"R2 {error['r2']:.4f} ({error['n_samples']} samples)"
        )
    if options.json is not None:
        write_text(options.json, json.dumps({"bags": entries}, indent=2, allow_nan=False) + "\n")
    return 0
