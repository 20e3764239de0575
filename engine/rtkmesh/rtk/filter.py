"""The filter of single differences: time update, measurement update, bookkeeping of its states.

State: baseline (m, ECEF), velocity and acceleration, then one state per *key*, in rising order of keys: 0 the zenith wet delay (m), a
satellite number its slant ionosphere at L1 (m), behind these the part by which all ionospheres exceed their model, then the slopes of
GLONASS phase biases over the channels on G1 and G2 (m), a pair's key its single-difference ambiguity (cycles). The receiver clock of each
group (system, signal pair; code and phase apart) is free in every epoch and is eliminated from the normal equations, so there is no
reference satellite, and the common part of a group's ambiguities is simply not known.

Measurement update: with P = U'U the posterior is U' (I + U N U')^-1 U, formed from triangular factors: symmetric and
positive definite by construction. All matrices are row-major and all inner loops run along rows.
"""

from math import sqrt
from typing import Final, cast

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place, scratch, scratch_indices, scratch_table

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]
Cube = NDArray[np.float64]

OK: Final = 0
NOT_POSITIVE_DEFINITE: Final = 1

# Columns of an observation. Y (m) is observed minus predicted; W is the inverse variance (1/m2, 0: not used); H_X to H_Z, H_ZENITH,
# H_IONOSPHERE, H_AMBIGUITY, H_SLOPE and H_EXCESS are the partial derivatives by the baseline, the zenith wet delay, the slant ionosphere,
# the ambiguity, the GLONASS slope and the excess of the ionosphere.
Y, W, H_X, H_Y, H_Z, H_ZENITH, H_IONOSPHERE, H_AMBIGUITY, H_SLOPE, H_EXCESS = range(10)
OBSERVATION: Final = 10
# Columns of its places: clock group, then where the states of these five are (-1: none).
GROUP, AT_ZENITH, AT_IONOSPHERE, AT_AMBIGUITY, AT_SLOPE, AT_EXCESS = range(6)
PLACES: Final = 6
SHARED: Final = 5  # states of an observation beside the position

_ZERO: Final = cast("int", np.int64(0))  # a literal as argument makes numba compile the callee once more


@kernel
def merge_keys(old: Indices, keep: NDArray[np.bool_], new: Indices) -> tuple[Indices, Indices]:
    """Return the sorted union of the kept old keys and the new keys (both sorted), and where in ``old`` each was (-1: nowhere)."""
    keys, source = np.empty(len(old) + len(new), np.int64), np.empty(len(old) + len(new), np.int64)
    i, j, n = 0, 0, 0
    while i < len(old) or j < len(new):
        if j == len(new) or (i < len(old) and old[i] < new[j]):
            if keep[i]:
                keys[n], source[n] = old[i], i
                n += 1
            i += 1
            continue
        keys[n], source[n] = new[j], -1
        if i < len(old) and old[i] == new[j]:
            source[n] = i
            i += 1
        j += 1
        n += 1
    return keys[:n].copy(), source[:n].copy()


@kernel
def rearrange(x: Vector, P: Matrix, source: Indices, dynamic: int) -> tuple[Vector, Matrix]:
    """Return state and covariance with the keyed states taken from ``source``; new ones are zero (to be initialised)."""
    n = dynamic + len(source)
    x_new, P_new = np.zeros(n), np.zeros((n, n))
    place = np.empty(n, np.int64)
    for i in range(n):
        place[i] = i if i < dynamic else (dynamic + source[i - dynamic] if source[i - dynamic] >= 0 else -1)
    for i in range(n):
        if place[i] < 0:
            continue
        x_new[i] = x[place[i]]
        for j in range(n):
            if place[j] >= 0:
                P_new[i, j] = P[place[i], place[j]]
    return x_new, P_new


@kernel_in_place
def take_out(x: Vector, P: Matrix, state: int, room: Matrix) -> None:
    """Condition on a state that is nothing, for certain; ``room`` is two rows to work in."""
    value, variance, gain, row, n = x[state], P[state, state], room[0], room[1], len(x)
    if not variance > 0.0:
        return
    for i in range(n):
        gain[i], row[i] = P[i, state] / variance, P[state, i]
    for i in range(n):
        x[i] -= gain[i] * value
        for j in range(n):
            P[i, j] -= gain[i] * row[j]


