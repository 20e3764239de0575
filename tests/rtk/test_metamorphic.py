"""What must not matter to the engine, what must turn its answer around, and what must never break it: on simulated epochs, through
the public API alone.
"""

from dataclasses import replace
from math import radians

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.rtk.bits import same_bits

from rtkmesh.gnss.epoch import COLUMNS, Epoch, make_epoch
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.rtk.engine import Rtk
from rtkmesh.rtk.options import AmbiguityMode, AmbiguityOptions, Mode, RtkOptions
from rtkmesh.rtk.session import Session, SessionOptions, Source, pairing_for
from rtkmesh.rtk.solution import Solution, Status
from rtkmesh.simulation.classes import F9P, SURVEY
from rtkmesh.simulation.receiver import Receiver
from rtkmesh.simulation.sky import KLOBUCHAR, SATELLITES, broadcast
from rtkmesh.simulation.trajectories import AntennaPath, Site, driving

pytestmark = pytest.mark.slow  # without compilation; with it, seconds
START = GpsTime(2445, 100000.0)
SITE = Site(radians(47.0), radians(8.0), 400.0)
EPOCHS = 14
OPTIONS = RtkOptions(frequencies=2)
BASE_ENU_M = (-320.0, 210.0, 4.0)
RIGHT_M = 0.03


class Scene:
    """A drive of a rover, 400 m from its base: epochs, truth and ephemerides."""

    def __init__(self) -> None:
        rover = Receiver("rover", AntennaPath(SITE, driving, (0.0, 0.0, -1.5)), 5, F9P)
        base = Receiver("base", AntennaPath(SITE, None, BASE_ENU_M), 5, replace(SURVEY, steered=True))
        seen = [(rover.observe(START + float(k)), base.observe(START + float(k))) for k in range(EPOCHS)]
        self.rover, self.base = [r.epoch for r, _ in seen], [b.epoch for _, b in seen]
        self.truth = np.array([r.position_ecef_m for r, _ in seen])
        self.base_ecef_m = seen[0][1].position_ecef_m
        self.ephemerides = [broadcast(satellite, START) for satellite in SATELLITES.tolist()]

    def solve(self, rover=None, base=None, ephemerides=None, options=OPTIONS, base_ecef_m=None) -> list[Solution]:
        """Return the solutions; what is not given is the scene's own."""
        engine, table = Rtk(options), EphemerisTable()
        for ephemeris in ephemerides or self.ephemerides:
            table.add(ephemeris)
        place = self.base_ecef_m if base_ecef_m is None else base_ecef_m
        pairs = zip(rover or self.rover, base or self.base, strict=True)
        return [engine.step(r, b, table, KLOBUCHAR, base_position_ecef_m=place) for r, b in pairs]

    def errors_m(self, solutions: list[Solution]) -> np.ndarray:
        """Return the 3D errors of one solution per epoch."""
        return np.linalg.norm(positions(solutions) - self.truth, axis=1)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene()


@pytest.fixture(scope="module")
def plain(scene: Scene) -> list[Solution]:
    """The scene's own solutions, right from the first to the last."""
    solutions = scene.solve()
    assert all(s.status is Status.FIX for s in solutions)
    assert scene.errors_m(solutions).max() < RIGHT_M
    return solutions


def positions(solutions: list[Solution]) -> np.ndarray:
    return np.array([s.position_ecef_m for s in solutions])


def shuffled(epoch: Epoch, rng: np.random.Generator) -> Epoch:
    order = rng.permutation(len(epoch))
    return make_epoch(epoch.time, **{name: getattr(epoch, name)[order] for name, _, _ in COLUMNS})


# --- what must not matter ---


@pytest.mark.parametrize("mode", [AmbiguityMode.CONTINUOUS, AmbiguityMode.INSTANTANEOUS, AmbiguityMode.FIX_AND_HOLD])
def test_the_same_input_gives_the_same_bits(scene: Scene, mode: AmbiguityMode):
    """Every field of every solution, in every way of resolving ambiguities."""
    options = replace(OPTIONS, ambiguity=AmbiguityOptions(mode=mode))
    pairs = zip(scene.solve(options=options), scene.solve(options=options), strict=True)
    assert all(same_bits(first, second) for first, second in pairs)


def test_the_order_of_satellites_is_irrelevant(scene: Scene, plain: list[Solution]):
    """Observations and ephemerides that come in another order: the same bits."""
    rng = np.random.default_rng(3)
    ephemerides = [scene.ephemerides[k] for k in rng.permutation(len(scene.ephemerides))]
    other = scene.solve([shuffled(e, rng) for e in scene.rover], [shuffled(e, rng) for e in scene.base], ephemerides)
    assert all(same_bits(first, second) for first, second in zip(plain, other, strict=True))


