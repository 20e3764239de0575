"""Two receivers of one vehicle whose clocks differ: the baseline is that of the instant that the rover's tag names."""

from math import nan, radians

import numpy as np
import pytest

from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.common_instant import base_move_ecef_m
from rtkmesh.models.single import Located
from rtkmesh.rtk.options import Mode, RtkOptions
from rtkmesh.rtk.session import Session, SessionOptions, Source, pairing_for
from rtkmesh.rtk.solution import Status
from rtkmesh.simulation.classes import F9P
from rtkmesh.simulation.receiver import Receiver
from rtkmesh.simulation.sky import KLOBUCHAR, SATELLITES, absolute_s, broadcast
from rtkmesh.simulation.trajectories import AntennaPath, Site, driving

SITE = Site(radians(52.5), radians(13.4), 50.0)
START = GpsTime(2445, 345608.0)
FRONT_M = (1.0, 0.0, -2.0)
EPOCHS = 60


def test_clocks_that_differ_do_not_move_the_baseline():
    """At up to 14 m/s and clocks half a millisecond apart the mean error along the track was 6 mm; it is below 1.2."""
    paths = [AntennaPath(SITE, driving, place) for place in ((-1.0, 0.0, -2.0), FRONT_M)]
    base, rover = (Receiver(name, path, 3, F9P) for name, path in zip(("a", "c"), paths, strict=True))
    options = RtkOptions(mode=Mode.MOVING_BASE)
    session = Session(SessionOptions(options, pairing_for(options, replay=False)))
    for satellite in SATELLITES.tolist():
        session.feed(Source.NAVIGATION, broadcast(satellite, START))
    session.feed(Source.NAVIGATION, KLOBUCHAR)
    along_m, apart_s = [], []
    for k in range(EPOCHS):
        seen = [receiver.observe(START + 0.2 * k) for receiver in (base, rover)]
        session.feed(Source.BASE, seen[0].epoch, k)
        session.feed(Source.ROVER, seen[1].epoch, k)
        [solution] = session.solutions(k + 0.5)
        apart_s.append(seen[1].true_time - seen[0].true_time)
        if solution.status is Status.FIX:
            true = np.subtract(*(path.position_ecef_m(absolute_s(seen[1].epoch.time)) for path in reversed(paths)))
            velocity = seen[1].velocity_ecef_mps
            along_m.append(float((solution.baseline_ecef_m - true) @ velocity) / float(np.linalg.norm(velocity)))
    assert abs(np.mean(apart_s)) > 3e-4
    assert len(along_m) > 0.8 * EPOCHS
    assert abs(np.mean(along_m)) < 0.0012


@pytest.mark.parametrize(("clock_s", "speed_mps"), [(nan, 3.0), (1e-4, nan), (9.0, 3.0)])
def test_what_is_not_known_moves_nothing(clock_s: float, speed_mps: float):
    """Neither without a clock or a velocity, nor for a clock that is seconds off."""
    located = Located(0, *[np.zeros(3)] * 2, clock_s, np.zeros(5), np.full(4, speed_mps), *[np.zeros((3, 3))] * 7)  # pyright: ignore[reportArgumentType, reportCallIssue]  the rest is not looked at
    still = located._replace(clock_s=0.0, velocity_mps=np.zeros(4))
    assert not base_move_ecef_m(still, located, 0.0).any()
    assert not base_move_ecef_m(located, still, 0.0).any()