@kernel_in_place
def reset_state(x: Vector, P: Matrix, i: int, value: float, variance: float) -> None:
    """Forget what is known of state i."""
    for j in range(len(x)):
        P[i, j] = 0.0
        P[j, i] = 0.0
    x[i], P[i, i] = value, variance


@kernel_in_place
def take_value(x: Vector, P: Matrix, i: int, value: float, variance: float) -> None:
    """Take in an observation of one state with this variance."""
    n = len(x)
    gain = scratch(n)
    spread = P[i, i] + variance
    innovation = value - x[i]
    for a in range(n):
        gain[a] = P[a, i] / spread
        x[a] += gain[a] * innovation
    for a in range(n):
        for b in range(n):
            P[a, b] -= gain[a] * gain[b] * spread


@kernel_in_place
def predict_motion(x: Vector, P: Matrix, dt_s: float, decay_s: float, Q: Matrix) -> None:
    """Move position, velocity and acceleration (states 0 to 8) ahead by ``dt_s``.

    The acceleration decays with ``decay_s`` (Singer 1970, IEEE Trans. AES-6:473, eq. 8) and is driven by white jerk of the spectral
    density Q (3 x 3, m2/s5, ECEF). The noise is that of a triple integrator: an upper bound, since decay only takes from it.
    """
    n = len(x)
    a = dt_s / decay_s
    to_velocity = decay_s * (1.0 - np.exp(-a)) if a > 1e-6 else dt_s
    to_position = decay_s * (dt_s - to_velocity) if a > 1e-3 else 0.5 * dt_s * dt_s
    keep = np.exp(-a)
    for i in range(3):
        x[i] += dt_s * x[3 + i] + to_position * x[6 + i]
        x[3 + i] += to_velocity * x[6 + i]
        x[6 + i] *= keep
        for j in range(n):
            P[i, j] += dt_s * P[3 + i, j] + to_position * P[6 + i, j]
            P[3 + i, j] += to_velocity * P[6 + i, j]
            P[6 + i, j] *= keep
    for j in range(n):
        row = P[j]
        for i in range(3):
            row[i] += dt_s * row[3 + i] + to_position * row[6 + i]
            row[3 + i] += to_velocity * row[6 + i]
            row[6 + i] *= keep
    t2, t3, t4, t5 = dt_s**2 / 2.0, dt_s**3 / 6.0, dt_s**4 / 8.0, dt_s**5 / 20.0
    for i in range(3):
        for j in range(3):
            q = Q[i, j]
            P[i, j] += q * t5
            P[i, 3 + j] += q * t4
            P[3 + i, j] += q * t4
            P[i, 6 + j] += q * t3
            P[6 + i, j] += q * t3
            P[3 + i, 3 + j] += q * 2.0 * t3
            P[3 + i, 6 + j] += q * t2
            P[6 + i, 3 + j] += q * t2
            P[6 + i, 6 + j] += q * dt_s


@kernel_in_place
def _entries(row: Vector, places: Indices, dynamic: int, at: Indices, h: Vector) -> int:
    """Write the non-zero partial derivatives of one observation and the states they belong to; return how many."""
    for k in range(3):
        at[k], h[k] = k, row[H_X + k]
    count = 3
    for k in range(SHARED):
        if places[AT_ZENITH + k] >= 0:
            at[count], h[count] = dynamic + places[AT_ZENITH + k], row[H_ZENITH + k]
            count += 1
    return count


