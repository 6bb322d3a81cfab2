"""What the page costs, what it says of nodes that have died, and who can lock viewers out."""

from __future__ import annotations

import http.client
import json
import math
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, replace
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from benchmarks.figure import Figure
from benchmarks.helper_programs import Viewer, start_helper
from benchmarks.latency import SETTLED, SideBySide, sine_blocks
from benchmarks.processes import ProfiledDomain, start_node
from mr_damper_ros.live.live_record import SILENT_AFTER
from mr_damper_ros.live.page_server import CONNECTIONS
from mr_damper_ros.processes.programs import PATIENCE, Program, RosDomain
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tools.demo import page_of

VIEWERS = 3
DURATION = 300.0
SEGMENT, SEGMENTS = 20.0, 5
RATE, BLOCK = 1000.0, 10
WARM = 30.0
"""Seconds after which the memory of the page's node is compared: it has started by then."""
SIEGE = 20.0
"""Seconds that slow connections last while a viewer asks."""
_DRIBBLE = 4.0
"""Seconds between two bytes of a slow connection."""


@dataclass(frozen=True)
class PageCost:
    """Share of a core and growth of the memory [bytes] of the node live; windows that it saw.

    ``grey``: seconds after the death of identifier and model until both are said to be silent;
    ``answer``: longest time [s] to an answer while another client holds slow connections.
    """

    cpu: float
    growth: int
    windows: int
    answer: float
    grey: float


@contextmanager
def watched(domain: RosDomain) -> Iterator[Program]:
    """A node live in a domain, with its viewers."""
    with ExitStack() as stack:
        live = start_node("live", domain, port=0)
        stack.callback(live.close)
        viewers = start_helper("view", page_of(live), str(VIEWERS))
        stack.callback(viewers.close)
        yield live


def measure_cost(duration: float, warm: float = WARM, siege: float = SIEGE) -> PageCost:
    """Let a whole system run with its page, and see what the page's node takes."""
    with ExitStack() as stack:
        domain = stack.enter_context(closing(ProfiledDomain()))
        nodes = [start_node(name, domain) for name in ("identifier", "model")]
        for node in nodes:
            stack.callback(node.close)
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
        growth = live.resident_bytes - memory
        page = page_of(live)
        windows = Viewer(page).windows()
        return PageCost(used, growth, windows, _besieged(page, siege), _grey(page, nodes))


def _ask(page: str) -> dict[str, Any]:
    """The status, asked for from another address than those of the slow connections."""
    netloc = urlsplit(page).netloc
    asked = http.client.HTTPConnection(netloc, timeout=PATIENCE, source_address=("127.0.0.2", 0))
    with closing(asked):
        asked.request("GET", "/status")
        told: dict[str, Any] = json.loads(asked.getresponse().read())
        return told


def _besieged(page: str, duration: float) -> float:
    """Longest time [s] to an answer while a client has as many connections as the page takes."""
    parts = urlsplit(page)
    slow: list[socket.socket] = []
    longest, end, due = 0.0, time.monotonic() + duration, 0.0
    while time.monotonic() < end:
        if time.monotonic() >= due:
            due = time.monotonic() + _DRIBBLE
            slow = [each for each in slow if _dribbles(each)]
            while len(slow) < CONNECTIONS:
                slow.append(socket.create_connection((parts.hostname, parts.port), PATIENCE))
        began = time.monotonic()
        try:
            _ask(page)
            longest = max(longest, time.monotonic() - began)
        except (OSError, http.client.HTTPException):
            longest = math.inf
        time.sleep(0.2)
    for each in slow:
        each.close()
    return longest


def _dribbles(slow: socket.socket) -> bool:
    """Send a byte; whether it was taken."""
    with suppress(OSError):
        return slow.send(b"x") == 1
    slow.close()
    return False


def _grey(page: str, nodes: list[Program]) -> float:
    """Seconds from the death of all nodes until the page says of all that they are silent."""
    for node in nodes:
        node.kill()
    died = time.monotonic()
    names = ("identifier", "model")
    while time.monotonic() < died + PATIENCE:
        if all(
            concern["silence"] > SILENT_AFTER
            for concern in _ask(page)["concerns"]
            if concern["name"].startswith(names)
        ):
            return time.monotonic() - died
        time.sleep(0.05)
    return math.inf


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
    siege: float = SIEGE,
) -> list[Figure]:
    """Figures whose keys begin with ``live_``."""
    cost = measure_cost(duration, warm, siege)
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
            "live_grey_s",
            cost.grey,
            "Seconds from kill -9 of identifier and model until the page shows both as silent.",
            (SILENT_AFTER - 1.0, SILENT_AFTER + 1.0),
        ),
        Figure(
            "live_besieged_answer_s",
            cost.answer,
            f"Longest time [s] to an answer for one client while another opens {CONNECTIONS} "
            f"connections with a byte every {_DRIBBLE:g} s, in {siege:g} s; infinite where it is "
            "refused once.",
            (0.0, 1.0),
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
