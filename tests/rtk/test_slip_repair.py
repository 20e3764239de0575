"""Slips in a run with fixed integers: what is certain changes nothing but the ambiguity. On simulated epochs, through the public API."""

from collections.abc import Sequence
from dataclasses import replace
from math import radians

import numpy as np
import pytest

from rtkmesh.gnss.epoch import SLIP, Epoch
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.rtk.engine import Rtk
from rtkmesh.rtk.options import RtkOptions
from rtkmesh.rtk.solution import USED_PHASE, Solution, Status
from rtkmesh.simulation.classes import F9P, SURVEY
from rtkmesh.simulation.receiver import Receiver, ReceiverOptions
from rtkmesh.simulation.sky import KLOBUCHAR, SATELLITES, broadcast
from rtkmesh.simulation.trajectories import AntennaPath, Site, driving

pytestmark = pytest.mark.slow  # without compilation; with it, seconds
START = GpsTime(2445, 100000.0)
SITE = Site(radians(47.0), radians(8.0), 400.0)
EPOCHS, AT = 18, 10


def quiet(options: ReceiverOptions) -> ReceiverOptions:
    return replace(options, signals=options.signals._replace(slips_per_hour=0.0))


class Scene:
    """A drive with two bands: epochs, ephemerides and the solutions without slips."""

    def __init__(self) -> None:
        rover = Receiver("rover", AntennaPath(SITE, driving, (0.0, 0.0, -1.5)), 5, quiet(F9P))
        base = Receiver("base", AntennaPath(SITE, None, (-320.0, 210.0, 4.0)), 5, replace(quiet(SURVEY), steered=True))
        self.rover = [rover.observe(START + float(k)).epoch for k in range(EPOCHS)]
        seen = [base.observe(START + float(k)) for k in range(EPOCHS)]
        self.base, self.place = [b.epoch for b in seen], seen[0].position_ecef_m
        self.plain = self.solve(self.rover)

    def solve(self, rover: Sequence[Epoch | None]) -> list[Solution]:
        """Return a solution per epoch that is there."""
        engine, table = Rtk(RtkOptions()), EphemerisTable()
        for satellite in SATELLITES.tolist():
            table.add(broadcast(satellite, START))
        pairs = zip(rover, self.base, strict=True)
        return [engine.step(r, b, table, KLOBUCHAR, base_position_ecef_m=self.place) for r, b in pairs if r is not None]

    def used(self) -> list[tuple[int, int]]:
        """Return the (satellite, signal) whose phases serve."""
        t = self.plain[AT].satellites
        rows = zip(t.satellite.tolist(), t.signal.tolist(), t.state.tolist(), strict=True)
        return [(satellite, signal) for satellite, signal, state in rows if state & USED_PHASE]


@pytest.fixture(scope="module")
def scene() -> Scene:
    found = Scene()
    assert all(s.status is Status.FIX for s in found.plain[1:])
    return found


def slipped(epochs: Sequence[Epoch], jumps: dict[tuple[int, int], float], *, told: bool = False) -> list[Epoch | None]:
    """Return epochs with jumps (cycles) per (satellite, signal) from AT on."""
    out: list[Epoch | None] = []
    for k, epoch in enumerate(epochs):
        rows = list(zip(epoch.satellite.tolist(), epoch.signal.tolist(), strict=True))
        jump = np.array([jumps.get(row, 0.0) if k >= AT else 0.0 for row in rows])
        flags = epoch.flags | np.where((jump != 0.0) & told & (k == AT), SLIP, 0).astype(np.uint8)
        out.append(replace(epoch, phase_cyc=epoch.phase_cyc + jump, flags=flags))
    return out


def same(first: Sequence[Solution], second: Sequence[Solution], limit_m: float) -> None:
    """Hold two runs of solutions against each other: status, integers, grade, position."""
    for one, other in zip(first, second, strict=True):
        assert (one.status, one.ambiguities_fixed, one.grade) == (other.status, other.ambiguities_fixed, other.grade)
        assert np.abs(one.position_ecef_m - other.position_ecef_m).max() < limit_m


@pytest.mark.parametrize("cycles", [1.0, -1.0, 4.0, -900.0])
@pytest.mark.parametrize("told", [False, True])
def test_whole_cycles_change_nothing_but_the_ambiguity(scene: Scene, cycles: float, told: bool):
    """Of one signal: fixes, numbers of integers and positions stay; the slip is counted once."""
    signal = scene.used()[4]
    solutions = scene.solve(slipped(scene.rover, {signal: cycles}, told=told))
    same(scene.plain, solutions, 1e-4)
    t = solutions[-1].satellites
    rows = zip(t.satellite.tolist(), t.signal.tolist(), t.slips.tolist(), strict=True)
    assert {(satellite, code) for satellite, code, slips in rows if slips} == {signal}


def test_half_of_the_satellites_slip_at_once(scene: Scene):
    """By one cycle on both bands, with signs at random: bands of one satellite tell of each other, and these do not vote."""
    rng, used = np.random.default_rng(1), scene.used()
    satellites = sorted({satellite for satellite, _ in used})
    signs = {satellite: float(rng.choice((-1.0, 1.0))) for satellite in satellites[::2]}
    jumps = {row: signs[row[0]] for row in used if row[0] in signs}
    same(scene.plain, scene.solve(slipped(scene.rover, jumps)), 1e-3)


def test_half_cycles_keep_the_integers(scene: Scene):
    """A phase that is half a cycle off from some epoch on serves on with the integer that it had."""
    same(scene.plain, scene.solve(slipped(scene.rover, {scene.used()[2]: 0.5, scene.used()[8]: -1.5})), 1e-3)


@pytest.mark.parametrize("cycles", [0.0, 1.0, -5.0])
@pytest.mark.parametrize("told", [False, True])
def test_a_satellite_that_was_away_comes_back_with_its_integer(scene: Scene, cycles: float, told: bool):
    """For three seconds, with a slip meanwhile or none: by the motion since, whatever the receiver says of its lock."""
    satellite = scene.used()[4][0]
    jumps = {row: cycles for row in scene.used() if row[0] == satellite}
    epochs = slipped(scene.rover, jumps, told=told)
    for k in range(AT - 3, AT):
        epoch = scene.rover[k]
        epochs[k] = epoch.take(epoch.satellite != satellite)
    solutions = scene.solve(epochs)
    same(scene.plain[AT:], solutions[AT:], 1e-3)
