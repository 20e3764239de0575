"""Solid tides against the test cases that the IERS prints with its own program."""

from datetime import UTC, datetime
from math import degrees

import numpy as np
import pytest

from rtkmesh.gnss.frames import ecef_from_geodetic
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.tides import earth_rotation_rad, solid_tides, sun_and_moon, tide_of

# Place, sun, moon and displacement (m), as printed in the prologue of DEHANTTIDEINEL.F (IERS Conventions 2010, chapter 7, software;
# its fourth case repeats the result of the third by mistake and is left out).
CASES = {
    (2009, 4, 13): (
        (4075578.385, 931852.890, 4801570.154),
        (137859926952.015, 54228127881.4350, 23509422341.6960),
        (-179996231.920342, -312468450.131567, -169288918.592160),
        (0.07700420357108126, 0.06304056321824968, 0.05516568152597247),
    ),
    (2012, 7, 13): (
        (1112189.660, -4842955.026, 3985352.284),
        (-54537460436.2357, 130244288385.279, 56463429031.5996),
        (300396716.912, 243238281.451, 120548075.939),
        (-0.02036831479592076, 0.05658254776225972, -0.07597679676871742),
    ),
    (2015, 7, 15): (
        (1112200.5696, -4842957.8511, 3985345.9122),
        (100210282451.6279, 103055630398.3160, 56855096480.4475),
        (369817604.4348, 1897917.5258, 120804980.8284),
        (0.00509570869172364, 0.08286630259835287, -0.06366349254041896),
    ),
}


@pytest.mark.parametrize("date", CASES)
def test_displacements(date: tuple[int, int, int]):
    """The diurnal band that is left out moves places up and down (K1: 13 mm at 45 degrees); along the ground 1 mm remains."""
    place, sun, moon, printed = (np.array(column) for column in CASES[date])
    difference = tide_of(place, sun, moon) - printed
    up = place / np.linalg.norm(place)
    assert abs(difference @ up) < 0.013
    assert np.linalg.norm(difference - (difference @ up) * up) < 0.001


@pytest.mark.parametrize("date", [(2009, 4, 13), (2012, 7, 13)])
def test_sun_and_moon(date: tuple[int, int, int]):
    """Directions to a tenth of a degree and distances to 0.2 % (those of the third case are not of its date)."""
    time = GpsTime.from_utc(datetime(*date, tzinfo=UTC))
    for ours, printed in zip(sun_and_moon(time.week, time.tow_s), CASES[date][1:3], strict=True):
        theirs = np.array(printed)
        cosine = ours @ theirs / np.linalg.norm(ours) / np.linalg.norm(theirs)
        assert degrees(np.arccos(cosine)) < 0.1
        assert np.linalg.norm(ours) / np.linalg.norm(theirs) == pytest.approx(1.0, abs=2e-3)


def test_the_sun_passes_greenwich_when_it_should():
    """At the equinox of 2026 (20 March, 14:46 UTC) the sun stands above the equator at 15 degrees an hour from noon, 7.4 minutes late."""
    time = GpsTime.from_utc(datetime(2026, 3, 20, 14, 46, tzinfo=UTC))
    longitude_deg = -15.0 * (14.0 + 46.0 / 60.0 - 12.0) + 7.4 / 4.0
    sun, _ = sun_and_moon(time.week, time.tow_s)
    assert degrees(np.arcsin(sun[2] / np.linalg.norm(sun))) == pytest.approx(0.0, abs=0.02)
    turned_deg = degrees(np.arctan2(sun[1], sun[0]) - earth_rotation_rad(time.week, time.tow_s))
    assert (turned_deg - longitude_deg + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=0.1)


def test_the_difference_grows_with_the_baseline():
    """No place moves by more than 0.45 m; neighbours move alike, and 100 km are worth some millimetres."""
    rng = np.random.default_rng(1)
    found: dict[float, list[float]] = {0.0: [], 35e3: [], 100e3: []}
    for _ in range(200):
        lat, lon, azimuth = np.arcsin(rng.uniform(-0.9, 0.9)), rng.uniform(-np.pi, np.pi), rng.uniform(0.0, 2.0 * np.pi)
        here, tow_s = ecef_from_geodetic(lat, lon, 0.0), rng.uniform(0.0, 604800.0)
        for distance_m, differences in found.items():
            angle = distance_m / 6.371e6
            there = ecef_from_geodetic(lat + angle * np.cos(azimuth), lon + angle * np.sin(azimuth) / np.cos(lat), 0.0)
            first, second = solid_tides(2445, tow_s, here, there)
            assert np.linalg.norm(first) < 0.45
            differences.append(float(np.linalg.norm(first - second)))
    assert max(found[0.0]) == 0.0
    assert 0.001 < np.percentile(found[35e3], 95) < 0.003
    assert 0.004 < np.percentile(found[100e3], 95) < 0.008
