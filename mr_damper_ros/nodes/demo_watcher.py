"""What the demonstration hears of the running nodes."""

from __future__ import annotations

import time

from mr_damper_msgs.msg import DamperParameters, FitReport, MtsSamples, PredictedForce

from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import from_field, to_nanoseconds
from mr_damper_ros.nodes.observer import Observer
from mr_damper_ros.signals.arrays import Array


class DemoWatcher(Observer):
    """Keeps the samples, the predictions, the reports and the newest parameters.

    Each report is printed as it comes. The dictionaries hold arrays by the index of their first
    sample.
    """

    def __init__(self) -> None:
        super().__init__("demo")
        self.displacement: dict[int, Array] = {}
        self.measured: dict[int, Array] = {}
        self.predicted: dict[int, Array] = {}
        self.reports: list[FitReport] = []
        self.parameters: DamperParameters | None = None
        self.last_report = time.monotonic()
        stream = quality.stream()
        self.listen(MtsSamples, "mts/samples", stream, self._keep_samples)
        self.listen(PredictedForce, "damper/predicted_force", stream, self._keep_force)
        self.listen(FitReport, "damper/fit_report", stream, self._keep_report)
        self.listen(DamperParameters, "damper/parameters", quality.latched(), self._keep_set)

    def _keep_samples(self, message: MtsSamples) -> None:
        self.displacement[message.seq] = from_field(message.displacement).copy()
        self.measured[message.seq] = from_field(message.force).copy()

    def _keep_force(self, message: PredictedForce) -> None:
        if message.valid:
            self.predicted[message.seq] = from_field(message.force).copy()

    def _keep_set(self, message: DamperParameters) -> None:
        self.parameters = message

    def _keep_report(self, message: FitReport) -> None:
        self.reports.append(message)
        self.last_report = time.monotonic()
        elapsed = 1e-9 * (
            to_nanoseconds(message.header.stamp) - to_nanoseconds(self.reports[0].window_start)
        )
        verdict = "accepted" if message.accepted else f"kept: {message.reason}"
        print(
            f"{elapsed:6.1f} s  NRMSE {message.nrmse_before:9.2%} -> {message.nrmse_after:6.2%}  "
            f"{message.evaluations:4d} evaluations, {1e3 * message.duration:4.0f} ms  "
            f"force scale {message.force_scale:6.4f}  {message.parameter_set}: {verdict}",
            flush=True,
        )
