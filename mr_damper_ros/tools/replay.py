"""Report what identifier and model would have published for a recording.

The report contains the verdict on each window, the predicted force and its validity.
"""

from __future__ import annotations

import argparse

from mr_damper_ros.api.comparison import FORMATS
from mr_damper_ros.api.replay import replay
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import DEFAULT_MODEL
from mr_damper_ros.report.document import save_figure
from mr_damper_ros.tools.console import add_json_option, add_path, program, write_json
from mr_damper_ros.tracking.engine import EngineSettings
from mr_damper_ros.tracking.tracker import OF_THE_SET


def _options(parser: argparse.ArgumentParser) -> None:
    add_path(parser, "bag", "BAG", "bag folder, .mcap or .db3 file")
    add_path(parser, "--parameters", "FILE", "initial parameter set (default: none)")
    parser.add_argument(
        "--model",
        choices=(OF_THE_SET, *MODELS),
        default=OF_THE_SET,
        help=f"force law to identify (default {OF_THE_SET}: the law of --parameters, or "
        f"{DEFAULT_MODEL} without --parameters)",
    )
    add_path(parser, "--output", "FILE", "write the newest set as YAML")
    add_json_option(parser, "the result")
    add_path(parser, "--plot", "FILE", f"draw the result ({', '.join(FORMATS)})")


def _replay(options: argparse.Namespace) -> int:
    kind = "" if options.plot is None else options.plot.suffix.removeprefix(".")
    if options.plot is not None and kind not in FORMATS:
        raise ValueError(f"{options.plot} must end in .{', .'.join(FORMATS)}")
    result = replay(
        options.bag, options.parameters, settings=EngineSettings().for_law(options.model)
    )
    print(result)
    write_json(options, result.document())
    if options.plot is not None:
        save_figure(result.plot(), options.plot)
    if options.output is not None:
        if result.parameter_set is None:
            raise ValueError(f"no set was accepted: {options.output} is not written")
        result.parameter_set.save(options.output)
    return 0


main = program("mr-damper replay", __doc__, _options, _replay)
