"""Whether what is published of a damper that does not change says so: sets, errors, force scale."""

from __future__ import annotations

from benchmarks import following
from benchmarks.figure import Figure
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.rig.emulator import ConstantDamper
from mr_damper_ros.tracking.acceptance import Verdict
from mr_damper_ros.tracking.tracker_settings import TrackerSettings
from mr_damper_ros.tracking.trackers import TRACKERS

WINDOWS = 600


def exchanges(tracker: str, windows: int, seed: int = 3) -> int:
    """Sets exchanged after the first in windows of a constant damper of the exact law."""
    duration = following.WINDOW + (windows - 1) * following.HOP
    run = following.recording(ConstantDamper(THESIS_28_CELSIUS), duration, seed=seed)
    steps = following.follow(run, TrackerSettings(tracker=tracker))
    verdicts = [step.report.verdict for step in steps]
    if Verdict.ACCEPTED not in verdicts:
        raise RuntimeError("no window of the constant damper was accepted")
    return sum(verdict.accepted for verdict in verdicts) - 1


def figures(windows: int = WINDOWS) -> list[Figure]:
    """``needless_exchanges``."""
    counts = {name: exchanges(name, windows) for name in TRACKERS}
    return [
        Figure(
            "needless_exchanges",
            float(max(counts.values())),
            f"Sets exchanged in {windows} windows of a constant damper of the exact law "
            f"({following.WINDOW:g} s every {following.HOP:g} s), the first not counted; of the "
            "trackers the one with the most.",
            (0.0, 6.0),
            ", ".join(f"{name}: {count}" for name, count in counts.items()) + ".",
        ),
    ]
