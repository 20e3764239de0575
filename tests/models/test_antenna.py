"""Antennas: the correction against closed forms, and which calibration stands for which carrier."""

from math import cos, radians, sin

import numpy as np
import pytest

from rtkmesh.gnss.antenna import AntennaCalibration, BandCalibration
from rtkmesh.gnss.signals import SYSTEMS
from rtkmesh.models.antenna import Antenna, antenna_correction_m, antenna_of, carrier_place, find_antenna, null_antenna

OFFSET_ENU_M = (0.003, -0.002, 0.09)
FLAT = np.zeros((1, 19))


def calibration(variation_m: np.ndarray = FLAT, *codes: str, azimuth_step_deg: float = 0.0, radome: str = "NONE") -> AntennaCalibration:
    """Return a calibration whose bands differ by a millimetre in height."""
    east, north, up = OFFSET_ENU_M
    bands = tuple(BandCalibration(code, (east, north, up + 1e-3 * k), variation_m) for k, code in enumerate(codes or ("G01",)))
    return AntennaCalibration("TEST", radome, "", 5.0, azimuth_step_deg, bands)


def place_of(antenna: Antenna, code: str) -> int:
    return carrier_place(antenna.pattern, SYSTEMS.index(code[0]), int(code[2]))


def correction_m(antenna: Antenna, azimuth_deg: float, elevation_deg: float, code: str = "G01") -> float:
    return antenna_correction_m(antenna.pattern, place_of(antenna, code), radians(azimuth_deg), radians(elevation_deg))


def by_azimuth() -> np.ndarray:
    """Return variations (m) by azimuths of 30 degrees that are those of no symmetry."""
    grid = np.random.default_rng(1).normal(0.0, 2e-3, (12, 19))
    grid[:, 0] = 0.0
    return np.vstack([grid, grid[:1]])


def test_offset_alone() -> None:
    """Zenith: minus the offset up; horizon: minus the offset towards the satellite."""
    antenna = antenna_of(calibration())
    east, north, up = OFFSET_ENU_M
    assert correction_m(antenna, 123.0, 90.0) == pytest.approx(-up, abs=1e-12)
    for azimuth_deg, toward in ((0.0, north), (90.0, east), (180.0, -north), (270.0, -east)):
        assert correction_m(antenna, azimuth_deg, 0.0) == pytest.approx(-toward, abs=1e-12)
    expected = -(up * sin(0.5) + cos(0.5) * (east * sin(4.0) + north * cos(4.0)))
    assert antenna_correction_m(antenna.pattern, place_of(antenna, "G01"), 4.0, 0.5) == pytest.approx(expected, abs=1e-12)


def test_variation_is_added_and_linear_between_its_points() -> None:
    """At grid points the value, half way the mean of the neighbours, below the last zenith angle the last value."""
    variation_m = np.linspace(0.0, 9e-3, 17)[None] ** 2  # to 80 degrees
    antenna, bare = antenna_of(calibration(variation_m)), antenna_of(calibration())
    added = [
        correction_m(antenna, 40.0, 90.0 - zenith) - correction_m(bare, 40.0, 90.0 - zenith) for zenith in (0.0, 35.0, 37.5, 80.0, 89.0)
    ]
    expected = [0.0, variation_m[0, 7], (variation_m[0, 7] + variation_m[0, 8]) / 2.0, variation_m[0, 16], variation_m[0, 16]]
    assert added == pytest.approx(expected, abs=1e-12)


def test_variation_by_azimuth_is_bilinear_and_closes_at_north() -> None:
    """Grid points, the middle of a cell, and both sides of north."""
    grid = by_azimuth()
    antenna, bare = antenna_of(calibration(grid, azimuth_step_deg=30.0)), antenna_of(calibration())

    def added(azimuth_deg: float, zenith_deg: float) -> float:
        return correction_m(antenna, azimuth_deg, 90.0 - zenith_deg) - correction_m(bare, azimuth_deg, 90.0 - zenith_deg)

    assert added(60.0, 50.0) == pytest.approx(grid[2, 10], abs=1e-12)
    assert added(75.0, 52.5) == pytest.approx(grid[2:4, 10:12].mean(), abs=1e-12)
    assert added(345.0, 50.0) == pytest.approx((grid[11, 10] + grid[0, 10]) / 2.0, abs=1e-12)
    assert added(360.0, 50.0) == pytest.approx(added(0.0, 50.0), abs=1e-12)
    assert added(-15.0, 50.0) == pytest.approx(added(345.0, 50.0), abs=1e-12)


