"""Regression check: compare the results of some forty streams with stored results.

    python -m benchmarks.characterisation          run all streams and print the differences
    python -m benchmarks.characterisation --keep   run all streams and store the results
    python -m benchmarks.characterisation sine     run only streams with "sine" in their name

Verdicts, sets, forces and validity of emulated dampers (own and foreign laws, switched currents,
faults), of the shipped bags and, where MR_DAMPER_DATA is set, of real records.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import following, foreign_dampers
from benchmarks.figure import PROCESSES
from benchmarks.real_records import raw_records
from benchmarks.streams import SetInUse, TrialResult
from mr_damper_ros.api.replay import Replay, replay
from mr_damper_ros.processes.files import write_text
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.tracking.engine import EngineSettings
from studies import recordings

KEPT = Path(__file__).with_suffix(".json")

_EVERY = 0.5
"""Interval [s] of the stored forces; each is the mean of |F| over one interval."""

_SWITCHED = 20.0
_LONGEST = 25.0
"""Duration [s] of a stream with switched current, and of a real record."""

_DIGITS = 6

_SAME = 1e-4
"""Relative difference below which two numbers differ only by rounding."""

Said = dict[str, Any]
"""Results of a stream: ``reports`` and ``sets``, and ``force`` and ``valid`` every half second."""


def streams() -> dict[str, Callable[[], TrialResult | Replay]]:
    """All streams by name."""
    bags = sorted((Path(__file__).parents[1] / "bags").iterdir())
    found: dict[str, Callable[[], TrialResult | Replay]] = {
        f"bag {path.name}": partial(replay, path) for path in bags if path.is_dir()
    }
    for each in foreign_dampers.combinations()[::5]:
        found[f"foreign {each.name}"] = each.run
    for case in following.SWITCHED:
        found[f"switched {case.name}"] = partial(following.streamed, case, _SWITCHED)
    place = recordings.folder()
    if place is not None:
        for law in ("sigmoid_lag", "series_springs"):
            for number in (0, 2, 4, 7):
                found[f"raw record {number} by {law}"] = partial(
                    _record, partial(raw_records, place), number, law
                )
            found[f"earthquake by {law}"] = partial(
                _record, partial(recordings.unsmoothed_earthquakes, place), 1, law
            )
    return found


def _record(read: Callable[[], Sequence[Recording]], number: int, law: str) -> Replay:
    record = read()[number]
    begin = recordings.cut(record, slice(0, round(_LONGEST / record.period)))
    return replay(begin, settings=EngineSettings().for_law(law))


def _said(result: TrialResult | Replay) -> Said:
    sets = [each.parameters if isinstance(each, SetInUse) else each for each in result.sets]
    time = result.time
    parts = np.searchsorted(time, np.arange(time[0], time[-1], _EVERY))
    counts = np.diff([*parts, time.size])
    force = np.add.reduceat(np.nan_to_num(np.abs(result.predicted)), parts) / counts
    share = np.add.reduceat(result.valid.astype(float), parts) / counts
    return {
        "reports": [
            [each.verdict.name, each.set_id, *map(_rounded, (each.nrmse_before, each.nrmse_after))]
            for each in result.reports
        ],
        "sets": {each.set_id: [_rounded(value) for value in each.values] for each in sets},
        "force": [_rounded(value) for value in force],
        "valid": [round(value, 3) for value in share.tolist()],
    }


def _rounded(value: float) -> float | None:
    return float(f"{value:.{_DIGITS}g}") if np.isfinite(value) else None


def differences(before: Said, now: Said) -> Iterator[str]:
    """Descriptions of the differences; only the first different verdict or set is listed."""
    for number, (old, new) in enumerate(zip(before["reports"], now["reports"], strict=False)):
        if not _same(old, new):
            yield f"report {number}: {_told(old)}, now {_told(new)}"
            break
    if len(before["reports"]) != len(now["reports"]):
        yield f"{len(before['reports'])} reports, now {len(now['reports'])}"
    for name in before["sets"]:
        if not _same(before["sets"][name], now["sets"].get(name, [])):
            yield f"set {name} differs"
            break
    count = min(len(before["force"]), len(now["force"]))
    old, new = (np.array(each["force"][:count]) for each in (before, now))
    change = float(np.sqrt(np.mean((new - old) ** 2) / max(float(np.mean(old**2)), 1e-12)))
    if change > _SAME:
        yield f"the predicted force differs by {change:.2%}"
    old, new = (np.array(each["valid"][:count]) for each in (before, now))
    if np.any(np.abs(new - old) > _SAME):
        yield f"valid {np.mean(old):.1%}, now {np.mean(new):.1%}"


def _same(old: Sequence[Any], new: Sequence[Any]) -> bool:
    return len(old) == len(new) and all(
        a == b
        if isinstance(a, str) or a is None or b is None
        else abs(a - b) <= _SAME * max(abs(a), abs(b))
        for a, b in zip(old, new, strict=True)
    )


def _told(report: Sequence[Any]) -> str:
    return " ".join(str(value) for value in report)


def _run(name: str) -> tuple[str, Said]:
    return name, _said(streams()[name]())


def main() -> int:
    """Run the program; the exit code is 1 if there is a difference."""
    parser = argparse.ArgumentParser(
        prog="characterisation",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--keep", action="store_true", help="keep what comes out")
    parser.add_argument("part", nargs="?", default="", help="part of the names of streams")
    options = parser.parse_args()
    chosen = [name for name in streams() if options.part in name]
    kept = json.loads(KEPT.read_text(encoding="utf-8")) if KEPT.exists() else {}
    changed = 0
    with ProcessPoolExecutor(PROCESSES, mp_context=get_context("spawn")) as pool:
        for name, said in pool.map(_run, chosen):
            if options.keep:
                kept[name] = said
                continue
            told = list(differences(kept[name], said)) if name in kept else ["not kept before"]
            changed += bool(told)
            print(f"{name}: {'; '.join(told) or 'the same'}", flush=True)
    if options.keep:
        lines = [f"{json.dumps(name)}: {json.dumps(kept[name])}" for name in sorted(kept)]
        write_text(KEPT, "{\n" + ",\n".join(lines) + "\n}\n")
    print(f"{changed} of {len(chosen)} differ", file=sys.stderr)
    return int(changed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
