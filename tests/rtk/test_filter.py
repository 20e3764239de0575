"""The filter's kernels against dense linear algebra."""

import numpy as np
import pytest

from rtkmesh.rtk.filter import (
    AT_AMBIGUITY,
    AT_SLOPE,
    GROUP,
    H_X,
    NOT_POSITIVE_DEFINITE,
    OBSERVATION,
    OK,
    PLACES,
    W,
    Y,
    factor,
    merge_keys,
    normal_equations,
    posterior,
    posterior_of,
    predict_motion,
    rearrange,
    reset_state,
    residuals,
)

DYNAMIC = 9


def random_case(rng, pairs=8, groups=2):
    """Codes and phases of some pairs in two clock groups each, with a prior that knows little of the ambiguities."""
    n, keyed = DYNAMIC + 1 + pairs, 1 + pairs
    A = rng.normal(size=(n, n)) * 0.3
    P = A @ A.T + np.diag(np.r_[np.ones(9) * 4.0, 1e-3, np.full(pairs, 1e4)])
    observations, places = np.zeros((2 * pairs, OBSERVATION)), np.full((2 * pairs, PLACES), -1, np.int64)
    for row in range(2 * pairs):
        k, phase = row % pairs, row >= pairs
        direction = rng.normal(size=3)
        observations[row, H_X : H_X + 3] = direction / np.linalg.norm(direction)
        observations[row, H_X + 3 :] = rng.uniform(0.1, 2.0, OBSERVATION - H_X - 3)
        observations[row, Y], observations[row, W] = rng.normal(), 1e4 if phase else 1.0
        places[row, GROUP] = k % groups + (groups if phase else 0)
        if phase:
            places[row, AT_AMBIGUITY], places[row, AT_SLOPE] = 1 + k, 0
    assert keyed == n - DYNAMIC
    return P, observations, places, 2 * groups


def dense(observations, places, n, groups):
    """Design matrix with explicit clocks, observations and weights."""
    H = np.zeros((len(observations), n + groups))
    for k, row in enumerate(observations):
        H[k, :3] = row[H_X : H_X + 3]
        for i in range(4):
            if places[k, 1 + i] >= 0:
                H[k, DYNAMIC + places[k, 1 + i]] = row[H_X + 3 + i]
        H[k, n + places[k, GROUP]] = 1.0
    return H, observations[:, Y], np.clip(observations[:, W], 0.0, None)


def adjust(P, observations, places, groups):
    n = len(P)
    N, b, mean, P_new, dx = np.empty((n, n)), np.empty(n), np.empty((groups, n + 2)), np.empty((n, n)), np.empty(n)
    normal_equations(observations, places, DYNAMIC, groups, N, b, mean)
    return posterior(P, N, b, P_new, dx), N, mean, P_new, dx


def test_update_equals_dense_update_with_explicit_clocks():
    """Eliminating the group clocks is the same as estimating them with no prior knowledge."""
    rng = np.random.default_rng(1)
    P, observations, places, groups = random_case(rng)
    n = len(P)
    status, _, _, P_new, dx = adjust(P, observations, places, groups)
    H, y, w = dense(observations, places, n, groups)
    information = np.zeros((n + groups, n + groups))
    information[:n, :n] = np.linalg.inv(P)
    full = np.linalg.inv(information + H.T * w @ H)
    assert status == OK
    sigma = np.sqrt(np.diag(P_new))
    assert np.abs(P_new - full[:n, :n]).max() < 1e-6 * sigma.max() ** 2
    assert P_new / np.outer(sigma, sigma) == pytest.approx(full[:n, :n] / np.outer(sigma, sigma), abs=1e-6)
    assert dx == pytest.approx((full @ (H.T * w @ y))[:n], rel=1e-5, abs=1e-7)


def test_residuals_and_their_variances():
    """Residuals and variances are those of the dense adjustment; an observation put aside is judged by its prediction."""
    rng = np.random.default_rng(2)
    P, observations, places, groups = random_case(rng)
    observations[3, W] *= -1.0
    n = len(P)
    _, _, mean, P_new, dx = adjust(P, observations, places, groups)
    value, variance = np.empty(len(observations)), np.empty(len(observations))
    residuals(observations, places, DYNAMIC, mean, P_new, dx, False, value, variance)
    H, y, w = dense(observations, places, n, groups)
    information = np.zeros((n + groups, n + groups))
    information[:n, :n] = np.linalg.inv(P)
    full = np.linalg.inv(information + H.T * w @ H)
    expected = y - H @ (full @ (H.T * w @ y))
    fitted = np.einsum("ki,ij,kj->k", H, full, H)
    used = w > 0.0
    assert value == pytest.approx(expected, rel=1e-5, abs=1e-6)
    assert variance[used] == pytest.approx((1.0 / w[used]) - fitted[used], rel=1e-3, abs=1e-7)
    assert variance[3] == pytest.approx(1.0 / abs(observations[3, W]) + fitted[3], rel=1e-4)


