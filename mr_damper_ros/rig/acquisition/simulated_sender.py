"""A sender that is not there: a sine, and what a damper makes of it, as lines or records."""

from __future__ import annotations

import math
import re
import struct
import time

from mr_damper_ros.rig.acquisition.row_decoders import CHECKS
from mr_damper_ros.rig.acquisition.row_format import RowFormat

_RATE = 1000.0
"""Samples per second [Hz] where none is stated."""

_IDLE = 0.01


class SimulatedSender:
    """Sends 5 mm at 1 Hz, 1 kN, 1.5 A and 25 °C in a format; records after the ``mark``."""

    def __init__(
        self, form: RowFormat, rate: float, layout: str = "", mark: bytes = b"", check: str = "none"
    ) -> None:
        self._form = form
        self._rate = _RATE if math.isnan(rate) else rate
        self._layout, self._mark, self._check = layout, mark, CHECKS[check]
        self._began = time.monotonic()
        self._sent = 0

    def read(self) -> bytes | None:
        """What is due by now."""
        time.sleep(_IDLE)
        until = math.floor((time.monotonic() - self._began) * self._rate)
        first, self._sent = self._sent, until
        return b"".join(self.row(k) for k in range(first, until)) or None

    def close(self) -> None:
        """Nothing is to be let go."""

    def row(self, k: int) -> bytes:
        """Line or record number ``k``."""
        cells = self._cells(k)
        if not self._layout:
            return ",".join(f"{cell:.10g}" for cell in cells).encode() + b"\n"
        letters = re.sub(r"[<>]|\d*x", "", self._layout)
        values = [
            cell if letter in "efd" else round(cell)
            for cell, letter in zip(cells, letters, strict=True)
        ]
        data = self._mark + struct.pack(self._layout, *values)
        size, check = self._check
        return data + check(data)[:size]

    def _cells(self, k: int) -> list[float]:
        form = self._form
        phase = 2.0 * math.pi * k / self._rate
        measured = {
            "time": k / self._rate,
            "displacement": 0.005 * math.sin(phase),
            "force": 1000.0 * math.tanh(3.0 * math.cos(phase)),
            "current": 1.5,
            "temperature": 25.0,
        }
        cells = [0.0] * (form.width or form.least)
        for column in form.columns:
            value = (measured[column.quantity] - column.offset) / column.factor
            cells[column.position] = value
        if form.count is not None:
            cells[form.count] = k % 2**form.bits
        return cells
