"""Orbits and clocks obey their own derivatives, their symmetries and the equation of the time of transmission."""

from math import sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.ephemeris import NavigationMessage
from rtkmesh.gnss.signals import satellite_number, signal_number
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.models.glonass_orbit import propagate_state
from rtkmesh.models.orbit import (
    STATE,
    STATE_CLOCK,
    STATE_CLOCK_RATE,
    STATE_OK,
    STATE_VARIANCE,
    eccentric_anomaly,
    group_delay_m,
    satellite_clock_s,
    satellite_state,
    satellite_states,
)


@pytest.fixture
def row(make_kepler, make_glonass, noon):
    def of(name: str, **changes: object) -> np.ndarray:
        table = EphemerisTable()
        ephemeris = make_glonass(name, **changes) if name[0] == "R" else make_kepler(name, **changes)
        assert table.add(ephemeris), table.refused
        return table.select(np.array([satellite_number(name)], np.int16), noon)[0]

    return of


def state_at(row: np.ndarray, week: int, tow_s: float) -> np.ndarray:
    out = np.empty(STATE)
    satellite_state(row, week, tow_s, out)
    return out


@pytest.mark.parametrize("name", ["G05", "E11", "C21", "C03", "C60", "J02", "R07"])
@pytest.mark.parametrize("offset_s", [-1700.0, 0.0, 1234.5])
def test_velocity_and_clock_rate_are_the_derivatives_of_position_and_clock(row, noon, name, offset_s):
    changes = {"sqrt_a": 6493.4, "i0_rad": 0.1} if name in ("C03", "C60") else {}
    r, at = row(name, **changes), noon + offset_s
    before, now, after = (state_at(r, at.week, at.tow_s + dt) for dt in (-1.0, 0.0, 1.0))
    np.testing.assert_allclose(now[3:6], (after[:3] - before[:3]) / 2.0, atol=2e-4)  # third derivative / 6
    assert now[STATE_CLOCK_RATE] == pytest.approx((after[STATE_CLOCK] - before[STATE_CLOCK]) / 2.0, abs=2e-16)


def test_a_geostationary_beidou_satellite_stands_still(row, noon):
    """A GEO's elements refer to a frame tilted by -5 degrees: an orbit inclined by 5 there, its node opposite, is equatorial."""
    node = (np.pi + 7.292115e-5 * (noon.tow_s - 14.0)) % (2.0 * np.pi)
    r = row("C03", sqrt_a=6493.39, eccentricity=2e-4, i0_rad=np.deg2rad(5.0), omega0_rad=node, omega_rad=1.0, delta_n_radps=0.0,
            omega_dot_radps=0.0, idot_radps=0.0, cuc_rad=0.0, cus_rad=0.0, crc_m=0.0, crs_m=0.0, cic_rad=0.0, cis_rad=0.0)  # fmt: skip
    for offset_s in (0.0, 5000.0, 10000.0):
        state = state_at(r, noon.week, noon.tow_s + offset_s)
        assert np.linalg.norm(state[3:6]) < 2.0
        assert abs(state[2]) < 1.0
        assert np.linalg.norm(state[:3]) == pytest.approx(42.164e6, rel=1e-3)


def test_a_beidou_toe_counts_in_beidou_time(row, noon):
    """The node is counted from the start of the BeiDou week, 14 s after that of GPS: 14 s of earth rotation, here 28 km."""
    common = {"i0_rad": 0.96, "sqrt_a": 5282.6, "eccentricity": 0.001, "m0_rad": 0.3, "omega0_rad": 0.4}
    beidou, galileo = (state_at(row(name, **common), noon.week, noon.tow_s) for name in ("C21", "E21"))
    turn = 14.0 * 7.292115e-5
    turned = [galileo[0] * np.cos(turn) - galileo[1] * np.sin(turn), galileo[0] * np.sin(turn) + galileo[1] * np.cos(turn)]
    # the systems' earth rates differ by 1.467e-12 rad/s over the seconds of week
    assert np.hypot(*(np.array(turned) - beidou[:2])) < 30.0


def test_glonass_integration_runs_backwards_and_does_not_depend_on_its_steps(make_glonass):
    ephemeris = make_glonass("R07")
    start, acceleration = np.array((*ephemeris.position_m, *ephemeris.velocity_mps)), np.array(ephemeris.acceleration_mps2)
    there = start.copy()
    assert propagate_state(there, acceleration, 900.0) == 15
    back, pieces = there.copy(), start.copy()
    propagate_state(back, acceleration, -900.0)
    np.testing.assert_allclose(back[:3], start[:3], atol=1e-4)
    for _ in range(90):
        propagate_state(pieces, acceleration, 10.0)
    np.testing.assert_allclose(pieces[:3], there[:3], atol=1e-4)
    assert propagate_state(there, acceleration, 0.0) == 0


