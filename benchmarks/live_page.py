"""What the page costs: processor time and memory of its node, and the latency of the model."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace

import numpy as np

from benchmarks import page_viewers
from benchmarks.figure import Figure
from benchmarks.processes import ProfiledDomain, start_node
from benchmarks.side_by_side import SideBySide
from benchmarks.streaming_load import SETTLED, sine_blocks
from mr_damper_ros.processes.programs import PATIENCE, Program
from mr_damper_ros.processes.ros_domain import RosDomain
from mr_damper_ros.signals.arrays import Array

VIEWERS = 3
DURATION = 300.0
SEGMENT, SEGMENTS = 20.0, 5
RATE, BLOCK = 1000.0, 10
WARM = 30.0
"""Seconds after which the memory of the page's node is compared: it has started by then."""


@dataclass(frozen=True)
class PageCost:
    """Share of a core and growth of the memory [bytes] of the node live; windows that it saw."""

    cpu: float
    growth: int
    windows: int


@contextmanager
def watched(domain: RosDomain) -> Iterator[Program]:
    """A node live in a domain, with its viewers."""
    with ExitStack() as stack:
        live = start_node("live", domain, port=0)
        stack.callback(live.close)
        live.wait_for_log("the page is at", PATIENCE)
        found = re.search(r"the page is at (\S+)", live.log)
        assert found
        viewers = Program([sys.executable, page_viewers.__file__, found[1], str(VIEWERS)])
        stack.callback(viewers.close)
        yield live


def measure_cost(duration: float, warm: float = WARM) -> PageCost:
    """Let a whole system run with its page, and see what the page's node takes."""
    with ExitStack() as stack:
        domain = stack.enter_context(closing(ProfiledDomain()))
        for name in ("identifier", "model"):
            stack.callback(start_node(name, domain).close)
        live = stack.enter_context(watched(domain))
        bridge = start_node(
            "bridge",
            domain,
            emulated__sample_rate=RATE,
            block_size=BLOCK,
            wait_for_subscribers=2,
            wait_timeout=PATIENCE,
        )
        stack.callback(bridge.close)
        time.sleep(warm)
        began, before, memory = time.monotonic(), live.cpu_seconds, live.resident_bytes
        time.sleep(duration)
        used = (live.cpu_seconds - before) / (time.monotonic() - began)
        return PageCost(used, live.resident_bytes - memory, _windows(live))


def _windows(live: Program) -> int:
    """Windows that the page has to show."""
    found = re.search(r"the page is at (\S+)", live.log)
    assert found
    viewer = page_viewers.Viewer(found[1])
    return viewer.windows()


def measure_latencies(segment: float, segments: int) -> tuple[Array, Array]:
    """Latencies [s] of the model with the page and its viewers, and without, in turn."""
    found: tuple[list[Array], list[Array]] = ([], [])
    blocks = sine_blocks(RATE, BLOCK, 2.0 * segments * segment)
    length = len(blocks) // (2 * segments)
    settled = round(SETTLED * RATE / BLOCK)
    with SideBySide() as both:
        for number in range(2 * segments):
            part = blocks[number * length : (number + 1) * length]
            begin = part[0].start_ns
            part = [replace(block, start_ns=block.start_ns - begin) for block in part]
            both.model.forget()
            both.relay.forget()
            with ExitStack() as stack:
                if number % 2:
                    stack.enter_context(watched(both.domain))
                both.send(part)
            found[number % 2].append(np.array(list(both.model.latencies.values())[settled:]))
    without, watched_ones = (np.concatenate(parts) for parts in found)
    return watched_ones, without


def figures(
    duration: float = DURATION,
    segment: float = SEGMENT,
    segments: int = SEGMENTS,
    warm: float = WARM,
) -> list[Figure]:
    """``live_cpu_percent``, ``live_memory_growth_mb`` and ``live_p99_ratio``."""
    cost = measure_cost(duration, warm)
    with_page, without = measure_latencies(segment, segments)
    p99 = [float(np.quantile(times, 0.99)) for times in (with_page, without)]
    system = (
        f"bridge at {RATE:g} Hz in blocks of {BLOCK}, identifier, model and the page with "
        f"{VIEWERS} viewers that ask as a browser does"
    )
    return [
        Figure(
            "live_cpu_percent",
            100.0 * cost.cpu,
            f"Processor time of the node live [% of a core] in {duration:g} s: {system}.",
            (0.0, 5.0),
            f"{cost.windows} windows.",
        ),
        Figure(
            "live_memory_growth_mb",
            cost.growth / 1e6,
            f"Growth of its resident memory [MB] meanwhile, from {warm:g} s after its start.",
            (-np.inf, 5.0),
        ),
        Figure(
            "live_p99_ratio",
            p99[0] / p99[1],
            "Block of 10 at 1 kHz published to prediction received: p99 with the page and its "
            f"viewers over that without, in turn {segments} times {segment:g} s each, in one run.",
            (0.0, 1.1),
            f"{1e3 * p99[0]:.2f} ms beside {1e3 * p99[1]:.2f} ms.",
        ),
    ]