@pytest.mark.parametrize("side", ["rover", "base"])
def test_whole_cycles_from_the_first_epoch_change_nothing_but_ambiguities(scene: Scene, plain: list[Solution], side: str):
    """Another integer for every arc: the positions stay to a tenth of a millimetre, statuses and counts exactly."""
    rng = np.random.default_rng(4)
    integers = {(s, g): float(rng.integers(-5000, 5000)) for s in SATELLITES.tolist() for g in range(260)}

    def moved(epoch: Epoch) -> Epoch:
        rows = zip(epoch.satellite.tolist(), epoch.signal.tolist(), strict=True)
        return replace(epoch, phase_cyc=epoch.phase_cyc + np.array([integers[row] for row in rows]))

    other = scene.solve(**{side: [moved(e) for e in getattr(scene, side)]})
    assert positions(other) == pytest.approx(positions(plain), abs=1e-4)
    assert [(s.status, s.ambiguities_fixed, s.satellites_used) for s in other] == [
        (s.status, s.ambiguities_fixed, s.satellites_used) for s in plain
    ]
    assert not np.allclose(other[-1].satellites.ambiguity_cyc, plain[-1].satellites.ambiguity_cyc, equal_nan=True)


def test_another_week_changes_nothing(scene: Scene, plain: list[Solution]):
    """Epochs and ephemerides of a week later give the same (the troposphere's season moves by a week, half a millimetre)."""

    def later(value):
        return GpsTime(value.week + 1, value.tow_s)

    names = ("toe", "toc", "transmitted")
    ephemerides = [replace(e, **{n: later(getattr(e, n)) for n in names if hasattr(e, n)}) for e in scene.ephemerides]
    rover, base = ([replace(e, time=later(e.time)) for e in side] for side in (scene.rover, scene.base))
    other = scene.solve(rover, base, ephemerides)
    assert positions(other) == pytest.approx(positions(plain), abs=5e-4)
    assert [s.status for s in other] == [s.status for s in plain]


def test_an_epoch_that_comes_twice_does_no_harm(scene: Scene, plain: list[Solution]):
    """The engine, asked twice for one epoch, is still right and fixed afterwards; a session passes it once, with the same bits."""
    twice = [0, 1, 2, 3, 3, 4, 5, 5, 5, *range(6, EPOCHS)]
    solutions = scene.solve([scene.rover[k] for k in twice], [scene.base[k] for k in twice])
    assert np.linalg.norm(positions(solutions) - scene.truth[twice], axis=1).max() < RIGHT_M
    assert all(s.status is Status.FIX for s in solutions)

    def session_over(order: list[int]) -> list[Solution]:
        session = Session(SessionOptions(OPTIONS, pairing_for(OPTIONS, replay=False), tuple(scene.base_ecef_m.tolist())))
        for message in (*scene.ephemerides, KLOBUCHAR):
            session.feed(Source.NAVIGATION, message)
        out: list[Solution] = []
        for k in order:
            session.feed(Source.ROVER, scene.rover[k], float(k))
            session.feed(Source.BASE, scene.base[k], float(k))
            out += session.solutions(float(k))
        return out

    pairs = zip(session_over(list(range(EPOCHS))), session_over(twice), strict=True)
    assert all(same_bits(first, second) for first, second in pairs)


def test_a_satellite_that_goes_and_comes_back_does_no_harm(scene: Scene, plain: list[Solution]):
    """Each of the highest ones in turn away for three epochs: right and fixed throughout, and in use again at the end."""
    last = plain[-1].satellites
    for satellite in dict.fromkeys(last.satellite[np.argsort(-last.elevation_rad)][:12].tolist()):
        rover = [e.take(e.satellite != satellite) if 5 <= k < 8 else e for k, e in enumerate(scene.rover)]
        solutions = scene.solve(rover)
        assert all(s.status is Status.FIX for s in solutions)
        assert scene.errors_m(solutions).max() < RIGHT_M
        assert satellite in solutions[-1].satellites.satellite
        assert satellite not in solutions[6].satellites.satellite


def test_rover_and_base_change_places(scene: Scene):
    """The baseline between two receivers of a vehicle that stands 400 m from the other has the opposite sign."""
    forward = scene.solve(options=replace(OPTIONS, mode=Mode.MOVING_BASE))
    backward = scene.solve(scene.base, scene.rover, options=replace(OPTIONS, mode=Mode.MOVING_BASE))
    both = [(f, b) for f, b in zip(forward, backward, strict=True) if f.status is Status.FIX and b.status is Status.FIX]
    assert len(both) >= EPOCHS - 2
    for one, two in both:
        assert two.baseline_ecef_m == pytest.approx(-one.baseline_ecef_m, abs=0.01)


