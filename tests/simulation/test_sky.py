"""The simulated sky."""

import numpy as np
import pytest

from rtkmesh.gnss.ephemeris import GlonassEphemeris
from rtkmesh.gnss.frames import ecef_from_geodetic
from rtkmesh.gnss.signals import BEIDOU, GALILEO, GLONASS, GPS, SATELLITES_PER_SYSTEM
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.ephemeris_table import NO_EPHEMERIS, EphemerisTable
from rtkmesh.models.orbit import STATE, STATE_CLOCK, satellite_state
from rtkmesh.simulation.sky import SATELLITES, Sky, broadcast, glonass_generation

# Soon after the start of a GLONASS generation, so that little has to be integrated; then a day of changes of issue.
START = GpsTime(2445, 529200.0 + 3600.0)


def states(time: GpsTime, seconds: float) -> np.ndarray:
    """States of all satellites at ``time`` + ``seconds`` by the ephemerides that are broadcast at ``time``."""
    rows, out = Sky().rows(time), np.empty((len(SATELLITES), STATE))
    at = time + seconds
    for row, state in zip(rows, out, strict=True):
        satellite_state(row, at.week, at.tow_s, state)
    return out


def test_constellations_are_nominal():
    """31 GPS, 24 Galileo, 27 BeiDou (24 MEO, 3 IGSO) and 24 GLONASS satellites."""
    systems = SATELLITES // SATELLITES_PER_SYSTEM
    assert [int(np.sum(systems == s)) for s in (GPS, GALILEO, BEIDOU, GLONASS)] == [31, 24, 27, 24]


def test_every_broadcast_ephemeris_is_taken_by_the_table():
    """The receiver's own checks find nothing wrong with any satellite."""
    table = EphemerisTable()
    assert all(table.add(broadcast(satellite, START)) for satellite in SATELLITES.tolist())
    assert not np.any(table.select(SATELLITES, START)[:, 0] == NO_EPHEMERIS)


@pytest.mark.parametrize(
    "change_s",
    [GpsTime(2446, 0.0) - START, 18.0 + 1800.0 * round((GpsTime(2446, 3600.0) - START) / 1800.0), GpsTime(2446, 3614.0) - START],
    ids=["week rollover", "GLONASS", "BeiDou"],
)
def test_orbits_and_clocks_are_continuous_over_changes_of_issue(change_s: float):
    """The issue before and the issue after a change say the same to 0.1 mm."""
    change = START + change_s
    before, after = states(change + -0.5, 0.5), states(change + 0.5, -0.5)
    assert not np.array_equal(Sky().rows(change + -0.5), Sky().rows(change + 0.5))
    assert np.abs(before[:, :3] - after[:, :3]).max() < 1e-4
    assert np.abs(before[:, 3:6] - after[:, 3:6]).max() < 1e-6
    assert np.abs(before[:, STATE_CLOCK] - after[:, STATE_CLOCK]).max() < 1e-13


def test_velocities_are_the_derivatives_of_positions():
    """What the Doppler is made of agrees with what the ranges are made of."""
    half_s = 0.5
    ahead, behind, now = states(START, half_s), states(START, -half_s), states(START, 0.0)
    assert np.abs((ahead[:, :3] - behind[:, :3]) / (2 * half_s) - now[:, 3:6]).max() < 1e-3


@pytest.mark.parametrize("lat_deg", [-75.0, -35.0, 0.0, 20.0, 52.5, 80.0])
def test_enough_satellites_are_in_view_everywhere(lat_deg: float):
    """At every latitude and time of a day at least six of GPS and 22 in all are above 10 degrees."""
    for hour in range(0, 24, 6):
        for lon_deg in (0.0, 120.0, 240.0):
            place = ecef_from_geodetic(np.deg2rad(lat_deg), np.deg2rad(lon_deg), 0.0)
            up = place / np.linalg.norm(place)
            towards = states(START + 3600.0 * hour, 0.0)[:, :3] - place
            sine = towards @ up / np.linalg.norm(towards, axis=1)
            seen = SATELLITES[sine > np.sin(np.deg2rad(10.0))] // SATELLITES_PER_SYSTEM
            assert np.sum(seen == GPS) >= 6
            assert len(seen) >= 22


def test_glonass_starts_anew_once_a_week_and_says_so():
    """The generation number changes exactly where the orbits are not continuous."""
    change = GpsTime(2445, 529200.0 + 18.0)
    assert glonass_generation(change + 0.5) == glonass_generation(change + -0.5) + 1
    assert glonass_generation(change + -0.5) == glonass_generation(START + -86400.0)


def test_ephemerides_do_not_depend_on_the_moment_within_their_issue():
    """Two processes that ask at different moments of one issue get the same."""
    for satellite in SATELLITES.tolist():
        first, second = broadcast(satellite, START + 100.0), broadcast(satellite, START + 900.0)
        assert first == second


def test_glonass_channels_are_shared_by_antipodal_satellites_only():
    """Satellites on one frequency are half an orbit apart."""
    found = [e for s in SATELLITES.tolist() if isinstance(e := broadcast(s, START), GlonassEphemeris)]
    pairs = [(a, b) for a in found for b in found if a.satellite < b.satellite and a.channel == b.channel]
    assert len(pairs) == 12
    for a, b in pairs:
        cosine = np.dot(a.position_m, b.position_m) / np.linalg.norm(a.position_m) / np.linalg.norm(b.position_m)
        assert cosine < -0.99
