"""An epoch without a fix is looked at without its past too: what spoilt the filter does not keep the integers from being found."""

from dataclasses import replace
from math import radians

import numpy as np
import pytest

from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.models.single import Located
from rtkmesh.rtk.engine import Rtk
from rtkmesh.rtk.options import AmbiguityMode, AmbiguityOptions, Mode, RtkOptions
from rtkmesh.rtk.solution import Solution, Status
from rtkmesh.rtk.state import FilterState
from rtkmesh.simulation.classes import F9P, SURVEY
from rtkmesh.simulation.faults import Disturbance, disturbed
from rtkmesh.simulation.receiver import Receiver
from rtkmesh.simulation.sky import KLOBUCHAR, SATELLITES, absolute_s, broadcast
from rtkmesh.simulation.trajectories import AntennaPath, Site, driving

pytestmark = pytest.mark.slow  # without compilation; with it, seconds
START = GpsTime(2445, 100000.0)
SITE = Site(radians(47.0), radians(8.0), 400.0)
EPOCHS, CLEAR = 24, 12


class WithPast(Rtk):
    """An engine that never looks at an epoch without its past."""

    def _may_begin_anew(self, state: FilterState, single: Located) -> bool:
        del state, single
        return False


class Counting(Rtk):
    """An engine that counts how often it does."""

    looks = 0

    def _may_begin_anew(self, state: FilterState, single: Located) -> bool:
        found = super()._may_begin_anew(state, single)
        self.looks += found
        return found


def drive() -> tuple[list, list, np.ndarray, np.ndarray]:
    """Return rover epochs whose codes are off by tens of metres until CLEAR, base epochs, true positions, and the base's place."""
    rover = Receiver("rover", AntennaPath(SITE, driving, (0.0, 0.0, -1.5)), 5, F9P)
    base = Receiver("base", AntennaPath(SITE, None, (-320.0, 210.0, 4.0)), 5, replace(SURVEY, steered=True))
    seen = [(rover.observe(START + float(k)), base.observe(START + float(k))) for k in range(EPOCHS)]
    rng, until_s = np.random.default_rng(3), absolute_s(START) + CLEAR - 0.5
    satellites = np.unique(np.concatenate([r.epoch.satellite for r, _ in seen])).tolist()
    faults = [Disturbance(s, None, -1e12, until_s, code_m=float(rng.normal(0.0, 15.0))) for s in satellites]
    epochs = [disturbed(r.epoch, faults) for r, _ in seen]
    return epochs, [b.epoch for _, b in seen], np.array([r.position_ecef_m for r, _ in seen]), seen[0][1].position_ecef_m


@pytest.fixture(scope="module")
def scene() -> tuple[list, list, np.ndarray, np.ndarray]:
    return drive()


def solve(scene: tuple[list, list, np.ndarray, np.ndarray], engine: Rtk) -> list[Solution]:
    table = EphemerisTable()
    for satellite in SATELLITES.tolist():
        table.add(broadcast(satellite, START))
    return [engine.step(r, b, table, KLOBUCHAR, base_position_ecef_m=scene[3]) for r, b in zip(scene[0], scene[1], strict=True)]


@pytest.mark.parametrize("options", [
    RtkOptions(ambiguity=AmbiguityOptions(mode=AmbiguityMode.INSTANTANEOUS)),
    RtkOptions(mode=Mode.DGPS),
    RtkOptions(ambiguity=AmbiguityOptions(mode=AmbiguityMode.OFF)),
])  # fmt: skip
def test_where_there_is_no_past_or_no_fix_nothing_changes(scene: tuple[list, list, np.ndarray, np.ndarray], options: RtkOptions):
    """Modes that keep no integers are the same with and without."""
    for one, other in zip(solve(scene, Rtk(options)), solve(scene, WithPast(options)), strict=True):
        assert one.status is other.status
        assert np.array_equal(one.position_ecef_m, other.position_ecef_m)


def test_a_look_that_finds_nothing_leaves_no_trace(scene: tuple[list, list, np.ndarray, np.ndarray]):
    """While codes are bad epochs are looked at again in vain: floats are the same to the last bit as without, and so is what follows."""
    engine = Counting(RtkOptions(systems="G"))
    found, slow = solve(scene, engine), solve(scene, WithPast(RtkOptions(systems="G")))
    assert {s.status for s in found[:CLEAR]} == {Status.FLOAT}
    assert engine.looks >= CLEAR // 2
    for one, other in zip(found, slow, strict=True):
        assert one.status is other.status
        assert np.array_equal(one.position_ecef_m, other.position_ecef_m)
        assert np.array_equal(one.position_cov_ecef_m2, other.position_cov_ecef_m2)


def test_an_epoch_believed_without_its_past_is_a_reset(scene: tuple[list, list, np.ndarray, np.ndarray]):
    """It is counted like every other new beginning; an engine that never looks at one so stays with its float."""
    options = RtkOptions(systems="GE", frequencies=1)
    found, slow = solve(scene, Rtk(options)), solve(scene, WithPast(options))
    first = next(k for k, s in enumerate(found) if s.status is Status.FIX)
    assert found[first].resets == found[first - 1].resets + 1
    assert np.linalg.norm(found[first].position_ecef_m - scene[2][first]) < 0.1
    assert (slow[first].status, slow[first].resets) == (Status.FLOAT, found[first - 1].resets)
