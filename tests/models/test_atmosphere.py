"""Delays of troposphere and ionosphere at published points and at their limits."""

from math import pi, radians, sin

import numpy as np
import pytest

from rtkmesh.gnss.ephemeris import KlobucharParameters
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.atmosphere import (
    DEFAULT_KLOBUCHAR,
    TROPOSPHERE,
    day_of_year,
    hydrostatic_mapping,
    ionosphere_l1_m,
    klobuchar_vector,
    troposphere_at,
    troposphere_m,
    wet_mapping,
    zenith_hydrostatic_m,
    zenith_wet_m,
)


def troposphere(lat_deg: float, height_m: float, week: int = 2150, tow_s: float = 396000.0) -> np.ndarray:
    out = np.empty(TROPOSPHERE)
    troposphere_at(radians(lat_deg), height_m, week, tow_s, out)
    return out


@pytest.mark.parametrize(
    ("year", "month", "day"), [(1980, 1, 6), (1980, 12, 31), (1981, 1, 1), (2023, 12, 31), (2024, 2, 29), (2024, 12, 31), (2025, 1, 1)]
)
def test_day_of_year_is_the_calendars(year, month, day):
    at = GpsTime.from_calendar(year, month, day, 18)
    assert day_of_year(at.week, at.tow_s) == at.to_calendar().timetuple().tm_yday + 0.75


def test_zenith_delays_of_the_standard_atmosphere():
    """2.307 m hydrostatic at sea level and 45 degrees is 0.0022768 m/hPa times 1013.25 hPa; half the pressure at 5.5 km halves it."""
    assert zenith_hydrostatic_m(pi / 4.0, 0.0) == pytest.approx(0.0022768 * 1013.25, rel=1e-6)
    assert zenith_hydrostatic_m(pi / 4.0, 5500.0) == pytest.approx(0.0022768 * 505.0, rel=3e-3)
    assert 0.08 < zenith_wet_m(0.0) < 0.14
    assert zenith_wet_m(5000.0) < 0.25 * zenith_wet_m(0.0)


@pytest.mark.parametrize("height_m", [-1e6, -500.0, 0.0, 9000.0, 10999.0, 11001.0, 39e3, 41e3, 1e6, 2e7])
def test_delays_are_finite_and_plausible_at_every_height(height_m):
    assert 0.0 <= zenith_hydrostatic_m(0.5, height_m) < 2.7
    assert 0.0 <= zenith_wet_m(height_m) < 0.3
    assert 0.0 <= troposphere_m(troposphere(30.0, height_m), radians(1.0)) < 75.0


def test_mapping_functions_are_one_at_the_zenith_and_grow_to_the_horizon():
    t = troposphere(40.0, 200.0)
    for mapping in (hydrostatic_mapping, wet_mapping):
        values = [mapping(t, radians(el)) for el in (90.0, 60.0, 30.0, 15.0, 10.0, 5.0, 3.0)]
        assert values[0] == pytest.approx(1.0, abs=1e-12)
        assert values == sorted(values)
        assert mapping(t, radians(-30.0)) == mapping(t, radians(2.0))
    assert hydrostatic_mapping(t, radians(30.0)) == pytest.approx(1.0 / sin(radians(30.0)), rel=5e-3)
    assert hydrostatic_mapping(t, radians(5.0)) == pytest.approx(10.15, abs=0.05)  # Niell 1996, figure 1: 10.15 at mid latitudes


def test_mapping_is_continuous_over_latitude_and_mirrored_by_half_a_year():
    for lat in (15.0, 30.0, 45.0, 60.0, 75.0):
        a, b = (hydrostatic_mapping(troposphere(lat + d, 0.0), radians(7.0)) for d in (-1e-6, 1e-6))
        assert a == pytest.approx(b, abs=1e-6)
    half_year_weeks = 26
    north = hydrostatic_mapping(troposphere(50.0, 0.0, 2150), radians(7.0))
    south = hydrostatic_mapping(troposphere(-50.0, 0.0, 2150 + half_year_weeks), radians(7.0))
    assert north == pytest.approx(south, abs=2e-4)
    np.testing.assert_array_equal(troposphere(5.0, 0.0)[2:], troposphere(14.999999999, 0.0)[2:])  # below 15 degrees the table is constant


EXAMPLE = KlobucharParameters("G", (3.82e-8, 1.49e-8, -1.79e-7, 0.0), (1.43e5, 0.0, -3.28e5, 1.13e5))


def test_klobuchar_at_a_widely_used_example():
    """40 N, 260 E, azimuth 210, elevation 20 degrees, 20:45 UT: 23.784 m (the example that MATLAB codes of the model are tested with)."""
    delay = ionosphere_l1_m(klobuchar_vector(EXAMPLE), radians(40.0), radians(-100.0), radians(210.0), radians(20.0), 74700.0)
    assert delay == pytest.approx(23.784, abs=2e-3)


def test_klobuchar_at_night_is_five_nanoseconds_times_the_slant():
    slant = 1.0 + 16.0 * (0.53 - 0.5) ** 3
    delay = ionosphere_l1_m(klobuchar_vector(EXAMPLE), 0.7, 0.0, 0.0, pi / 2.0, 7200.0)
    assert delay == pytest.approx(299792458.0 * 5e-9 * slant, rel=1e-9)


@pytest.mark.parametrize("elevation_rad", [-1.0, 0.0, 0.1, pi / 2.0])
@pytest.mark.parametrize("lat_rad", [-pi / 2.0, 0.0, pi / 2.0])
def test_default_parameters_give_a_few_metres_everywhere(lat_rad, elevation_rad):
    for tow_s in range(0, 86400, 7200):
        delay = ionosphere_l1_m(klobuchar_vector(None), lat_rad, 1.0, 2.0, elevation_rad, 3 * 86400.0 + tow_s)
        assert 1.4 < delay < 20.0


def test_a_polynomial_below_its_floor_is_clamped():
    """A negative amplitude counts as 0 and a period under 20 hours as 20 hours (IS-GPS-200N 20.3.3.5.2.5)."""
    negative = KlobucharParameters("G", (-1e-7, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    afternoon = ionosphere_l1_m(klobuchar_vector(negative), 0.7, 0.0, 0.0, pi / 2.0, 50400.0)
    night = ionosphere_l1_m(klobuchar_vector(negative), 0.7, 0.0, 0.0, pi / 2.0, 3600.0)
    assert afternoon == night
    assert len(DEFAULT_KLOBUCHAR) == 8
