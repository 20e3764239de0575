"""Leap seconds, years and Moscow hours that are remembered by the hour are those of the calendar."""

from datetime import UTC, date, datetime, timedelta

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtkmesh.codecs.utc import from_utc, gps_day, leap_seconds_of, microseconds, moscow_hour, utc_year
from rtkmesh.gnss.time import GpsTime, gps_minus_utc_s


def check(time: GpsTime) -> None:
    utc = time.to_utc()
    assert (leap_seconds_of(time), utc_year(time), moscow_hour(time)) == (gps_minus_utc_s(time), utc.year, (utc + timedelta(hours=3)).hour)


@given(week=st.integers(0, 4000), tow_s=st.floats(0.0, 604_800.0, exclude_max=True))
@settings(max_examples=200, deadline=None)
def test_any_instant(week: int, tow_s: float):
    """Over seventy years."""
    check(GpsTime(week, tow_s))


@pytest.mark.parametrize(("year", "month"), [(1980, 7), (1981, 7), (1999, 1), (1999, 7), (2006, 1), (2016, 7), (2017, 1), (2024, 1)])
def test_the_seconds_around_midnights_with_and_without_a_leap_second(year: int, month: int):
    """Half a minute before and after the turn of the year and of its half, in steps that meet the boundaries and miss them by rounding."""
    turn = GpsTime.from_utc(datetime(year, month, 1, tzinfo=UTC))
    for hours in (-3, 0):
        for step in range(-60, 61):
            for offset_s in (0.0, 1e-7, -1e-7, 4e-10, -4e-10):
                check(turn + (3600.0 * hours + 0.5 * step + offset_s))


SECONDS_OF_DAY = st.one_of(
    st.floats(0.0, 86_461.0),
    st.integers(0, 86_460_000).map(lambda n: n / 1e3),
    st.integers(0, 172_800).map(lambda n: n / 2 + 5e-7),  # halves of a microsecond
)


@given(day=st.dates(date(1979, 1, 1), date(2070, 1, 1)), second_s=SECONDS_OF_DAY)
@settings(max_examples=200, deadline=None)
def test_times_of_day_are_those_of_the_standard_library(day: date, second_s: float):
    """Days, microseconds and GPS times against datetime, leap seconds at the end of the day included."""
    utc = datetime(day.year, day.month, day.day, tzinfo=UTC) + timedelta(seconds=second_s)
    days, time_of_day_us = divmod(microseconds(second_s), 86_400_000_000)
    assert timedelta(days=days, microseconds=time_of_day_us) == timedelta(seconds=second_s)
    assert from_utc(gps_day(day.year, day.month, day.day) + days, time_of_day_us) == GpsTime.from_utc(utc)