@kernel_in_place
def normal_equations(observations: Matrix, places: Indices, dynamic: int, groups: int, N: Matrix, b: Vector, mean: Matrix) -> None:
    """Write N (n x n) and b (n) of all observations with their group clocks eliminated (Schur complement, one rank per group).

    ``mean`` (groups x (n + 2)) receives per group the weighted mean row, the weighted mean of Y and the sum of weights.
    """
    n = len(b)
    N[:, :] = 0.0
    b[:] = 0.0
    mean[:, :] = 0.0
    at, h = scratch_indices(3 + SHARED), scratch(3 + SHARED)
    for k in range(observations.shape[0]):
        w, y, g = observations[k, W], observations[k, Y], places[k, GROUP]
        if not w > 0.0:
            continue
        count = _entries(observations[k], places[k], dynamic, at, h)
        for i in range(count):
            b[at[i]] += w * h[i] * y
            mean[g, at[i]] += w * h[i]
            for j in range(count):
                N[at[i], at[j]] += w * h[i] * h[j]
        mean[g, n] += w * y
        mean[g, n + 1] += w
    for g in range(groups):
        total = mean[g, n + 1]
        if not total > 0.0:
            continue
        for i in range(n):
            if mean[g, i] == 0.0:
                continue
            factor = mean[g, i] / total
            b[i] -= factor * mean[g, n]
            for j in range(n):
                N[i, j] -= factor * mean[g, j]
        for i in range(n + 1):
            mean[g, i] /= total


@kernel_in_place
def add_rows(target: Vector, coefficients: Vector, rows: Matrix, first: int, last: int, column: int) -> None:
    """Add to ``target`` the sum of coefficients[k] times rows[k, column:] over first <= k < last.

    Four rows at a time, so that the target is read and written less often.
    """
    m, k = len(target), first
    while k + 4 <= last:
        fa, fb, fc, fd = coefficients[k], coefficients[k + 1], coefficients[k + 2], coefficients[k + 3]
        a, b, c, d = rows[k, column:], rows[k + 1, column:], rows[k + 2, column:], rows[k + 3, column:]
        for j in range(m):
            target[j] += (fa * a[j] + fb * b[j]) + (fc * c[j] + fd * d[j])
        k += 4
    while k < last:
        fa, a = coefficients[k], rows[k, column:]
        for j in range(m):
            target[j] += fa * a[j]
        k += 1


@kernel_in_place
def factor(P: Matrix, U: Matrix) -> int:
    """Write the upper triangular U with P = U'U."""
    return _factor(P, U, scratch(len(P)))


@kernel_in_place
def _factor(P: Matrix, U: Matrix, minus: Vector) -> int:
    n = P.shape[0]
    for i in range(n):
        row = U[i, i:]
        for k in range(i):
            U[i, k] = 0.0
            minus[k] = -U[k, i]
        for j in range(i, n):
            U[i, j] = P[i, j]
        add_rows(row, minus, U, _ZERO, i, i)
        if not row[0] > 0.0:
            return NOT_POSITIVE_DEFINITE
        pivot = 1.0 / sqrt(row[0])
        for j in range(n - i):
            row[j] *= pivot
    return OK


@kernel_in_place
def _inner(U: Matrix, N: Matrix, columns: Matrix, T: Matrix, M: Matrix) -> None:
    """Write the lower triangle of M = I + U N U' (N symmetric and sparse); U' and N U' are written beside it."""
    n = U.shape[0]
    for i in range(n):
        for j in range(n):
            columns[j, i] = U[i, j]
    for k in range(n):  # T[k, :] = sum over j of N[k, j] * (column j of U as a row)
        T[k, :] = 0.0
        for j in range(n):
            f = N[k, j]
            if f != 0.0:
                for i in range(j + 1):
                    T[k, i] += f * columns[j, i]
    for i in range(n):
        for j in range(n):
            M[i, j] = 0.0
        add_rows(M[i, : i + 1], U[i], T, i, n, _ZERO)
        M[i, i] += 1.0


@kernel
def posterior(P: Matrix, N: Matrix, b: Vector, P_new: Matrix, dx: Vector) -> int:
    """Write P_new = (P^-1 + N)^-1 and dx = P_new b.

    With P = U'U, M = I + U N U' = F'F (F lower triangular) and V = F^-T U (upper triangular), P_new = V'V.
    """
    U = np.empty(P.shape)
    if factor(P, U) != OK:
        return NOT_POSITIVE_DEFINITE
    return posterior_of(U, N, b, P_new, dx)


