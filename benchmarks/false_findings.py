"""Sound records: how many the package refuses, or warns of.

They are of dampers of foreign laws and of laws of the package, with gas, friction, inertia and
heating, of the bundled bags, and of a press. ``python -m benchmarks.false_findings --list`` prints
every record.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.dampers import LAWS
from benchmarks.figure import PROCESSES, Measured, in_processes
from benchmarks.real_records import raw_records
from benchmarks.sound_records import MOTION_KINDS, OF_THE_PACKAGE, SLOW_TRIANGLE, Plan, SoundRecord
from benchmarks.told_findings import Given, answer
from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.io.columns import UNITS
from mr_damper_ros.signals.recording import Recording
from studies import recordings

OF_THE_LAW = frozenset({"unexplained", "other_law"})
"""Findings about the law, not the data: right where the law leaves more than 30 % of the force."""

BAGS = Path("bags")
_FOREIGN, _OF_THE_PACKAGE = 44, 9

_RAW_RUNS = 10
"""Number of runs in the original files of the press."""

_RATES = (200.0, 300.0, 500.0, 1000.0, 2000.0, 5000.0)
_CURRENTS = (0.0, 0.3, 0.8, 1.2, None)
_NOISES = (0.0, 0.003, 0.01, 0.03)
_BITS = (0, 12, 14, 16)
_SIZES = (1.0, 0.3, 2.5, 0.1, 30.0)
_FEATURES: tuple[dict[str, float], ...] = (
    {},
    {"offset": -150.0},
    {"stiffness": 8000.0},
    {"mass": 2.0},
    {"fades": 0.2},
    {"offset": 80.0, "stiffness": 3000.0},
)
"""A gas preload and a gas spring, a mass on the load cell, and a force that falls as it heats."""


class Sound(NamedTuple):
    """A sound record: its name, how it is made, and findings that are true of it."""

    name: str
    make: Callable[[], Given]
    true: frozenset[str] = frozenset()


def _emulated(plan: Plan) -> Sound:
    features = [f"{name} {getattr(plan, name):g}" for name in ("offset", "stiffness", "mass")]
    features += [f"fades {plan.fades:g}", f"noise {plan.force_noise:g}", f"{plan.bits} bit"]
    shown = [feature for feature in features if not feature.endswith(" 0") or "noise" in feature]
    return Sound(f"{plan.name}, {', '.join(shown)}", partial(_made, plan))


def _made(*plans: Plan) -> Given:
    return Given([SoundRecord(plan).recording() for plan in plans])


def _duration(motion: str) -> float:
    slow = {SLOW_TRIANGLE: 120.0, "10 mm 0.1 Hz": 30.0, "earthquakes": 12.0, "sweep": 6.0}
    return slow.get(motion, 8.0)


def _plans(dampers: Sequence[str], count: int, seed: int) -> Iterator[Plan]:
    """Plans that combine the tables at random, each entry about as often as the others."""
    rng = np.random.default_rng((7, seed, count))
    tables = tuple(MOTION_KINDS), _RATES, _CURRENTS, _NOISES, _BITS, _SIZES, _FEATURES
    columns = [
        [table[place] for place in rng.permutation(np.arange(count) % len(table)).tolist()]
        for table in tables
    ]
    for number, (damper, motion, rate, current, noise, bits, size, features) in enumerate(
        zip(cycle(dampers), *columns, strict=False)
    ):
        duration = _duration(motion)
        yield Plan(
            damper,
            motion,
            current,
            rate=min(rate, 300.0) if duration > 20.0 else rate,
            duration=duration,
            size=size,
            force_noise=noise,
            bits=bits,
            displacement_noise=(0.0, 1e-6, 5e-6)[number % 3],
            jitter=(0.0, 0.05)[number % 2],
            seed=10_000 + 1000 * seed + number,
            **_scaled(features, size),
        )


def _scaled(features: dict[str, float], size: float) -> dict[str, Any]:
    """The features of a damper of this size; the share by which its force falls is the same."""
    return {name: value * (1.0 if name == "fades" else size) for name, value in features.items()}


def _weak_with_gas(seed: int) -> list[Plan]:
    """Dampers of about 60 N with a gas preload of 150 N, and a heating one with much friction."""
    return [
        Plan(damper, motion, 0.0, size=size, offset=offset, fades=fades, seed=20_000 + seed)
        for damper, motion, size, offset, fades in (
            ("gas_bouc_wen", "5 mm 1 Hz", 0.5, -150.0, 0.0),
            ("shim_valves", "random 0.5-8 Hz", 0.3, 150.0, 0.0),
            ("stribeck", "18 mm 0.5 Hz", 1.5, 0.0, 0.25),
        )
    ]


def _several(seed: int) -> list[Sound]:
    """Dampers at three currents each, warmer from record to record."""
    found = []
    for number, (damper, motion, offset) in enumerate(
        (
            ("gas_bouc_wen", "5 mm 1 Hz", -120.0),
            ("shim_valves", "random 0.2-3 Hz", 0.0),
            ("springs", "2 mm 5 Hz", 60.0),
            ("remanence", "18 mm 0.5 Hz", 0.0),
        )
    ):
        plan = Plan(damper, motion, offset=offset, seed=30_000 + 1000 * seed + number)
        plans = [
            replace(plan, current=current, size=1.0 - 0.1 * place, seed=plan.seed + 10 * place)
            for place, current in enumerate((0.1, 0.6, 1.2))
        ]
        found.append(Sound(f"three records: {plan.name}", partial(_made, *plans)))
    return found


_FILES = (
    ("time:s,displacement:mm,force:kN", "Time [s],Displacement [mm],Force [kN]", ","),
    ("time:s,displacement:in,force:lbf", "Elapsed,Axial Stroke,Load\nsec,in,lbf", "\t"),
    ("time:ms,displacement:um,force:N", "Zeit (ms);Weg (µm);Kraft (N)", ";"),
    ("time:s,force:kgf,displacement:cm", "t/s Kraft/kgf x/cm", " "),
    ("time:s,displacement:m,force:N", "", " "),
)
"""Columns, first lines and separators of sound files in several units."""


def _file(plan: Plan, number: int) -> Given:
    columns, head, separator = _FILES[number]
    made = SoundRecord(plan).sampled()
    rows = np.transpose(
        [
            getattr(made, name) / UNITS[name][unit]
            for name, unit in (entry.split(":") for entry in columns.split(","))
        ]
    )
    lines = [head] * bool(head) + [separator.join(f"{x:.7g}" for x in row) for row in rows.tolist()]
    options = {"columns": columns, "current": plan.current}
    return Given([made.recording(1.0 / plan.rate)], "\n".join(lines) + "\n", options)


def _files(seed: int) -> list[Sound]:
    """Sound files in several units."""
    plans = [
        Plan(damper, motion, 0.7, rate=500.0, jitter=0.0, seed=40_000 + seed)
        for damper, motion in zip(LAWS, ("5 mm 1 Hz", "random 0.2-3 Hz") * 3, strict=False)
    ]
    return [
        Sound(f"file {_FILES[number][0]}", partial(_file, plan, number))
        for number, plan in enumerate(plans[: len(_FILES)])
    ]


def _measured() -> list[Sound]:
    """The bundled bags, and the recordings of the press if they are there."""
    bags = sorted(path for path in BAGS.iterdir() if path.is_dir())
    found = [Sound(f"bag {path.name}", partial(_only, read_bag, path)) for path in bags]
    folder = recordings.folder()
    if folder is None:
        return found
    for path in sorted((folder / "processed").glob("*.txt")):
        # Their makers smoothed them by a moving average.
        read = partial(_processed, path)
        found.append(Sound(f"processed {path.stem}", read, frozenset({"smoothed"})))
    for count, read_all in ((_RAW_RUNS, raw_records), (3, recordings.unsmoothed_earthquakes)):
        for number in range(count):
            name = f"{read_all.__name__} {number}"
            found.append(Sound(name, partial(_only, read_all, folder, number)))
    found.append(Sound("five raw_records", partial(_one_motion, folder, 5)))
    return found


def _only(read: Callable[[Path], list[Recording]], path: Path, number: int = 0) -> Given:
    """One of the recordings that are read."""
    return Given([read(path)[number]])


def _processed(path: Path) -> Given:
    return Given([recordings.processed(path)[1]])


def _one_motion(folder: Path, first: int) -> Given:
    """The five runs of a motion in the original files."""
    return Given(raw_records(folder)[first : first + 5])


def sound_records(seed: int = 0) -> list[Sound]:
    """All sound records: 100 with the recordings of the press."""
    weak = _weak_with_gas(seed)
    foreign = _plans(tuple(LAWS), _FOREIGN - len(weak), seed)
    known = _plans(tuple(OF_THE_PACKAGE), _OF_THE_PACKAGE, seed)
    emulated = map(_emulated, [*weak, *foreign, *known])
    return [*emulated, *_several(seed), *_files(seed), *_measured()]


class Found(NamedTuple):
    """A judged record: names of the findings that are false, and of all."""

    name: str
    false: frozenset[str]
    of_the_law: bool
    told: str


def _judged(part: int, parts: int, seed: int) -> list[Found]:
    found = []
    for sound in sound_records(seed)[part::parts]:
        told = answer(sound.make())
        found.append(
            Found(
                sound.name,
                told.named - OF_THE_LAW - sound.true,
                bool(told.named & OF_THE_LAW),
                "; ".join(f"{each.name} ({each.severity})" for each in told.findings),
            )
        )
    return found


def judge_all(seed: int = 0) -> list[Found]:
    """All judged records."""
    parts = range(PROCESSES)
    groups = in_processes(_judged, parts, [PROCESSES] * PROCESSES, [seed] * PROCESSES)
    return [one for group in groups for one in group]


def figures(seed: int = 0) -> Measured:
    """Number of sound records that are refused or warned of."""
    found = judge_all(seed)
    missing = f" {recordings.NONE}" * (recordings.folder() is None)
    note = f"Of {len(found)} records.{missing}"
    return {
        "false_findings": (float(sum(bool(one.false) for one in found)), note),
        "false_findings_of_the_law": (float(sum(one.of_the_law for one in found)), note),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the figures, and every record with ``--list``."""
    parser = argparse.ArgumentParser(prog="false_findings", description=__doc__)
    parser.add_argument("--list", action="store_true", help="print every record")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    if options.list:
        for one in judge_all(options.seed):
            verdict = "FALSE" if one.false else "law" if one.of_the_law else "fine"
            print(f"{verdict:6s} {one.name:90s} {one.told}")
    else:
        for key, value in figures(options.seed).items():
            print(key, value)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
