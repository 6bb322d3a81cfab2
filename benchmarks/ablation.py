"""What each mechanism is worth: the figures with it and without it.

    python -m benchmarks.ablation                      every mechanism (some hours)
    python -m benchmarks.ablation "change checks"      one of them, by its name
    python -m benchmarks.ablation --list               the mechanisms with their constants

The cases are part of those of the benchmarks: foreign dampers, faults, a switched current, the
quarter car under control and, where MR_DAMPER_DATA is set, raw records, for three seeds. Each case
runs with and without the mechanism. A figure changes if the mean difference over its cases exceeds
twice its standard error. Mechanisms are switched off in processes of their own, from outside: the
programs have no such option.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks import faults, following, foreign_dampers, whole_loop
from benchmarks.dampers import DAMPERS
from benchmarks.figure import PROCESSES, some_of
from benchmarks.real_records import raw_records
from benchmarks.streams import StreamTrial, TrialSettings
from mr_damper_ros.api.replay import replay
from mr_damper_ros.processes.blas_threads import keep_one_thread
from mr_damper_ros.tracking.acceptance import ACCEPTED, Gatekeeper, Judgement, Verdict
from mr_damper_ros.tracking.engine import EngineSettings
from studies import recordings

# -- mechanisms ------------------------------------------------------------------------------------

Switch = tuple[str, Any]
"""What is replaced, as "module:name" or "module:class.name" below mr_damper_ros, and by what."""


@dataclass(frozen=True)
class Mechanism:
    """A part of the core that can be left out, with its tuned constants ("module:name")."""

    name: str
    constants: tuple[str, ...]
    off: tuple[Switch, ...]

    def switch_off(self) -> None:
        """Leave the mechanism out in this process."""
        for place, value in self.off:
            owner, name = _owner(place)
            setattr(owner, name, value)


def _owner(place: str) -> tuple[Any, str]:
    """The module or class of a name, and the last part of the name; AttributeError without it."""
    module, _, path = place.partition(":")
    owner: Any = import_module(f"mr_damper_ros.{module}")
    *classes, name = path.split(".")
    for each in classes:
        owner = getattr(owner, each)
    getattr(owner, name)
    return owner, name


def _never(*_: Any, **__: Any) -> bool:
    return False


def _no_objection(*_: Any, **__: Any) -> str:
    return ""


def _nothing(*_: Any, **__: Any) -> None:
    return None


def _at_once(judge: Callable[..., Judgement]) -> Callable[..., Judgement]:
    """A judgement that does not wait for the next window."""

    def judged(*given: Any, **named: Any) -> Judgement:
        found = judge(*given, **named)
        return ACCEPTED if found.verdict is Verdict.UNCONFIRMED else found

    return judged


def _explained(_window: Any, _parts: Any, found: Any) -> tuple[float, bool]:
    return math.nan, True


_GATE = "tracking.acceptance:"
_BANK = "tracking.model_bank:"
_MONITOR = "tracking.residual_monitor:"

MECHANISMS = (
    Mechanism(
        "change checks",
        ("tracking.tracker:TrackerSettings.smallest_change",),
        ((f"{_GATE}Gatekeeper.may_be_early", _never),),
    ),
    Mechanism(
        "current schedule",
        (f"{_BANK}_RECENT_NS",),
        ((f"{_BANK}ModelBank.follow_current", _nothing),),
    ),
    Mechanism(
        "branch rule chosen at run time",
        (f"{_BANK}_EVIDENCE_DECAY",),
        ((f"{_BANK}ModelBank.with_other_branch_rule", _nothing),),
    ),
    Mechanism(
        "search among former sets",
        (f"{_BANK}_MOST_SETS", f"{_BANK}_JUDGED_TIME", f"{_BANK}_BETTER_RATIO"),
        ((f"{_BANK}ModelBank._better", _nothing),),
    ),
    Mechanism(
        "confirmation of sudden changes (UNCONFIRMED)",
        (f"{_GATE}LARGE_SHAPE_CHANGE", f"{_GATE}AcceptanceSettings.step_limit"),
        ((f"{_GATE}Gatekeeper._comparison", _at_once(Gatekeeper._comparison)),),
    ),
    Mechanism(
        "confirmation of global sets",
        (),
        ((f"{_GATE}Gatekeeper.judge_global", _at_once(Gatekeeper.judge_global)),),
    ),
    Mechanism(
        "zero of the load cell",
        (),
        ((f"{_MONITOR}LoadCellZero.learn", _nothing),),
    ),
    Mechanism(
        "residual baseline",
        (f"{_GATE}AcceptanceSettings.residual_factor",),
        ((f"{_GATE}Gatekeeper._disturbance", _nothing),),
    ),
    Mechanism(
        "longer patience where the damper is known",
        (f"{_GATE}Gatekeeper._PATIENCE_WHERE_KNOWN", f"{_GATE}Gatekeeper._PATIENCE"),
        ((f"{_GATE}Gatekeeper._PATIENCE_WHERE_KNOWN", 4),),
    ),
    Mechanism(
        "limit of the loss elsewhere",
        (f"{_GATE}_LARGEST_LOSS",),
        ((f"{_GATE}_LARGEST_LOSS", math.inf),),
    ),
    Mechanism(
        "worthwhile improvement only",
        (),
        ((f"{_GATE}_WORTHWHILE", 1.0),),
    ),
    Mechanism(
        "significance of the lead",
        (f"{_GATE}SIGNIFICANT_LEAD",),
        ((f"{_GATE}SIGNIFICANT_LEAD", 0.0),),
    ),
    Mechanism(
        "limits of change (BEYOND_LIMITS)",
        (f"{_GATE}AcceptanceSettings.change_limit",),
        (("tracking.operating_point:KnownPoints.objection", _no_objection),),
    ),
    Mechanism(
        "windows that the dependence on current does not explain",
        ("tracking.tracker:_POINT_GROWTH",),
        (("tracking.tracker:judge_parts", _explained),),
    ),
    Mechanism(
        "prior widened by doubling",
        ("estimation.window_fit:_MOST_DOUBLINGS", "estimation.window_fit:_CONTRADICTED"),
        (("estimation.window_fit:_MOST_DOUBLINGS", 1),),
    ),
    Mechanism(
        "prior of the running set",
        ("estimation.window_fit:DRIFT_PER_WINDOW",),
        (("estimation.window_fit:DRIFT_PER_WINDOW", 1e6),),
    ),
    Mechanism(
        "rejected windows make the force invalid",
        ("tracking.validity:_IN_A_ROW",),
        (("tracking.validity:RefusedWindows.follow", _nothing),),
    ),
    Mechanism(
        "implausible sets",
        (),
        (("tracking.tracker:implausible", _no_objection),),
    ),
)
"""The mechanisms, each left out by itself."""


# -- cases -----------------------------------------------------------------------------------------

Values = dict[str, float]
"""Figures of a case by name; NaN without a value."""


class Case(NamedTuple):
    """A case by name; ``run`` returns its figures."""

    name: str
    run: Callable[[], Values]


def _foreign(given: foreign_dampers.Combination) -> Values:
    found = foreign_dampers.run(given)
    return {
        "foreign wrong valid [s]": found.wrong_valid,
        "foreign right refused [%]": 100.0 * found.refused,
        "foreign worse sets": float(len(found.worse_sets)),
    }


def _faulty(scenario: faults.Scenario, damper: str, seed: int) -> Values:
    motion, current = faults.STREAMS[scenario.stream]
    settings = TrialSettings(seed, block_size=20)
    base = StreamTrial(DAMPERS[damper], motion(seed), current, settings=settings)
    base.advance(scenario.begin - 0.5)
    found = faults.run(base, scenario, damper, seed)
    recovery = min(found.recovery, faults.LONGEST_RECOVERY)
    return {
        "faults wrong valid [s]": found.wrong.total,
        "faults recovery [windows]": recovery,
        "faults bad sets": float(len(found.bad_sets)),
    }


def _switched(case: following.SwitchedStream) -> Values:
    found = following.streamed(case, 20.0)
    asked = foreign_dampers.asked(found)
    count = max(int(np.count_nonzero(asked)), 1)
    return {
        "switched wrong valid [s]": found.wrong_valid().total,
        "switched right refused [%]": 100.0
        * float(np.count_nonzero(asked & found.right & ~found.valid))
        / count,
    }


def _driven(road: str, seed: int) -> Values:
    found = whole_loop.driven(road, seed, 20.0)
    return {
        "loop refused [%]": 100.0 * (1.0 - found.valid),
        "loop NRMSE over that of the exact set": found.nrmse / found.exact,
        "loop time at the safe current [%]": 100.0 * found.safe,
        "loop range of currents lost [%]": 100.0 * (1.0 - found.reach),
    }


def _raw(place: Path, number: int, law: str) -> Values:
    record = raw_records(place)[number]
    record = recordings.cut(record, slice(0, round(25.0 / record.period)))
    found = replay(record, settings=EngineSettings().for_law(law))
    error = recordings.rms((found.predicted - record.force)[found.valid])
    return {
        "raw records invalid [%]": 100.0 * float(np.mean(~found.valid)),
        "raw records NRMSE of the valid force": error / float(np.std(record.force)),
    }


_EVERY_FOREIGN, _EVERY_FAULT = 9, 15
"""One in so many cases is run for each seed."""

_FAULTY = ("viscous_tanh", "bouc_wen")
"""Dampers of the cases with faults."""


def cases(seeds: int) -> list[Case]:
    """The cases of all seeds."""
    found = []
    for seed in range(seeds):
        of_seed: list[Case] = [
            Case(each.name, partial(_foreign, each))
            for each in some_of(foreign_dampers.combinations(seed), _EVERY_FOREIGN, seed)
        ]
        for number, each in enumerate(some_of(faults.SCENARIOS, _EVERY_FAULT, seed)):
            damper = _FAULTY[number % len(_FAULTY)]
            of_seed.append(Case(f"{each.name}, {damper}", partial(_faulty, each, damper, seed)))
        for road in "BD":
            of_seed.append(Case(f"road {road}", partial(_driven, road, seed)))
        found += [each._replace(name=f"seed {seed}: {each.name}") for each in of_seed]
    found += [Case(each.name, partial(_switched, each)) for each in following.SWITCHED]
    if (place := recordings.folder()) is not None:
        for law, number in (("sigmoid", 0), ("sigmoid_lag", 2), ("sigmoid", 4), ("sigmoid_lag", 7)):
            run = partial(_raw, place, number, law)
            found.append(Case(f"raw record {number} by {law}", run))
    return found


# -- with and without ------------------------------------------------------------------------------


def _begin(mechanism: str) -> None:
    keep_one_thread()
    if mechanism:
        next(each for each in MECHANISMS if each.name == mechanism).switch_off()


_FAILED = "cases that fail"


def _figures_of(case: Case) -> Values:
    try:
        return case.run()
    except Exception as error:  # without the mechanism a case may fail
        print(f"{case.name}: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
        return {_FAILED: 1.0}


def measured(mechanism: str, given: Sequence[Case]) -> list[Values]:
    """Figures of the cases without a mechanism, or with all of them (empty name)."""
    context = get_context("spawn")
    with ProcessPoolExecutor(
        PROCESSES, mp_context=context, initializer=_begin, initargs=(mechanism,)
    ) as pool:
        return list(pool.map(_figures_of, given))


class Change(NamedTuple):
    """Mean of a figure over ``cases`` with a mechanism, and its mean change without it."""

    figure: str
    mean: float
    change: float
    error: float
    cases: int

    @property
    def counts(self) -> bool:
        """Whether the change exceeds the scatter of the cases."""
        return abs(self.change) > 2.0 * self.error

    def __str__(self) -> str:
        mark = "*" if self.counts else " "
        return (
            f" {mark} {self.figure:40} {self.mean:9.4g} {self.change:+10.4g} ± {self.error:.3g}"
            f" ({self.cases} cases)"
        )


def changes(before: Iterable[Values], after: Iterable[Values]) -> list[Change]:
    """The mean changes of all figures, paired by case; the error is that of the mean."""
    pairs = list(zip(before, after, strict=True))
    found = []
    for figure in sorted({name for pair in pairs for values in pair for name in values}):
        # A case that fails in one of the two has no other figures to compare.
        missing = 0.0 if figure == _FAILED else math.nan
        table = np.array([[values.get(figure, missing) for values in pair] for pair in pairs])
        table = table[np.isfinite(table).all(axis=1)]
        if table.size:
            apart, count = table[:, 1] - table[:, 0], len(table)
            error = float(np.std(apart, ddof=1)) / math.sqrt(count) if count > 1 else math.inf
            found.append(
                Change(figure, float(table[:, 0].mean()), float(apart.mean()), error, count)
            )
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    parser = argparse.ArgumentParser(prog="ablation", description=__doc__.split("\n")[0])
    parser.add_argument("mechanisms", nargs="*", metavar="MECHANISM", help="default: all")
    parser.add_argument("--list", action="store_true", help="list the mechanisms")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--output", type=Path, default=Path("build", "ablation.json"))
    options = parser.parse_args(arguments)
    known = {each.name: each for each in MECHANISMS}
    if options.list:
        for each in MECHANISMS:
            print(f"{each.name}: {', '.join(each.constants) or 'no constants of its own'}")
        return 0
    if unknown := [each for each in options.mechanisms if each not in known]:
        parser.error(f"unknown: {', '.join(unknown)}; known are {', '.join(known)}")
    given = cases(options.seeds)
    before = measured("", given)
    document = {}
    options.output.parent.mkdir(parents=True, exist_ok=True)
    for name in options.mechanisms or known:
        began = time.monotonic()
        found = changes(before, measured(name, given))
        print(f"\nwithout {name} ({time.monotonic() - began:.0f} s):", *found, sep="\n", flush=True)
        document[name] = [each._asdict() for each in found]
        options.output.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
