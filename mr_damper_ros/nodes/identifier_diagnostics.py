"""How the identification stands, in words and figures."""

from __future__ import annotations

from collections.abc import Callable

from mr_damper_ros.nodes.diagnostics import ERROR, OK, STALE, WARN, Finding
from mr_damper_ros.processes.worker import PooledWorker
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.tracking.acceptance import Verdict
from mr_damper_ros.tracking.identifier import Identifier


class IdentifierDiagnostics:
    """Findings on an identifier; ``now_ns`` is the clock of the data's stamps.

    A fit that was refused is worth a warning only where the set in use predicts the window worse
    than ``maximum_nrmse``.
    """

    def __init__(
        self,
        identifier: Identifier,
        worker: PooledWorker,
        maximum_nrmse: float,
        now_ns: Callable[[], int],
    ) -> None:
        self._identifier = identifier
        self._worker = worker
        self._maximum_nrmse = maximum_nrmse
        self._now_ns = now_ns

    def window(self) -> Finding:
        """How far the next window is."""
        assembler = self._identifier.assembler
        if assembler.waits_for_current:
            return Finding(
                WARN,
                "a window is full but waits for a supply current stamped at or after its end: is "
                "one published, with stamps on the clock of the samples?",
            )
        return Finding(OK, f"window {assembler.fill:.0%} full")

    def fit(self) -> Finding:
        """What became of the last window."""
        report, tracker = self._identifier.last_report, self._identifier.tracker
        if report is None:
            return Finding(STALE, "no window has been fitted yet")
        values = {
            "NRMSE before": f"{report.nrmse_before:.4f}",
            "NRMSE after": f"{report.nrmse_after:.4f}",
            "force scale": f"{report.scale.value:.4f} ± {report.scale.standard_error:.4f}",
            "temperature from the force [°C]": (
                f"{report.fluid.celsius:.1f} ± {report.fluid.standard_error:.1f}"
            ),
            "accepted windows": tracker.accepted_windows,
            "operating points": tracker.reservoir.operating_points,
        }
        if report.verdict is Verdict.ACCEPTED_EARLY:
            return Finding(WARN, f"{report.reason} as {report.set_id}", values)
        if report.accepted:
            return Finding(OK, f"accepted as {report.set_id}", values)
        waits = report.verdict is Verdict.TOO_LITTLE_MOTION and tracker.accepted_windows > 0
        good = waits or report.nrmse_before <= self._maximum_nrmse
        return Finding(OK if good else WARN, f"not accepted: {report.reason}", values)

    def worker(self) -> Finding:
        """What the worker does, and whether it keeps up."""
        worker, identifier = self._worker, self._identifier
        dropped = identifier.dropped_windows
        values = {
            "waiting windows": identifier.waiting_windows,
            "dropped windows": dropped,
            "replaced": worker.replaced,
            "process": worker.pid,
        }
        if dropped:
            return Finding(
                WARN,
                f"{dropped} windows were dropped: they come faster than they are fitted; "
                "raise hop or waiting_windows",
                values,
            )
        if not worker.ready:
            return Finding(OK, "the process is starting", values)
        if worker.waits:
            return Finding(OK, "waits for a process that others have", values)
        return Finding(OK, identifier.running or "idle", values)

    def parameters(self) -> Finding:
        """The set in use."""
        tracker = self._identifier.tracker
        parameters = tracker.parameters
        age = (self._now_ns() - parameters.stamp_ns) / NANOSECONDS
        names = parameters.law.parameter_names
        hidden = [n for n, seen in zip(names, parameters.observable, strict=True) if not seen]
        values = {
            "id": parameters.set_id,
            "model": parameters.model,
            "source": parameters.source,
            "age [s]": f"{age:.1f}" if parameters.stamp_ns else "unknown",
            "NRMSE": f"{parameters.nrmse:.4f}",
            "not observable": ", ".join(hidden) or "none",
        }
        if tracker.accepted_windows == 0:
            return Finding(
                WARN, f"no window accepted yet: running with {parameters.set_id}", values
            )
        return Finding(OK, f"running with {parameters.set_id}", values)

    def state(self) -> Finding:
        """Whether what is known is on disk."""
        state = self._identifier.state
        if state.fault:
            return Finding(ERROR, state.fault)
        if state.set_aside:
            return Finding(ERROR, f"{state.set_aside} (once you have read this: ~/acknowledge)")
        if state.path is None:
            return Finding(OK, "nothing is kept on disk: state_dir is not set")
        return Finding(OK, f"kept in {state.path}")
