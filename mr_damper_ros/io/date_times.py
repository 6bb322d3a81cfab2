"""Date and time of day as loggers write them."""

from __future__ import annotations

import re
from datetime import datetime, timezone
from functools import lru_cache

_MOMENT = re.compile(
    r"\s*(\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4})[ T]+(\d{1,2}):(\d{2})(?::(\d{2}(?:[.,]\d+)?))?"
    r"\s*(?:([AaPp])\.?[Mm]\.?)?\s*(Z|[+-]\d{2}:?\d{2})?\s*"
)
"""Date, hour, minute, second, half of the day, zone."""


def seconds_since_1970(text: str) -> float | None:
    """Seconds of a date with the time of day, taken for UTC unless it says its zone; None if none.

    The numbers of the date are year, month, day where the first has four digits; else between
    slashes month, day, year, unless the first is above twelve; between others day, month, year.
    """
    found = _MOMENT.fullmatch(text)
    if found is None:
        return None
    date, hour, minute, second, half, zone = found.groups()
    midnight = _midnight(date)
    hours, seconds = int(hour), float((second or "0").replace(",", "."))
    if midnight is None or hours > 23 or int(minute) > 59 or seconds >= 61.0:
        return None
    # Some loggers write AM and PM after hours up to 23.
    if half and hours <= 12:
        hours = hours % 12 + (12 if half in "Pp" else 0)
    return midnight + (3600 * hours + 60 * int(minute) - _offset(zone)) + seconds


@lru_cache(maxsize=64)
def _midnight(date: str) -> int | None:
    """Seconds from 1970 to the beginning of a day; None where there is no such day."""
    a, b, c = (int(part) for part in re.split(r"[-/.]", date))
    if a > 31:
        year, month, day = a, b, c
    elif "/" in date and a <= 12:
        year, month, day = c, a, b
    else:
        year, month, day = c, b, a
    try:
        begins = datetime(year + 2000 if year < 100 else year, month, day, tzinfo=timezone.utc)
    except ValueError:
        return None
    return int(begins.timestamp())


def _offset(zone: str | None) -> int:
    """Seconds by which a zone is ahead of UTC."""
    if zone is None or zone == "Z":
        return 0
    seconds = 3600 * int(zone[1:3]) + 60 * int(zone[-2:])
    return -seconds if zone[0] == "-" else seconds
