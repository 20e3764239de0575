"""Integer least squares: the LAMBDA method.

Decorrelation: Teunissen 1995 (J. Geodesy 70:65-82) with the symmetric pivoting and lazy reductions of Chang, Yang, Zhou 2005
(MLAMBDA, J. Geodesy 79:552-565); search: Schnorr-Euchner enumeration with a shrinking ellipsoid (MLAMBDA section 4).
Factorisation Q = L' D L with L unit lower triangular (de Jonge and Tiberius 1996, LGR-12), indices from 0; D[n-1] is the variance of the
ambiguity that is fixed first. Everything is in place in arrays of the caller.
"""

from math import erf, sqrt
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel_in_place, scratch, scratch_indices, scratch_table

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

OK: Final = 0
NOT_POSITIVE_DEFINITE: Final = 1
NODE_LIMIT: Final = 2  # the search was cut off: the candidates are not proven to be the best
FOUND: Final = 3  # there is one more vector

# Rows of a walk, a column per ambiguity (level): its conditional variance (D) and the float (z); the conditional mean under the integers of
# the levels above, the integer that is tried, the step to the next one, and the squared norm of the levels above.
VARIANCE, FLOAT, MEAN, TRIAL, STEP, DIST = range(6)
WALK: Final = 6


@kernel_in_place
def factorize(Q: Matrix, L: Matrix, D: Vector, permutation: NDArray[np.int64]) -> int:
    """Factorise Q (n x n, destroyed) as P' Q P = L' D L, the smallest conditional variance first (MLAMBDA, algorithm 3.1).

    ``permutation[i]`` is the index of the input that ends at place i. Return OK or NOT_POSITIVE_DEFINITE.
    """
    n = len(D)
    for i in range(n):
        permutation[i] = i
    for k in range(n - 1, -1, -1):
        smallest = k
        for i in range(k):
            if Q[i, i] < Q[smallest, smallest]:
                smallest = i
        if not Q[smallest, smallest] > 1e-14:
            return NOT_POSITIVE_DEFINITE
        if smallest != k:
            _exchange(Q, L, permutation, k, smallest)
        D[k] = Q[k, k]
        for i in range(k):
            L[k, i] = Q[k, i] / D[k]
        L[k, k] = 1.0
        for i in range(k):
            factor = L[k, i] * D[k]
            for j in range(i + 1):
                Q[i, j] -= factor * L[k, j]
        for i in range(k + 1, n):
            L[k, i] = 0.0
    return OK


@kernel_in_place
def _exchange(Q: Matrix, L: Matrix, permutation: NDArray[np.int64], k: int, i: int) -> None:
    """Exchange row and column i < k of the remaining lower triangle Q[:k+1, :k+1] and the columns of L below it."""
    n = len(permutation)
    for j in range(i):
        Q[i, j], Q[k, j] = Q[k, j], Q[i, j]
    for j in range(i + 1, k):
        Q[j, i], Q[k, j] = Q[k, j], Q[j, i]
    Q[i, i], Q[k, k] = Q[k, k], Q[i, i]
    for j in range(k + 1, n):
        L[j, i], L[j, k] = L[j, k], L[j, i]
    permutation[i], permutation[k] = permutation[k], permutation[i]


@kernel_in_place
def _gauss(L: Matrix, back: Matrix, z: Vector, i: int, j: int) -> float:
    """Subtract from ambiguity j the integer multiple (returned) of ambiguity i > j that makes L[i, j] at most one half.

    ``back`` holds in its rows the inverse transformation: input = sum over i of back[i, :] z[i].
    """
    mu = np.rint(L[i, j])
    if mu == 0.0:
        return 0.0
    n = len(z)
    for k in range(i, n):
        L[k, j] -= mu * L[k, i]
    for k in range(n):
        back[i, k] += mu * back[j, k]
    z[j] -= mu * z[i]
    return mu


@kernel_in_place
def reduce(L: Matrix, D: Vector, back: Matrix, z: Vector) -> None:
    """Decorrelate: make D as flat as integer transformations can, in place (LGR-12 section 3.4).

    Size reduction is lazy (only what the next exchange needs), except after large multiples, where waiting would cost digits
    (Xie, Chang, Al Borno 2011, algorithm PLLL).
    """
    n = len(D)
    k = n - 2
    while k >= 0:
        if abs(_gauss(L, back, z, k + 1, k)) >= 2.0:
            for i in range(k + 2, n):
                _gauss(L, back, z, i, k)
        swapped = D[k] + L[k + 1, k] * L[k + 1, k] * D[k + 1]
        if swapped < D[k + 1] * (1.0 - 1e-9):
            _swap(L, D, back, z, k, swapped)
            k = min(k + 1, n - 2)
        else:
            k -= 1
    for j in range(n - 2, -1, -1):
        for i in range(j + 1, n):
            if abs(L[i, j]) > 0.5:  # mostly not, and a call costs more than this
                _gauss(L, back, z, i, j)


