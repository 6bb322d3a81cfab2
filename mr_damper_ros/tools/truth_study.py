"""``truth_study``: every force law judged on recordings and a benchmark, in one report."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from mr_damper_ros.study.truth_report import ALL, PARTS, SHORT, build_truth
from mr_damper_ros.tools.console import run_tool
from mr_damper_ros.tools.study_program import study_parser, write_page


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    return run_tool(_parser(), _judge, arguments)


def _parser() -> argparse.ArgumentParser:
    return study_parser(
        "truth_study",
        "Judge every force law on the recordings in the folder that the variable "
        "MR_DAMPER_DATA names, where it is set, and on the re-created hysteretic benchmark of Noël "
        "and Schoukens; write one report, report.html, and its figures, truth.json.",
        PARTS,
        "few laws, few and short records",
        "build/truth",
    )


def _judge(options: argparse.Namespace) -> int:
    extent = SHORT if options.quick else ALL
    return write_page(
        lambda say: build_truth(options.output, options.only, options.workers, extent, say)
    )
