"""The engine backward through simulated epochs: as right as forward, from the other end."""

from dataclasses import dataclass, replace
from math import radians

import numpy as np
import pytest

from rtkmesh.gnss.epoch import SLIP
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.backward import Backward, Course
from rtkmesh.rtk.combination import How, combine_runs
from rtkmesh.rtk.options import Direction, Mode, RtkOptions
from rtkmesh.rtk.session import EndOfStream, Session, SessionOptions, Source, pairing_for
from rtkmesh.rtk.solution import Status
from rtkmesh.rtk.track import track_of
from rtkmesh.simulation.classes import F9P, SURVEY
from rtkmesh.simulation.receiver import Receiver
from rtkmesh.simulation.sky import KLOBUCHAR, SATELLITES, broadcast
from rtkmesh.simulation.trajectories import AntennaPath, Site, driving

pytestmark = pytest.mark.slow  # without compilation; with it, seconds
START = GpsTime(2445, 100000.0)
SITE = Site(radians(47.0), radians(8.0), 400.0)
EPOCHS = 14
RIGHT_M = 0.03


@dataclass
class Recording:
    rover: list
    base: list
    truth: np.ndarray
    base_ecef_m: np.ndarray
    moves: bool


def recorded(path):
    rover = Receiver("rover", AntennaPath(SITE, path, (0.0, 0.0, -1.5)), 5, F9P)
    base = Receiver("base", AntennaPath(SITE, None, (-320.0, 210.0, 4.0)), 5, replace(SURVEY, steered=True))
    seen = [(rover.observe(START + float(k)), base.observe(START + float(k))) for k in range(EPOCHS)]
    truth = np.array([r.position_ecef_m for r, _ in seen])
    return Recording([r.epoch for r, _ in seen], [b.epoch for _, b in seen], truth, seen[0][1].position_ecef_m, path is not None)


@pytest.fixture(scope="module")
def drive():
    return recorded(driving)


@pytest.fixture(scope="module")
def stand():
    return recorded(None)


def both(recording, mode=Mode.KINEMATIC, *, rover=None, base=None, ephemerides_before=0):
    """Return the solutions of a forward and of a backward run, both in rising order of time."""
    place = tuple(recording.base_ecef_m)
    options = RtkOptions(mode=mode, frequencies=2, fixed_position_ecef_m=tuple(recording.truth[0]) if mode is Mode.FIXED else None)
    session = Session(SessionOptions(options, pairing_for(options, replay=True), None if mode is Mode.MOVING_BASE else place))
    course, forward, taken = Course(session), [], []
    for k, epoch in enumerate(rover or recording.rover):
        if k == ephemerides_before:
            for message in [broadcast(satellite, START) for satellite in SATELLITES.tolist()] + [KLOBUCHAR]:
                session.feed(Source.ROVER, message)
        session.feed(Source.ROVER, epoch)
    for epoch in base or recording.base:
        session.feed(Source.BASE, epoch)
    for source in (Source.ROVER, Source.BASE):
        session.feed(source, EndOfStream())
    while (pair := session.next_pair(0.0)) is not None:
        taken.append(course.take(pair))
        forward.append(session.solve(pair))
    return forward, list(Backward(options, course).solutions(reversed(taken)))[::-1]


def errors_m(solutions, recording):
    return np.linalg.norm(np.array([s.position_ecef_m for s in solutions]) - recording.truth, axis=1)


def test_backward_is_as_right_as_forward(drive):
    """Fixed from the epoch at which it begins, which is the last one, with velocities of the right sign."""
    forward, backward = both(drive)
    assert [s.time for s in backward] == [s.time for s in forward] == [e.time for e in drive.rover]
    assert all(s.status is Status.FIX for s in backward)
    assert errors_m(backward, drive).max() < RIGHT_M
    velocity = 0.5 * (drive.truth[2:] - drive.truth[:-2])
    assert np.linalg.norm(velocity, axis=1).min() > 1.0
    for run in (forward, backward):
        assert np.abs(np.array([s.velocity_ecef_mps for s in run])[1:-1] - velocity).max() < 0.35


