"""Earth frames: known points, poles, round trips, orthogonality."""

from math import atan2, cos, hypot, pi, radians, sin, sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh.gnss.constants import WGS84_A_M, WGS84_F
from rtkmesh.gnss.frames import azimuth_elevation, ecef_from_geodetic, enu_from_ecef, enu_from_ecef_at, geodetic_from_ecef

MICROMETRE = 1e-6
latitudes = st.floats(-pi / 2, pi / 2)
longitudes = st.floats(-pi, pi)


def test_known_points() -> None:
    """Equator and poles by definition; a surveyed point against Bowring's closed formula (Survey Review 28, 1985)."""
    assert ecef_from_geodetic(0.0, 0.0, 0.0) == pytest.approx([WGS84_A_M, 0.0, 0.0], abs=MICROMETRE)
    assert ecef_from_geodetic(pi / 2, 0.3, 10.0) == pytest.approx([0.0, 0.0, WGS84_A_M * (1 - WGS84_F) + 10.0], abs=MICROMETRE)
    x, y, z = point = np.array([-3962108.673, 3381309.574, 3668678.638])
    b, e2 = WGS84_A_M * (1 - WGS84_F), WGS84_F * (2 - WGS84_F)
    p = hypot(x, y)
    reduced = atan2(z * WGS84_A_M, p * b)
    bowring = atan2(z + e2 / (1 - e2) * b * sin(reduced) ** 3, p - e2 * WGS84_A_M * cos(reduced) ** 3)
    lat, lon, height = geodetic_from_ecef(point)
    assert (lat, lon) == (pytest.approx(bowring, abs=1e-11), pytest.approx(atan2(y, x), abs=1e-15))
    n = WGS84_A_M / sqrt(1 - e2 * sin(bowring) ** 2)
    assert height == pytest.approx(p / cos(bowring) - n, abs=1e-4)


@given(latitudes, longitudes, st.floats(-1000.0, 3e7))
def test_geodetic_round_trip(lat_rad: float, lon_rad: float, height_m: float) -> None:
    position = ecef_from_geodetic(lat_rad, lon_rad, height_m)
    lat, lon, height = geodetic_from_ecef(position)
    assert ecef_from_geodetic(lat, lon, height) == pytest.approx(position, abs=1e-4)
    assert height == pytest.approx(height_m, abs=1e-4)


@pytest.mark.parametrize("z", [6.4e6, -6.4e6])
def test_the_poles_have_a_latitude_and_a_height(z: float) -> None:
    lat, _, height = geodetic_from_ecef(np.array([0.0, 0.0, z]))
    assert abs(lat) == pytest.approx(pi / 2)
    assert height == pytest.approx(abs(z) - WGS84_A_M * (1 - WGS84_F), abs=1e-4)


@given(latitudes, longitudes)
def test_the_rotation_is_orthogonal_and_up_is_the_normal(lat_rad: float, lon_rad: float) -> None:
    rotation = enu_from_ecef(lat_rad, lon_rad)
    assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    normal = [cos(lat_rad) * cos(lon_rad), cos(lat_rad) * sin(lon_rad), sin(lat_rad)]
    assert rotation @ normal == pytest.approx([0.0, 0.0, 1.0], abs=1e-12)


def test_the_rotation_at_a_place_is_that_of_its_coordinates() -> None:
    place = ecef_from_geodetic(0.6, 2.1, 55.0)
    assert enu_from_ecef_at(place) == pytest.approx(enu_from_ecef(0.6, 2.1), abs=1e-9)


@given(st.floats(0.0, 359.9), st.floats(-89.0, 89.0), st.floats(0.1, 3e7))
def test_azimuth_is_clockwise_from_north(azimuth_deg: float, elevation_deg: float, length_m: float) -> None:
    a, e = radians(azimuth_deg), radians(elevation_deg)
    azimuth, elevation = azimuth_elevation(length_m * np.array([sin(a) * cos(e), cos(a) * cos(e), sin(e)]))
    assert cos(azimuth - a) == pytest.approx(1.0, abs=1e-9)
    assert 0.0 <= azimuth <= 2 * pi
    assert elevation == pytest.approx(e, abs=1e-9)
