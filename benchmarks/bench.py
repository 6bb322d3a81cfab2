"""Measure all figures, write ``build/bench.json`` and print a table: ``make bench``.

With ``--soak`` what takes longer than a test may: kills, Ctrl-C, hours of data, hostile input, into
``build/soak.json``: ``make soak``.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from benchmarks.figure import Figure, table, write
from mr_damper_ros.processes.blas_threads import keep_one_thread

Arguments = Callable[[Any], tuple[Any, ...]]
"""The arguments of a function of figures, from its module."""

PARTS: dict[str, str] = {
    "window_refit": "fit_times.refit_figures",
    "whole_damper": "fit_times.global_figures",
    "inverse": "fit_times.inverse_figures",
    "noise_limit": "noise_limit.figures",
    "honest_errors": "honest_errors.figures",
    "drift": "following.drift_figures",
    "force_step": "following.step_figures",
    "switched_current": "switched_current.figures",
    "state_law": "state_law.figures",
    "reversal_jump": "reversal_jump.figures",
    "cold_start": "cold_start.figures",
    "truth": "study_figures.truth_figures",
    "control": "study_figures.control_figures",
    "global_minimum": "global_minimum.figures",
    "jitter": "jitter.figures",
    "kinematics": "kinematics.figures",
    "faults": "faults.figures",
    "healthy": "healthy.figures",
    "foreign_dampers": "foreign_dampers.figures",
    "load_cell_spikes": "load_cell_spikes.figures",
    "block_sizes": "block_sizes.figures",
    "thread_load": "thread_load.figures",
    "planned_runs": "planned_runs.figures",
    "whole_loop": "whole_loop.figures",
    "rig_troubles": "rig_troubles.figures",
    "streaming_load": "streaming_load.figures",
    "command_latency": "latency.command_figures",
    "single_sample": "latency.single_sample_figures",
    "live_page": "live_page.figures",
    "lossy_link": "lossy_link.figures",
    "hostile_messages": "hostile_messages.figures",
    "supply_safety": "supply_safety.figures",
    "eight_rigs": "eight_rigs.figures",
    "topic_samples": "topic_samples.figures",
}
"""The functions of figures, in the order of the table."""

QUICK: dict[str, Arguments] = {
    "window_refit": lambda _: (2,),
    "whole_damper": lambda _: (20, 1),
    "honest_errors": lambda _: (60,),
    "drift": lambda _: (120.0,),
    "force_step": lambda _: ((0.0, 0.5),),
    "switched_current": lambda module: (30.0, module.CASES[:1]),
    "state_law": lambda _: (5.0, 8.0, 16.0),
    "truth": lambda _: (True,),
    "control": lambda _: (True,),
    "global_minimum": lambda _: (4, ("sigmoid",), 4),
    "faults": lambda module: (module.SCENARIOS[::8], ("viscous_tanh",)),
    "healthy": lambda module: (module.PROGRAMMES[2:5], ("viscous_tanh",)),
    "foreign_dampers": lambda module: (module.COMBINATIONS[::5],),
    "load_cell_spikes": lambda module: (module.STREAMS[1:2],),
    "block_sizes": lambda module: (12.0, module.CASES[:1]),
    "thread_load": lambda _: (2, 20),
    "planned_runs": lambda _: (2,),
    "whole_loop": lambda _: (("C",), (0,), (0, 1), ("sine", "85 %")),
    "rig_troubles": lambda module: (module.FAULTS, (0,)),
    "streaming_load": lambda _: (30.0, 30.0),
    "command_latency": lambda _: (20.0,),
    "single_sample": lambda _: (15.0, 8.0),
    "live_page": lambda _: (30.0, 10.0, 2),
    "lossy_link": lambda _: (20.0,),
    "supply_safety": lambda _: (12,),
    "eight_rigs": lambda _: (20.0, 2),
    "topic_samples": lambda _: (10.0,),
}
"""Shorter versions of the long ones, for development: their figures are not the real ones."""

SOAK: dict[str, tuple[str, Callable[[argparse.Namespace], tuple[Any, ...]]]] = {
    "fuzz": ("fuzz.figures", lambda given: (given.cases, given.seed)),
    "recordings": ("hostile_recordings.figures", lambda given: (given.recordings, given.seed)),
    "kills": ("node_soak.kill_figures", lambda given: (given.kills, given.kills, given.seed)),
    "many_kills": ("program_kills.many_kills", lambda given: (50, 300, given.seed)),
    "campaign_kills": ("program_kills.campaign_kills", lambda given: (50, given.seed)),
    "starts": ("poisoned_starts.figures", lambda given: (given.starts, 40, given.seed)),
    "interrupts": ("node_soak.interrupt_figures", lambda given: (given.interrupts, given.seed)),
    "soak": (
        "node_soak.stream_figures",
        lambda given: (given.hours, min(1.0, 0.25 * given.hours)),
    ),
}
"""The parts of the soak, and their arguments from the options."""

_SOAK_OPTIONS: dict[str, tuple[float | int, str]] = {
    "hours": (8.0, "of data at 20 x"),
    "kills": (100, "of nodes, and as many of the worker"),
    "interrupts": (200, "of each node"),
    "cases": (100_000, "of hostile input"),
    "recordings": (100, "that say little or are spoilt, to identify from"),
    "starts": (10_000, "from mutated state and parameter files"),
    "seed": (0, "of what is random"),
}


def measure(function: str, arguments: Arguments | tuple[Any, ...]) -> list[Figure]:
    """The figures of a function, in a process of its own.

    Fast DDS looks for the interfaces of the network once in a process: in one that has had a
    participant before, the lossy link is not seen.
    """
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
        module, _, name = function.partition(".")
        if callable(arguments):
            arguments = arguments(import_module(f"benchmarks.{module}"))
        return process.submit(_figures, module, name, arguments).result()


def _figures(module: str, name: str, arguments: tuple[Any, ...]) -> list[Figure]:
    keep_one_thread()
    return list(getattr(import_module(f"benchmarks.{module}"), name)(*arguments))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    soak = "--soak" in (sys.argv if arguments is None else arguments)
    options = _parser(soak).parse_args(arguments)
    keep_one_thread()
    figures: list[Figure] = []
    for name in options.only or (SOAK if soak else PARTS):
        began = time.monotonic()
        print(f"{name} ...", end=" ", file=sys.stderr, flush=True)
        if soak:
            function, given = SOAK[name]
            figures += measure(function, given(options))
        else:
            quick = options.quick and name in QUICK
            figures += measure(PARTS[name], QUICK[name] if quick else ())
        print(f"{time.monotonic() - began:.1f} s", file=sys.stderr, flush=True)
        write(figures, options.output)
    if not soak and options.quick:
        print("QUICK RUN: fewer repetitions and shorter recordings; these are not the figures.")
    print(table(figures))
    print(f"\nwritten to {options.output}")
    return 0


def _parser(soak: bool) -> argparse.ArgumentParser:
    parts = list(SOAK if soak else PARTS)
    output = Path("build", "soak.json" if soak else "bench.json")
    parser = argparse.ArgumentParser(prog="bench", description=__doc__)
    parser.add_argument("--soak", action="store_true", help="soak instead of measuring")
    parser.add_argument(
        "--only", nargs="+", choices=parts, metavar="NAME", help=f"of {', '.join(parts)}"
    )
    parser.add_argument("--output", type=Path, default=output, help="file (default %(default)s)")
    if not soak:
        parser.add_argument(
            "--quick", action="store_true", help="shorter, for development: not the real figures"
        )
        return parser
    for name, (default, text) in _SOAK_OPTIONS.items():
        parser.add_argument(
            f"--{name}", type=type(default), default=default, help=f"{text} (default %(default)s)"
        )
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
