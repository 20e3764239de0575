"""Phases of unlike codes of one band that are a quarter or half a cycle apart (L2 P(Y) against L2C): clock groups take it up."""

from dataclasses import replace
from math import radians

import numpy as np
import pytest

from rtkmesh.gnss.epoch import Epoch, make_epoch
from rtkmesh.gnss.signals import GPS, SATELLITES_PER_SYSTEM, signal_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.rtk.engine import Rtk
from rtkmesh.rtk.options import RtkOptions
from rtkmesh.rtk.solution import Solution, Status
from rtkmesh.simulation.classes import F9P, SURVEY
from rtkmesh.simulation.receiver import Receiver
from rtkmesh.simulation.sky import KLOBUCHAR, SATELLITES, broadcast
from rtkmesh.simulation.trajectories import AntennaPath, Site, driving

pytestmark = pytest.mark.slow  # without compilation; with it, seconds
START = GpsTime(2445, 100000.0)
SITE = Site(radians(47.0), radians(8.0), 400.0)
L2C, P2 = signal_number("2L"), signal_number("2W")
EPOCHS = 10


def renamed(epoch: Epoch, every: int, shift_cyc: float = 0.0) -> Epoch:
    """Return an epoch of a base that tracks P(Y) on some satellites and L2C on the others, whose phases are off by a shift."""
    l2 = (epoch.satellite // SATELLITES_PER_SYSTEM == GPS) & (epoch.signal == L2C)
    by_p = l2 & (epoch.satellite % every == 0)
    kept = ("satellite", "channel", "flags", "pseudorange_m", "doppler_hz", "cn0_dbhz", "lock_s")
    columns = {name: getattr(epoch, name) for name in kept}
    phase = epoch.phase_cyc + np.where(by_p, shift_cyc, 0.0)
    return make_epoch(epoch.time, **columns, signal=np.where(by_p, P2, epoch.signal), phase_cyc=phase)


def solve(shift_cyc: float) -> list[Solution]:
    """Return the solutions of a drive with the base's P(Y) phases off by a shift."""
    rover = Receiver("rover", AntennaPath(SITE, driving, (0.0, 0.0, -1.5)), 5, F9P)
    base = Receiver("base", AntennaPath(SITE, None, (-320.0, 210.0, 4.0)), 5, replace(SURVEY, steered=True))
    table, engine = EphemerisTable(), Rtk(RtkOptions(systems="G"))
    for satellite in SATELLITES.tolist():
        table.add(broadcast(satellite, START))
    out: list[Solution] = []
    for k in range(EPOCHS):
        seen, reference = rover.observe(START + float(k)), base.observe(START + float(k))
        place = reference.position_ecef_m
        out.append(engine.step(seen.epoch, renamed(reference.epoch, 2, shift_cyc), table, KLOBUCHAR, base_position_ecef_m=place))
    return out


@pytest.mark.parametrize("shift_cyc", [0.25, 0.5, -0.25])
def test_fractions_between_codes_of_a_band_change_nothing(shift_cyc: float):
    """GPS alone, the rover with L2C, the base with P(Y) on half of the satellites: the same fixes, integers and positions."""
    aligned, shifted = solve(0.0), solve(shift_cyc)
    assert sum(s.status is Status.FIX for s in aligned) > EPOCHS // 2
    for one, other in zip(aligned, shifted, strict=True):
        assert (one.status, one.ambiguities_fixed, one.grade) == (other.status, other.ambiguities_fixed, other.grade)
        assert np.abs(one.position_ecef_m - other.position_ecef_m).max() < 1e-5