def test_a_matrix_that_is_not_positive_definite_is_a_status():
    P = np.eye(4)
    P[0, 0] = -1.0
    assert posterior(P, np.zeros((4, 4)), np.zeros(4), np.empty((4, 4)), np.empty(4)) == NOT_POSITIVE_DEFINITE


@pytest.mark.parametrize("decay_s", [0.5, 5.0, 1e9])
def test_motion_equals_the_transition_matrix(decay_s):
    """Prediction is F P F' + Q, cross covariances with the other states included; half steps compose to whole ones."""
    rng = np.random.default_rng(4)
    n, dt = 12, 0.8
    A = rng.normal(size=(n, n))
    P, x = A @ A.T, rng.normal(size=n)
    a = np.exp(-dt / decay_s)
    v = decay_s * (1.0 - a) if decay_s < 1e6 else dt
    p = decay_s * (dt - v) if decay_s < 1e6 else dt * dt / 2.0
    F = np.eye(n)
    for i in range(3):
        F[i, 3 + i], F[i, 6 + i], F[3 + i, 6 + i], F[6 + i, 6 + i] = dt, p, v, a
    expected, moved = F @ P @ F.T, F @ x
    x1, P1 = x.copy(), P.copy()
    predict_motion(x1, P1, dt, decay_s, np.zeros((3, 3)))
    x2, P2 = x.copy(), P.copy()
    for _ in range(2):
        predict_motion(x2, P2, dt / 2.0, decay_s, np.zeros((3, 3)))
    assert x1 == pytest.approx(moved, rel=1e-9)
    assert pytest.approx(expected, rel=1e-9, abs=1e-12) == P1
    assert pytest.approx(P1, rel=1e-6, abs=1e-9) == P2


def test_keys_are_merged_and_states_follow_them():
    """Old keys that are kept, and new ones, end in rising order; a state keeps its value and covariances."""
    keys, source = merge_keys(np.array([2, 5, 9]), np.array([True, False, True]), np.array([1, 5, 9, 11]))
    assert keys.tolist() == [1, 2, 5, 9, 11]
    assert source.tolist() == [-1, 0, 1, 2, -1]
    x, P = np.arange(4.0), np.arange(16.0).reshape(4, 4)
    x_new, P_new = rearrange(x, P, source, 1)
    assert x_new.tolist() == [0.0, 0.0, 1.0, 2.0, 3.0, 0.0]
    assert P_new[2, 4] == P[1, 3]
    assert P_new[1].tolist() == [0.0] * 6


def test_covariance_stays_positive_definite_over_a_long_run():
    """After thousands of updates with fresh and forgotten ambiguities the smallest eigenvalue is still positive."""
    rng = np.random.default_rng(5)
    P, observations, places, groups = random_case(rng)
    Q = np.eye(3) * 9.0
    x = np.zeros(len(P))
    for k in range(2000):
        predict_motion(x, P, 0.2, 5.0, Q)
        P[np.arange(9, len(P)), np.arange(9, len(P))] += 1e-6
        if k % 50 == 0:
            reset_state(x, P, 10 + k // 50 % 8, 0.0, 1e4)
        observations[:, H_X : H_X + 3] += rng.normal(size=(len(observations), 3)) * 1e-3
        status, _, _, P_new, _ = adjust(P, observations, places, groups)
        assert status == OK
        P = P_new
    assert np.array_equal(P, P.T)
    assert np.linalg.eigvalsh(P)[0] > 0.0


def test_one_factor_of_the_prior_serves_several_adjustments():
    """Weights change between the adjustments of an update, the prior does not: its factor, copied, gives the same bits as a new one."""
    P, observations, places, groups = random_case(np.random.default_rng(7))
    n, U = len(P), np.empty(P.shape)
    assert factor(P, U) == OK
    for weight in (1.0, 0.3, 0.0):
        observations[:4, W] = weight
        status, N, mean, P_new, dx = adjust(P, observations, places, groups)
        b, mean, P_again, dx_again = np.empty(n), np.empty((groups, n + 2)), np.empty((n, n)), np.empty(n)
        normal_equations(observations, places, DYNAMIC, groups, N, b, mean)
        assert posterior_of(U.copy(), N, b, P_again, dx_again) == status == OK
        assert np.array_equal(P_new, P_again)
        assert np.array_equal(dx, dx_again)