@kernel_in_place
def _swap(L: Matrix, D: Vector, back: Matrix, z: Vector, k: int, swapped: float) -> None:
    """Exchange the neighbours k and k + 1; ``swapped`` is the new D[k + 1] (LGR-12 section 3.3)."""
    n = len(D)
    eta = D[k] / swapped
    lam = D[k + 1] * L[k + 1, k] / swapped
    D[k] = eta * D[k + 1]
    D[k + 1] = swapped
    for j in range(k):
        a, b = L[k, j], L[k + 1, j]
        L[k, j] = b - L[k + 1, k] * a
        L[k + 1, j] = eta * a + lam * b
    L[k + 1, k] = lam
    for i in range(k + 2, n):
        L[i, k], L[i, k + 1] = L[i, k + 1], L[i, k]
    for j in range(n):
        back[k, j], back[k + 1, j] = back[k + 1, j], back[k, j]
    z[k], z[k + 1] = z[k + 1], z[k]


@kernel_in_place
def begin_walk(walk: Matrix, S: Matrix, D: Vector, z: Vector) -> None:
    """Begin a walk (WALK x n, with S of ``next_vector``) through the integer vectors near z, at the last level."""
    walk[:, :], S[:, :] = 0.0, 0.0
    for k in range(len(D)):
        walk[VARIANCE, k], walk[FLOAT, k] = D[k], z[k]
    _begin_level(walk, len(D) - 1, 0.0)


@kernel_in_place
def _begin_level(walk: Matrix, k: int, shift: float) -> None:
    """Try the integer nearest to the conditional mean of level k, to which the levels above add ``shift``."""
    walk[MEAN, k] = walk[FLOAT, k] + shift
    walk[TRIAL, k] = np.rint(walk[MEAN, k])
    walk[STEP, k] = 1.0 if walk[MEAN, k] >= walk[TRIAL, k] else -1.0


@kernel_in_place
def go_on(walk: Matrix, k: int) -> None:
    """Try the next integer of level k: nearest first, from side to side (Schnorr-Euchner)."""
    walk[TRIAL, k] += walk[STEP, k]
    walk[STEP, k] = -walk[STEP, k] - (1.0 if walk[STEP, k] > 0.0 else -1.0)


@kernel_in_place
def next_vector(L: Matrix, S: Matrix, walk: Matrix, k: int, limit: float, nodes: int) -> tuple[int, float, int]:
    """Walk from level k to the next integer vector of a squared norm below ``limit``, which is TRIAL then; level 0 is where to go on.

    ``S[k, j]`` (n x n, work) is what the levels above k add to the conditional mean of j. Return FOUND, OK (there is none any more) or
    NODE_LIMIT; the squared norm; how many of the ``nodes`` are left. Plain arrays, not a tuple of them: that would cost every vector more
    than its walk.
    """
    n = L.shape[0]
    for used in range(nodes):
        offset = walk[MEAN, k] - walk[TRIAL, k]
        total = walk[DIST, k] + offset * offset / walk[VARIANCE, k]
        if total < limit:
            if k == 0:
                return FOUND, total, nodes - used - 1
            k -= 1
            walk[DIST, k] = total
            for j in range(k + 1):
                S[k, j] = S[k + 1, j] - offset * L[k + 1, j]
            _begin_level(walk, k, S[k, k])
            continue
        if k == n - 1:
            return OK, total, 0
        k += 1
        go_on(walk, k)
    return NODE_LIMIT, 0.0, 0


