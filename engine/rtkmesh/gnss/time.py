"""GPS time and the other scales.

``GpsTime`` is the only time that crosses function boundaries. UTC and GLONASS time are reached through the leap second
table; a receiver's own leap second count is never needed.
"""

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from math import floor
from typing import Final

from rtkmesh.gnss.constants import SECONDS_PER_DAY, SECONDS_PER_WEEK

GPS_ORIGIN: Final = datetime(1980, 1, 6, tzinfo=UTC)

# (UTC instant from which it holds, GPST - UTC in seconds); IERS Bulletin C, newest last.
_LEAP_SECONDS: Final = tuple(
    (datetime(year, month, 1, tzinfo=UTC), leap)
    for year, month, leap in (
        (1981, 7, 1), (1982, 7, 2), (1983, 7, 3), (1985, 7, 4), (1988, 1, 5), (1990, 1, 6), (1991, 1, 7), (1992, 7, 8),
        (1993, 7, 9), (1994, 7, 10), (1996, 1, 11), (1997, 7, 12), (1999, 1, 13), (2006, 1, 14), (2009, 1, 15),
        (2012, 7, 16), (2015, 7, 17), (2017, 1, 18),
    )
)  # fmt: skip


@dataclass(frozen=True, slots=True, order=True)
class GpsTime:
    """An instant in GPS time: full week number since 1980-01-06 and seconds of week in [0, 604800)."""

    week: int
    tow_s: float

    @staticmethod
    def normalized(week: int, tow_s: float) -> "GpsTime":
        """Return the instant with whole weeks carried over, for a ``tow_s`` of any size."""
        weeks = floor(tow_s / SECONDS_PER_WEEK)
        tow_s -= weeks * SECONDS_PER_WEEK
        if tow_s >= SECONDS_PER_WEEK:  # rounding of a tiny negative value
            weeks, tow_s = weeks + 1, 0.0
        return GpsTime(week + weeks, tow_s)

    @staticmethod
    def from_calendar(year: int, month: int, day: int, hour: int = 0, minute: int = 0, second: float = 0.0) -> "GpsTime":
        """Return the instant of a calendar date that is counted in GPS time (as in RINEX observation files)."""
        days = (datetime(year, month, day, tzinfo=UTC) - GPS_ORIGIN).days
        return GpsTime.normalized(days // 7, (days % 7) * SECONDS_PER_DAY + hour * 3600.0 + minute * 60.0 + second)

    @staticmethod
    def from_utc(utc: datetime) -> "GpsTime":
        """Return the instant of an aware UTC datetime."""
        since = utc - GPS_ORIGIN
        return GpsTime.normalized(0, since.days * SECONDS_PER_DAY + since.seconds + leap_seconds(utc)) + since.microseconds * 1e-6

    def to_calendar(self) -> datetime:
        """Return the calendar date counted in GPS time (no leap seconds), rounded to microseconds."""
        return GPS_ORIGIN + timedelta(weeks=self.week, microseconds=round(self.tow_s * 1e6))

    def to_utc(self) -> datetime:
        """Return the UTC datetime, rounded to microseconds."""
        calendar = self.to_calendar()
        return calendar - timedelta(seconds=leap_seconds(calendar - timedelta(seconds=leap_seconds(calendar))))

    def __add__(self, seconds: float) -> "GpsTime":
        return GpsTime.normalized(self.week, self.tow_s + seconds)

    def __sub__(self, other: "GpsTime") -> float:
        """Return the seconds from ``other`` to this instant."""
        return (self.week - other.week) * SECONDS_PER_WEEK + (self.tow_s - other.tow_s)


def leap_seconds(utc: datetime) -> int:
    """Return GPST - UTC (s) at an aware UTC datetime."""
    for since, leap in reversed(_LEAP_SECONDS):
        if utc >= since:
            return leap
    return 0


def gps_minus_utc_s(time: GpsTime) -> int:
    """Return GPST - UTC (s) at a GPS instant."""
    calendar = time.to_calendar()
    return leap_seconds(calendar - timedelta(seconds=leap_seconds(calendar)))


def nearest_week(tow_s: float, near: GpsTime, weeks: int = 1) -> GpsTime:
    """Return the instant with this ``tow_s`` that is nearest to ``near``.

    ``tow_s`` is taken modulo ``weeks`` weeks (1: a time of week; more: a time counted from a truncated week number).
    """
    period = weeks * SECONDS_PER_WEEK
    gap = tow_s - (near.week % weeks) * SECONDS_PER_WEEK - near.tow_s
    return GpsTime.normalized(near.week, near.tow_s + gap - period * floor(gap / period + 0.5))


def resolve_week(truncated_week: int, bits: int, near: GpsTime) -> int:
    """Return the full GPS week whose lowest ``bits`` bits are ``truncated_week`` and which is nearest to ``near``."""
    period = 1 << bits
    return truncated_week + period * floor((near.week - truncated_week) / period + 0.5)