def test_azimuth_matters_only_where_the_calibration_says_so() -> None:
    """Rows that are all alike give what a calibration without azimuths gives, for every azimuth."""
    row = np.linspace(0.0, 5e-3, 19)[None]
    alike, without = antenna_of(calibration(np.repeat(row, 13, 0), azimuth_step_deg=30.0)), antenna_of(calibration(row))
    for azimuth_deg in np.arange(0.0, 360.0, 7.0):
        assert correction_m(alike, azimuth_deg, 33.0) == pytest.approx(correction_m(without, azimuth_deg, 33.0), abs=1e-12)


def test_a_null_antenna_and_an_unknown_carrier_change_nothing() -> None:
    """Both have a correction of zero in every direction."""
    null, antenna = null_antenna("ADVNULLANTENNA"), antenna_of(calibration())
    for elevation_deg in (-5.0, 0.0, 40.0, 90.0):
        assert [correction_m(null, 50.0, elevation_deg, code) for code in ("G01", "R02", "E05")] == [0.0] * 3
        assert correction_m(antenna, 50.0, elevation_deg, "I09") == 0.0


def rows_of(antenna: Antenna, *codes: str) -> list[int]:
    """Return which of the calibration's bands, told apart by their heights, stands for each carrier; -1 for none."""
    heights_mm = [-1e3 * correction_m(antenna, 0.0, 90.0, code) for code in codes]
    return [round(height_mm - 1e3 * OFFSET_ENU_M[2]) if height_mm else -1 for height_mm in heights_mm]


def test_carriers_without_calibration_take_the_nearest() -> None:
    """GPS and GLONASS calibrated: the upper band of others is L1, the lower one L2, and the antenna says so."""
    antenna = antenna_of(calibration(FLAT, "G01", "G02", "R01", "R02"))
    assert rows_of(antenna, "G01", "G02", "R01", "R02") == [0, 1, 2, 3]
    assert rows_of(antenna, "E01", "C01", "C02", "J01", "S01") == [0] * 5
    assert rows_of(antenna, "G05", "E05", "E07", "E08", "E06", "C05", "C07", "C06", "J02", "J05", "I05") == [1] * 11
    assert rows_of(antenna, "R04", "R03", "R06") == [2, 3, 3]
    assert rows_of(antenna, "I09", "G03") == [-1, -1]
    assert antenna.substitutes["E01"] == "G01"
    assert antenna.substitutes["C06"] == "G02"
    assert "R01" not in antenna.substitutes
    assert "other carriers as G01 G02 R01 R02" in str(antenna)


def test_the_same_frequency_of_another_system_is_nearer_than_l1_and_l2() -> None:
    """E5a stands for L5, B2b takes E5b; but B3 is not E6 and GLONASS L2 CDMA is none of them."""
    antenna = antenna_of(calibration(FLAT, "G01", "G02", "E05", "E06", "E07"))
    assert rows_of(antenna, "G05", "J05", "C05", "I05") == [2] * 4
    assert rows_of(antenna, "J06", "C07", "C06", "R06", "R02", "E08") == [3, 4, 1, 1, 1, 1]


def test_a_single_frequency_antenna_serves_all_carriers() -> None:
    """With L1 alone everything is taken as L1: carriers of one receiver must not be centimetres apart."""
    antenna = antenna_of(calibration())
    assert rows_of(antenna, "G02", "R01", "R02", "E05", "C02") == [0] * 5


class Table:
    """One calibration under its name."""

    def __init__(self, radome: str) -> None:
        self._radome = radome

    def find(self, antenna: str, radome: str, serial: str = "") -> AntennaCalibration | None:
        return calibration(radome=radome) if (antenna, radome, serial) == ("TEST", self._radome, "") else None


def test_the_right_radome_of_any_table_goes_before_none() -> None:
    """Radome first in every table, then NONE, which the antenna says; unknown types are told; network null antennas are known."""
    exact = find_antenna([Table("NONE"), Table("SNOW")], "TEST            SNOW")
    assert isinstance(exact, Antenna)
    assert (str(exact), exact.radome) == ("TEST SNOW (other carriers as G01)", "")
    fallen = find_antenna([Table("NONE")], "TEST            SNOW")
    assert isinstance(fallen, Antenna)
    assert str(fallen) == "TEST NONE (radome SNOW not calibrated; other carriers as G01)"
    assert find_antenna([Table("SNOW")], "TEST") == "no calibration of TEST NONE"
    assert str(find_antenna([], "GPPNULLANTENNA")) == "GPPNULLANTENNA"
