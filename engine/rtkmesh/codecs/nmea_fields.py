"""Numbers, times and angles as NMEA 0183 writes them; None for what is no such thing. Version 4.11."""

from math import isfinite


def number(text: str) -> float | None:
    """Return a finite number."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if isfinite(value) else None


def time_of_day_s(text: str) -> float | None:
    """Return the seconds of ``hhmmss.ss``."""
    seconds = number(text[4:])
    if not text[:4].isdecimal() or seconds is None:
        return None
    hour, minute = int(text[:2]), int(text[2:4])
    return hour * 3600.0 + minute * 60.0 + seconds if hour < 24 and minute < 60 and 0.0 <= seconds < 61.0 else None


def degrees(text: str, side: str, digits: int, sides: str) -> float | None:
    """Return degrees of ``dddmm.mmmm`` and a hemisphere letter."""
    minutes = number(text[digits:])
    if not text[:digits].isdecimal() or minutes is None or side not in sides or len(side) != 1:
        return None
    value = int(text[:digits]) + minutes / 60.0
    if not 0.0 <= minutes < 60.0 or value > (90.0 if digits == 2 else 180.0):
        return None
    return -value if side == sides[1] else value
