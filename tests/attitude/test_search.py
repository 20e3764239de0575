"""Integers of several baselines together: all combinations by hand, invariants, closed forms, simulated truth, closure."""

import os
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, product
from math import log, radians

import numpy as np
import pytest

from rtkmesh.attitude.rigid_body import Layout, baselines, fit
from rtkmesh.attitude.rotation import rotation_of, rotation_of_angles, vector_of
from rtkmesh.attitude.search import Candidates, Expectation, Verdict, choose, closure, joint_covariance
from rtkmesh.gnss.signals import BEIDOU
from rtkmesh.models.odds import SURENESS, log_odds
from rtkmesh.simulation.scenario import SCENARIOS

PLACES = np.array([[-1.0, -0.6, -2.0], [1.0, -0.6, -2.0], [-1.0, 0.6, -2.0], [1.0, 0.6, -2.0]])
BOAT = Layout(("a", "b", "c", "d"), PLACES)
SIGMA_M = 0.005
STAR3, TRIANGLE, STAR4 = ((0, 1), (0, 2)), ((0, 1), (0, 2), (1, 2)), ((0, 1), (0, 2), (0, 3))


def drawn(seed: int, pairs: Sequence[tuple[int, int]], count: int, spread_m: float = 0.04) -> tuple[np.ndarray, list[Candidates]]:
    """Return a rotation and candidates of baselines, the first of each the right one but for noise; norms in any order."""
    rng = np.random.default_rng(seed)
    rotation = rotation_of(rng.normal(0.0, 1.0, 3))
    noise = rng.normal(0.0, SIGMA_M / np.sqrt(2.0), (4, 3))
    tables: list[Candidates] = []
    for start, end in pairs:
        right = rotation @ (PLACES[end] - PLACES[start]) + noise[end] - noise[start]
        others = right + rng.normal(0.0, spread_m, (count - 1, 3))
        norms = rng.permutation(np.sort(rng.uniform(2.0, 20.0, count)))
        tables.append(Candidates(start, end, np.vstack([right, others]), SIGMA_M**2 * np.diag([1.0, 1.0, 4.0]), norms, 8))
    return rotation, tables


def by_hand(tables: list[Candidates], share: float) -> list[tuple[float, tuple[int, ...]]]:
    """Return the costs of all combinations, least first."""
    found: list[tuple[float, tuple[int, ...]]] = []
    for combination in product(*(range(len(table.norms)) for table in tables)):
        values = np.array([table.baselines_ned_m[k] for table, k in zip(tables, combination, strict=True)])
        fitted = fit(BOAT, baselines(tuple((t.start, t.end) for t in tables), 4, values, joint_covariance(tables)))
        if fitted is not None:
            norms = sum(float(table.norms[k]) for table, k in zip(tables, combination, strict=True))
            found.append((share * norms + fitted.chi_square, combination))
    return sorted(found)


@pytest.mark.parametrize(("pairs", "count", "share"), [
    (((0, 1),), 12, 1.0), (((0, 1), (2, 3)), 5, 1.0), (STAR3, 6, 2.0 / 3.0), (TRIANGLE, 4, 2.0 / 3.0), (STAR4, 3, 0.5),
    (tuple(combinations(range(4), 2)), 2, 0.5), (((1, 0), (0, 2), (2, 1)), 4, 2.0 / 3.0),
])  # fmt: skip
@pytest.mark.parametrize("seed", range(3))
def test_branch_and_bound_finds_what_trying_all_combinations_finds(
    seed: int, pairs: tuple[tuple[int, int], ...], count: int, share: float
) -> None:
    _, tables = drawn(seed, pairs, count)
    choice, (best, second) = choose(BOAT, tables), by_hand(tables, share)[:2]
    assert (choice.chosen, choice.runner_up) == (best[1], second[1])
    assert (choice.cost, choice.other) == pytest.approx((best[0], second[0]), rel=1e-3)
    independent = len({a for pair in pairs for a in pair}) - 1 if len(pairs) > 1 and pairs[1] != (2, 3) else len(pairs)
    assert choice.log_odds == pytest.approx(log_odds(choice.cost, choice.other, 8 * independent))


