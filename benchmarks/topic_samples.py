"""Joint states of a real publisher process, taken in by the bridge: what is lost, what it tells.

A sample is a message. Sent at 1 kHz, each tells its number; sent from a bag of the thesis, they are
identified, and the error that is left is held against the noise in the bag.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from mr_damper_msgs.msg import MtsSamples

import mr_damper_ros as mr
from benchmarks.figure import Figure
from benchmarks.helper_programs import JOINT, JOINT_TOPIC, start_helper
from benchmarks.processes import ProfiledDomain, start_node
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import from_field
from mr_damper_ros.nodes.observer import Observer
from mr_damper_ros.signals.arrays import Array

BAGS = tuple(
    sorted(path for path in (Path(__file__).parents[1] / "bags").iterdir() if path.is_dir())
)
NOISE = 5.53
"""Standard deviation of the noise in the bags [N]."""

RATE = 1000.0
_QUIET = 0.7
"""Seconds without a sample after which all have come; the diagnostics come every second."""

_PATIENCE = 60.0
"""Seconds, besides the time that sending takes."""


@dataclass
class Taken:
    """What came out of the bridge: numbers, displacements and forces (n,); its own counts."""

    numbers: Array
    displacement: Array
    force: Array
    period: float
    counts: dict[str, str]


def taken(*arguments: str, duration: float = 0.0) -> Taken:
    """Let a sender publish to the bridge; see :mod:`benchmarks.helper_programs`."""
    found: list[MtsSamples] = []
    counts: dict[str, str] = {}

    def hear(message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == "bridge: source":
                counts.update({item.key: item.value for item in status.values})

    with closing(ProfiledDomain()) as domain, closing(Observer(domain=domain)) as observer:
        observer.listen(MtsSamples, "mts/samples", quality.lossless(), found.append)
        observer.listen(DiagnosticArray, "/diagnostics", quality.stream(), hear)
        bridge = start_node(
            "bridge",
            domain,
            source="topics",
            mirror_rate=0.0,
            wait_for_subscribers=1,
            topics__displacement_topic=JOINT_TOPIC,
            topics__displacement_field=f"position[{JOINT}]",
            topics__force_field=f"effort[{JOINT}]",
        )
        with closing(bridge):
            # Its first samples are to find it streaming.
            observer.wait_for_publishers("mts/samples")
            observer.spin_for(1.0)
            with closing(start_helper(*arguments, environment=domain.environment)) as sender:
                observer.until(
                    lambda: "all sent" in sender.errors, "the sender", duration + _PATIENCE
                )
                count = -1
                while count != len(found):
                    count = len(found)
                    observer.spin_for(_QUIET)
                counts.clear()
                observer.until(lambda: counts, "the diagnostics")
    return Taken(
        np.concatenate([m.seq + np.arange(len(m.force), dtype=np.float64) for m in found]),
        np.concatenate([from_field(m.displacement) for m in found]),
        np.concatenate([from_field(m.force) for m in found]),
        found[0].period,
        counts,
    )


def lost(duration: float) -> tuple[int, int, int]:
    """Samples lost inside the bridge, lost by DDS, and sent, at 1 kHz for ``duration`` [s]."""
    sent = round(duration * RATE)
    came = taken("send-count", str(sent), str(RATE), duration=duration)
    # The force is the number of the sample.
    between = int(came.force[-1] - came.force[0]) + 1 - came.force.size
    by_dds = sent - int(came.counts["force received"])
    return max(between - by_dds, 0), by_dds, sent


def ratios(bag: Path) -> tuple[float, float]:
    """RMSE over the noise of what came by topics, and of the bag itself."""
    (run,) = mr.read_bag(bag)
    return ratio(taken("send-bag", str(bag)), float(run.current[0])), mr.identify(run).rmse / NOISE


def ratio(came: Taken, current: float) -> float:
    """RMSE of the set identified from what came, at a current [A], over the noise in the bags."""
    found = mr.identify(
        displacement=came.displacement, force=came.force, current=current, period=came.period
    )
    return found.rmse / NOISE


def figures(duration: float = 60.0, bags: tuple[Path, ...] = BAGS) -> list[Figure]:
    """``topics_lost_inside``, ``topics_lost_by_dds`` and ``topics_rmse_ratio``."""
    inside, by_dds, sent = lost(duration)
    found = [ratios(bag) for bag in bags]
    return [
        Figure(
            "topics_lost_inside",
            float(inside),
            f"Samples that reached the bridge and did not come out of it, of {sent} messages of "
            f"one sample at {RATE:g} Hz from a process of its own; from the first that came out "
            "on, as the clock of the stamps is found first.",
            (0.0, 0.0),
        ),
        Figure(
            "topics_lost_by_dds",
            float(by_dds),
            "Messages that never reached it, by its own count.",
        ),
        Figure(
            "topics_rmse_ratio",
            [by_topics for by_topics, _ in found],
            "RMSE of the set identified from the thesis' bags, published as joint states and taken "
            f"in from there, over the noise in them ({NOISE:g} N): "
            + ", ".join(bag.name for bag in bags),
            (0.0, 1.02),
            "From the bags themselves: "
            + ", ".join(f"{from_bag:.4f}" for _, from_bag in found)
            + ".",
        ),
    ]
