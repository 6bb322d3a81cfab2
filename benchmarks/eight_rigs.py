"""Eight dampers at once on two cores: a bridge each, their identifiers and models in two processes.

Nothing but the nodes' own words and the fit reports is listened to: a subscriber of all samples
would take a good part of a core itself.
"""

from __future__ import annotations

import os
import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from contextlib import ExitStack, closing

from diagnostic_msgs.msg import DiagnosticArray
from mr_damper_msgs.msg import FitReport

from benchmarks.figure import Figure
from benchmarks.latency import on_cores
from benchmarks.processes import ProfiledDomain, start_node
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.observer import Observer
from mr_damper_ros.processes.programs import PATIENCE, Program, cpu_seconds
from mr_damper_ros.tracking.acceptance import Verdict

RIGS = 8
CORES = 2
DURATION = 120.0
_RATE, _BLOCK = 1000.0, 10
_WINDOW, _HOP = 2.0, 1.0
_CURRENT_PERIOD = 0.1
"""Seconds between two readings of the current; a window waits for one at or after its end."""

_SETTLED = 5.0
"""Seconds of the streams after which the processor time counts."""

_QUIET = 3.0
"""Seconds for what all nodes say, which comes every second."""

_PATIENCE = 30.0
"""Seconds without a report after which no more are waited for."""

_SHOWN = ("identifier: input", "model: input", "model: latency", "bridge: source")


class Fleet:
    """What the nodes of a fleet say: losses by node, samples sent and reports by damper."""

    def __init__(self, observer: Observer, dampers: Sequence[str]) -> None:
        self._observer = observer
        self.dampers = dampers
        self.said: dict[str, dict[str, str]] = {}
        self.skipped: Counter[str] = Counter()
        self.reports: dict[str, list[FitReport]] = defaultdict(list)
        self._last_report = time.monotonic()
        observer.listen(DiagnosticArray, "/diagnostics", quality.stream(), self._take)
        for damper in dampers:
            observer.listen(
                FitReport,
                f"/{damper}/damper/fit_report",
                quality.lossless(),
                lambda report, damper=damper: self._keep(damper, report),  # type: ignore[misc]
            )

    def _take(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.endswith(_SHOWN):
                values = {item.key: item.value for item in status.values}
                self.said[status.name] = values
                self.skipped[status.name] += int(values.get("skipped blocks", 0))

    def _keep(self, damper: str, report: FitReport) -> None:
        self._last_report = time.monotonic()
        if report.verdict != Verdict.ACCEPTED_EARLY:
            self.reports[damper].append(report)

    def sent(self, damper: str) -> int:
        """Samples that the bridge of a damper has sent, as far as it has said."""
        return int(self.said.get(f"{damper}/bridge: source", {}).get("samples sent", 0))

    def lost(self, damper: str) -> int:
        """Samples that identifier and model of a damper have missed, or could not use."""
        return sum(
            int(self.said[f"{damper}/{node}: input"][name])
            for node in ("identifier", "model")
            for name in ("lost", "rejected messages")
        )

    def unfitted(self, damper: str) -> int:
        """Windows of the samples sent that were not fitted, or whose fit failed."""
        known = self.sent(damper) / _RATE - _CURRENT_PERIOD
        windows = int((known - _WINDOW) / _HOP + 1e-9) + 1
        fitted = [r for r in self.reports[damper] if r.verdict != Verdict.FAILED]
        return max(windows - len(fitted), 0)

    def listen(self, duration: float) -> None:
        """Hear what comes in so many seconds."""
        self._observer.spin_for(duration)

    def drain(self) -> None:
        """Wait until nothing is left to be fitted, or nothing comes, and for what the nodes say."""
        self.listen(_QUIET)
        while any(map(self.unfitted, self.dampers)):
            if time.monotonic() - self._last_report > _PATIENCE:
                break
            self.listen(_QUIET)


def measure(rigs: int, duration: float) -> tuple[list[str], Fleet, dict[str, float]]:
    """Stream so many rigs for ``duration`` [s] on two cores.

    Returns the names of the dampers, what came of them, and the processor time of each kind of
    process [s/s].
    """
    dampers = [f"damper_{number}" for number in range(1, rigs + 1)]
    places = [text for damper in dampers for text in ("--namespace", damper)]
    with ExitStack() as stack:
        stack.enter_context(on_cores(sorted(os.sched_getaffinity(0))[:CORES]))
        domain = stack.enter_context(closing(ProfiledDomain()))
        hosts = {
            name: stack.enter_context(closing(start_node(name, domain, *places)))
            for name in ("identifier", "model")
        }
        observer = stack.enter_context(closing(Observer(domain=domain)))
        fleet = Fleet(observer, dampers)
        for damper in dampers:
            observer.wait_for_publishers(f"/{damper}/damper/predicted_force")
            observer.wait_for_publishers(f"/{damper}/damper/fit_report")
        bridges = [
            stack.enter_context(
                closing(
                    start_node(
                        "bridge",
                        domain,
                        *("--ros-args", "-r", f"__ns:=/{damper}", "--"),
                        wait_for_subscribers=2,
                        wait_timeout=PATIENCE,
                        emulated__sample_rate=_RATE,
                        block_size=_BLOCK,
                    )
                )
            )
            for damper in dampers
        ]
        observer.until(lambda: all(map(fleet.sent, dampers)), "samples of all bridges")
        fleet.listen(_SETTLED)
        began, before = time.monotonic(), _used(hosts, bridges)
        fleet.listen(duration)
        elapsed, after = time.monotonic() - began, _used(hosts, bridges)
        for damper in dampers:
            _deactivate(observer, f"/{damper}/bridge")
        fleet.drain()
        return dampers, fleet, {k: (after[k] - before[k]) / elapsed for k in after}


def _deactivate(observer: Observer, bridge: str) -> None:
    """Let a bridge send no more; it still says how much it has sent."""
    from lifecycle_msgs.msg import Transition
    from lifecycle_msgs.srv import ChangeState

    client = observer.node.create_client(ChangeState, f"{bridge}/change_state")
    observer.until(client.service_is_ready, f"the services of {bridge}")
    request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE))
    future = client.call_async(request)
    observer.until(future.done, f"the end of the samples of {bridge}")