@pytest.mark.parametrize("seed", range(2))
def test_order_and_direction_of_the_baselines_do_not_matter(seed: int) -> None:
    _, tables = drawn(seed, STAR4, 8)
    choice, turned = choose(BOAT, tables), choose(BOAT, tables[::-1])
    assert turned.chosen == choice.chosen[::-1]
    assert turned.log_odds == pytest.approx(choice.log_odds, rel=1e-3)
    t = tables[1]
    reversed_ = [tables[0], Candidates(t.end, t.start, -t.baselines_ned_m, t.cov_ned_m2, t.norms, t.count), tables[2]]
    assert choose(BOAT, reversed_).chosen == choice.chosen


def test_the_length_alone_decides_for_one_baseline() -> None:
    """In closed form: of two equal norms, the misfit of the length in sigmas is the cost."""
    values = np.array([[2.0, 0.0, 0.0], [0.0, 2.03, 0.0]])
    table = Candidates(0, 1, values, SIGMA_M**2 * np.eye(3), np.array([6.0, 6.0]), 8)
    choice = choose(BOAT, [table])
    assert choice.chosen == (0,)
    assert (choice.cost, choice.other) == pytest.approx((6.0, 6.0 + (0.03 / SIGMA_M) ** 2))


def test_the_rotation_is_the_true_one_and_costs_nothing_it_should_not() -> None:
    rotation, tables = drawn(1, STAR4, 10, spread_m=0.4)
    choice = choose(BOAT, tables)
    assert choice.chosen == (0, 0, 0)
    assert choice.fit is not None
    off = vector_of(rotation @ choice.fit.ned_from_body.T)
    assert float(off @ np.linalg.solve(choice.fit.cov, off)) < 16.3  # chi-square of 3 at 0.1 %


def test_a_tilted_candidate_is_out_of_the_window_and_an_expected_heading_decides() -> None:
    level, steep = np.array([2.0, 0.0, 0.0]), np.array([2.0 * np.cos(0.5), 0.0, -2.0 * np.sin(0.5)])
    table = Candidates(0, 1, np.array([steep, level, -level]), SIGMA_M**2 * np.eye(3), np.array([2.0, 3.0, 2.5]), 8)
    assert choose(BOAT, [table]).chosen == (0,)
    assert choose(BOAT, [table], Expectation(tilt_rad=radians(15.0))).chosen == (2,)
    expected = Expectation(radians(15.0), rotation_of_angles(0.1, 0.0, 0.0), 0.05 * np.eye(3))
    choice = choose(BOAT, [table], expected)
    assert choice.chosen == (1,)
    assert choice.cost == pytest.approx(3.0 + 0.1**2 / 0.05, rel=1e-2)


def test_what_is_not_in_a_table_limits_how_sure_a_choice_is() -> None:
    """A runner-up that nothing else comes near does not make sure: what was not searched may be the right one."""
    table = Candidates(0, 1, np.array([[2.0, 0.0, 0.0], [0.0, 9.0, 0.0]]), SIGMA_M**2 * np.eye(3), np.array([6.0, 7.0]), 8, beyond=9.0)
    choice = choose(BOAT, [table])
    assert (choice.verdict, choice.other) == (Verdict.NOT_SURE, pytest.approx(9.0))


def test_the_failure_rate_decides() -> None:
    _, tables = drawn(2, STAR4, 8)
    choice = choose(BOAT, tables)
    assert choice.wrong_probability == pytest.approx(np.exp(-choice.log_odds / SURENESS))
    for rate, accepted in ((choice.wrong_probability * 1.01, True), (choice.wrong_probability * 0.99, False)):
        assert (choose(BOAT, tables, failure_rate=rate).verdict is Verdict.ACCEPTED) == accepted
    assert -SURENESS * log(choice.wrong_probability) == pytest.approx(choice.log_odds)


@pytest.mark.parametrize(("tables", "verdict"), [
    ([], Verdict.NO_CANDIDATES),
    ([Candidates(0, 1, np.zeros((0, 3)), np.eye(3), np.zeros(0), 8)], Verdict.NO_CANDIDATES),
    ([Candidates(0, 1, np.array([[2.0, 0.0, 0.0]]), 1e-5 * np.eye(3), np.array([1.0]), 3)], Verdict.FEW_AMBIGUITIES),
    ([Candidates(0, 1, np.array([[2.4, 0.0, 0.0]]), 1e-5 * np.eye(3), np.array([1.0]), 8)], Verdict.GEOMETRY),
    ([Candidates(0, 1, np.array([[2.0, 0.0, 0.0]]), 1e-5 * np.eye(3), np.array([90.0]), 8)], Verdict.NORM),
])  # fmt: skip
def test_what_is_refused_and_why(tables: list[Candidates], verdict: Verdict) -> None:
    assert choose(BOAT, tables).verdict is verdict


