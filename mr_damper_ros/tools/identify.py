"""``identify``: one parameter set of the sigmoid law for all bags given."""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from mr_damper_ros.estimation.differential_evolution import STRATEGIES, EvolutionSettings
from mr_damper_ros.estimation.experiment_design import RigRange
from mr_damper_ros.estimation.global_fit import GLOBAL_METHODS, GlobalFit
from mr_damper_ros.estimation.multi_start import (
    SearchRecord,
    SearchRecordError,
    identify_from_seeds,
)
from mr_damper_ros.models.parameter_set import DEFAULT_MODEL, ParameterSet
from mr_damper_ros.models.published import LITERATURE
from mr_damper_ros.models.sigmoid.extension import EXTENDED_MODEL, without_extension
from mr_damper_ros.models.sigmoid.law import COEFFICIENT_NAMES
from mr_damper_ros.models.sigmoid.scale_misfit import Window
from mr_damper_ros.processes.process_pool import ProcessPool, Tell
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tools import findings
from mr_damper_ros.tools.bag_windows import BagWindows, bag_windows, metrics
from mr_damper_ros.tools.console import run_tool, write_text
from mr_damper_ros.tools.progress import ProgressLine
from mr_damper_ros.tools.temperature_map import temperature_maps
from mr_damper_ros.tracking.state_directory import read_parameter_file