def _used(hosts: dict[str, Program], bridges: Sequence[Program]) -> dict[str, float]:
    """Processor time [s] so far, by kind of process."""
    return {
        "identifiers": hosts["identifier"].cpu_seconds,
        "workers": sum(map(cpu_seconds, hosts["identifier"].children)),
        "models": hosts["model"].cpu_seconds,
        "bridges": sum(bridge.cpu_seconds for bridge in bridges),
    }


def figures(duration: float = DURATION, rigs: int = RIGS) -> list[Figure]:
    """``eight_rigs_lost``, ``eight_rigs_unfitted`` and ``eight_rigs_cpu_..._percent``."""
    dampers, fleet, used = measure(rigs, duration)
    lost = [fleet.lost(damper) for damper in dampers]
    sent = [fleet.sent(damper) for damper in dampers]
    unfitted = [fleet.unfitted(damper) for damper in dampers]
    conditions = (
        f"{rigs} rigs at {_RATE:g} Hz in blocks of {_BLOCK} for {duration:g} s on {CORES} cores: a "
        "bridge each, all identifiers in a process with two workers, all models in another"
    )
    return [
        Figure(
            "eight_rigs_lost",
            float(sum(lost)),
            f"Samples that an identifier or a model missed; {conditions}.",
            (0.0, 0.0),
            f"{sum(sent)} sent; {sum(fleet.skipped.values())} blocks of the models were followed "
            "without a force, as newer ones had come.",
        ),
        Figure(
            "eight_rigs_unfitted",
            float(sum(unfitted)),
            f"Windows of {_WINDOW:g} s, one every {_HOP:g} s, that were not fitted, or whose fit "
            "failed; the same.",
            (0.0, 0.0),
            f"{sum(map(len, fleet.reports.values()))} fits.",
        ),
        *(
            Figure(
                f"eight_rigs_cpu_{kind}_percent",
                100.0 * share,
                f"Processor time of the {kind} of {rigs} rigs [% of a core].",
            )
            for kind, share in used.items()
        ),
    ]
