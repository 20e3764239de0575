"""Ephemerides that put satellites kilometres from where they are: no code and no phase of those serves. On simulated epochs."""

from collections.abc import Collection
from dataclasses import replace
from math import radians

import numpy as np
import pytest

from rtkmesh.gnss.ephemeris import Ephemeris, GlonassEphemeris
from rtkmesh.gnss.signals import GLONASS, GPS, SATELLITES_PER_SYSTEM
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.rtk.engine import Rtk
from rtkmesh.rtk.options import RtkOptions
from rtkmesh.rtk.solution import USED_CODE, USED_PHASE, Solution
from rtkmesh.simulation.classes import SURVEY
from rtkmesh.simulation.receiver import Receiver
from rtkmesh.simulation.sky import KLOBUCHAR, SATELLITES, broadcast
from rtkmesh.simulation.trajectories import AntennaPath, Site

pytestmark = pytest.mark.slow  # without compiled kernels

START = GpsTime(2445, 200000.0)
SITE = Site(radians(48.0), radians(11.0), 500.0)
STEP_S, EPOCHS = 30.0, 20
ALL_OF_GLONASS = frozenset(s for s in SATELLITES.tolist() if s // SATELLITES_PER_SYSTEM == GLONASS)
SOME_OF_GPS = frozenset([s for s in SATELLITES.tolist() if s // SATELLITES_PER_SYSTEM == GPS][::3])


def misplaced(e: Ephemeris) -> Ephemeris:
    """Return an ephemeris that puts its satellite tens to hundreds of kilometres along its orbit."""
    if isinstance(e, GlonassEphemeris):
        (x, y, z), (vx, vy, vz), s = e.position_m, e.velocity_mps, 30.0 + e.satellite % 7
        return replace(e, position_m=(x + s * vx, y + s * vy, z + s * vz))
    return replace(e, m0_rad=e.m0_rad + 0.002 * (1 + e.satellite % 5))


def solve(km: float, wrong: Collection[int], systems: str = "GR") -> tuple[list[Solution], np.ndarray]:
    """Return the solutions of two receivers that stand km apart, and the true place of the rover."""
    options = replace(SURVEY, steered=True, systems="GR", frequencies=2)
    place = AntennaPath(SITE, None, (600.0 * km, -800.0 * km, 20.0))
    rover = Receiver("rover", AntennaPath(SITE, None, (0.0, 0.0, 0.0)), 7, options, (), None, 1.0)
    base = Receiver("base", place, 7, options, (), None, 1.0)
    engine, table = Rtk(RtkOptions(systems=systems)), EphemerisTable()
    for satellite in SATELLITES.tolist():
        true = broadcast(satellite, START)
        table.add(misplaced(true) if satellite in wrong else true)
    found: list[Solution] = []
    for k in range(EPOCHS):
        mine, theirs = (r.observe(START + k * STEP_S) for r in (rover, base))
        found.append(engine.step(mine.epoch, theirs.epoch, table, KLOBUCHAR, base_position_ecef_m=theirs.position_ecef_m))
    return found, rover.observe(START).position_ecef_m


def served(solution: Solution) -> set[int]:
    """Return the satellites of which a code or a phase serves."""
    t = solution.satellites
    return {s for s, state in zip(t.satellite.tolist(), t.state.tolist(), strict=True) if state & (USED_CODE | USED_PHASE)}


@pytest.mark.parametrize("km", [3.0, 40.0])
@pytest.mark.parametrize("wrong", [ALL_OF_GLONASS, SOME_OF_GPS])
def test_misplaced_satellites_serve_for_nothing(km: float, wrong: frozenset[int]) -> None:
    """However many of them: the rover is where the others put it, and its sigma says how well."""
    solutions, truth_ecef_m = solve(km, wrong)
    for solution in solutions:
        away_m, cov_m2 = solution.position_ecef_m - truth_ecef_m, solution.position_cov_ecef_m2
        assert len(served(solution) & wrong) <= (wrong == ALL_OF_GLONASS)  # a last one has a clock for itself, and says nothing
        assert away_m @ np.linalg.solve(cov_m2, away_m) < 25.0
