"""``identify``: fits one parameter set of a force law to all given bags."""

from __future__ import annotations

import argparse
from pathlib import Path

from mr_damper_ros.api.findings import Findings, searches
from mr_damper_ros.api.identification import AUTO, MOST_LEFT, Identification, identify
from mr_damper_ros.estimation.differential_evolution import STRATEGIES
from mr_damper_ros.estimation.global_fit import GLOBAL_METHODS
from mr_damper_ros.estimation.record_levels import USUAL_SPREAD
from mr_damper_ros.models import MODELS
from mr_damper_ros.tools.console import (
    FAILED,
    INTERRUPTED,
    ProgressLine,
    add_arguments,
    add_json_option,
    add_plot_options,
    add_run_options,
    arguments_of,
    program,
    write_json,
    write_plots,
)

EXPLAINS_TOO_LITTLE = 3
"""Exit code if the fitted set leaves a larger error than a user would accept."""

SEARCH_HELPS = {
    "model": "force law; sigmoid_lag: with the lag of the force, a stiffness and an offset as well",
    "method": "global: laws by differential evolution, then least squares on the samples; "
    "nelder_mead, least_squares: local search on the samples; differential_evolution: over all "
    "free parameters at once, as in the thesis",
    "start": "parameter file whose values undetermined parameters keep (default: the model's own "
    "initial values, for the sigmoid law those of the thesis' literature set); model sigmoid_lag "
    "also starts from a set of model sigmoid",
    "seed": "of the random numbers",
    "generations": "of differential evolution, at most",
}
"""Help texts of the options for an identification."""

SEARCH_CHOICES = {"model": tuple(MODELS), "method": GLOBAL_METHODS}

_HELPS = {
    **SEARCH_HELPS,
    "model": SEARCH_HELPS["model"] + "; auto: the simplest of those that predict best what was "
    "left out of the bags, with a table of all",
    "strategy": "of differential evolution",
    "starts": "search from so many seeds, that given and those that follow it; the best is the "
    "result",
    "workers": "processes that read the bags, search and make the profiles; they do not change the "
    "result",
    "resume": "keep in this file what each search has found, also when stopped, and go on from it: "
    "finished searches are not done again, one that was stopped is, from what it had found",
    "mass": "that moves between load cell and damper [kg], whose inertia the force includes",
    "fit_mass": "identify that mass too; needs motion that is not one sine",
    "profile": "profile likelihood of these parameters, with their 95 % intervals; where one has "
    "its minimum elsewhere, the search starts again from there",
}

_ADVICE_HELPS = {
    "top_velocity": "largest peak velocity [m/s] of a run that may be advised (default: that of "
    "the bags)",
    "top_current": "largest current [A] of a run that may be advised (default: that of the bags)",
}


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
    choices = {**SEARCH_CHOICES, "model": (*MODELS, AUTO), "strategy": STRATEGIES}
    add_arguments(parser, identify, _HELPS, choices)
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
    add_arguments(parser, Identification.determination, _ADVICE_HELPS)
    parser.add_argument("--output", type=Path, metavar="FILE", help="write the set as YAML")
    add_json_option(parser, "all results")
    add_plot_options(parser)
    return parser


def _identify(options: argparse.Namespace) -> int:
    with ProgressLine() as progress:
        given = arguments_of(options, identify)
        result = identify(options.bags, report=progress, **given)
        more = Findings([], {})
        # After Ctrl-C the user wants the result at once, without another long computation.
        if not progress.stopped:
            more += result.determination(**arguments_of(options, Identification.determination))
        more += searches(result.searches)
        more += result.profiles
    if not progress.stopped:
        more += result.temperature_maps()
    print(result)
    print(more)
    if options.output is not None:
        result.save(options.output)
    write_json(options, result.document() | more.document)
    write_plots(options, [run.comparison for run in result.runs])
    return 0 if result.explains else EXPLAINS_TOO_LITTLE


main = program(_parser, _identify)
