"""Faults touch what they name and nothing else, and receivers of a class track what the class tracks."""

import numpy as np
import pytest

from rtkmesh.gnss.epoch import COLUMNS, make_epoch
from rtkmesh.gnss.signals import GLONASS, GPS, SATELLITES_PER_SYSTEM, satellite_number, signal_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.models.orbit import STATE, satellite_state
from rtkmesh.simulation.classes import F9P, M8, SURVEY
from rtkmesh.simulation.faults import Disturbance, disturbed, with_orbit_error
from rtkmesh.simulation.receiver import Receiver
from rtkmesh.simulation.sky import SATELLITES, absolute_s, broadcast
from rtkmesh.simulation.trajectories import AntennaPath, Site, static

START = GpsTime(2445, 3600.0)
G05, L1, L2 = satellite_number("G05"), signal_number("1C"), signal_number("2L")


def epoch(after_s: float):
    satellites = [satellite_number(name) for name in ("G05", "G05", "G07", "E01")]
    return make_epoch(
        START + after_s, satellite=satellites, signal=[L1, L2, L1, L1], pseudorange_m=np.arange(4.0) + 2e7, phase_cyc=np.arange(4.0) + 1e8,
        lock_s=np.full(4, 30.0),
    )  # fmt: skip


def changes(column: str, after_s: float, *disturbances: Disturbance) -> list[float]:
    return (getattr(disturbed(epoch(after_s), disturbances), column) - getattr(epoch(after_s), column)).tolist()


def test_a_step_holds_from_its_start_to_its_end():
    """On one signal or on all of the satellite; before and after it, and elsewhere, nothing."""
    begin = absolute_s(START) + 10.0
    one, all_ = (Disturbance(G05, signal, begin, begin + 5.0, code_m=30.0, phase_cyc=2.0) for signal in (L2, None))
    assert changes("pseudorange_m", 9.0, all_) == [0.0, 0.0, 0.0, 0.0]
    assert changes("pseudorange_m", 10.0, all_) == [30.0, 30.0, 0.0, 0.0]
    assert changes("phase_cyc", 14.0, one) == [0.0, 2.0, 0.0, 0.0]
    assert changes("phase_cyc", 15.0, one) == [0.0, 0.0, 0.0, 0.0]


def test_ramps_grow_and_disturbances_add_up():
    """Two on the same satellite are the sum."""
    begin = absolute_s(START)
    ramp, step = Disturbance(G05, None, begin, code_rate_mps=0.5), Disturbance(G05, L1, begin, code_m=-1.0)
    assert changes("pseudorange_m", 8.0, ramp, step) == [3.0, 4.0, 0.0, 0.0]


def test_nobody_tells():
    """Flags and lock times and all else stay as they are, and the given epoch is not touched."""
    given = epoch(1.0)
    found = disturbed(given, [Disturbance(G05, None, absolute_s(START), code_m=9.0, phase_cyc=1.0)])
    for name, _, _ in COLUMNS:
        if name not in ("pseudorange_m", "phase_cyc"):
            assert np.array_equal(getattr(found, name), getattr(given, name), equal_nan=True), name
    assert given.pseudorange_m[0] == 2e7


def positions(seed: int, time: GpsTime) -> np.ndarray:
    table = EphemerisTable()
    for satellite in SATELLITES.tolist():
        assert table.add(broadcast(satellite, time) if seed < 0 else with_orbit_error(broadcast(satellite, time), seed))
    out = np.empty((len(SATELLITES), STATE))
    for row, state in zip(table.select(SATELLITES, time), out, strict=True):
        satellite_state(row, time.week, time.tow_s, state)
    return out[:, :3]


def test_orbits_are_off_by_a_metre_or_two_that_last():
    """The size of the error over all satellites, as good as the same before and after all issues change, others for another seed."""
    change = GpsTime(2445, 7200.0)
    errors = [positions(1, time) - positions(-1, time) for time in (change + -1.0, change + 1.0)]
    size = np.linalg.norm(errors[0], axis=1)
    assert 0.8 < np.median(size) < 3.0
    assert size.max() < 8.0
    assert np.abs(errors[1] - errors[0]).max() < 0.2
    assert np.abs(positions(2, START) - positions(1, START)).max() > 1.0


@pytest.mark.parametrize(
    ("options", "systems", "bands"), [(M8, {GPS, GLONASS}, {1}), (F9P, {0, 1, 2, 3}, {1, 2, 7}), (SURVEY, {0, 1, 2, 3}, {1, 2, 7})]
)
def test_a_class_tracks_its_systems_and_bands(options, systems, bands):
    """What comes out of a receiver of the class."""
    path = AntennaPath(Site(0.9, 0.2, 50.0), static, (0.0, 0.0, 0.0))
    found = Receiver("a", path, 1, options).observe(START).epoch
    assert {s // SATELLITES_PER_SYSTEM for s in found.satellite.tolist()} == systems
    assert {s // 26 for s in found.signal.tolist()} == bands
