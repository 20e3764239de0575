"""The table chooses by time, health and upload, whatever the order in which ephemerides came."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtkmesh.gnss.ephemeris import KeplerEphemeris, NavigationMessage
from rtkmesh.gnss.signals import NO_CHANNEL, satellite_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.ephemeris_table import (
    AF0,
    ISSUES_PER_SATELLITE,
    KEPLERIAN,
    KIND,
    MESSAGE,
    NO_EPHEMERIS,
    ROW,
    STATE_VECTOR,
    TOE_TOW,
    TOE_WEEK,
    EphemerisTable,
    refusal,
)


def ids(*names: str) -> np.ndarray:
    return np.array([satellite_number(name) for name in names], np.int16)


def test_a_row_per_requested_satellite_and_nan_where_nothing_is_known(make_kepler, make_glonass, noon):
    table = EphemerisTable()
    assert table.add(make_kepler("G05"))
    assert table.add(make_glonass("R03"))
    rows = table.select(ids("R03", "G06", "G05"), noon)
    assert rows.shape == (3, ROW)
    assert list(rows[:, KIND]) == [STATE_VECTOR, NO_EPHEMERIS, KEPLERIAN]
    assert np.isnan(rows[1, 1:]).all()
    assert np.isfinite(rows[[0, 2]]).all()
    assert table.channel(satellite_number("R03")) == make_glonass("R03").channel
    assert list(table.channels(ids("R04", "R03"))) == [NO_CHANNEL, make_glonass("R03").channel]


def test_the_same_issue_twice_is_counted_and_kept_once(make_kepler):
    table = EphemerisTable()
    assert table.add(make_kepler("G05"))
    assert not table.add(make_kepler("G05"))
    assert not table.add(replace(make_kepler("G05"), transmitted=make_kepler("G05").toe))
    assert (len(table), table.added, table.repeated) == (1, 1, 2)


@pytest.mark.parametrize(("name", "half_width_s"), [("G05", 7200.0), ("E05", 14400.0), ("C20", 10800.0), ("J02", 7200.0), ("R05", 1800.0)])
def test_an_issue_is_used_only_within_its_validity(make_kepler, make_glonass, noon, name, half_width_s):
    table = EphemerisTable()
    assert table.add(make_glonass(name) if name[0] == "R" else make_kepler(name))
    for offset_s, kind in ((half_width_s, True), (half_width_s + 2.0, False), (-half_width_s, True), (-half_width_s - 2.0, False)):
        assert bool(table.select(ids(name), noon + offset_s)[0, KIND] != NO_EPHEMERIS) is kind


def test_the_nearest_toe_wins_also_across_the_week(make_kepler):
    table, saturday = EphemerisTable(), GpsTime(2200, 604800.0 - 7200.0)
    assert table.add(make_kepler("G05", saturday))
    assert table.add(make_kepler("G05", saturday + 7200.0))
    assert table.select(ids("G05"), saturday + 3500.0)[0, TOE_WEEK] == 2200
    assert table.select(ids("G05"), saturday + 3700.0)[0, TOE_WEEK] == 2201
    assert table.select(ids("G05"), saturday + 3600.0)[0, TOE_WEEK] == 2201, "of equally near ones the later"


def test_of_practically_one_toe_the_newer_upload_wins(make_kepler, noon):
    table = EphemerisTable()
    assert table.add(make_kepler("G05", noon, transmitted=noon + -7000.0, af0_s=1e-5))
    assert table.add(make_kepler("G05", noon + -16.0, transmitted=noon + -4000.0, af0_s=2e-5))
    assert table.select(ids("G05"), noon + 100.0)[0, AF0] == 2e-5


def test_inav_is_preferred_to_fnav_unless_it_is_an_hour_older(make_kepler, noon):
    table = EphemerisTable()
    assert table.add(make_kepler("E05", noon + -1200.0))
    assert table.add(make_kepler("E05", noon, message=NavigationMessage.FNAV))
    assert table.select(ids("E05"), noon)[0, MESSAGE] == NavigationMessage.INAV
    assert table.add(make_kepler("E05", noon + 7200.0, message=NavigationMessage.FNAV))
    assert table.select(ids("E05"), noon + 7200.0)[0, MESSAGE] == NavigationMessage.FNAV


def test_an_unhealthy_satellite_is_given_only_on_request(make_kepler, noon):
    table = EphemerisTable()
    assert table.add(make_kepler("G05", health=63))
    assert table.select(ids("G05"), noon)[0, KIND] == NO_EPHEMERIS
    assert table.select(ids("G05"), noon, include_unhealthy=True)[0, KIND] == KEPLERIAN


def test_the_last_word_before_now_withdraws_a_satellite_though_an_older_issue_is_nearer(make_kepler, noon):
    table = EphemerisTable()
    assert table.add(make_kepler("G05", noon, transmitted=noon + -3600.0))
    assert table.add(make_kepler("G05", noon + 7184.0, transmitted=noon + 600.0, health=1))
    assert table.select(ids("G05"), noon + 500.0)[0, KIND] == KEPLERIAN
    assert table.select(ids("G05"), noon + 700.0)[0, KIND] == NO_EPHEMERIS


@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_the_order_of_adding_changes_nothing(data: st.DataObject):
    noon = GpsTime(2150, 396000.0)
    issues = [_issue(noon, hours, sent, health) for hours in (-2, 0, 0.004, 2) for sent in (-1, 1) for health in (0, 1)]
    first, second = EphemerisTable(), EphemerisTable()
    for table, order in ((first, issues), (second, data.draw(st.permutations(issues)))):
        for issue in order:
            table.add(issue)
    for hours in (-3.0, -1.0, 0.0, 0.5, 1.0, 2.9):
        at = noon + hours * 3600.0
        np.testing.assert_array_equal(first.select(ids("G05"), at), second.select(ids("G05"), at))


def _issue(noon: GpsTime, hours: float, sent: float, health: int) -> KeplerEphemeris:
    toe = noon + hours * 3600.0
    return KeplerEphemeris(
        satellite_number("G05"), NavigationMessage.LNAV, 1, 1, toe, toe, noon + sent * 1800.0, health, 2.0, 7200.0, 5153.6, 0.01,
        sent * 0.1, 4e-9, 1.0, 0.5, -8e-9, 0.96, 1e-10, 1e-6, 1e-6, 200.0, 20.0, 1e-8, 1e-8, 1e-5, 0.0, 0.0, (0.0, 0.0),
    )  # fmt: skip


def test_withdrawing_undoes_adding(make_kepler, noon):
    """In any order: what is left is the table of the others; what is not there cannot be withdrawn."""
    issues = [make_kepler("G05", toe=noon + 7200.0 * k) for k in range(-3, 4)]
    table, others = EphemerisTable(), EphemerisTable()
    for issue in issues:
        table.add(issue)
    for issue in (issues[5], issues[0], issues[3]):
        assert table.withdraw(issue)
        assert not table.withdraw(issue)
    for issue in (issues[1], issues[2], issues[4], issues[6]):
        others.add(issue)
    times = [noon + 1800.0 * k for k in range(-16, 17)]
    assert len(table) == len(others) == 4
    assert all(np.array_equal(table.select(ids("G05"), t), others.select(ids("G05"), t), equal_nan=True) for t in times)
    assert table.add(issues[3])


def test_a_full_satellite_loses_its_oldest_issue(make_kepler, noon):
    table = EphemerisTable()
    for k in range(ISSUES_PER_SATELLITE + 5):
        assert table.add(make_kepler("E05", noon + 600.0 * k))
    assert len(table) == ISSUES_PER_SATELLITE
    assert not table.add(make_kepler("E05", noon))
    assert table.refused["older than all kept"] == 1
    last = noon + 600.0 * (ISSUES_PER_SATELLITE + 4)
    assert table.select(ids("E05"), last)[0, TOE_TOW] == last.tow_s
    oldest = noon + 3000.0
    assert table.select(ids("E05"), oldest)[0, TOE_TOW] == oldest.tow_s


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"sqrt_a": 100.0}, "orbit size or shape"),
        ({"eccentricity": 0.7}, "orbit size or shape"),
        ({"m0_rad": float("nan")}, "not finite"),
        ({"fit_s": float("inf")}, "not finite"),
        ({"i0_rad": 9.0}, "angle"),
        ({"omega_dot_radps": 1e-3}, "rate or correction"),
        ({"crs_m": 1e6}, "rate or correction"),
        ({"af0_s": 0.5}, "clock"),
        ({"group_delay_s": (1e-3, 0.0)}, "clock"),
        ({"toc": GpsTime(2151, 396000.0)}, "clock and orbit apart"),
        ({"satellite": satellite_number("R05")}, "satellite"),
        ({"satellite": satellite_number("G05") - 5}, "satellite"),
        ({"satellite": satellite_number("S20")}, "satellite"),
        ({"satellite": 9999}, "satellite"),
    ],
)
def test_impossible_kepler_elements_are_refused_and_counted(make_kepler, change, reason):
    table = EphemerisTable()
    assert not table.add(make_kepler("G05", **change))
    assert table.refused == {reason: 1}
    assert len(table) == 0


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"position_m": (0.0, 0.0, 0.0)}, "orbit size or shape"),
        ({"velocity_mps": (9e3, 0.0, 0.0)}, "orbit size or shape"),
        ({"acceleration_mps2": (1.0, 0.0, 0.0)}, "rate or correction"),
        ({"tau_s": 1.0}, "clock"),
        ({"gamma": float("nan")}, "not finite"),
        ({"channel": 40}, "channel"),
        ({"satellite": satellite_number("G05")}, "satellite"),
    ],
)
def test_impossible_glonass_states_are_refused(make_glonass, change, reason):
    assert refusal(make_glonass("R05", **change)) == reason
