"""Integers of a baseline of known length, against all vectors of a box; and phases that are better than the filter has them."""

from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray

from rtkmesh.rtk.lambda_search import NODE_LIMIT, NOT_POSITIVE_DEFINITE, OK, integer_least_squares
from rtkmesh.rtk.length_search import FEWEST, Given, nearest_of_length
from rtkmesh.rtk.noise import new_code_scale
from rtkmesh.rtk.published import learn_fix
from rtkmesh.rtk.single_epoch import PRIOR, PRIOR_DOF, sharpness, with_sharper_phases
from rtkmesh.rtk.state import DYNAMIC, FIRST_PAIR_KEY, HISTORY, SLOPE_KEYS, Filter

Matrix = NDArray[np.float64]
BOX = 5
LENGTH_M = 1.0


def model(seed: int, n: int = 4) -> tuple[Matrix, Matrix, Given]:
    """Return float ambiguities, their covariance, and how a baseline of about the length follows from them."""
    rng = np.random.default_rng(seed)
    mix = rng.normal(size=(n, n))
    Q = 0.05 * mix @ mix.T + 0.02 * np.eye(n)
    gain = rng.normal(size=(3, n)) * 0.3
    direction = rng.normal(size=3)
    mean = LENGTH_M * direction / np.linalg.norm(direction) - gain @ np.zeros(n)
    root = rng.normal(size=(3, 3)) * 0.01
    return rng.uniform(-0.5, 0.5, n), Q, Given(mean, gain, root @ root.T + 1e-6 * np.eye(3), LENGTH_M, 0.01)


def all_totals(a: Matrix, Q: Matrix, given: Given) -> tuple[Matrix, Matrix, Matrix]:
    """Return all vectors of the box, their squared norms, and these with the misfit of the length."""
    vectors = np.array(list(product(range(-BOX, BOX + 1), repeat=len(a))), float)
    off = vectors - a
    norms = np.einsum("ki,ij,kj->k", off, np.linalg.inv(Q), off)
    places = given.mean_m + vectors @ given.gain.T
    lengths = np.linalg.norm(places, axis=1)
    along = places / lengths[:, None]
    misfits = (lengths - given.length_m) ** 2 / (given.sigma_m**2 + np.einsum("ki,ij,kj->k", along, given.cov_m2, along))
    return vectors, norms, norms + misfits


@pytest.mark.parametrize("seed", range(12))
def test_the_best_of_all_vectors_are_found_and_nothing_better_is_left_out(seed: int) -> None:
    a, Q, given = model(seed)
    fixed, norms, totals = np.zeros((20, 4)), np.zeros(20), np.zeros(20)
    status, beyond, success = nearest_of_length(a, Q, given, 50_000, fixed, norms, totals)
    assert status == OK
    assert 0.0 < success <= 1.0
    vectors, plain, both = all_totals(a, Q, given)
    order = np.argsort(both)
    better = int(np.sum(both < beyond - 1e-9))
    assert better >= 1
    found = int(np.sum(totals < beyond - 1e-9))
    assert found == better
    assert np.allclose(fixed[:found], vectors[order[:found]])
    assert np.allclose(totals[:found], both[order[:found]])
    assert np.allclose(norms[:found], plain[order[:found]])


@pytest.mark.parametrize("seed", range(4))
def test_without_a_length_it_is_integer_least_squares(seed: int) -> None:
    a, Q, given = model(seed, 6)
    free = given._replace(length_m=np.nan)
    fixed, norms, totals, expected, best, D = np.zeros((2, 6)), np.zeros(2), np.zeros(2), np.zeros((2, 6)), np.zeros(2), np.zeros(6)
    assert nearest_of_length(a, Q, free, 50_000, fixed, norms, totals)[0] == OK
    assert integer_least_squares(a, Q, 50_000, expected, best, D) == OK
    assert np.array_equal(fixed, expected)
    assert np.allclose(totals, best)
    assert np.array_equal(norms, totals)


def test_the_length_finds_what_is_far_down_the_list_of_norms() -> None:
    """One vector alone has the length: not among the nearest, and found."""
    a, Q = np.full(3, 0.1), np.eye(3) * 4.0
    true = np.array((2.0, -3.0, 1.0))
    gain = np.diag((0.19, 0.19, 0.19))
    given = Given(np.array((LENGTH_M, 0.0, 0.0)) - gain @ true, gain, np.eye(3) * 1e-8, LENGTH_M, 1e-5)
    fixed, norms, totals = np.zeros((2, 3)), np.zeros(2), np.zeros(2)
    assert nearest_of_length(a, Q, given, 50_000, fixed, norms, totals)[0] == OK
    assert np.array_equal(fixed[0], true)
    nearest = all_totals(a, Q, given)[1]
    assert np.sum(nearest < norms[0]) > 2 * FEWEST


def test_what_cannot_be_searched_is_said() -> None:
    a, Q, given = model(0)
    fixed, norms, totals = np.zeros((2, 4)), np.zeros(2), np.zeros(2)
    assert nearest_of_length(a, Q, given, 3, fixed, norms, totals)[0] == NODE_LIMIT
    assert nearest_of_length(a, -Q, given, 50_000, fixed, norms, totals)[0] == NOT_POSITIVE_DEFINITE


def one_epoch(factor: float) -> Filter:
    """Return the filter of an epoch whose phases (two of a sloped system, three others) have variances times ``factor``."""
    rng = np.random.default_rng(3)
    shared = rng.normal(size=(4, 4))
    shared = shared @ shared.T + np.eye(4)  # position and slope
    slope, phases = DYNAMIC, slice(DYNAMIC + 1, DYNAMIC + 6)
    H = rng.normal(size=(5, 4))
    n = DYNAMIC + 6
    P = np.eye(n)
    to = [0, 1, 2, slope]
    P[np.ix_(to, to)] = shared
    P[phases, to] = H @ shared
    P[to, phases] = (H @ shared).T
    P[phases, phases] = H @ shared @ H.T + factor * np.diag(rng.uniform(1e-4, 1e-3, 5))
    keys = np.concatenate((SLOPE_KEYS[:1], FIRST_PAIR_KEY + np.arange(5)))
    return Filter(rng.normal(size=n), P, keys.astype(np.int64), np.zeros((6, HISTORY)))


def test_sharper_phases_are_those_of_an_epoch_with_better_phases() -> None:
    worse, better = one_epoch(1.0), one_epoch(0.05)
    found = with_sharper_phases(worse, 0.05)
    assert np.allclose(found.P, better.P, rtol=1e-9, atol=1e-12)
    assert np.array_equal(found.x, worse.x)
    assert np.allclose(with_sharper_phases(worse, 1.0).P, worse.P, rtol=1e-9, atol=1e-12)


def test_phases_are_sharper_by_what_fixes_have_shown() -> None:
    scale = new_code_scale()
    assert sharpness(scale) == PRIOR
    learn_fix(scale, 0.05 * 90.0, 90.0)
    assert sharpness(scale) == pytest.approx((PRIOR * PRIOR_DOF + 4.5) / (PRIOR_DOF + 90.0))
    learn_fix(scale, 4.0 * 400.0, 400.0)
    assert sharpness(scale) == 1.0
