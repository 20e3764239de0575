"""New coefficients of the ionosphere while a filter runs: nothing moves, and what is remembered is as if they had been there before."""

from dataclasses import replace

import numpy as np
import pytest

from rtkmesh.gnss.ephemeris import KlobucharParameters
from rtkmesh.gnss.signals import KEYS_PER_SATELLITE
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.atmosphere import klobuchar_vector
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.rtk.engine import Rtk
from rtkmesh.rtk.ionosphere_change import change_ionosphere
from rtkmesh.rtk.options import RtkOptions
from rtkmesh.rtk.solution import Status
from rtkmesh.rtk.state import BASE_M, ROVER_M
from rtkmesh.simulation.classes import M8, SURVEY
from rtkmesh.simulation.receiver import Receiver
from rtkmesh.simulation.sky import KLOBUCHAR, SATELLITES, broadcast
from rtkmesh.simulation.trajectories import AntennaPath, Site

START, SITE = GpsTime(2445, 50400.0), Site(0.82, 0.14, 400.0)  # two in the afternoon: as much ionosphere as there is
STRONG = KlobucharParameters("G", (3.0e-8, 1.5e-8, -1.2e-7, -6.0e-8), (1.2e5, 1.3e5, -6.6e4, -5.9e5))


def ephemerides():
    table = EphemerisTable()
    for number in SATELLITES.tolist():
        table.add(broadcast(number, START))
    return table


def ran(coefficients, receivers=(M8, SURVEY), systems="GR", frequencies=1):
    """Return the engine and the solutions of epochs of a second, in each of which these coefficients are known."""
    rover_options, base_options = receivers
    rover = Receiver("rover", AntennaPath(SITE, None, (0.0, 0.0, -1.5)), 5, rover_options)
    base = Receiver("base", AntennaPath(SITE, None, (-120.0, 110.0, 4.0)), 5, replace(base_options, steered=True))
    engine, table, solutions = Rtk(RtkOptions(systems=systems, frequencies=frequencies)), ephemerides(), []
    for k, klobuchar in enumerate(coefficients):
        pair = [end.observe(START + float(k)) for end in (rover, base)]
        solutions.append(engine.step(pair[0].epoch, pair[1].epoch, table, klobuchar, base_position_ecef_m=pair[1].position_ecef_m))
    return engine, solutions


@pytest.mark.slow  # without compilation; with it, seconds
@pytest.mark.parametrize(("systems", "frequencies", "receivers"), [("GR", 1, (M8, SURVEY)), ("GREC", 2, (SURVEY, SURVEY))])
def test_a_rover_does_not_move_when_coefficients_come(systems, frequencies, receivers):
    """A metre more of ionosphere, different for each satellite: fixes go on, where they were, at the velocity that they had."""
    _, solutions = ran([None] * 40 + [STRONG] * 5, receivers, systems, frequencies)
    assert solutions[39].status is Status.FIX
    for solution in solutions[40:]:
        assert solution.status is Status.FIX
        assert solution.resets == solutions[39].resets
        assert np.linalg.norm(solution.baseline_ecef_m - solutions[39].baseline_ecef_m) < 0.03
        assert np.linalg.norm(solution.velocity_ecef_mps) < 0.05


def remembered(engine):
    f = engine._state.filter
    return f.history[f.keys >= KEYS_PER_SATELLITE][:, [ROVER_M, BASE_M]].T.copy()


@pytest.mark.slow  # without compilation; with it, seconds
def test_what_is_remembered_is_less_the_new_model():
    """The base's phases are then what they are with the new coefficients from the start; the rover, near by, sees the same change."""
    engine, wanted = ran([KLOBUCHAR] * 5)[0], remembered(ran([STRONG] * 5)[0])
    before, state, time = remembered(engine), engine._state, START + 4.0
    old, new = (klobuchar_vector(k) for k in (KLOBUCHAR, STRONG))
    channel, places_ecef_m = ephemerides().issues.channel, (state.rover_ecef_m, state.base_ecef_m)
    change_ionosphere(state.filter, engine._single, channel, (time.week, time.tow_s), places_ecef_m, old, new)
    after = remembered(engine)
    assert after[1] == pytest.approx(wanted[1], abs=1e-3)
    assert after[0] - before[0] == pytest.approx(after[1] - before[1], abs=1e-3)
    assert np.ptp(after[1] - before[1]) > 0.3
