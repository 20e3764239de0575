"""Sessions of recordings whose base is slower than the rover: interpolated, forward and backward."""

from dataclasses import dataclass, replace
from math import radians

import numpy as np
import pytest

from rtkmesh.gnss.epoch import SLIP, Epoch
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.backward import Backward, Course
from rtkmesh.rtk.options import Mode, RtkOptions
from rtkmesh.rtk.session import EndOfStream, Session, SessionOptions, Source, pairing_for
from rtkmesh.rtk.solution import Solution, Status
from rtkmesh.simulation.classes import F9P, SURVEY
from rtkmesh.simulation.receiver import Receiver
from rtkmesh.simulation.sky import KLOBUCHAR, SATELLITES, broadcast
from rtkmesh.simulation.trajectories import AntennaPath, Site, driving

pytestmark = pytest.mark.slow  # without compilation; with it, seconds
START = GpsTime(2445, 100000.0)
SITE = Site(radians(47.0), radians(8.0), 400.0)
EPOCHS, EVERY = 21, 5


@dataclass
class Recording:
    rover: list[Epoch]
    base: list[Epoch]
    truth: np.ndarray
    base_ecef_m: np.ndarray


def recorded(late_s: float) -> Recording:
    """Return a drive at 1 Hz, its tags ``late_s`` after the base's, which has one in five seconds."""
    rover = Receiver("rover", AntennaPath(SITE, driving, (0.0, 0.0, -1.5)), 5, F9P)
    base = Receiver("base", AntennaPath(SITE, None, (-320.0, 210.0, 4.0)), 5, replace(SURVEY, steered=True))
    seen = [rover.observe(START + (k + late_s)) for k in range(EPOCHS)]
    stood = [base.observe(START + float(k)) for k in range(0, EPOCHS + EVERY, EVERY)]
    return Recording(
        [r.epoch for r in seen], [b.epoch for b in stood], np.array([r.position_ecef_m for r in seen]), stood[0].position_ecef_m
    )


@pytest.fixture(scope="module")
def drive() -> Recording:
    return recorded(0.0)


def solved(
    recording: Recording, *, interpolate: bool = True, placed: bool = True, mode: Mode = Mode.KINEMATIC
) -> tuple[list[Solution], list[Solution]]:
    """Return the solutions forward and backward, both in rising order of time."""
    options = RtkOptions(mode=mode)
    place = tuple(recording.base_ecef_m.tolist()) if placed else None
    session = Session(SessionOptions(options, pairing_for(options, replay=True, interpolate=interpolate), place))
    for message in [broadcast(satellite, START) for satellite in SATELLITES.tolist()] + [KLOBUCHAR]:
        session.feed(Source.NAVIGATION, message)
    for source, epochs in ((Source.ROVER, recording.rover), (Source.BASE, recording.base)):
        for message in (*epochs, EndOfStream()):
            session.feed(source, message)
    course, forward, taken = Course(session), [], []
    while (pair := session.next_pair(0.0)) is not None:
        taken.append(course.take(pair))
        forward.append(session.solve(pair))
    return forward, list(Backward(options, course).solutions(reversed(taken)))[::-1]


def errors_m(solutions: list[Solution], recording: Recording) -> np.ndarray:
    return np.linalg.norm(np.array([s.position_ecef_m for s in solutions]) - recording.truth, axis=1)


def test_every_epoch_is_fixed_and_its_age_is_that_of_the_nearer_base_epoch(drive: Recording) -> None:
    for run in solved(drive):
        assert [round(s.age_s) for s in run[:6]] == [0, 1, 2, -2, -1, 0]
        assert all(s.status is Status.FIX for s in run)
        assert errors_m(run, drive).max() < 0.03


def test_where_epochs_match_nothing_changes(drive: Recording) -> None:
    """To the last bit, up to the first epoch that has no base epoch of its own time."""
    own = replace(drive, rover=[epoch for epoch in drive.rover if any(epoch.time == base.time for base in drive.base)])
    for with_, without in zip(solved(own), solved(own, interpolate=False), strict=True):
        assert [s.position_ecef_m.tolist() for s in with_] == [s.position_ecef_m.tolist() for s in without]
        assert [s.age_s for s in with_] == [0.0] * len(own.rover)


def test_without_a_place_of_the_base_or_ephemerides_pairs_are_as_they_were(drive: Recording) -> None:
    forward, _ = solved(drive, placed=False)
    assert [s.reason for s in forward] == [s.reason for s in solved(drive, interpolate=False, placed=False)[0]]
    assert not any(s.status is Status.FIX for s in forward)


def test_a_moving_base_is_not_interpolated(drive: Recording) -> None:
    forward, _ = solved(drive, mode=Mode.MOVING_BASE)
    assert [s.status is Status.FIX for s in forward] == [k % EVERY == 0 for k in range(EPOCHS)]


@pytest.mark.parametrize("flagged", [True, False])
@pytest.mark.parametrize("late_s", [0.0, 0.4])
def test_slips_of_the_base_do_no_harm(late_s: float, flagged: bool) -> None:
    """A third of the satellites slips by a cycle or more between two base epochs, flagged or not, whether or not the rover has an epoch at
    the second one's time: every epoch is fixed and right, and no phase takes the slip for motion.
    """
    recording = recorded(late_s)

    def slipped(base: Epoch) -> Epoch:
        many = np.isin(base.satellite, np.unique(base.satellite)[::3])
        since = base.time - START
        jump = np.where(many & (since >= 10.0), 1.0 + base.satellite % 3, 0.0)
        told = many & (since == 10.0) & flagged
        return replace(base, phase_cyc=base.phase_cyc + jump, flags=base.flags | np.where(told, SLIP, 0).astype(np.uint8))

    for run in solved(replace(recording, base=[slipped(base) for base in recording.base])):
        assert all(s.status is Status.FIX for s in run)
        assert errors_m(run, recording).max() < 0.04