@settings(max_examples=60, deadline=None)
@given(st.floats(-20.0, 20.0), st.floats(0.0, 0.5))
def test_keplers_equation_is_solved(mean_rad: float, eccentricity: float):
    e_k = eccentric_anomaly(mean_rad, eccentricity)
    assert e_k - eccentricity * sin(e_k) == pytest.approx(mean_rad, abs=1e-12)


def test_transmission_is_when_the_satellites_own_clock_reads_tag_minus_flight(sky, noon, place_ecef_m):
    codes = sky.pseudoranges(noon, place_ecef_m, dict.fromkeys("GRECJ", 1234.0))
    rows, states = sky.table.select(sky.satellites, noon), np.empty((len(codes), STATE))
    assert satellite_states(rows, noon.week, noon.tow_s, codes, states) == np.isfinite(codes).sum()
    for i in np.flatnonzero(np.isfinite(codes)):
        reading = noon.tow_s - codes[i] / SPEED_OF_LIGHT_MPS
        sent = reading - satellite_clock_s(rows[i], noon.week, reading)
        again = state_at(rows[i], noon.week, sent)
        np.testing.assert_allclose(states[i, :STATE_OK], again[:STATE_OK], rtol=1e-15)
        polynomial = satellite_clock_s(rows[i], noon.week, sent + satellite_clock_s(rows[i], noon.week, reading))
        assert sent + polynomial == pytest.approx(reading, abs=1e-9)


def test_a_week_later_is_the_same(make_sky, noon):
    codes = np.full(len(make_sky(noon).satellites), 2.2e7)
    early, late = np.empty((len(codes), STATE)), np.empty((len(codes), STATE))
    for week, out in ((0, early), (1, late)):
        at = noon + week * 604800.0
        sky = make_sky(at)
        satellite_states(sky.table.select(sky.satellites, at), at.week, at.tow_s, codes, out)
    np.testing.assert_array_equal(early, late)


@pytest.mark.parametrize("code_m", [np.nan, 0.0, -2.3e7, 1e9, np.inf])
def test_without_a_plausible_code_there_is_no_state(sky, noon, code_m):
    codes = np.full(len(sky.satellites), 2.3e7)
    codes[3] = code_m
    states = np.empty((len(codes), STATE))
    assert satellite_states(sky.table.select(sky.satellites, noon), noon.week, noon.tow_s, codes, states) == len(codes) - 1
    assert states[3, STATE_OK] == 0.0
    assert np.isnan(states[3, :STATE_OK]).all()


def test_variance_is_the_square_of_the_broadcast_accuracy(row, noon):
    assert state_at(row("G05", accuracy_m=2.8), noon.week, noon.tow_s)[STATE_VARIANCE] == pytest.approx(7.84)
    assert state_at(row("E05", accuracy_m=float("nan")), noon.week, noon.tow_s)[STATE_VARIANCE] == pytest.approx(500.0**2)
    assert state_at(row("R05", accuracy_m=1.0), noon.week, noon.tow_s)[STATE_VARIANCE] == pytest.approx(25.0)


@pytest.mark.parametrize(
    ("name", "message", "first", "second"),
    [
        ("G05", NavigationMessage.LNAV, "1C", "2W"),
        ("E05", NavigationMessage.INAV, "1C", "7Q"),
        ("E05", NavigationMessage.FNAV, "1C", "5Q"),
        ("J02", NavigationMessage.LNAV, "1C", "2L"),
    ],
)
def test_group_delays_cancel_in_the_combination_that_the_clock_refers_to(row, name, message, first, second):
    hz = {"1": 1575.42, "2": 1227.60, "5": 1176.45, "7": 1207.14}
    r = row(name, message=message, group_delay_s=(3e-9, -5e-9))
    gamma = (hz[first[0]] / hz[second[0]]) ** 2
    a, b = (group_delay_m(r, signal_number(code)) for code in (first, second))
    assert a == pytest.approx(SPEED_OF_LIGHT_MPS * (-5e-9 if message is NavigationMessage.INAV else 3e-9))
    assert (gamma * a - b) / (gamma - 1.0) == pytest.approx(0.0, abs=1e-9)


def test_beidou_and_glonass_delays_are_those_of_their_interface_documents(row):
    beidou, glonass = row("C21", group_delay_s=(3e-9, -5e-9)), row("R05", group_delay_s=2e-9)
    delays = [group_delay_m(beidou, signal_number(code)) for code in ("2I", "7I", "6I")]
    np.testing.assert_allclose(delays, [SPEED_OF_LIGHT_MPS * 3e-9, SPEED_OF_LIGHT_MPS * -5e-9, 0.0])
    assert group_delay_m(glonass, signal_number("1C")) == 0.0
    assert group_delay_m(glonass, signal_number("2C")) == pytest.approx(SPEED_OF_LIGHT_MPS * 2e-9)


def test_without_an_ephemeris_the_group_delay_is_not_known(noon):
    nothing = EphemerisTable().select(np.array([satellite_number("G05")], np.int16), noon)
    assert np.isnan(group_delay_m(nothing[0], signal_number("1C")))
