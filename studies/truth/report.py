"""Report on the accuracy of the laws: recordings, and a benchmark with a known truth."""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from pathlib import Path

from mr_damper_ros.models import MODELS
from mr_damper_ros.processes.process_pool import ProcessPool
from studies import earthquake, recordings
from studies.program import Make, Part, Say, Study, each_result, write_parts
from studies.truth.oscillator import (
    EstimationTrial,
    OscillatorTrial,
    estimate_oscillator,
    judge_on_oscillator,
    oscillator_chapter,
    oscillator_document,
    oscillator_headline,
)
from studies.truth.records import (
    EarthquakeTrial,
    Recorded,
    RecordTrial,
    earthquake_chapter,
    headlines,
    judge_earthquake,
    judge_records,
    microseconds_per_sample,
    parameter_chapter,
    record_document,
    sinusoid_chapter,
)

_TITLE = "What the force laws are worth"

_NO_RECORDINGS = (
    "The recordings were not at hand (the variable MR_DAMPER_DATA is not set to a folder that "
    "holds utfsm): here is only the benchmark, which is re-created. "
)
_NOTICE = (
    "Nothing was tuned to what it is judged by, and all random numbers have fixed seeds. Times are "
    "processor times."
)

_NEEDS_PEAKS = ("sigmoid", "sigmoid_lag")
"""Laws that depend on the peak velocity, which is known only after the motion of the mass."""


@dataclass(frozen=True)
class TruthExtent:
    """Extent of the study.

    ``laws`` are the laws under test, and ``online`` those with the identifier running. ``every`` is
    the stride over the currents of the sinusoid records. ``currents`` [A] and ``longest`` [s] apply
    to the earthquakes. The other values are the sample ``count``, the steps per sample and the
    duration of a sweep [s] of the benchmark.
    """

    laws: tuple[str, ...] = tuple(MODELS)
    online: tuple[str, ...] = tuple(MODELS)
    every: int = 1
    currents: tuple[float, ...] = earthquake.CURRENTS
    longest: float = math.inf
    count: int = 8192
    steps: int = 20
    sweep: float = math.inf


ALL = TruthExtent()
SHORT = TruthExtent(
    laws=("hyperbolic_tangent", "sigmoid", "sigmoid_lag", "series_springs"),
    online=("sigmoid",),
    every=4,
    currents=(0.6,),
    longest=20.0,
    count=1024,
    steps=5,
    sweep=10.0,
)
"""Short variant that checks whether everything works; its figures are not representative."""


def _recordings(pool: ProcessPool, quick: bool, say: Say) -> Part:
    utfsm = recordings.folder()
    if utfsm is None:
        return Part([], [], {})
    found = _recorded(utfsm, pool, SHORT if quick else ALL, say)
    chapters = [sinusoid_chapter(found), earthquake_chapter(found), parameter_chapter(found)]
    return Part(chapters, headlines(found), record_document(found))


def _recorded(utfsm: Path, pool: ProcessPool, extent: TruthExtent, say: Say) -> Recorded:
    motions = list(recordings.processed_motions(utfsm))
    tasks = [
        RecordTrial(utfsm, law, left_out, extent.every)
        for law in extent.laws
        for left_out in (None, *motions)
    ]
    judged = each_result(pool, judge_records, tasks, "sinusoid records", say)
    one_set = {task.law: result for task, result in judged.items() if task.left_out is None}
    left_out = {
        law: {
            name: error
            for task, result in judged.items()
            if task.law == law and task.left_out is not None
            for name, error in result.nrmse.items()
        }
        for law in extent.laws
    }
    trials = {
        (law, current, follows): EarthquakeTrial(
            utfsm, one_set[law].parameter_set, current, follows, extent.longest
        )
        for follows in (False, True)
        for law in extent.laws
        if not follows or law in extent.online
        for current in extent.currents
    }
    shaken = each_result(pool, judge_earthquake, list(trials.values()), "earthquakes", say)
    window = recordings.processed_windows(utfsm)[0]
    return Recorded(
        one_set,
        left_out,
        {key: shaken[trial] for key, trial in trials.items()},
        {law: microseconds_per_sample(one_set[law].parameter_set, window) for law in extent.laws},
    )


def _oscillator(pool: ProcessPool, quick: bool, say: Say) -> Part:
    extent = SHORT if quick else ALL
    tasks = [OscillatorTrial(law, extent.count, law not in _NEEDS_PEAKS) for law in extent.laws]
    results = each_result(pool, judge_on_oscillator, tasks, "laws on the benchmark", say)
    found = {task.law: result for task, result in results.items()}
    say("the benchmark in its own form")
    estimation = estimate_oscillator(EstimationTrial(extent.count, extent.steps, extent.sweep))
    return Part(
        [oscillator_chapter(found, estimation)],
        [oscillator_headline(found, estimation)],
        oscillator_document(found, estimation),
    )


_PARTS: dict[str, Make] = {"recordings": _recordings, "oscillator": _oscillator}


def _build(options: argparse.Namespace, say: Say) -> Path:
    notice = _NO_RECORDINGS if recordings.folder() is None else ""
    notice += _NOTICE
    if options.quick:
        notice += " Quick variant: few laws, few and short records; not the real figures."
    return write_parts(options, say, "truth", _TITLE, notice, _PARTS)


main = Study(
    "truth",
    "Judge every force law on the recordings in the folder that the variable MR_DAMPER_DATA names, "
    "where it is set, and on the re-created hysteretic benchmark of Noël and Schoukens; write one "
    "report, report.html, and its figures, truth.json.",
    tuple(_PARTS),
    "few laws, few and short records",
    _build,
).main
