"""Time columns. Whole seconds are integers, fractions are computed as RTKLIB does, so that twelve decimals agree."""

from datetime import datetime
from functools import lru_cache
from math import floor
from typing import Final, NamedTuple

from rtkmesh.gnss.constants import SECONDS_PER_WEEK
from rtkmesh.gnss.time import GPS_ORIGIN, GpsTime, gps_minus_utc_s
from rtkmesh_services.texts.options import TextOptions, TimeSystem

_WEEK: Final = int(SECONDS_PER_WEEK)
_DAY: Final = 86400
_JST_S: Final = 9 * 3600
_ORIGIN_DAY: Final = GPS_ORIGIN.toordinal()
# RTKLIB rounds these seconds of a NMEA sentence up (it writes two decimals).
_NMEA_CARRY: Final = 0.995


class Instant(NamedTuple):
    """Seconds since 1980-01-06 in a time scale: whole ones, and the rest in [0, 1)."""

    whole: int
    fraction: float

    def __add__(self, seconds: float) -> "Instant":  # type: ignore[override]
        """Return the instant some seconds later."""
        fraction = self.fraction + seconds
        whole = floor(fraction)
        return Instant(self.whole + whole, fraction - whole)


def instant(week: int, tow_s: float) -> Instant:
    """Return a GPS time."""
    whole = floor(tow_s)
    return Instant(week * _WEEK + whole, tow_s - whole)


def in_system(time: Instant, system: TimeSystem) -> Instant:
    """Return a GPS time in the scale of a column."""
    if system == "gpst":
        return time
    utc = time + -float(_gps_minus_utc_s(time.whole))
    return utc + float(_JST_S) if system == "jst" else utc


def calendar(time: Instant, decimals: int) -> str:
    """Return ``yyyy/mm/dd hh:mm:ss.sss``; what rounds to 60 seconds is the next minute."""
    if 1.0 - time.fraction < 0.5 / 10.0**decimals:
        time = Instant(time.whole + 1, 0.0)
    seconds = time.whole % 60 + time.fraction
    width = 3 + decimals if decimals else 2
    return f"{_date(time.whole // _DAY)} {time.whole % _DAY // 3600:02d}:{time.whole % 3600 // 60:02d}:{seconds:0{width}.{decimals}f}"


def week_and_seconds(time: Instant, decimals: int, separator: str) -> str:
    """Return week and seconds of week; what rounds to a whole week is the next week's 0."""
    week, whole = divmod(time.whole, _WEEK)
    tow_s = whole + time.fraction
    if _WEEK - tow_s < 0.5 / 10.0**decimals:
        week, tow_s = week + 1, 0.0
    return f"{week:4d}{separator}{tow_s:{7 + decimals if decimals else 6}.{decimals}f}"


def time_column(week: int, tow_s: float, options: TextOptions) -> str:
    """Return the time column or columns of a GPS time."""
    time = in_system(instant(week, tow_s), options.time_system)
    if options.time_form == "hms":
        return calendar(time, options.time_decimals)
    return week_and_seconds(time, options.time_decimals, options.field_separator)


def nmea_time(week: int, tow_s: float) -> tuple[str, str]:
    """Return UTC of a GPS time as NMEA's ``hhmmss.ss`` and ``ddmmyy``."""
    time = in_system(instant(week, tow_s), "utc")
    if time.fraction >= _NMEA_CARRY:
        time = Instant(time.whole + 1, 0.0)
    clock = f"{time.whole % _DAY // 3600:02d}{time.whole % 3600 // 60:02d}{time.whole % 60 + time.fraction:05.2f}"
    day = datetime.fromordinal(_ORIGIN_DAY + time.whole // _DAY)
    return clock, f"{day:%d%m%y}"


def is_due(tow_s: float, interval_s: float, tolerance_s: float) -> bool:
    """Return whether an epoch is a multiple of an interval in GPS time of week; 0: every epoch is, below 0: none."""
    if interval_s == 0.0:
        return True
    return interval_s > 0.0 and (tow_s + tolerance_s) % interval_s <= 2.0 * tolerance_s


@lru_cache(maxsize=8)
def _date(day: int) -> str:
    return f"{datetime.fromordinal(_ORIGIN_DAY + day):%Y/%m/%d}"


@lru_cache(maxsize=64)
def _gps_minus_utc_s(whole: int) -> int:
    return gps_minus_utc_s(GpsTime(*divmod(whole, _WEEK)))
