"""The candidates of an epoch: of a real engine over simulated receivers of the boat, held against what the engine itself makes of them."""

from functools import cache

import numpy as np
import pytest

from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.rtk.candidates import KEPT, CandidateTable
from rtkmesh.rtk.engine import Rtk
from rtkmesh.rtk.length_search import enough
from rtkmesh.rtk.options import AmbiguityMode, AmbiguityOptions, Mode, RtkOptions
from rtkmesh.rtk.solution import Solution, Status
from rtkmesh.simulation.scenario import open_stream, truth
from rtkmesh.simulation.sky import KLOBUCHAR, SATELLITES, broadcast

START = GpsTime(2445, 7200.0)
LENGTH_M = 2.0
Solved = tuple[Solution, CandidateTable | None]


def options(length_m: float | None, mode: AmbiguityMode = AmbiguityMode.CONTINUOUS, systems: str = "GE") -> RtkOptions:
    return RtkOptions(
        mode=Mode.MOVING_BASE, frequencies=1, systems=systems, baseline_length_m=length_m, ambiguity=AmbiguityOptions(mode=mode)
    )


@cache
def solved(
    length_m: float | None, mode: AmbiguityMode = AmbiguityMode.CONTINUOUS, systems: str = "GE", told: tuple[float, float] | None = None
) -> list[Solved]:
    issues, engine = EphemerisTable(), Rtk(options(length_m, mode, systems))
    for satellite in SATELLITES.tolist():
        issues.add(broadcast(satellite, START))
    base, rover = (open_stream("boat", name, seed=5, rate_hz=1.0, start=START).receiver() for name in ("rover", "heading"))
    out: list[Solved] = []
    assert engine.candidates() is None
    for k in range(4 if mode is AmbiguityMode.CONTINUOUS else 1):
        solution = engine.step(rover.observe(START + float(k)).epoch, base.observe(START + float(k)).epoch, issues, KLOBUCHAR)
        out.append((solution, engine.candidates(told)))
    return out


@pytest.mark.parametrize("length_m", [None, LENGTH_M])
def test_the_best_candidate_is_the_engine_s_own_fix(length_m: float | None) -> None:
    fixed = [(s, c) for s, c in solved(length_m) if s.status is Status.FIX and s.ambiguities_fixed]
    assert fixed
    for solution, found in fixed:
        assert found is not None
        if found.count == solution.ambiguities_fixed:
            # an epoch without a past: its phases are taken for better than the filter takes them, so its codes count for less
            first = solution is solved(length_m)[0][0]
            assert np.allclose(found.baselines_ecef_m[0], solution.baseline_ecef_m, atol=1e-4 if first else 1e-6)
            # that of the candidates is the filter's, which knows of no integers and is larger; where it is large is the same
            told, published = np.trace(found.cov_ecef_m2), np.trace(solution.baseline_cov_ecef_m2)
            assert told > published
            assert np.allclose(found.cov_ecef_m2 / told, solution.baseline_cov_ecef_m2 / published, atol=0.1)


def test_candidates_are_different_and_the_true_one_is_among_them() -> None:
    tell = truth("boat", seed=5)
    for k, (_, found) in enumerate(solved(LENGTH_M)):
        assert found is not None
        assert 2 <= len(found.norms) <= KEPT
        assert len(np.unique(found.integers, axis=0)) == len(found.norms)
        assert found.integers.shape[1] == len(found.satellite) > found.count
        at = tell(START + float(k)).antennas_ecef_m
        assert np.linalg.norm(found.baselines_ecef_m - (at["heading"] - at["rover"]), axis=1).min() < 0.05


def test_without_a_length_they_come_by_their_norm_and_nothing_nearer_is_left_out() -> None:
    for _, found in solved(None):
        assert found is not None
        assert np.all(np.diff(found.norms) >= 0.0)
        assert found.beyond >= min(found.norms[-1], enough(found.norms[0], found.count)) - 1e-9


def off_m(table: CandidateTable | None) -> float:
    """Return by how much candidates are not as long as the baseline, on average."""
    assert table is not None
    return float(np.abs(np.linalg.norm(table.baselines_ecef_m, axis=1) - LENGTH_M).mean())


def test_a_known_length_brings_up_what_has_it_whoever_knows_it() -> None:
    """The engine's options, or who asks; where the model is strong (all systems here) what is not kept cannot be right anyway."""
    free, known, asked = (
        solved(length_m, AmbiguityMode.INSTANTANEOUS, "G", told)[0][1]
        for length_m, told in ((None, None), (2.0, None), (None, (2.0, 0.01)))
    )
    assert max(off_m(known), off_m(asked)) < 0.5 * off_m(free)
    assert known is not None
    assert asked is not None
    assert np.array_equal(known.integers, asked.integers)
    strong = solved(LENGTH_M, AmbiguityMode.INSTANTANEOUS, "GREC")[0][1]
    assert off_m(strong) > 0.5 * off_m(free)


def certainty(rate_hz: float) -> tuple[float, float]:
    """Return the sigma (m, 3D) that candidates have after two seconds of GPS alone, and the least one of floats (cycles)."""
    issues, engine = EphemerisTable(), Rtk(options(None, systems="G"))
    for satellite in SATELLITES.tolist():
        issues.add(broadcast(satellite, START))
    base, rover = (open_stream("boat", name, seed=5, rate_hz=rate_hz, start=START).receiver() for name in ("rover", "heading"))
    for k in range(int(2.0 * rate_hz) + 1):
        time = START + k / rate_hz
        engine.step(rover.observe(time).epoch, base.observe(time).epoch, issues, KLOBUCHAR)
    found, state = engine.candidates(), engine._state
    assert found is not None
    assert state is not None
    n = len(state.filter.keys)
    differences = np.eye(n)[1:] - np.eye(n)[0]
    floats = differences @ state.filter.P[-n:, -n:] @ differences.T
    return float(np.sqrt(np.trace(found.cov_ecef_m2))), float(np.sqrt(np.linalg.eigvalsh(floats)[0]))


@pytest.mark.parametrize("rate_hz", [5.0, 10.0])
def test_candidates_are_placed_by_phases_that_count_in_full(rate_hz: float) -> None:
    """All epochs of a second say of ambiguities what one does; where these put the rover an epoch knows by itself."""
    (placed_m, known_cyc), (placed_1hz_m, known_1hz_cyc) = certainty(rate_hz), certainty(1.0)
    assert placed_m < 1.2 * placed_1hz_m
    assert known_cyc > 0.8 * known_1hz_cyc


def test_an_epoch_without_a_base_has_none() -> None:
    engine = Rtk(options(None))
    rover = open_stream("boat", "heading", seed=5, rate_hz=1.0, start=START).receiver()
    engine.step(rover.observe(START).epoch, None, EphemerisTable(), KLOBUCHAR)
    assert engine.candidates() is None
