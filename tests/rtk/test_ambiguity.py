"""Double differences, conditioning on integers, comparison of integer sets, log odds."""

import numpy as np
import pytest

from rtkmesh.gnss.signals import KEYS_PER_SATELLITE, satellite_number
from rtkmesh.models.odds import log_odds
from rtkmesh.rtk.ambiguity import add_constraints, choose_references, compare_integers, condition, difference
from rtkmesh.rtk.filter import OK, posterior
from rtkmesh.rtk.memory import confidence

N = 9


def case(seed=0):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(N, N))
    return rng.normal(size=N), A @ A.T + np.eye(N), np.array([[4, 3], [5, 3], [7, 6]]), np.array([2.0, -1.0, 5.0])


def test_conditioning_is_the_gaussian_one():
    """Mean, covariance and norm given the integers are those of the textbook, for any slack."""
    x, P, pairs, integers = case()
    D = np.zeros((3, N))
    for k, (i, r) in enumerate(pairs):
        D[k, i], D[k, r] = 1.0, -1.0
    wanted = np.array([0, 1, 2, 8])
    for slack in (0.0, 0.3):
        Q = D @ P @ D.T + slack * np.eye(3)
        gain = P @ D.T @ np.linalg.inv(Q)
        mean, cov = x + gain @ (integers - D @ x), P - gain @ D @ P
        x_out, P_out = np.empty(4), np.empty((4, 4))
        norm = condition(x, P, pairs, integers, slack, wanted, x_out, P_out)
        d = integers - D @ x
        assert norm == pytest.approx(d @ np.linalg.inv(Q) @ d)
        assert x_out == pytest.approx(mean[wanted])
        assert P_out == pytest.approx(cov[np.ix_(wanted, wanted)])


def test_soft_constraints_equal_conditioning_with_slack():
    """Feeding integers to the normal equations is the same as conditioning on them with that variance."""
    x, P, pairs, integers = case(1)
    Nm, b, P_new, dx = np.zeros((N, N)), np.zeros(N), np.empty((N, N)), np.empty(N)
    add_constraints(pairs, x, integers, 0.3, Nm, b)
    assert posterior(P, Nm, b, P_new, dx) == OK
    x_out, P_out = np.empty(N), np.empty((N, N))
    condition(x, P, pairs, integers, 0.3, np.arange(N), x_out, P_out)
    assert x + dx == pytest.approx(x_out)
    assert P_new == pytest.approx(P_out)


def test_differences_and_references():
    """The heaviest of each group is its reference; a lone member gives no difference; ties go to the lower state."""
    out = np.empty((6, 2), np.int64)
    n = choose_references(np.array([10, 11, 12, 13, 14, 15]), np.array([0, 1, 0, 0, 1, 2]), np.array([1.0, 5.0, 3.0, 3.0, 2.0, 9.0]), out)
    assert out[:n].tolist() == [[10, 12], [13, 12], [14, 11]]
    x, P, pairs, _ = case(2)
    a, Q = np.empty(3), np.empty((3, 3))
    difference(x, P, pairs, a, Q)
    assert a[2] == x[7] - x[6]
    assert Q[0, 2] == pytest.approx(P[4, 7] - P[4, 6] - P[3, 7] + P[3, 6])


def test_integer_sets_are_compared_up_to_an_offset_per_group():
    """A common offset of a group changes nothing; one different integer is one difference; unknown values do not count."""
    keys = np.array([(1 + k) * KEYS_PER_SATELLITE + s for k in range(4) for s in (5, 900)])
    values = np.arange(8.0)
    shifted = values + np.where(keys % KEYS_PER_SATELLITE == 5, 100.0, -7.0)
    assert compare_integers(keys, values, keys, shifted) == (6, 0)
    shifted[5] += 1.0
    assert compare_integers(keys, values, keys, shifted) == (6, 1)
    shifted[5] = np.nan
    assert compare_integers(keys, values, keys, shifted) == (5, 0)
    assert compare_integers(keys[:3], values[:3], keys[3:], values[3:]) == (0, 0)


def test_geostationary_satellites_have_an_offset_of_their_own():
    """C01 and C02 are off by other integers than C19 to C21, as their clock group may be: nothing differs, nor is a difference hidden."""
    keys = np.array([satellite_number(name) * KEYS_PER_SATELLITE + 5 for name in ("C01", "C02", "C19", "C20", "C21")])
    values, offset = np.arange(5.0), np.array([3.0, 3.0, -8.0, -8.0, -8.0])
    assert compare_integers(keys, values, keys, values + offset) == (3, 0)
    offset[1] += 1.0
    assert compare_integers(keys, values, keys, values + offset) == (3, 1)


def test_log_odds_ask_more_of_few_ambiguities_and_of_bad_norms():
    assert log_odds(5.0, 15.0, 5) < 5.0 < log_odds(20.0, 60.0, 20)
    assert log_odds(10.0, 30.0, 10) > log_odds(100.0, 120.0, 10)
    assert log_odds(10.0, 10.0, 10) == 0.0
    assert confidence(3.0) == pytest.approx(1.0)
    assert confidence(2.0) < 1.0 < confidence(4.0)
