"""Measure all figures, write ``build/bench.json`` and print a table: ``make bench``."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path

from benchmarks import (
    cold_start,
    faults,
    following,
    foreign_dampers,
    global_minimum,
    healthy,
    honest_errors,
    inverse,
    jitter,
    kinematics,
    noise_limit,
    planned_runs,
    reversal_jump,
    rig_troubles,
    state_law,
    study_figures,
    switched_current,
    whole_damper,
    whole_loop,
    window_refit,
)
from benchmarks.fault_scenarios import SCENARIOS
from benchmarks.figure import Figure, table, write
from mr_damper_ros.processes.blas_threads import keep_one_thread

OUTPUT = Path("build/bench.json")

Measure = Callable[[], list[Figure]]


def _of_nodes(module: str, **options: float) -> Measure:
    """Figures of a module that needs ROS, measured in a process of its own.

    Fast DDS looks for the interfaces of the network once in a process: in one that has had a
    participant before, the lossy link is not seen.
    """

    def measure() -> list[Figure]:
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
            return process.submit(_figures, module, options).result()

    return measure


def _figures(module: str, options: Mapping[str, float]) -> list[Figure]:
    return list(import_module(f"benchmarks.{module}").figures(**options))


FULL: dict[str, Measure] = {
    "window_refit": window_refit.figures,
    "whole_damper": whole_damper.figures,
    "noise_limit": noise_limit.figures,
    "honest_errors": honest_errors.figures,
    "drift": following.drift_figures,
    "force_step": following.step_figures,
    "switched_current": switched_current.figures,
    "state_law": state_law.figures,
    "reversal_jump": reversal_jump.figures,
    "cold_start": cold_start.figures,
    "truth": study_figures.truth_figures,
    "control": study_figures.control_figures,
    "global_minimum": global_minimum.figures,
    "jitter": jitter.figures,
    "kinematics": kinematics.figures,
    "faults": faults.figures,
    "healthy": healthy.figures,
    "foreign_dampers": foreign_dampers.figures,
    "inverse": inverse.figures,
    "planned_runs": planned_runs.figures,
    "whole_loop": whole_loop.figures,
    "streaming_load": _of_nodes("streaming_load"),
    "command_latency": _of_nodes("command_latency"),
    "single_sample": _of_nodes("single_sample"),
    "live_page": _of_nodes("live_page"),
    "lossy_link": _of_nodes("lossy_link"),
    "hostile_messages": _of_nodes("hostile_messages"),
    "supply_safety": _of_nodes("supply_safety"),
    "eight_rigs": _of_nodes("eight_rigs"),
    "topic_samples": _of_nodes("topic_samples"),
    "rig_troubles": rig_troubles.figures,
}
"""Every module of figures, in the order of the table."""

QUICK: dict[str, Measure] = {
    "window_refit": lambda: window_refit.figures(repetitions=2),
    "whole_damper": lambda: whole_damper.figures(generations=20, repetitions=1),
    "honest_errors": lambda: honest_errors.figures(windows=60),
    "drift": lambda: following.drift_figures(duration=120.0),
    "force_step": lambda: following.step_figures(offsets=(0.0, 0.5)),
    "truth": lambda: study_figures.truth_figures(quick=True),
    "control": lambda: study_figures.control_figures(quick=True),
    "global_minimum": lambda: global_minimum.figures(4, ("sigmoid",), step=4),
    "faults": lambda: faults.figures(SCENARIOS[::8], ("viscous_tanh",)),
    "healthy": lambda: healthy.figures(healthy.PROGRAMMES[2:5], ("viscous_tanh",)),
    "foreign_dampers": lambda: foreign_dampers.figures(foreign_dampers.COMBINATIONS[::5]),
    "switched_current": lambda: switched_current.figures(30.0, switched_current.CASES[:1]),
    "state_law": lambda: state_law.figures(5.0, 8.0, 16.0),
    "planned_runs": lambda: planned_runs.figures(2),
    "whole_loop": lambda: whole_loop.figures(("C",), (0,), (0, 1), ("sine", "85 %")),
    "streaming_load": _of_nodes("streaming_load", duration=30.0, latency_duration=30.0),
    "command_latency": _of_nodes("command_latency", duration=20.0),
    "single_sample": _of_nodes("single_sample", duration=15.0, overload_duration=8.0),
    "live_page": _of_nodes("live_page", duration=30.0, segment=10.0, segments=2),
    "lossy_link": _of_nodes("lossy_link", duration=20.0),
    "supply_safety": _of_nodes("supply_safety", trials=12),
    "eight_rigs": _of_nodes("eight_rigs", duration=20.0, rigs=2),
    "topic_samples": _of_nodes("topic_samples", duration=10.0),
    "rig_troubles": lambda: rig_troubles.figures(seeds=(0,)),
}
"""Shorter versions of the long ones, for development: their figures are not the real ones."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    keep_one_thread()
    options = _parser().parse_args(arguments)
    chosen = {**FULL, **QUICK} if options.quick else FULL
    figures: list[Figure] = []
    for name in options.only or chosen:
        began = time.monotonic()
        print(f"{name} ...", end=" ", file=sys.stderr, flush=True)
        figures += chosen[name]()
        print(f"{time.monotonic() - began:.1f} s", file=sys.stderr, flush=True)
        write(figures, options.output)
    if options.quick:
        print("QUICK RUN: fewer repetitions and shorter recordings; these are not the figures.")
    print(table(figures))
    print(f"\nwritten to {options.output}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="bench", description="Measure all figures.")
    parser.add_argument(
        "--quick", action="store_true", help="shorter, for development: not the real figures"
    )
    parser.add_argument(
        "--only", nargs="+", choices=list(FULL), metavar="NAME", help=f"of {', '.join(FULL)}"
    )
    parser.add_argument("--output", type=Path, default=OUTPUT, help="file (default %(default)s)")
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
