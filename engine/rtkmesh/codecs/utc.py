"""UTC of streams, which ask for it with every message: leap seconds are remembered by the hour and by the day."""

from datetime import date, timedelta
from functools import lru_cache
from typing import Final

from rtkmesh.gnss.time import GPS_ORIGIN, GpsTime, gps_minus_utc_s, leap_seconds

_HOUR_S: Final = 3600.0
_HOUR_US: Final = 3_600_000_000
_ORIGIN: Final = GPS_ORIGIN.toordinal()
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


def gps_day(year: int, month: int, day: int) -> int:
    """Return the days from the beginning of GPS time to a date; ValueError if there is no such date."""
    return date(year, month, day).toordinal() - _ORIGIN


def from_utc(day: int, time_of_day_us: int) -> GpsTime:
    """Return the GPS instant of a time of day (microseconds) of UTC, ``day`` days after the beginning of GPS time."""
    seconds, micros = divmod(time_of_day_us, 1_000_000)
    week, tow_s = divmod(day * 86_400 + seconds + _leap_seconds_of_day(day), 604_800)
    return GpsTime(week, tow_s + micros * 1e-6)


def microseconds(time_of_day_s: float) -> int:
    """Return a time of day in whole microseconds, rounded as ``timedelta`` does."""
    whole = int(time_of_day_s)
    return whole * 1_000_000 + round((time_of_day_s - whole) * 1e6)


@lru_cache(maxsize=64)
def _leap_seconds_of_day(day: int) -> int:
    """Return GPST - UTC (s) of a day of UTC: it changes only between days."""
    return leap_seconds(GPS_ORIGIN + timedelta(days=day))


@lru_cache(maxsize=256)
def _of_hour(week: int, hour: int) -> tuple[int | None, int | None]:
    """Return leap seconds and year of an hour of the week, None where they change in it (both never fall: equal ends mean no change)."""
    first, last = (GpsTime.normalized(week, (hour + k) * _HOUR_S) for k in (0, 1))
    leaps, years = {gps_minus_utc_s(first), gps_minus_utc_s(last)}, {first.to_utc().year, last.to_utc().year}
    return leaps.pop() if len(leaps) == 1 else None, years.pop() if len(years) == 1 else None
