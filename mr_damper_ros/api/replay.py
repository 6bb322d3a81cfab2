"""Replay of a recording or a bag through the engine, with the same results as the nodes."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mr_damper_ros.io.bag_reader import bag_stream
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.processes.files import json_ready
from mr_damper_ros.report.document import GREY, INK, Grid, Shown, panels, styled
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock
from mr_damper_ros.signals.error_sums import ErrorSums
from mr_damper_ros.signals.recording import (
    BLOCK_SIZE,
    CurrentReading,
    Recording,
    StreamItem,
    stream_of,
)
from mr_damper_ros.tracking.acceptance import Verdict
from mr_damper_ros.tracking.engine import Engine, EngineSettings
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.state_directory import SetSource, given_set
from mr_damper_ros.tracking.tracker import WindowTracker
from mr_damper_ros.tracking.validity import DoubtKind
from mr_damper_ros.tracking.window_assembler import WindowAssembler, WindowSettings

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Replay(Shown):
    """Results of the identifier and the model node for a recording, sample by sample.

    Arrays of shape (n,): ``time`` [s] since the first sample, by the stamps; ``displacement`` [m];
    ``measured`` and ``predicted`` force [N], NaN without a prediction; ``doubts``: reason
    code (:class:`DoubtKind`) of each invalid sample, 0 if it is valid. ``reports``: the results for
    windows and global identifications; ``sets``: the accepted sets. Both are in the order in which
    they took effect. ``start_ns`` is the stamp of the first sample [ns].
    """

    name: str
    start_ns: int
    time: Array
    displacement: Array
    measured: Array
    predicted: Array
    doubts: np.ndarray
    reports: tuple[Report, ...]
    sets: tuple[ParameterSet, ...]

    @property
    def valid(self) -> np.ndarray:
        """Whether the predicted force of each sample is valid, shape (n,)."""
        return np.asarray(self.doubts == DoubtKind.NONE)

    @property
    def error(self) -> ErrorSums:
        """RMSE, NRMSE and R² of the valid force."""
        return ErrorSums.of(self.predicted[self.valid], self.measured[self.valid])

    @property
    def parameter_set(self) -> ParameterSet | None:
        """The newest accepted set; None without an accepted set."""
        return self.sets[-1] if self.sets else None

    def invalid_share(self) -> dict[DoubtKind, float]:
        """Fraction of all samples that is invalid for each reason, the largest first."""
        kinds, counts = np.unique(self.doubts[~self.valid], return_counts=True)
        order = np.argsort(-counts)
        return {DoubtKind(kinds[k]): float(counts[k] / self.doubts.size) for k in order}

    def plot(self) -> Figure:
        """Figure: measured and predicted force, error of the valid force, force scale."""
        with styled():
            figure, axes = panels(3, 1, 7.2, 6.0, sharex=True)
            force, error, scale = axes[:, 0]
            shown = np.where(self.valid, self.predicted, np.nan)
            force.plot(self.time, self.measured, color=GREY, label="measured")
            force.plot(self.time, shown, color=INK[1], label="predicted, valid")
            force.set_ylabel("Force [N]")
            error.plot(self.time, shown - self.measured, color=INK[0], linewidth=0.6)
            error.set_ylabel("Error of the\nvalid force [N]")
            for each in (force, error):
                low, high = each.get_ylim()
                each.fill_between(
                    self.time, low, high, where=~self.valid, color="0.92", linewidth=0, zorder=0
                )
                each.set_ylim(low, high)
            points = [
                (self.time_of(each), each.scale.value, each.scale.standard_error)
                for each in self.reports
                if math.isfinite(each.scale.value)
            ]
            scale.errorbar(*np.reshape(points, (-1, 3)).T, color=INK[2], marker=".")
            for each in self.reports:
                if each.accepted:
                    scale.axvline(self.time_of(each), color=GREY, linewidth=0.6)
            scale.set_ylabel("Force scale [1]")
            scale.set_xlabel("Time [s]; grey: not valid, vertical lines: sets accepted")
            force.legend(loc="lower right", ncols=2, bbox_to_anchor=(1.0, 1.0))
            scale.ticklabel_format(useOffset=False)
            figure.suptitle("\n".join(self._summary()[:2]), fontsize="medium")
        return figure

    def document(self) -> dict[str, Any]:
        """The result without the samples, as JSON-compatible values."""
        error = self.error
        return {
            "recording": self.name,
            "samples": int(self.time.size),
            "valid": float(np.mean(self.valid)),
            "nrmse": json_ready(error.nrmse),
            "rmse": json_ready(error.rmse),
            "invalid": {kind.name: share for kind, share in self.invalid_share().items()},
            "reports": [
                {
                    "time": self.time_of(report),
                    "verdict": report.verdict.name,
                    "reason": report.reason,
                    "set": report.set_id,
                    "nrmse_before": json_ready(report.nrmse_before),
                    "nrmse_after": json_ready(report.nrmse_after),
                    "force_scale": json_ready(report.scale.value),
                    "force_scale_standard_error": json_ready(report.scale.standard_error),
                }
                for report in self.reports
            ],
        }

    def time_of(self, report: Report) -> float:
        """Time [s] of the last sample of a report's window."""
        return (report.stamp_ns - self.start_ns) / NANOSECONDS

    def _blocks(self) -> list[str | Grid]:
        columns = ("t [s]", "verdict", "before", "after", "scale", "set in use", "reason")
        rows = [
            (
                f"{self.time_of(report):.2f}",
                _words(report.verdict),
                _percent(report.nrmse_before),
                _percent(report.nrmse_after),
                f"{report.scale.value:.3f}" if math.isfinite(report.scale.value) else "-",
                report.set_id,
                report.reason,
            )
            for report in self.reports
        ]
        return [(columns, rows), *self._summary()]

    def _summary(self) -> list[str]:
        accepted = sum(report.verdict is Verdict.ACCEPTED for report in self.reports)
        error = self.error
        return [
            f"{self.name}: {self.time.size} samples, {len(self.reports)} reports, "
            f"{accepted} accepted",
            f"predicted force: valid for {np.mean(self.valid):.1%} of the samples"
            + (f", NRMSE {error.nrmse:.2%} there" if error.count else ""),
            *(
                f"  not valid for {share:.1%}: {_words(kind)}"
                for kind, share in self.invalid_share().items()
            ),
        ]


