"""One antenna without a right candidate: the choice of the others, and no choice where that would be a guess."""

from dataclasses import replace

import numpy as np
import pytest

from rtkmesh.attitude.candidates import Candidates
from rtkmesh.attitude.rigid_body import Layout
from rtkmesh.attitude.rotation import rotation_of
from rtkmesh.attitude.search import FAILURE_RATE, Verdict, choose
from rtkmesh.attitude.without_one import choose_without_one

PLACES = np.array([[-1.0, -0.6, -2.0], [1.0, -0.6, -2.0], [-1.0, 0.6, -2.0], [1.0, 0.6, -2.0]])
BOAT = Layout(("a", "b", "c", "d"), PLACES)
STAR = ((0, 1), (0, 2), (0, 3))
ALL = (*STAR, (1, 2), (1, 3), (2, 3))


def tables(seed: int, pairs: tuple[tuple[int, int], ...], bad: int | None = None) -> list[Candidates]:
    """Return candidates, the first of each right; those of baselines that end at ``bad`` are all a decimetre and more off."""
    rng = np.random.default_rng(seed)
    rotation, out = rotation_of(rng.normal(0.0, 1.0, 3)), list[Candidates]()
    for start, end in pairs:
        right = rotation @ (PLACES[end] - PLACES[start])
        others = right + rng.choice((-1.0, 1.0), (9, 3)) * rng.uniform(0.3, 2.0, (9, 3))
        values = np.vstack([right, others])
        if bad in (start, end):
            values[0] += (0.2, -0.3, 0.4)
        norms = np.concatenate(([6.0], rng.uniform(20.0, 60.0, 9)))
        out.append(Candidates(start, end, values, 0.005**2 * np.diag([1.0, 1.0, 4.0]), norms, 8, 80.0))
    return out


@pytest.mark.parametrize("bad", [1, 2, 3])
@pytest.mark.parametrize("seed", range(3))
def test_an_antenna_without_a_right_candidate_is_left_out(seed: int, bad: int) -> None:
    given = tables(seed, STAR, bad)
    whole = choose(BOAT, given)
    assert not whole.accepted
    rest = choose_without_one(BOAT, given, whole)
    assert rest is not None
    assert rest.antenna == bad
    assert rest.kept == tuple(i for i, pair in enumerate(STAR) if bad not in pair)
    assert set(rest.choice.chosen) == {0}
    assert rest.looks == 3  # without the antenna that all baselines share none is left
    assert rest.wrong_probability == pytest.approx(3.0 * rest.choice.wrong_probability)
    assert rest.wrong_probability <= FAILURE_RATE


@pytest.mark.parametrize("bad", range(4))
def test_with_all_pairs_any_antenna_may_be_the_one(bad: int) -> None:
    given = tables(1, ALL, bad)
    rest = choose_without_one(BOAT, given, choose(BOAT, given))
    assert rest is not None
    assert (rest.antenna, set(rest.choice.chosen)) == (bad, {0})


def test_two_bad_antennas_leave_nothing_that_is_believed() -> None:
    given = [tables(2, STAR, 1)[0], tables(2, STAR, 2)[1]]
    assert choose_without_one(BOAT, given, choose(BOAT, given)) is None
    assert choose_without_one(BOAT, given[:1], choose(BOAT, given[:1])) is None


def test_choices_that_contradict_each_other_are_none() -> None:
    """Without c the first baseline has one direction, without d another: which antenna is the bad one is not known."""
    one, other = np.eye(3), rotation_of(np.array([0.0, 0.0, 1.0]))
    turns = {(0, 1): (one, other), (0, 2): (other,), (0, 3): (one,)}
    given = [
        Candidates(s, e, np.array([turn @ (PLACES[e] - PLACES[s]) for turn in by]), 2.5e-5 * np.eye(3), np.full(len(by), 6.0), 8, 80.0)
        for (s, e), by in turns.items()
    ]
    whole = choose(BOAT, given)
    assert not whole.accepted
    assert all(choose(BOAT, [given[0], table]).accepted for table in given[1:])
    assert choose_without_one(BOAT, given, whole) is None


def test_what_only_lacks_ambiguities_is_not_tried_again() -> None:
    given = [replace(table, count=3) for table in tables(0, STAR, 1)]
    whole = choose(BOAT, given)
    assert whole.verdict is Verdict.FEW_AMBIGUITIES
    assert choose_without_one(BOAT, given, whole) is None
