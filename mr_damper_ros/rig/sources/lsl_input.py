"""Streams of the lab streaming layer, by pylsl, which brings its library along."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

from mr_damper_ros.rig.sources.analog_input import (
    BUFFERED,
    MOST_READ,
    AnalogChannels,
    Connect,
    Readings,
)
from mr_damper_ros.rig.sources.device_source import POLL, SILENCE


def connector(channels: AnalogChannels) -> Connect:
    """What connects to the stream; raises ValueError where the library is missing."""
    try:
        pylsl: Any = import_module("pylsl")
    except (ImportError, RuntimeError, OSError) as error:
        raise ValueError(
            "daq.driver is lsl, for which pylsl is not installed: pip install pylsl==1.18.6"
        ) from error
    return lambda: _LslInlet(pylsl, channels)


class _LslInlet:
    """The stream of a name; its stamps are those of its sender on the clock of this computer."""

    def __init__(self, pylsl: Any, channels: AnalogChannels) -> None:
        self._name = channels.device
        self._failures: tuple[type[Exception], ...] = (
            *(pylsl.util.LostError, pylsl.util.InternalError),
            *(TimeoutError, RuntimeError, ValueError),
        )
        found = pylsl.resolve_byprop("name", channels.device, 1, SILENCE)
        if not found:
            raise OSError(f"there is no stream '{channels.device}' on the network")
        if found[0].channel_format() == pylsl.cf_string:
            raise OSError(f"the stream '{channels.device}' holds texts, not numbers")
        try:
            self._inlet = pylsl.StreamInlet(
                found[0],
                max_buflen=round(BUFFERED),
                recover=False,
                processing_flags=pylsl.proc_clocksync,
                as_numpy=True,
            )
            labels = self._inlet.info(SILENCE).get_channel_labels() or []
            self._inlet.open_stream(SILENCE)
        except self._failures as error:
            raise OSError(f"the stream '{self._name}' cannot be opened: {error}") from error
        count = found[0].channel_count()
        self._places = [_place(name, labels, count, self._name) for name in channels.names]

    def read(self) -> Readings | None:
        try:
            samples, stamps = self._inlet.pull_chunk(POLL, MOST_READ, min_samples=1)
        except self._failures as error:
            raise ConnectionError(f"the stream '{self._name}' was lost") from error
        if len(stamps) == 0:
            return None
        values = np.asarray(samples, dtype=np.float64).T[self._places]
        return Readings(values, 0.0, np.asarray(stamps, dtype=np.float64))

    def close(self) -> None:
        self._inlet.close_stream()
        del self._inlet


def _place(name: str, labels: list[str | None], count: int, stream: str) -> int:
    """The place of a channel, by its label or its number from 0; raises OSError."""
    if name in labels:
        return labels.index(name)
    if name.isdigit() and int(name) < count:
        return int(name)
    known = ", ".join(label for label in labels if label) or "none has a label"
    raise OSError(f"the stream '{stream}' has {count} channels ({known}), and no '{name}'")