@kernel
def posterior_of(U: Matrix, N: Matrix, b: Vector, P_new: Matrix, dx: Vector) -> int:
    """Write P_new and dx as ``posterior`` does, for P = U'U; U (written to) becomes V."""
    n = len(b)
    return posterior_in(np.empty((3, n, n)), scratch(n), U, N, b, P_new, dx)


@kernel_in_place
def posterior_in(room: Cube, minus: Vector, U: Matrix, N: Matrix, b: Vector, P_new: Matrix, dx: Vector) -> int:
    """Do what ``posterior_of`` does with room for three matrices and a vector."""
    n, F = len(b), room[0]
    _inner(U, N, room[1], room[2], F)
    for k in range(n - 1, -1, -1):
        row = F[k, : k + 1]
        for i in range(k + 1, n):
            minus[i] = -F[i, k]
        add_rows(row, minus, F, k + 1, n, _ZERO)
        if not row[k] > 0.0:
            return NOT_POSITIVE_DEFINITE
        pivot = 1.0 / sqrt(row[k])
        for j in range(k + 1):
            row[j] *= pivot
    for k in range(n - 1, -1, -1):
        for i in range(k + 1, n):
            minus[i] = -F[i, k]
        row, pivot = U[k, k:], 1.0 / F[k, k]
        add_rows(row[1:], minus, U, k + 1, n, k + 1)
        for j in range(n - k):
            row[j] *= pivot
    for i in range(n):
        for j in range(i, n):
            P_new[i, j] = 0.0
        for k in range(i + 1):
            minus[k] = U[k, i]
        add_rows(P_new[i, i:], minus, U, _ZERO, i + 1, i)
        for j in range(i + 1, n):
            P_new[j, i] = P_new[i, j]
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += P_new[i, j] * b[j]
        dx[i] = total
    return OK


@kernel_in_place
def residuals(
    observations: Matrix, places: Indices, dynamic: int, mean: Matrix, P: Matrix, dx: Vector, before: bool, value: Vector, variance: Vector
) -> None:
    """Write residual (m) and its variance (m2) per observation, after an update (P its posterior) or before it (P prior, dx zero).

    The group clock is that of ``normal_equations``: its weighted mean. Variances follow from R - H P H' after and R + H P H' before, with
    R and H reduced by the clock. Observations of weight 0 are judged against the clock of the others with their stored variance -1/W
    where W is negative; W = 0 gives NaN.
    """
    n, groups = len(dx), mean.shape[0]
    Pm, mPm, clock = scratch_table(groups, n), scratch(groups), scratch(groups)
    Pm[:, :], mPm[:], clock[:] = 0.0, 0.0, 0.0
    for g in range(groups):
        if not mean[g, n + 1] > 0.0:
            continue
        clock[g] = mean[g, n]
        for j in range(n):
            f = mean[g, j]
            if f != 0.0:
                clock[g] -= f * dx[j]
                for i in range(n):
                    Pm[g, i] += f * P[j, i]
        for j in range(n):
            mPm[g] += mean[g, j] * Pm[g, j]
    at, h = scratch_indices(3 + SHARED), scratch(3 + SHARED)
    for k in range(observations.shape[0]):
        g, w = places[k, GROUP], observations[k, W]
        value[k], variance[k] = np.nan, np.nan
        if w == 0.0 or not mean[g, n + 1] > 0.0:
            continue
        count = _entries(observations[k], places[k], dynamic, at, h)
        v, hPh, hPm = observations[k, Y] - clock[g], 0.0, 0.0
        for i in range(count):
            v -= h[i] * dx[at[i]]
            hPm += h[i] * Pm[g, at[i]]
            for j in range(count):
                hPh += h[i] * h[j] * P[at[i], at[j]]
        spread = hPh - 2.0 * hPm + mPm[g]
        value[k] = v
        if w > 0.0:
            own = 1.0 / w - 1.0 / mean[g, n + 1]
            variance[k] = own + spread if before else own - spread
        else:
            variance[k] = -1.0 / w + 1.0 / mean[g, n + 1] + spread
