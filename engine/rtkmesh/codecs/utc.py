"""GPST minus UTC for streams, which ask for it with every message: remembered by the hour."""

from functools import lru_cache

from rtkmesh.gnss.time import GpsTime, gps_minus_utc_s

_HOUR_S = 3600.0


def leap_seconds_of(time: GpsTime) -> int:
    """Return GPST - UTC (s) at a GPS instant."""
    leap = _of_hour(time.week, int(time.tow_s // _HOUR_S))
    return gps_minus_utc_s(time) if leap is None else leap


@lru_cache(maxsize=256)
def _of_hour(week: int, hour: int) -> int | None:
    """Return GPST - UTC (s) of an hour of the week, None if it changes in it (it never falls, so equal ends mean that it does not)."""
    first, last = (gps_minus_utc_s(GpsTime.normalized(week, (hour + k) * _HOUR_S)) for k in (0, 1))
    return first if first == last else None