@pytest.mark.parametrize("mode", [Mode.STATIC, Mode.STATIC_START, Mode.KINEMATIC, Mode.MOVING_BASE, Mode.DGPS, Mode.FIXED])
def test_every_relative_mode_goes_backward(stand, mode):
    """The same kind of solution in every epoch, within metres by codes and centimetres by integers."""
    forward, backward = both(stand, mode)
    assert [s.status for s in backward] == [s.status for s in forward]
    assert all(s.status is (Status.DGPS if mode is Mode.DGPS else Status.FIX) for s in backward)
    apart = np.array([a.baseline_ecef_m - b.baseline_ecef_m for a, b in zip(forward, backward, strict=True)])
    assert np.linalg.norm(apart, axis=1).max() < (2.0 if mode is Mode.DGPS else RIGHT_M)
    result = combine_runs(track_of(forward).table, track_of(backward).table)
    assert set(result.how.tolist()) == {How.SMOOTHED if mode is Mode.DGPS else How.AGREED}


def test_old_base_epochs_pair_as_they_did(drive):
    """A base epoch every three seconds: the backward run uses the same older ones, with the same ages."""
    forward, backward = both(drive, base=drive.base[::3])
    assert [s.age_s for s in backward] == [s.age_s for s in forward]
    assert {round(s.age_s) for s in backward} == {0, 1, 2}
    assert all(s.status is Status.FIX for s in backward)
    assert errors_m(backward, drive).max() < RIGHT_M


def test_a_flagged_slip_is_heard_from_both_sides(drive):
    """All satellites but seven (so many must test each other) slip where they are flagged: no run is misled, both stay fixed."""

    def slipped(k, epoch):
        many = np.isin(epoch.satellite, np.unique(epoch.satellite)[7:])
        jump = np.where(many, 2.0 + epoch.satellite % 7, 0.0) if k >= 7 else 0.0
        flags = epoch.flags | np.where(many & (k == 7), SLIP, 0).astype(np.uint8)
        return replace(epoch, phase_cyc=epoch.phase_cyc + jump, flags=flags)

    for run in both(drive, rover=[slipped(k, e) for k, e in enumerate(drive.rover)]):
        assert errors_m([s for s in run if s.status is Status.FIX] or run, recorded_at(drive, run)).max() < RIGHT_M
        assert sum(s.status is Status.FIX for s in run) >= EPOCHS - 2


def recorded_at(recording, run):
    """Return the recording with the truth of those epochs that are fixed."""
    return replace(recording, truth=recording.truth[[s.status is Status.FIX for s in run]])


def test_what_came_late_is_known_backward(drive):
    """Ephemerides that came after five epochs: nothing forward until then, everything backward."""
    forward, backward = both(drive, ephemerides_before=5)
    assert [s.status is Status.NONE for s in forward] == [True] * 5 + [False] * (EPOCHS - 5)
    assert all(s.status is Status.FIX for s in backward)
    result = combine_runs(track_of(forward).table, track_of(backward).table)
    assert set(result.table["status"].tolist()) == {Status.FIX}


def test_turned_round_twice_the_engine_gives_the_same(drive):
    """Backward of backward: forward over the recording in its normal form gives the solutions of the recording itself."""
    from rtkmesh.models.ephemeris_table import EphemerisTable
    from rtkmesh.rtk.engine import Rtk
    from rtkmesh.rtk.reversal import Reversal

    table = EphemerisTable()
    for satellite in SATELLITES.tolist():
        table.add(broadcast(satellite, START))

    def twice(epochs):
        for _ in range(2):
            reversal = Reversal()
            epochs = [reversal.turn(epoch) for epoch in reversed(epochs)]
        return epochs

    def solve(rover, base):
        engine = Rtk(RtkOptions(frequencies=2), Direction.FORWARD)
        pairs = zip(rover, base, strict=True)
        return [engine.step(r, b, table, KLOBUCHAR, base_position_ecef_m=drive.base_ecef_m).position_ecef_m for r, b in pairs]

    assert np.array_equal(solve(drive.rover, drive.base), solve(twice(drive.rover), twice(drive.base)))
