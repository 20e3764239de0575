"""GPS time: calendar, UTC with leap seconds, week resolution; known instants and round trips."""

from datetime import UTC, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh.gnss.time import GpsTime, gps_minus_utc_s, leap_seconds, nearest_week, resolve_week

times = st.builds(GpsTime, st.integers(0, 4000), st.integers(0, 604_799_999).map(lambda ms: ms / 1e3))


@pytest.mark.parametrize(
    ("calendar", "week", "tow_s"),
    [
        ((1980, 1, 6), 0, 0.0),
        ((1999, 8, 22), 1024, 0.0),  # the first rollover of the 10-bit week
        ((2018, 7, 14, 23, 50), 2009, 604_200.0),
        ((2019, 4, 7), 2048, 0.0),  # the second
        ((2038, 1, 19, 3, 14, 7.0), 3028, 184_447.0),
    ],
)
def test_known_dates(calendar: tuple[int, ...], week: int, tow_s: float) -> None:
    time = GpsTime.from_calendar(*calendar)
    assert (time.week, time.tow_s) == (week, tow_s)
    assert time.to_calendar() == datetime(*(int(v) for v in calendar), tzinfo=UTC)


@pytest.mark.parametrize(
    ("utc", "leap"),
    [
        (datetime(1980, 6, 1, tzinfo=UTC), 0),
        (datetime(2016, 12, 31, 23, 59, 59, tzinfo=UTC), 17),
        (datetime(2017, 1, 1, tzinfo=UTC), 18),
        (datetime(2026, 11, 22, tzinfo=UTC), 18),
    ],
)
def test_leap_seconds(utc: datetime, leap: int) -> None:
    assert leap_seconds(utc) == leap
    time = GpsTime.from_utc(utc)
    assert time.to_utc() == utc
    assert gps_minus_utc_s(time) == leap


@given(times)
def test_utc_round_trip(time: GpsTime) -> None:
    """All instants but the inserted second itself come back; that one has no name of its own in UTC here."""
    again = GpsTime.from_utc(time.to_utc())
    assert abs(again - time) < 2e-6 or abs(again - time) == pytest.approx(1.0, abs=2e-6)


@given(times, st.floats(-1e7, 1e7))
def test_adding_and_subtracting(time: GpsTime, seconds: float) -> None:
    moved = time + seconds
    assert moved - time == pytest.approx(seconds, abs=1e-6)
    assert 0.0 <= moved.tow_s < 604_800.0


@given(times)
def test_order_is_that_of_time(time: GpsTime) -> None:
    assert time < time + 0.5
    assert time + -0.5 < time


def test_a_tiny_negative_time_does_not_become_a_whole_week() -> None:
    time = GpsTime.normalized(100, -1e-13)
    assert time == GpsTime(100, 0.0)


@given(times, st.floats(-302_000.0, 302_000.0))
def test_a_time_of_week_is_found_again_within_half_a_week(time: GpsTime, shift: float) -> None:
    near = time + shift
    assert nearest_week(time.tow_s, near) - time == pytest.approx(0.0, abs=1e-6)


@given(st.integers(0, 4000), st.integers(-500, 500), st.sampled_from([10, 12, 13]))
def test_a_truncated_week_is_found_again_within_half_a_period(week: int, shift: int, bits: int) -> None:
    assert resolve_week(week % (1 << bits), bits, GpsTime(max(0, week + shift), 0.0)) == week


@given(times)
def test_the_week_rollover_keeps_differences(time: GpsTime) -> None:
    assert GpsTime(time.week + 1, 0.0) - GpsTime(time.week, 604_799.0) == 1.0
    assert (time + 604_800.0) - time == pytest.approx(604_800.0, abs=1e-9)
