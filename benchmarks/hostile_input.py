"""Good input, and what spoils it."""

from __future__ import annotations

import math
import random

import numpy as np

from mr_damper_ros.signals.blocks import NANOSECONDS

PERIOD = 1e-3
AMPLITUDE, FREQUENCY, CURRENT = 5e-3, 2.0, 1.5
T0 = 1_700_000_000 * NANOSECONDS

NUMBERS = (
    *(0.0, -0.0, -1.0, 1e-320, 1e300, -1e300, 1e18, 2.0**53, 0.1),
    *(math.nan, math.inf, -math.inf),
)
WORDS = (
    *(b"nan", b"inf", b"-1", b"1e999", b"0x10", b"1,5", b";", b",", b"\t", b"\n", b"\r", b"\0"),
    *(b"\xff\xfe", b"\xef\xbb\xbf", b"\xc3\xa4", b"'", b'"', b"#", b"---", b"&a [*a]", b"!!python"),
    *(
        b"{",
        b"[" * 50,
        b"[" * 5000,
        b"2001-02-31",
        b"!!int ''",
        b"]",
        b": ",
        b"? ",
        b"1" * 400,
        b"null",
        b"~",
        b"<<: *a",
        b"!!binary =",
    ),
)


def spoilt(chance: random.Random, good: bytes) -> bytes:
    """The bytes with a few of them changed, left out, doubled, or words put in between."""
    data = bytearray(good)
    for _ in range(chance.choice((1, 1, 1, 2, 5))):
        first = chance.randrange(len(data) + 1)
        last = min(first + chance.choice((1, 1, 4, 16, len(data))), len(data))
        change = chance.randrange(5)
        if change == 0:
            data[first:last] = b""
        elif change == 1:
            data[first:first] = data[first:last][:4000]
        elif change == 2:
            data[first:first] = chance.choice(WORDS)
        elif change == 3:
            data[first:last] = chance.choice(WORDS)
        elif first < len(data):
            data[first] ^= 1 << chance.randrange(8)
    return bytes(data)


def motion(time_: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Displacement [m], velocity [m/s] and acceleration [m/s²] of the sine that all input is of."""
    rate = 2.0 * math.pi * FREQUENCY
    # With a phase, so that no sample lies where the law jumps from one branch to the other.
    angle = rate * time_ + 0.3
    return (
        AMPLITUDE * np.sin(angle),
        AMPLITUDE * rate * np.cos(angle),
        -AMPLITUDE * rate**2 * np.sin(angle),
    )
