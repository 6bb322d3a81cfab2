"""The times that a stamp can hold."""

from __future__ import annotations

from mr_damper_ros.signals.blocks import NANOSECONDS

STAMP_LIMIT = 2**31 * NANOSECONDS
"""Nanoseconds that a stamp cannot hold any more: its seconds are a signed 32-bit number."""


def fits_a_stamp(nanoseconds: int) -> bool:
    """Whether a stamp can hold so many nanoseconds since the epoch."""
    return -STAMP_LIMIT <= nanoseconds < STAMP_LIMIT