@kernel_in_place
def search(L: Matrix, D: Vector, z: Vector, node_limit: int, candidates: Matrix, norms: Vector) -> int:
    """Find the integer vectors nearest to z in the metric of L' D L, best first, in an ellipsoid that shrinks (MLAMBDA section 4).

    ``candidates`` (m x n) and ``norms`` (m) receive the m best. Return OK or NODE_LIMIT.
    """
    m, n = len(norms), len(D)
    walk, S = scratch_table(WALK, n), scratch_table(n, n)
    begin_walk(walk, S, D, z)
    found, worst, limit, k, left = 0, 0, np.inf, n - 1, node_limit
    while True:
        status, total, left = next_vector(L, S, walk, k, limit, left)
        if status != FOUND:
            break
        place = found if found < m else worst
        for j in range(n):
            candidates[place, j] = walk[TRIAL, j]
        norms[place] = total
        if found < m:
            found += 1
        if found == m:
            worst = 0
            for j in range(1, m):
                if norms[j] > norms[worst]:
                    worst = j
            limit = norms[worst]
        k = 0
        go_on(walk, k)
    if status == OK:
        _sort(candidates, norms)
    return status


@kernel_in_place
def _sort(candidates: Matrix, norms: Vector) -> None:
    """Sort the few candidates by norm (insertion sort)."""
    for i in range(1, len(norms)):
        j = i
        while j > 0 and norms[j] < norms[j - 1]:
            norms[j], norms[j - 1] = norms[j - 1], norms[j]
            for c in range(candidates.shape[1]):
                candidates[j, c], candidates[j - 1, c] = candidates[j - 1, c], candidates[j, c]
            j -= 1


@kernel_in_place
def rounding_success(variance: float) -> float:
    """Return the probability that rounding a normal error of this variance (cycles squared) gives zero."""
    return erf(0.5 / sqrt(2.0 * variance)) if variance > 0.0 else 1.0


@kernel_in_place
def bootstrap_success(D: Vector, first: int) -> float:
    """Return the success rate of integer bootstrapping of D[first:], a lower bound of least squares' (Teunissen 1998, eq. 19)."""
    success = 1.0
    for k in range(first, len(D)):
        success *= rounding_success(D[k])
    return success


class Decorrelated(NamedTuple):
    """Float ambiguities ``z`` after the decorrelation, of covariance L' D L, and what takes integers back."""

    L: Matrix
    D: Vector
    z: Vector
    back: Matrix
    whole: Vector
    permutation: NDArray[np.int64]


@kernel_in_place
def decorrelate(a: Vector, Q: Matrix, there: Decorrelated) -> bool:
    """Write float ambiguities ``a`` (cycles, n) with covariance Q (n x n) in coordinates that are hardly correlated.

    False where there are none: Q is not positive definite.
    """
    n, work = len(a), scratch_table(len(a), len(a))
    for i in range(n):
        for j in range(n):
            work[i, j], there.L[i, j], there.back[i, j] = Q[i, j], 0.0, 0.0
        there.back[i, i], there.D[i] = 1.0, 0.0
    if factorize(work, there.L, there.D, there.permutation) != OK:
        return False
    for i in range(n):
        there.whole[i] = np.rint(a[there.permutation[i]])  # large integers must not cost digits in the transformation
        there.z[i] = a[there.permutation[i]] - there.whole[i]
    reduce(there.L, there.D, there.back, there.z)
    return True


@kernel_in_place
def restore(candidates: Matrix, there: Decorrelated, fixed: Matrix) -> None:
    """Write integer vectors (m x n) that were found in decorrelated coordinates as those of the float ambiguities."""
    n = candidates.shape[1]
    for c in range(candidates.shape[0]):
        for j in range(n):
            total = there.whole[j]
            for i in range(n):
                total += there.back[i, j] * candidates[c, i]
            fixed[c, there.permutation[j]] = total


@kernel_in_place
def integer_least_squares(a: Vector, Q: Matrix, node_limit: int, fixed: Matrix, norms: Vector, D: Vector) -> int:
    """Find the integer vectors nearest to the float ambiguities ``a`` (cycles, n) in the metric of their covariance Q (n x n).

    ``fixed`` (m x n) and ``norms`` (m, squared norms) receive the m best, best first; ``D`` (n) the conditional variances after
    decorrelation. Return OK, NOT_POSITIVE_DEFINITE or NODE_LIMIT (then nothing in ``fixed`` is to be used).
    """
    n, candidates = len(a), scratch_table(len(norms), len(a))
    there = Decorrelated(scratch_table(n, n), D, scratch(n), scratch_table(n, n), scratch(n), scratch_indices(n))
    norms[:] = np.inf
    if not decorrelate(a, Q, there):
        return NOT_POSITIVE_DEFINITE
    status = search(there.L, there.D, there.z, node_limit, candidates, norms)
    if status == OK:
        restore(candidates, there, fixed)
    return status