_DEFAULTS = EvolutionSettings()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    return run_tool(_parser(), _identify, arguments)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="identify",
        description="Fit one parameter set of the sigmoid force law to all bags given.",
    )
    parser.add_argument(
        "bags", nargs="+", type=Path, metavar="BAG", help="bag folder or .mcap file"
    )
    parser.add_argument(
        "--model",
        choices=(DEFAULT_MODEL, EXTENDED_MODEL),
        default=DEFAULT_MODEL,
        help="sigmoid: the sixteen parameters (default); sigmoid_lag: with the lag of the force, a "
        "stiffness and an offset as well",
    )
    parser.add_argument(
        "--method",
        choices=GLOBAL_METHODS,
        default="global",
        help="global: laws by differential evolution, then least squares on the samples (default); "
        "nelder_mead, least_squares: local search on the samples; differential_evolution: over "
        "all free parameters at once, as in the thesis",
    )
    parser.add_argument(
        "--start",
        default="literature",
        metavar="FILE",
        help="parameter file whose values undetermined parameters keep (default: the thesis' "
        "literature set); model sigmoid_lag also starts from a set of model sigmoid",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the random numbers (default 0)")
    parser.add_argument(
        "--strategy",
        choices=STRATEGIES,
        default=_DEFAULTS.strategy,
        help="of differential evolution (default %(default)s)",
    )
    parser.add_argument(
        "--generations",
        type=int,
        default=_DEFAULTS.generations,
        help="of differential evolution, at most (default %(default)s)",
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
        help="profile likelihood of these parameters, with their 95 %% intervals",
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
    return parser


def _identify(options: argparse.Namespace) -> int:
    start = _start(options.start, options.model)
    settings = EvolutionSettings(
        strategy=options.strategy, generations=options.generations, seed=options.seed
    )
    with ProcessPool(options.workers) as processes:
        bags = [bag for bag in processes.map(_read, options.bags) if bag is not None]
        windows = [window for bag in bags for window in bag.windows]
        record = SearchRecord(windows, start, settings, options.method)
        if options.resume is not None and options.resume.exists():
            _take(record, options.resume)
        began = time.monotonic()
        with ProgressLine() as progress:
            found = identify_from_seeds(
                windows,
                start,
                settings,
                options.starts,
                progress,
                method=options.method,
                processes=processes,
                record=record,
                keep=None if options.resume is None else partial(_keep, options.resume),
            )
            duration = time.monotonic() - began
            fit = found.best
            more = findings.determined(fit, windows, _rig(windows, options))
            more += findings.searches(found)
            if options.profile:
                more += findings.profiles(fit, windows, options.profile, processes, progress)
    if any(celsius is not None for bag in bags for celsius in bag.temperatures):
        maps = temperature_maps(bags, fit.parameter_set.values).identified
        more += findings.temperatures(maps)
    document = _document(fit, bags, options.method, duration) | more.document
    print(_table(fit.parameter_set, document))
    print("\n".join(more.lines))
    if options.output is not None:
        write_text(options.output, fit.parameter_set.to_yaml())
    if options.json is not None:
        write_text(options.json, json.dumps(document, indent=2, allow_nan=False) + "\n")
    return 0


def _read(path: Path, tell: Tell) -> BagWindows:
    return bag_windows(path)


def _take(record: SearchRecord, path: Path) -> None:
    try:
        record.take(json.loads(path.read_text(encoding="utf-8")))
    except ValueError as error:
        detail = (
            error if isinstance(error, SearchRecordError) else "it is not the record of a search"
        )
        raise ValueError(f"cannot resume from {path}: {detail}") from error


def _keep(path: Path, record: SearchRecord) -> None:
    write_text(path, json.dumps(record.document()) + "\n")


def _rig(windows: Sequence[Window], options: argparse.Namespace) -> RigRange:
    done = RigRange.of_windows(windows)
    speed, current = options.top_velocity, options.top_current
    return RigRange(
        amplitude=done.amplitude,
        peak_velocity=done.peak_velocity if speed is None else speed,
        current=done.current if current is None else current,
    )


def _start(source: str, model: str) -> Array:
    found = ParameterSet(LITERATURE) if source == "literature" else read_parameter_file(source)
    if model == EXTENDED_MODEL and found.model == DEFAULT_MODEL:
        return without_extension(found.values)
    return found.of_model(model).values


def _document(
    fit: GlobalFit, bags: Sequence[BagWindows], method: str, duration: float
) -> dict[str, Any]:
    found = fit.parameter_set
    names = found.law.parameter_names
    return {
        "model": found.model,
        "parameters": found.as_dict(),
        "standard_errors": {
            name: None if math.isnan(error) else float(error)
            for name, error in zip(names, found.standard_errors, strict=True)
        },
        "observable": dict(zip(names, map(bool, found.observable), strict=True)),
        "metrics": asdict(metrics(found, [window for bag in bags for window in bag.windows])),
        "evaluations": fit.evaluations,
        "duration_s": duration,
        "method": method,
        "message": fit.message,
        "bags": [_bag_entry(fit, bag) for bag in bags],
    }


def _bag_entry(fit: GlobalFit, bag: BagWindows) -> dict[str, Any]:
    longest = max(bag.windows, key=lambda window: window.sample_count)
    peak_velocity, current = longest.operating_point
    coefficients, errors = fit.coefficients((peak_velocity, current))
    return {
        "bag": str(bag.path),
        "metrics": asdict(metrics(fit.parameter_set, bag.windows)),
        "operating_point": {"peak_velocity": peak_velocity, "current": current},
        "coefficients": dict(zip(COEFFICIENT_NAMES, coefficients.tolist(), strict=True)),
        "coefficient_standard_errors": {
            name: error if math.isfinite(error) else None
            for name, error in zip(COEFFICIENT_NAMES, errors.tolist(), strict=True)
        },
    }


def _table(found: ParameterSet, document: dict[str, Any]) -> str:
    lines = ["parameter        value  standard error  unit"]
    for parameter, value, error, observable in zip(
        found.law.parameters, found.values, found.standard_errors, found.observable, strict=True
    ):
        shown = f"{error:14.3g}" if observable else "not observable"
        lines.append(f"{parameter.name:>9} {value:12.6g}  {shown}  {parameter.unit}")
    lines.append("")
    for bag in document["bags"]:
        error = bag["metrics"]
        lines.append(
            f"{bag['bag']}: RMSE {error['rmse']:.4g} N, NRMSE {error['nrmse']:.2%} "
            f"({error['n_samples']} samples)"
        )
    lines.append(
        f"{document['method']}: {document['evaluations']} evaluations in "
        f"{document['duration_s']:.2f} s, {document['message']}"
    )
    return "\n".join(lines)
