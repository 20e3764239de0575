"""Range, direction and delays as one receiver sees them."""

import numpy as np
import pytest

from rtkmesh.gnss.constants import OMEGA_EARTH_GPS_RADPS, SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.frames import enu_from_ecef_at
from rtkmesh.models.atmosphere import klobuchar_vector
from rtkmesh.models.geometry import (
    AZIMUTH,
    E_X,
    E_Z,
    ELEVATION,
    GEOMETRY,
    IONOSPHERE_L1_M,
    RANGE,
    TROPOSPHERE_M,
    line_of_sight,
    receiver_geometry,
    receiver_model,
)
from rtkmesh.models.orbit import STATE, STATE_OK


def light_time_range_m(sent_ecef_m: np.ndarray, receiver_ecef_m: np.ndarray) -> float:
    """Solve for the flight in an inertial frame that is ECEF at transmission: the receiver turns with the earth."""
    flight_s = 0.07
    for _ in range(20):
        c, s = np.cos(OMEGA_EARTH_GPS_RADPS * flight_s), np.sin(OMEGA_EARTH_GPS_RADPS * flight_s)
        x, y, z = receiver_ecef_m
        flight_s = np.linalg.norm(sent_ecef_m - [c * x - s * y, s * x + c * y, z]) / SPEED_OF_LIGHT_MPS
    return flight_s * SPEED_OF_LIGHT_MPS


@pytest.fixture
def model(sky, noon, place_ecef_m):
    rows, codes = sky.table.select(sky.satellites, noon), np.full(len(sky.satellites), 2.3e7)
    codes[2] = np.nan
    states, geometry = np.empty((len(codes), STATE)), np.empty((len(codes), GEOMETRY))
    valid = receiver_model(rows, noon.week, noon.tow_s, codes, place_ecef_m, klobuchar_vector(None), states, geometry)
    assert valid == len(codes) - 1
    return states, geometry


def test_range_is_that_of_light_in_an_inertial_frame(model, place_ecef_m):
    states, geometry = model
    for i in np.flatnonzero(states[:, STATE_OK]):
        assert geometry[i, RANGE] == pytest.approx(light_time_range_m(states[i, :3], place_ecef_m), abs=2e-7)


def test_direction_azimuth_and_elevation_agree(model, place_ecef_m):
    states, geometry = model
    ok = states[:, STATE_OK] != 0.0
    unit = geometry[ok, E_X : E_Z + 1]
    np.testing.assert_allclose(np.linalg.norm(unit, axis=1), 1.0, atol=1e-14)
    e, n, u = enu_from_ecef_at(place_ecef_m) @ unit.T
    np.testing.assert_allclose(geometry[ok, ELEVATION], np.arcsin(u), atol=1e-12)
    np.testing.assert_allclose(geometry[ok, AZIMUTH], np.arctan2(e, n) % (2.0 * np.pi), atol=1e-12)


def test_the_unit_vector_is_minus_the_derivative_of_the_range_by_the_receiver(model, place_ecef_m):
    states, geometry = model
    forward, back = np.empty(GEOMETRY), np.empty(GEOMETRY)
    for i in np.flatnonzero(states[:, STATE_OK]):
        for k in range(3):
            step = np.zeros(3)
            step[k] = 50.0
            line_of_sight(states[i], place_ecef_m + step, forward)
            line_of_sight(states[i], place_ecef_m - step, back)
            assert (forward[RANGE] - back[RANGE]) / 100.0 == pytest.approx(-geometry[i, E_X + k], abs=3e-6)  # the frame turns by 1.5e-6


def test_a_satellite_without_state_is_nan_and_the_others_have_delays(model):
    states, geometry = model
    assert np.isnan(geometry[2]).all()
    high = (states[:, STATE_OK] != 0.0) & (geometry[:, ELEVATION] > 0.2)
    assert (geometry[high, TROPOSPHERE_M] > 2.0).all()
    assert (geometry[high, TROPOSPHERE_M] < 14.0).all()
    assert (geometry[high, IONOSPHERE_L1_M] > 1.0).all()


@pytest.mark.parametrize("receiver", [np.zeros(3), np.array([2.0e7, 0.0, 0.0]), np.array([0.0, 0.0, 6.36e6])])
def test_the_geocentre_space_and_the_pole_are_no_trouble(model, noon, receiver):
    states, geometry = model
    receiver_geometry(states, noon.week, noon.tow_s, receiver, klobuchar_vector(None), geometry)
    ok = states[:, STATE_OK] != 0.0
    assert np.isfinite(geometry[ok]).all()
    if np.linalg.norm(receiver) < 6.3e6 or np.linalg.norm(receiver) > 6.5e6:
        assert (geometry[ok, TROPOSPHERE_M] == 0.0).all()
