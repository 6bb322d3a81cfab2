"""Fit one parameter set of a force law to all bags.

The bags may have different amplitudes, frequencies and currents.
"""

from __future__ import annotations

import argparse
from typing import Any

from mr_damper_ros.api.causes import LARGEST_NRMSE
from mr_damper_ros.api.details import Details, searches
from mr_damper_ros.api.identification import AUTO, Identification, identify
from mr_damper_ros.estimation.differential_evolution import STRATEGIES
from mr_damper_ros.estimation.experiment_design import MachineLimits
from mr_damper_ros.estimation.global_fit import GLOBAL_METHODS
from mr_damper_ros.estimation.record_levels import USUAL_SPREAD
from mr_damper_ros.models import MODELS
from mr_damper_ros.processes.exits import DOUBTFUL, FAILED, INTERRUPTED, UNREAD
from mr_damper_ros.tools import console

_OPTIONS = (
    *("model", "method", "start", "seed", "strategy", "generations", "starts", "workers"),
    *("resume", "mass", "fit_mass", "profile"),
)


_EPILOG = f"""\
Exit code: 0: success; {DOUBTFUL}: all results are written, but there is a warning, such
as an NRMSE above {100 * LARGEST_NRMSE:.0f} % (0 with --accept-doubtful);
{FAILED}: a bag or an option cannot be used; {INTERRUPTED}: Ctrl-C was pressed twice,
or after the search; {UNREAD}: the output was closed before its end, and files may be
missing.
"""


def _options(parser: argparse.ArgumentParser) -> None:
    console.add_run_options(parser)
    choices = {"model": (*MODELS, AUTO), "method": GLOBAL_METHODS, "strategy": STRATEGIES}
    console.add_arguments(parser, identify, _OPTIONS, choices)
    parser.add_argument(
        "--level-per-record",
        nargs="?",
        type=float,
        const=USUAL_SPREAD,
        default=0.0,
        metavar="SPREAD",
        help=f"{console.parameter_texts(identify)['level_per_record']} Default: %(const)s.",
    )
    console.add_arguments(parser, Identification.determination, ["top_velocity", "top_current"])
    console.add_path(parser, "--output", "FILE", "write the set as YAML")
    console.add_result_options(parser, "all results")


def _identify(options: argparse.Namespace) -> int:
    # A wrong range is refused before the long computation.
    tops = {"peak_velocity": options.top_velocity, "current": options.top_current}
    limits: dict[str, Any] = {n: 1.0 if top is None else top for n, top in tops.items()}
    MachineLimits(amplitude=1.0, force=1.0, duration=1.0, **limits)
    with console.ProgressLine() as progress:
        given = console.arguments_of(options, identify)
        result = identify(options.bags, report=progress, **given)
    # The result comes first, so that nothing that follows can lose it.
    if options.output is not None:
        result.save(options.output)
    print(result, flush=True)
    more = Details([], {})
    # After Ctrl-C the user wants the result at once, without another long computation.
    if not progress.stopped:
        more += result.determination(**console.arguments_of(options, Identification.determination))
    more += searches(result.searches)
    more += result.profiles
    if not progress.stopped:
        more += result.temperature_maps()
    print(more)
    console.write_result(options, result.document() | more.document, result.runs)
    return DOUBTFUL if result.warnings else 0


main = console.program("mr-damper identify", __doc__, _options, _identify, _EPILOG)
