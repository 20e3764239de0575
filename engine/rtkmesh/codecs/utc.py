"""UTC of streams, which ask for it with every message: remembered by the hour."""

from functools import lru_cache
from typing import Final

from rtkmesh.gnss.time import GpsTime, gps_minus_utc_s

_HOUR_S: Final = 3600.0
_HOUR_US: Final = 3_600_000_000
_MOSCOW_MINUS_UTC_S: Final = 10800  # GLONASS ICD 5.1, 3.3.3


def leap_seconds_of(time: GpsTime) -> int:
    """Return GPST - UTC (s) at a GPS instant."""
    leap_s, _ = _of_hour(time.week, int(time.tow_s // _HOUR_S))
    return gps_minus_utc_s(time) if leap_s is None else leap_s


def utc_year(time: GpsTime) -> int:
    """Return the year of UTC at a GPS instant."""
    _, year = _of_hour(time.week, int(time.tow_s // _HOUR_S))
    return time.to_utc().year if year is None else year


def moscow_hour(time: GpsTime) -> int:
    """Return the hour of day of UTC + 3 h at a GPS instant, which is rounded to microseconds."""
    seconds = leap_seconds_of(time) - _MOSCOW_MINUS_UTC_S
    return (round(time.tow_s * 1e6) - seconds * 1_000_000) // _HOUR_US % 24


@lru_cache(maxsize=256)
def _of_hour(week: int, hour: int) -> tuple[int | None, int | None]:
    """Return leap seconds and year of an hour of the week, None where they change in it (both never fall: equal ends mean no change)."""
    first, last = (GpsTime.normalized(week, (hour + k) * _HOUR_S) for k in (0, 1))
    leaps, years = {gps_minus_utc_s(first), gps_minus_utc_s(last)}, {first.to_utc().year, last.to_utc().year}
    return leaps.pop() if len(leaps) == 1 else None, years.pop() if len(years) == 1 else None
