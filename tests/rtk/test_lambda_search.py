"""Integer least squares against exhaustive search and its invariances."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtkmesh.rtk.lambda_search import NODE_LIMIT, NOT_POSITIVE_DEFINITE, OK, bootstrap_success, integer_least_squares, rounding_success


def solve(a, Q, candidates=2, node_limit=200_000):
    fixed, norms, D = np.zeros((candidates, len(a))), np.zeros(candidates), np.zeros(len(a))
    status = integer_least_squares(a, Q.copy(), node_limit, fixed, norms, D)
    return status, fixed, norms, D


def covariance(rng, n, weak_cyc):
    """Ambiguities that a few poorly known coordinates correlate, as a short session gives them."""
    H = rng.normal(size=(n, min(n, 3)))
    return H @ H.T * weak_cyc**2 + np.diag(rng.uniform(0.5e-3, 2e-3, n)) + 1e-3


def exhaustive(a, Q, reach):
    inverse = np.linalg.inv(Q)
    grids = [range(int(np.rint(v)) - reach, int(np.rint(v)) + reach + 1) for v in a]
    every = np.array(list(product(*grids)), dtype=float)
    d = every - a
    norms = np.einsum("ki,ij,kj->k", d, inverse, d)
    order = np.argsort(norms)[:2]
    return every[order], norms[order]


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 3))
def test_equals_exhaustive_search(seed, n):
    """The two best candidates are those that trying everything within reach finds."""
    rng = np.random.default_rng(seed)
    Q = covariance(rng, n, 0.6)
    a = rng.integers(-5, 6, n) + rng.multivariate_normal(np.zeros(n), Q)
    status, fixed, norms, _ = solve(a, Q)
    expected, expected_norms = exhaustive(a, Q, 7)
    assert status == OK
    assert norms == pytest.approx(expected_norms, rel=1e-8)
    assert np.array_equal(fixed, expected)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(2, 25))
def test_finds_the_truth_and_is_equivariant(seed, n):
    """Honest floats of a strong model give the true integers; shifting and permuting the input does the same to the result."""
    rng = np.random.default_rng(seed)
    Q = covariance(rng, n, 5.0) if n > 3 else np.eye(n) * 1e-3
    truth = rng.integers(-1_000_000, 1_000_000, n).astype(float)
    a = truth + rng.multivariate_normal(np.zeros(n), Q * 0.05)
    status, fixed, norms, D = solve(a, Q)
    if bootstrap_success(D, 0) > 0.999:
        assert np.array_equal(fixed[0], truth)
    shift, order = rng.integers(-50, 50, n).astype(float), rng.permutation(n)
    _, moved, moved_norms, _ = solve((a + shift)[order], Q[np.ix_(order, order)])
    assert status == OK
    assert np.array_equal(moved[0], (fixed[0] + shift)[order])
    assert moved_norms == pytest.approx(norms, rel=1e-6)


def test_more_candidates_are_sorted_and_distinct():
    rng = np.random.default_rng(3)
    Q = covariance(rng, 6, 1.0)
    status, fixed, norms, _ = solve(rng.normal(size=6), Q, candidates=12)
    assert status == OK
    assert np.all(np.diff(norms) >= 0.0)
    assert len({tuple(row) for row in fixed}) == 12


def test_refuses_what_is_no_covariance_and_stops_at_the_node_limit():
    """An indefinite matrix and a search that is too long are statuses, not results."""
    assert solve(np.zeros(2), np.array([[1.0, 2.0], [2.0, 1.0]]))[0] == NOT_POSITIVE_DEFINITE
    assert solve(np.array([np.nan, 0.0]), np.full((2, 2), np.nan))[0] == NOT_POSITIVE_DEFINITE
    rng = np.random.default_rng(0)
    n = 40
    H = rng.normal(size=(n, 3))
    assert solve(rng.normal(size=n) * 100.0, H @ H.T * 400.0 + np.eye(n) * 1e-3, node_limit=500)[0] == NODE_LIMIT


def test_success_rates():
    """Rounding within half a cycle at one sigma of a quarter cycle is the two-sigma probability."""
    assert rounding_success(0.25**2) == pytest.approx(0.9544997, abs=1e-6)
    assert bootstrap_success(np.array([0.25**2, 0.25**2, 1e-9]), 1) == pytest.approx(0.9544997, abs=1e-6)
