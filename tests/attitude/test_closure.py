"""Integers around triangles: they close whatever the receivers, references and directions, and a wrong one is found."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from rtkmesh.attitude.candidates import Candidates, known_baseline, pairs_of
from rtkmesh.attitude.closure import Closing, closing, closure, fixed_among, triangles

SATELLITES = np.array([3, 7, 9, 12, 20, 66, 70, 71], np.int16)  # of two systems
CODES = np.full(len(SATELLITES), 28, np.int16)
EDGES = list(combinations(range(4), 2))


def edges(seed: int, pairs: list[tuple[int, int]], rows: int = 3) -> list[Candidates]:
    """Return baselines of receivers with their integers, the right ones in row 0, the others off; each with its references."""
    rng = np.random.default_rng(seed)
    own, places = rng.integers(-1000, 1000, (4, len(SATELLITES))), rng.normal(0.0, 1.0, (4, 3))
    found: list[Candidates] = []
    for pair in pairs:
        start, end = pair if rng.random() < 0.5 else pair[::-1]
        seen = np.sort(rng.permutation(len(SATELLITES))[:7])
        integers = np.tile((own[end] - own[start])[seen], (rows, 1))
        integers[1:] += rng.integers(1, 5, (rows - 1, len(seen)))
        for system in (SATELLITES[seen] < 64, SATELLITES[seen] >= 64):
            reference = int(rng.choice(np.flatnonzero(system)))
            integers[:, system] -= integers[:, [reference]]
        vectors = places[end] - places[start] + 0.3 * np.arange(rows)[:, None]
        table = Candidates(
            start, end, vectors, 1e-5 * np.eye(3), np.arange(rows) + 2.0, 5, 60.0, SATELLITES[seen], CODES[seen], CODES[seen], integers
        )
        found.append(table)
    return found


def with_wrong(table: Candidates, column: int) -> Candidates:
    """Return it with one of its right integers wrong."""
    integers = table.integers.copy()
    integers[0, column] += 1
    return replace(table, integers=integers)


def told(tables: list[Candidates]) -> dict[int, Candidates]:
    found = {number: fixed_among(table, table.baselines_ned_m[0]) for number, table in enumerate(tables)}
    return {number: table for number, table in found.items() if table is not None}


@pytest.mark.parametrize("seed", range(8))
def test_right_integers_close_whatever_the_directions_and_references(seed: int) -> None:
    tables = edges(seed, EDGES)
    assert closure(tables, [0] * 6)[0] == 0
    assert closing(pairs_of(tables), told(tables)) == Closing(closed=4)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("wrong", range(6))
def test_one_wrong_baseline_of_four_antennas_is_named(seed: int, wrong: int) -> None:
    """Its two triangles are open, the two others close; where a satellite is not seen by others they may all close."""
    tables = edges(seed, EDGES)
    for column in range(7):
        bad = [with_wrong(table, column) if number == wrong else table for number, table in enumerate(tables)]
        found = closing(pairs_of(bad), told(bad))
        assert all(wrong in triangle for triangle in found.open)
        if len(found.open) == 2:
            assert (found.closed, found.wrong) == (2, wrong)
            break
    else:
        pytest.fail("no wrong integer was seen")


def test_one_triangle_cannot_say_which() -> None:
    tables = edges(1, [(0, 1), (1, 2), (0, 2)])
    for column in range(7):
        bad = [*tables[:2], with_wrong(tables[2], column)]
        found = closing(pairs_of(bad), told(bad))
        assert found.wrong is None
        if found.open:
            return
    pytest.fail("no wrong integer was seen")


def test_what_near_candidates_disagree_in_is_not_told() -> None:
    """A solver that fixed a part of its ambiguities: what it left open proves nothing."""
    [table] = edges(2, [(0, 1)])
    near = np.vstack([table.baselines_ned_m[0], table.baselines_ned_m[0] + 0.002, table.baselines_ned_m[2]])
    integers = np.vstack([table.integers[0], table.integers[0], table.integers[2]])
    integers[1, 4] += 1
    twin = Candidates(0, 1, near, table.cov_ned_m2, table.norms, 5, 60.0, table.satellite, table.signal, table.base_signal, integers)
    found = fixed_among(twin, near[0])
    assert found is not None
    assert found.satellite.tolist() == np.delete(table.satellite, 4).tolist()
    assert found.integers.tolist() == [np.delete(table.integers[0], 4).tolist()]
    assert fixed_among(twin, near[0] + 0.05) is None
    assert fixed_among(known_baseline(0, 1, near[0], table.cov_ned_m2), near[0]) is None


def test_triangles_are_named_by_their_sides() -> None:
    assert triangles(((0, 1), (0, 2), (0, 3))) == ()
    assert triangles(((1, 0), (0, 2), (2, 1), (0, 3))) == ((0, 2, 1),)
    assert len(triangles(tuple(EDGES))) == 4
