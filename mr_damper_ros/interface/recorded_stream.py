"""A recording as the stream that it once was: what the identifier node would have found."""

from __future__ import annotations

from collections.abc import Iterator

from mr_damper_ros.signals.blocks import SampleBlock
from mr_damper_ros.signals.recorded_stream import CurrentReading, stream_of
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.tracker import WindowTracker
from mr_damper_ros.tracking.window_assembler import WindowAssembler

_BLOCK = 100
"""Samples that come at once; the windows do not depend on it."""


def follow(
    tracker: WindowTracker, recording: Recording, *, window: float = 2.0, hop: float = 1.0
) -> Iterator[Report]:
    """Let a tracker follow a recording, window by window; a report for each, as it comes.

    ``window`` [s] is the length of a window, ``hop`` [s] the time from one to the next. The set in
    use is ``tracker.parameters``; ``tracker.identify()`` identifies globally from the windows kept.

    Raises ValueError where window or hop is not positive, or the hop is longer than the window.

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
    assembler = WindowAssembler(window, hop)
    for item in stream_of(recording, _BLOCK):
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