def test_a_layout_that_is_known_badly_forgives_a_wrong_length() -> None:
    table = Candidates(0, 1, np.array([[2.05, 0.0, 0.0], [2.5, 0.0, 0.0]]), 1e-6 * np.eye(3), np.array([1.0, 1.0]), 8)
    assert choose(BOAT, [table]).verdict is Verdict.GEOMETRY
    assert choose(Layout(BOAT.names, PLACES, 0.02**2 * np.eye(12)), [table]).accepted


def closed(shift: int = 0) -> list[Candidates]:
    """Return a triangle of exact baselines whose integers close, but for ``shift`` in one of them."""
    rng = np.random.default_rng(3)
    satellite, one = np.array([1, 5, 9, 70, 71], np.int16), np.full(5, 2, np.int16)
    first, second = rng.integers(-50, 50, (2, 5))
    third = first + second + 7  # any offset of a group: only differences mean something
    third[1] += shift
    sides = [PLACES[1] - PLACES[0], PLACES[2] - PLACES[1], PLACES[2] - PLACES[0]]
    return [
        Candidates(a, b, side[None], 1e-5 * np.eye(3), np.array([4.0]), 4, 100.0, satellite, one, one, values[None])
        for (a, b), side, values in zip(((0, 1), (1, 2), (0, 2)), sides, (first, second, third), strict=True)
    ]


def test_integers_around_a_triangle_add_up_to_zero() -> None:
    assert closure(closed(), (0, 0, 0)) == (0, 3)  # five satellites of two systems
    assert choose(BOAT, closed()).accepted


def test_a_wrong_integer_that_fits_everything_else_is_caught_by_closure() -> None:
    choice = choose(BOAT, closed(shift=1))
    assert (choice.verdict, choice.open_triangles, choice.triangle_sums) == (Verdict.CLOSURE, 1, 3)


def test_signals_that_do_not_match_have_no_closure() -> None:
    tables = closed(shift=1)
    t = tables[1]
    tables[1] = Candidates(
        t.start, t.end, t.baselines_ned_m, t.cov_ned_m2, t.norms, t.count, t.beyond, t.satellite, t.signal, t.base_signal + 1, t.integers
    )
    assert closure(tables, (0, 0, 0)) == (0, 0)


def test_the_boat_of_the_scenarios_is_the_one_of_these_tests() -> None:
    offsets = [SCENARIOS["boat"].antennas[name].offset_m for name in ("rover", "heading", "starboard", "bow")]
    assert np.array_equal(np.array(offsets), PLACES)


@pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="a hundred thousand combinations take long without JIT")
def test_what_would_take_too_long_is_not_sure() -> None:
    """Six baselines whose forty candidates all have about the right length, none the right direction: the search ends, and says nothing."""
    rng, tables = np.random.default_rng(1), list[Candidates]()
    for start, end in combinations(range(4), 2):
        right = PLACES[end] - PLACES[start]
        drawn_m = right + rng.normal(0.0, 0.2, (40, 3))
        lengths = np.linalg.norm(right) * (1.0 + rng.normal(0.0, 0.003, (40, 1)))
        vectors = lengths * drawn_m / np.linalg.norm(drawn_m, axis=1)[:, None]
        tables.append(Candidates(start, end, vectors, 3.6e-5 * np.eye(3), 5.0 + rng.uniform(0.0, 3.0, 40), 7))
    choice = choose(BOAT, tables)
    assert not choice.accepted
    assert choice.other == choice.cost


def test_geostationary_satellites_of_beidou_close_among_themselves() -> None:
    """They have a clock of their own: what their integers are off by, all alike, is nothing."""
    tables = closed()
    numbers = np.array([BEIDOU * 64 + 6, BEIDOU * 64 + 7, BEIDOU * 64 + 8, BEIDOU * 64 + 1, BEIDOU * 64 + 3], np.int16)
    for shift, different in (([3, 3], 0), ([3, 4], 1)):
        integers = tables[2].integers + np.array([[0, 0, 0, *shift]])
        given = [replace(table, satellite=numbers, integers=table.integers) for table in tables[:2]]
        given.append(replace(tables[2], satellite=numbers, integers=integers))
        assert closure(given, (0, 0, 0)) == (different, 3)
