"""Resources that the live page uses, and its effect on the other nodes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager

from benchmarks.figure import Measured
from benchmarks.helper_programs import Viewer, start_helper
from benchmarks.latency import page_ratio
from benchmarks.processes import ProfiledDomain, cpu_seconds, resident_bytes, start_node
from mr_damper_ros.processes.programs import PATIENCE, Program, RosDomain
from mr_damper_ros.tools.demo import page_of

VIEWERS = 3

WARM = 30.0
"""Time [s] after which the memory of the page's node is compared, when its start is complete."""


@contextmanager
def watched(domain: RosDomain) -> Iterator[Program]:
    """A node `live` in a domain, with its viewers."""
    with ExitStack() as stack:
        live = start_node("live", domain, port=0)
        stack.callback(live.close)
        viewers = start_helper("view", page_of(live), str(VIEWERS))
        stack.callback(viewers.close)
        yield live


def figures(
    duration: float = 300.0, segment: float = 20.0, segments: int = 5, warm: float = WARM
) -> Measured:
    """Resources that the page's node uses in a complete system."""
    with ExitStack() as stack:
        domain = stack.enter_context(closing(ProfiledDomain()))
        for name in ("identifier", "model"):
            stack.callback(start_node(name, domain).close)
        live = stack.enter_context(watched(domain))
        bridge = start_node(
            "bridge",
            domain,
            emulated__sample_rate=1000.0,
            block_size=10,
            wait_for_subscribers=2,
            wait_timeout=PATIENCE,
        )
        stack.callback(bridge.close)
        time.sleep(warm)
        began, before, memory = time.monotonic(), cpu_seconds(live.pid), resident_bytes(live.pid)
        time.sleep(duration)
        used = (cpu_seconds(live.pid) - before) / (time.monotonic() - began)
        growth = resident_bytes(live.pid) - memory
        windows = Viewer(page_of(live)).windows()
    return {
        "live_cpu_percent": (100.0 * used, f"{windows} windows."),
        "live_memory_growth_mb": growth / 1e6,
        "live_p99_ratio": page_ratio(watched, segment, segments),
    }