def test_a_base_that_is_told_elsewhere_moves_the_answer_with_it(scene: Scene, plain: list[Solution]):
    """Metres off in the base are the same metres off in the rover, to millimetres."""
    shift = np.array((3.0, -2.0, 1.0))
    other = scene.solve(base_ecef_m=scene.base_ecef_m + shift)
    assert positions(other) == pytest.approx(positions(plain) + shift, abs=2e-3)


# --- what must never break it ---

EXTREME = st.sampled_from([np.nan, np.inf, -np.inf, 0.0, -0.0, 1e300, -1e300, 1e-300, 1e9, -1e9, 2.5e7, 1.0])
FLOATS = [name for name, dtype, _ in COLUMNS if dtype is np.float64]


@st.composite
def damages(draw: st.DrawFn) -> list[tuple[int, str, str, float, int]]:
    """Return damages: epoch, side, column, value, and every how many rows (1: all)."""
    one = st.tuples(st.integers(0, 7), st.sampled_from(["rover", "base"]), st.sampled_from(FLOATS), EXTREME, st.sampled_from([1, 2, 5, 30]))
    return draw(st.lists(one, min_size=1, max_size=8))


def consistent(solution: Solution) -> None:
    """A solution that claims a position has finite numbers and positive covariances."""
    if solution.status is Status.NONE:
        return
    assert np.isfinite(solution.position_ecef_m).all()
    assert np.isfinite(solution.position_cov_ecef_m2).all()
    assert np.linalg.eigvalsh(solution.position_cov_ecef_m2)[0] > 0.0
    if solution.status in (Status.FIX, Status.FLOAT):
        assert np.isfinite(solution.baseline_ecef_m).all()
        assert np.isfinite(solution.velocity_ecef_mps).all()
        assert np.linalg.eigvalsh(solution.baseline_cov_ecef_m2)[0] > 0.0
        assert np.linalg.eigvalsh(solution.velocity_cov_ecef_m2ps2)[0] > 0.0


@settings(max_examples=40)
@given(damages=damages())
def test_extreme_values_never_raise_and_never_become_numbers(scene: Scene, damages: list[tuple[int, str, str, float, int]]):
    """Any column with NaN, infinities, zeros or absurd values, in any rows of rover and base: no exception, no NaN in what claims to
    be a position; six whole epochs later it is right again wherever it says that it is fixed.
    """
    sides = {"rover": list(scene.rover), "base": list(scene.base)}
    for k, side, name, value, step in damages:
        column = getattr(sides[side][k], name).copy()
        column[::step] = value
        sides[side][k] = replace(sides[side][k], **{name: column})
    solutions = scene.solve(sides["rover"], sides["base"])
    for solution in solutions:
        consistent(solution)
    if solutions[-1].status is Status.FIX:
        assert np.linalg.norm(solutions[-1].position_ecef_m - scene.truth[-1]) < RIGHT_M


@settings(max_examples=20)
@given(data=st.data())
def test_flags_and_channels_of_any_value_never_raise(scene: Scene, data: st.DataObject):
    """All 256 flags and all channels, in any epoch of the rover."""
    rover = list(scene.rover)
    for k in data.draw(st.sets(st.integers(0, EPOCHS - 1), min_size=1, max_size=4)):
        size, seed = len(rover[k]), data.draw(st.integers(0, 2**31))
        rng = np.random.default_rng(seed)
        flags, channels = rng.integers(0, 256, size).astype(np.uint8), rng.integers(-128, 128, size).astype(np.int8)
        rover[k] = replace(rover[k], flags=flags, channel=channels)
    for solution in scene.solve(rover):
        consistent(solution)


def test_thousands_of_updates_keep_covariances_positive():
    """Five minutes at 10 Hz with the few satellites above 30 degrees: no reset, no covariance that is not positive definite.

    `benchmarks/endurance.py` does the same a million times.
    """
    options = RtkOptions(frequencies=1, systems="G", elevation_mask_rad=radians(30.0))
    rover = Receiver("rover", AntennaPath(SITE, driving, (0.0, 0.0, -1.5)), 6, replace(F9P, systems="G", frequencies=1))
    base = Receiver("base", AntennaPath(SITE, None, BASE_ENU_M), 6, replace(SURVEY, steered=True))
    table = EphemerisTable()
    for satellite in SATELLITES.tolist():
        table.add(broadcast(satellite, START))
    engine, solutions = Rtk(options), 0
    for k in range(3000):
        time = START + 0.1 * k
        seen, other = rover.observe(time), base.observe(time)
        solution = engine.step(seen.epoch, other.epoch, table, KLOBUCHAR, base_position_ecef_m=other.position_ecef_m)
        consistent(solution)
        solutions += solution.status in (Status.FIX, Status.FLOAT)
    assert solution.resets == 0
    assert solutions > 2900
