"""``identify``: one parameter set of a force law for all bags given."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

from mr_damper_ros.api.findings import Findings, searches
from mr_damper_ros.api.identification import AUTO, MOST_LEFT, identify
from mr_damper_ros.estimation.differential_evolution import STRATEGIES, EvolutionSettings
from mr_damper_ros.estimation.global_fit import GLOBAL_METHODS
from mr_damper_ros.estimation.record_levels import USUAL_SPREAD
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import DEFAULT_MODEL
from mr_damper_ros.processes.files import write_text
from mr_damper_ros.tools.console import (
    FAILED,
    INTERRUPTED,
    ProgressLine,
    add_plot_options,
    add_run_options,
    program,
    write_plots,
)

EXPLAINS_TOO_LITTLE = 3
"""Exit code where the set found leaves more of the force than a reader would accept."""

_AUTO_HELP = (
    "; auto: the simplest of those that predict best what was left out of the bags, with a table "
    "of all"
)

_DEFAULTS = EvolutionSettings()


def add_search_options(
    group: argparse.ArgumentParser | argparse._ArgumentGroup, models: Sequence[str]
) -> None:
    """Add what a program takes that identifies: the law, the search, its start and its seed."""
    group.add_argument(
        "--model",
        choices=models,
        default=DEFAULT_MODEL,
        help="force law (default %(default)s); sigmoid_lag: with the lag of the force, a stiffness "
        "and an offset as well" + (_AUTO_HELP if AUTO in models else ""),
    )
    group.add_argument(
        "--method",
        choices=GLOBAL_METHODS,
        default="global",
        help="global: laws by differential evolution, then least squares on the samples (default); "
        "nelder_mead, least_squares: local search on the samples; differential_evolution: over "
        "all free parameters at once, as in the thesis",
    )
    group.add_argument(
        "--start",
        metavar="FILE",
        help="parameter file whose values undetermined parameters keep (default: the model's own "
        "initial values, for the sigmoid law those of the thesis' literature set); model "
        "sigmoid_lag also starts from a set of model sigmoid",
    )
    group.add_argument("--seed", type=int, default=0, help="of the random numbers (default 0)")
    group.add_argument(
        "--generations",
        type=int,
        default=_DEFAULTS.generations,
        help="of differential evolution, at most (default %(default)s)",
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="identify",
        description="Fit one parameter set of a force law to all bags given, of any amplitudes, "
        "frequencies and currents.",
        epilog=f"Exit code: 0; {EXPLAINS_TOO_LITTLE} where the set leaves an NRMSE above "
        f"{100 * MOST_LEFT:.0f} % in a run, with all results written; {FAILED} where a bag or an "
        f"option cannot be used; {INTERRUPTED} after Ctrl-C pressed twice.",
    )
    add_run_options(parser)
    add_search_options(parser, (*MODELS, AUTO))
    parser.add_argument(
        "--strategy",
        choices=STRATEGIES,
        default=_DEFAULTS.strategy,
        help="of differential evolution (default %(default)s)",
    )
    parser.add_argument(
        "--starts",
        type=int,
        default=1,
        metavar="N",
        help="search from N seeds, that given and those that follow it; the best is the result "
        "(default 1)",
    )
    parser.add_argument(
        "--workers",
        type=int,
        default=1,
        metavar="N",
        help="processes that read the bags, search and make the profiles; they do not change the "
        "result (default 1)",
    )
    parser.add_argument(
        "--resume",
        type=Path,
        metavar="FILE",
        help="keep in FILE what each search has found, also when stopped, and go on from it: "
        "finished searches are not done again, one that was stopped is, from what it had found",
    )
    parser.add_argument(
        "--profile",
        nargs="+",
        default=[],
        metavar="NAME",
        help="profile likelihood of these parameters, with their 95 %% intervals; where one has "
        "its minimum elsewhere, the search starts again from there",
    )
    parser.add_argument(
        "--level-per-record",
        nargs="?",
        type=float,
        const=USUAL_SPREAD,
        default=0.0,
        metavar="SPREAD",
        help="give each bag a force scale, drawn to 1 with this standard deviation (default "
        "%(const)s), and a force zero of its own, so that temperature, filling and an uncentred "
        "load cell do not bend the law",
    )
    parser.add_argument(
        "--top-velocity",
        type=float,
        metavar="M/S",
        help="largest peak velocity of a run that may be advised (default: that of the bags)",
    )
    parser.add_argument(
        "--top-current",
        type=float,
        metavar="A",
        help="largest current of a run that may be advised (default: that of the bags)",
    )
    parser.add_argument("--output", type=Path, metavar="FILE", help="write the set as YAML")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all results as JSON")
    add_plot_options(parser)
    return parser


def _identify(options: argparse.Namespace) -> int:
    with ProgressLine() as progress:
        result = identify(
            options.bags,
            model=options.model,
            method=options.method,
            start=options.start,
            seed=options.seed,
            strategy=options.strategy,
            generations=options.generations,
            starts=options.starts,
            workers=options.workers,
            accept_doubtful=options.accept_doubtful,
            resume=options.resume,
            profile=options.profile,
            level_per_record=options.level_per_record,
            report=progress,
        )
        more = Findings([], {})
        # Who has pressed Ctrl-C wants the result, and not what may take as long again.
        if not progress.stopped:
            more += result.determination(
                top_velocity=options.top_velocity, top_current=options.top_current
            )
        more += searches(result.searches)
        more += result.profiles
    if not progress.stopped:
        more += result.temperature_maps()
    print(result)
    print(more)
    if options.output is not None:
        result.save(options.output)
    if options.json is not None:
        document = result.document() | more.document
        write_text(options.json, json.dumps(document, indent=2, allow_nan=False) + "\n")
    write_plots(options, [run.comparison for run in result.runs])
    return 0 if result.explains else EXPLAINS_TOO_LITTLE


main = program(_parser, _identify)
