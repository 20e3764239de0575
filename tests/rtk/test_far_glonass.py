"""GLONASS codes between receivers of two makes: biased by channel for as long as these run, and over long baselines nobody's witnesses."""

from collections.abc import Iterator
from dataclasses import replace
from math import radians

import numpy as np
import pytest

from rtkmesh.gnss.ephemeris import ReferenceStation
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.signals import GLONASS, SATELLITES_PER_SYSTEM
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.options import AmbiguityMode, AmbiguityOptions, RtkOptions
from rtkmesh.rtk.session import Session, SessionOptions, Source, pairing_for
from rtkmesh.simulation.classes import SURVEY
from rtkmesh.simulation.receiver import Receiver
from rtkmesh.simulation.sky import SATELLITES, broadcast
from rtkmesh.simulation.trajectories import AntennaPath, Site

pytestmark = pytest.mark.slow  # without compiled kernels

START = GpsTime(2445, 200000.0)
SITE = Site(radians(48.0), radians(11.0), 500.0)
STEP_S = 30.0
BIAS_M = 0.5  # at the outermost channels


def _epochs(path: AntennaPath, name: str, count: int) -> Iterator[Epoch]:
    receiver = Receiver(name, path, 7, replace(SURVEY, steered=True, systems="GR", frequencies=2), (), None, 1.0)
    for k in range(count):
        yield receiver.observe(START + k * STEP_S).epoch


def _biased(epoch: Epoch) -> Epoch:
    """Return an epoch whose GLONASS codes are half a metre longer on one half of the satellites, and shorter on the other."""
    glonass = epoch.satellite // SATELLITES_PER_SYSTEM == GLONASS
    bias_m = np.where(epoch.satellite % 2 == 0, BIAS_M, -BIAS_M)
    return replace(epoch, pseudorange_m=epoch.pseudorange_m + np.where(glonass, bias_m, 0.0))


def _last_float_ecef_m(km: float, *, biased: bool) -> np.ndarray:
    base = AntennaPath(SITE, None, (600.0 * km, -800.0 * km, 20.0))
    options = RtkOptions(systems="GR", ambiguity=AmbiguityOptions(mode=AmbiguityMode.OFF))
    session = Session(SessionOptions(options, pairing_for(options, replay=True)))
    x, y, z = base.position_ecef_m(0.0).tolist()
    session.feed(Source.BASE, ReferenceStation(1, (x, y, z)), 0.0)
    for satellite in SATELLITES.tolist():
        session.feed(Source.NAVIGATION, broadcast(satellite, START))
    rover = AntennaPath(SITE, None, (0.0, 0.0, 0.0))
    found = []
    for k, (mine, theirs) in enumerate(zip(_epochs(rover, "rover", 20), _epochs(base, "base", 20), strict=True)):
        session.feed(Source.ROVER, _biased(mine) if biased else mine, k * STEP_S)
        session.feed(Source.BASE, theirs, k * STEP_S)
        found += list(session.solutions(k * STEP_S))
    return found[-1].position_ecef_m


@pytest.mark.parametrize(("km", "least_m", "most_m"), [(40.0, 0.0, 0.06), (3.0, 0.1, 1.0)])
def test_biases_by_channel_hardly_move_a_long_baseline(km: float, least_m: float, most_m: float) -> None:
    """Without being blurred they move it by 0.17 m. Nearer by, where they help first fixes, they count for what their residuals say."""
    moved_m = float(np.linalg.norm(_last_float_ecef_m(km, biased=True) - _last_float_ecef_m(km, biased=False)))
    assert least_m <= moved_m <= most_m
