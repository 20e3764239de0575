"""Other ephemerides of all satellites in one second: nothing moves, and a slip in that second is found. On simulated epochs."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from tests.rtk.test_slip_repair import AT, EPOCHS, START, Scene, same, slipped

from rtkmesh.gnss.ephemeris import Ephemeris, GlonassEphemeris
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.signals import KEYS_PER_SATELLITE
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.rtk.engine import Rtk
from rtkmesh.rtk.ephemeris_change import change_ephemerides
from rtkmesh.rtk.options import Direction, RtkOptions
from rtkmesh.rtk.solution import Solution, Status
from rtkmesh.rtk.state import BASE_M, ROVER_M, Filter
from rtkmesh.simulation.sky import KLOBUCHAR, SATELLITES, broadcast

pytestmark = pytest.mark.slow  # without compilation; with it, seconds


def other(satellite: int) -> Ephemeris:
    """Return an issue that was sent later than the true one and is off by metres and some millimetres a second."""
    e, rng = broadcast(satellite, START), np.random.default_rng(satellite)
    clock_s, rate = float(rng.normal(0.0, 5e-9)), float(rng.normal(0.0, 1e-11))
    if isinstance(e, GlonassEphemeris):
        x, y, z = e.position_m
        return replace(e, transmitted=START, iode=e.iode + 1, position_m=(x + 2.0, y - 1.0, z), tau_s=e.tau_s + clock_s)
    return replace(e, transmitted=START, iode=e.iode + 1, crc_m=e.crc_m + 3.0, af0_s=e.af0_s + clock_s, af1=e.af1 + rate)


def table(*, new: bool = False) -> EphemerisTable:
    """Return the true ephemerides, and the new ones with them."""
    out = EphemerisTable()
    for satellite in SATELLITES.tolist():
        out.add(broadcast(satellite, START))
        if new:
            out.add(other(satellite))
    return out


def solve(scene: Scene, rover: Sequence[Epoch | None]) -> list[Solution]:
    """Return a solution per epoch that is there; from AT on with the new ephemerides."""
    engine, tables = Rtk(RtkOptions()), (table(), table(new=True))
    pairs = enumerate(zip(rover, scene.base, strict=True))
    return [engine.step(r, b, tables[k >= AT], KLOBUCHAR, base_position_ecef_m=scene.place) for k, (r, b) in pairs if r is not None]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene()


@pytest.fixture(scope="module")
def changed(scene: Scene) -> list[Solution]:
    """The solutions without slips."""
    return solve(scene, scene.rover)


def test_nothing_moves(scene: Scene, changed: list[Solution]):
    """Single points jump by metres; fixes, integers and velocities go on, as near to the true ones as the new ephemerides are."""
    jump_m = np.linalg.norm(changed[AT].single_position_ecef_m - scene.plain[AT].single_position_ecef_m)
    assert jump_m > 0.5
    same(scene.plain, changed, 2e-3)
    for one, without in zip(changed[AT:], scene.plain[AT:], strict=True):
        assert one.status is Status.FIX
        assert np.linalg.norm(one.velocity_ecef_mps - without.velocity_ecef_mps) < 0.01


@pytest.mark.parametrize("cycles", [1.0, -4.0, 0.5])
def test_a_slip_in_that_second_is_found(scene: Scene, changed: list[Solution], cycles: float):
    """It changes nothing but the ambiguity, and is counted once."""
    signal = scene.used()[4]
    solutions = solve(scene, slipped(scene.rover, {signal: cycles}))
    same(changed, solutions, 1e-3)
    t = solutions[-1].satellites
    rows = zip(t.satellite.tolist(), t.signal.tolist(), t.slips.tolist(), strict=True)
    assert {(satellite, code) for satellite, code, slips in rows if slips} == {signal}


def test_half_of_the_satellites_slip_in_that_second(scene: Scene, changed: list[Solution]):
    satellites = sorted({satellite for satellite, _ in scene.used()})[::2]
    signs = {satellite: (-1.0) ** k for k, satellite in enumerate(satellites)}
    same(changed, solve(scene, slipped(scene.rover, {row: signs[row[0]] for row in scene.used() if row[0] in signs})), 1e-3)


@pytest.mark.parametrize("cycles", [0.0, 1.0])
def test_a_satellite_that_was_away_then_comes_back_with_its_integer(scene: Scene, changed: list[Solution], cycles: float):
    """It is seen with the old ephemeris last and with the new one next."""
    satellite = scene.used()[4][0]
    epochs = slipped(scene.rover, {row: cycles for row in scene.used() if row[0] == satellite})
    for k in (AT - 1, AT):
        epoch = epochs[k]
        assert epoch is not None
        epochs[k] = epoch.take(epoch.satellite != satellite)
    same(changed[AT + 1 :], solve(scene, epochs)[AT + 1 :], 1e-3)


def test_the_informed_filter_remembers_the_same(scene: Scene):
    """It sees the same phases less the same models, before a change of these and after it."""
    engine = Rtk(RtkOptions())
    for k in range(5):
        engine.step(scene.rover[k], scene.base[k], table(), KLOBUCHAR, base_position_ecef_m=scene.place)
    state, single = engine._state, engine._single
    assert state is not None
    assert single is not None
    state.informed = Filter(*(part.copy() for part in state.filter))
    before, channel = state.filter.history.copy(), table().issues.channel
    strong = np.array((3e-8, 0.0, 0.0, 0.0, 4e5, 0.0, 0.0, 0.0))  # a day of 4e5 s: at night too
    engine._change_models(START + 4.0, single, channel, (False, True), strong)
    after_ionosphere = state.filter.history.copy()
    other_single = single._replace(rows=table(new=True).select(single.satellites, START + 5.0))
    engine._change_models(START + 4.0, other_single, channel, (True, False), strong)
    assert np.nanmax(np.abs(after_ionosphere[:, BASE_M] - before[:, BASE_M])) > 0.5
    assert np.nanmax(np.abs(state.filter.history[:, BASE_M] - after_ionosphere[:, BASE_M])) > 0.5
    np.testing.assert_array_equal(state.informed.history, state.filter.history)


@pytest.mark.parametrize("direction", list(Direction))
def test_what_is_remembered_is_less_the_new_model(scene: Scene, direction: Direction):
    """The phases are then what they are where the new ephemerides are there from the start."""
    order = range(EPOCHS) if direction is Direction.FORWARD else reversed(range(EPOCHS))
    engines, tables = (Rtk(RtkOptions(), direction), Rtk(RtkOptions(), direction)), (table(), table(new=True))
    for k in order:
        for engine, known in zip(engines, tables, strict=True):
            engine.step(scene.rover[k], scene.base[k], known, KLOBUCHAR, base_position_ecef_m=scene.place)
    engine, wanted = engines
    assert engine._state is not None
    assert wanted._state is not None
    assert wanted._single is not None
    f, new, state = engine._state.filter, wanted._single, engine._state
    pairs = f.keys >= KEYS_PER_SATELLITE
    before, clock = f.history.copy(), (state.origin.week, state.origin.tow_s, engine._sense)
    places_ecef_m = wanted._state.rover_ecef_m, wanted._state.base_ecef_m
    change_ephemerides(f, new.rows, new.satellites, engine._ephemerides, clock, places_ecef_m)
    assert np.ptp(f.history[pairs, BASE_M] - before[pairs, BASE_M]) > 1.0
    assert f.history[pairs, BASE_M] == pytest.approx(wanted._state.filter.history[pairs, BASE_M], abs=1e-3)
    assert f.history[pairs, ROVER_M] - before[pairs, ROVER_M] == pytest.approx(f.history[pairs, BASE_M] - before[pairs, BASE_M], abs=1e-3)