def _words(member: Enum) -> str:
    return member.name.lower().replace("_", " ")


def _percent(value: float) -> str:
    return f"{value:.2%}" if math.isfinite(value) else "-"


def replay(
    source: Recording | str | os.PathLike[str],
    parameters: SetSource | None = None,
    *,
    identify: bool = True,
    settings: EngineSettings | None = None,
    block_size: int = BLOCK_SIZE,
) -> Replay:
    """Replay a recording, or the messages of a bag, through the engine of the nodes.

    ``parameters``: the initial set or its file, like the launch argument ``parameters``; None:
    no initial set. ``identify``: if False, only the model node runs, with ``parameters``.
    ``settings``: the settings of the nodes. ``block_size``: samples per block of a recording; a bag
    is replayed in its own blocks.

    Raises BagError, StateError or ParameterError if the bag or the parameters cannot be used, and
    ValueError if the block size is less than 1 or there are no samples.

    Examples
    --------
    >>> import numpy as np
    >>> import mr_damper_ros as mr
    >>> time = np.arange(8000) * 1e-3
    >>> velocity = 0.1 * np.cos(20 * time)
    >>> force = 900 * np.tanh(velocity / 0.02) + 1500 * velocity
    >>> run = mr.Recording("run", 0, 1e-3, 5e-3 * np.sin(20 * time), force, 0.0 * time)
    >>> said = mr.replay(run)
    >>> said.reports[0].verdict.name, f"{said.valid[-1000:].mean():.0%}"
    ('ACCEPTED', '100%')
    """
    initial = None if parameters is None else given_set(parameters)
    engine = Engine(settings, initial, identify=identify)
    stream: Iterable[StreamItem]
    if isinstance(source, Recording):
        name, stream = source.name, stream_of(source, block_size)
    elif isinstance(source, (str, os.PathLike)):
        name, stream = os.fspath(source), bag_stream(Path(source))
    else:
        wrong = f"a recording cannot be of type {type(source).__name__}"
        raise ValueError(f"{wrong}: give a Recording or the path of a bag")
    parts: list[tuple[np.ndarray, ...]] = []
    start_ns: int | None = None
    for block, prediction in engine.follow(stream):
        start_ns = block.start_ns if start_ns is None else start_ns
        start = (prediction.start_ns - start_ns) / NANOSECONDS
        seconds = start + np.arange(prediction.force.size) * prediction.period
        measured = map(prediction.at_its_samples, (block.displacement, block.force))
        parts.append((seconds, *measured, prediction.force, prediction.doubts))
    if start_ns is None:
        raise ValueError(f"{name} holds no samples")
    published = engine.take_publications()
    time, displacement, force, predicted, doubts = map(np.concatenate, zip(*parts, strict=True))
    return Replay(
        name,
        start_ns,
        time,
        displacement,
        force,
        predicted,
        doubts=doubts.astype(np.uint8),
        reports=tuple(each.report for each in published),
        sets=tuple(each.parameters for each in published if each.parameters is not None),
    )


def follow(
    tracker: WindowTracker, recording: Recording, *, window: float = 2.0, hop: float = 1.0
) -> Iterator[Report]:
    """Let a tracker follow a recording window by window, and yield its reports.

    ``window`` [s] is the length of a window, ``hop`` [s] the time between the starts of successive
    windows. The set in use is ``tracker.parameters``; ``tracker.identify()`` identifies globally
    from the stored windows.

    Raises ValueError if ``window`` or ``hop`` is not positive, or ``hop`` exceeds ``window``.

    Examples
    --------
    >>> import numpy as np
    >>> import mr_damper_ros as mr
    >>> time = np.arange(6000) * 1e-3
    >>> velocity = 0.1 * np.cos(20 * time)
    >>> weaker = np.where(time < 3, 1.0, 0.9)
    >>> force = weaker * (900 * np.tanh(velocity / 0.02) + 1500 * velocity)
    >>> run = mr.Recording("run", 0, 1e-3, 5e-3 * np.sin(20 * time), force, 0.0 * time)
    >>> tracker = mr.WindowTracker(mr.TrackerSettings(), mr.identify(run).parameter_set)
    >>> scales = [report.scale.value for report in mr.follow(tracker, run, window=1.0)]
    >>> [round(scale, 2) for scale in scales]
    [nan, 1.0, 1.0, 0.9, 0.9, 0.9]
    """
    assembler = WindowAssembler(WindowSettings(window, hop, looks=0))
    for item in stream_of(recording):
        if isinstance(item, CurrentReading):
            ready = assembler.add_current(*item)
        elif isinstance(item, SampleBlock):
            ready = assembler.add_block(item)
        else:
            continue
        for raw in ready:
            report = tracker.follow(raw)
            if report is not None:
                yield report
