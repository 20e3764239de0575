"""Integer ambiguities: double differences of the filter's ambiguities, the search, and what known integers do to the state.

Double differences are formed here and nowhere else, within one clock group each. Which ambiguity is the reference of its group does
not matter to any result.
"""

from math import isfinite, log
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.rtk.filter import factor
from rtkmesh.rtk.lambda_search import OK, bootstrap_success, integer_least_squares

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

NODE_LIMIT: Final = 50_000  # some 5 ms; a search that needs more has no clear winner
PRIOR_DOF: Final = 4.0  # how well the variance level is known before the norms are seen: see log_odds


def log_odds(best: float, other: float, count: int) -> float:
    """Return the natural logarithm of the odds of the best integer vector (squared norm ``best``) against another.

    Float ambiguities that are normal around the truth with a covariance known up to a factor, the factor inverse chi-square with
    PRIOR_DOF degrees of freedom around 1, are Student-t (Zellner 1971, B.2.4): p ~ (PRIOR_DOF + norm)^-((PRIOR_DOF + n) / 2). For few
    ambiguities this asks for a large ratio of the norms, for many for a small one, and a norm that is too large for its count costs
    confidence.
    """
    return 0.5 * (PRIOR_DOF + count) * log((PRIOR_DOF + other) / (PRIOR_DOF + best))


@kernel
def choose_references(states: Indices, groups: Indices, weight: Vector, out: Indices) -> int:
    """Pick in each group the state with the largest weight as reference; write per double difference (state, reference); return how many.

    ``states`` are sorted by anything; ``groups`` are small numbers. A group with one member gives none.
    """
    if len(states) == 0:
        return 0
    best = np.full(groups.max() + 1, -1, np.int64)
    for k in range(len(states)):
        b = best[groups[k]]
        if b < 0 or weight[k] > weight[b] or (weight[k] == weight[b] and states[k] < states[b]):
            best[groups[k]] = k
    n = 0
    for k in range(len(states)):
        b = best[groups[k]]
        if b != k:
            out[n, 0], out[n, 1] = states[k], states[b]
            n += 1
    return n


@kernel
def difference(x: Vector, P: Matrix, pairs: Indices, a: Vector, Q: Matrix) -> None:
    """Write the double differences (cycles) of (state, reference) pairs (n x 2) and their covariance (n x n)."""
    for k in range(pairs.shape[0]):
        i, r = pairs[k, 0], pairs[k, 1]
        a[k] = x[i] - x[r]
        for m in range(k + 1):
            j, s = pairs[m, 0], pairs[m, 1]
            q = (P[i, j] - P[i, s]) - (P[r, j] - P[r, s])
            Q[k, m], Q[m, k] = q, q


@kernel
def search_pairs(x: Vector, P: Matrix, pairs: Indices, node_limit: int, fixed: Matrix, norms: Vector) -> tuple[int, float]:
    """Search the integers of double differences; write the two best (2 x n) and their squared norms.

    Return the status of ``integer_least_squares`` and the success rate of bootstrapping.
    """
    n = pairs.shape[0]
    a, Q, D = np.empty(n), np.empty((n, n)), np.empty(n)
    difference(x, P, pairs, a, Q)
    status = integer_least_squares(a, Q, node_limit, fixed, norms, D)
    return status, bootstrap_success(D, 0) if status == OK else 0.0


@kernel
def condition(x: Vector, P: Matrix, pairs: Indices, integers: Vector, slack: float, wanted: Indices, x_out: Vector, P_out: Matrix) -> float:
    """Write the mean and covariance of the wanted states given the integers of double differences; return their squared norm.

    ``slack`` (cycles squared) is added to the variance of every double difference. The norm is infinite where their covariance is not
    positive definite (nothing is written then).
    """
    n, m = pairs.shape[0], len(wanted)
    a, Q, U = np.empty(n), np.empty((n, n)), np.empty((n, n))
    difference(x, P, pairs, a, Q)
    for k in range(n):
        Q[k, k] += slack
    if factor(Q, U) != 0:
        return np.inf
    # rows of G: U^-T times (residual, covariance with the wanted states)
    G = np.empty((n, m + 1))
    for k in range(n):
        G[k, 0] = integers[k] - a[k]
        for i in range(m):
            G[k, i + 1] = P[wanted[i], pairs[k, 0]] - P[wanted[i], pairs[k, 1]]
        for j in range(k):
            f = U[j, k]
            if f != 0.0:
                for i in range(m + 1):
                    G[k, i] -= f * G[j, i]
        for i in range(m + 1):
            G[k, i] /= U[k, k]
    norm = 0.0
    for k in range(n):
        norm += G[k, 0] * G[k, 0]
    for i in range(m):
        total = x[wanted[i]]
        for k in range(n):
            total += G[k, i + 1] * G[k, 0]
        x_out[i] = total
        for j in range(i + 1):
            total = P[wanted[i], wanted[j]]
            for k in range(n):
                total -= G[k, i + 1] * G[k, j + 1]
            P_out[i, j], P_out[j, i] = total, total
    return norm


@kernel
def held_references(new_group: Indices, held_group: Indices, held_weight: Vector, out: Indices) -> int:
    """Write per new ambiguity which held one of its group has the largest weight, -1 for none; return how many have one."""
    count = 0
    for k in range(len(new_group)):
        out[k] = -1
        for j in range(len(held_group)):
            if held_group[j] == new_group[k] and (out[k] < 0 or held_weight[j] > held_weight[out[k]]):
                out[k] = j
        count += 1 if out[k] >= 0 else 0
    return count


@kernel
def pack_pairs(pairs: Indices, wanted: Indices) -> int:
    """Number the states of pairs (n x 2) anew, in place, by their order in ``wanted`` (written, sorted); return how many these are."""
    count = 0
    for k in range(pairs.size):
        state, place = pairs[k // 2, k % 2], count
        while place > 0 and wanted[place - 1] >= state:
            place -= 1
        if place < count and wanted[place] == state:
            continue
        for i in range(count, place, -1):
            wanted[i] = wanted[i - 1]
        wanted[place] = state
        count += 1
    for k in range(pairs.size):
        place = 0
        while wanted[place] != pairs[k // 2, k % 2]:
            place += 1
        pairs[k // 2, k % 2] = place
    return count


@kernel
def held_differences(history: Matrix, column: int, pairs: Indices, dynamic: int) -> Vector:
    """Return the held integers (a column of the history) of (state, reference) pairs."""
    out = np.empty(len(pairs))
    for k in range(len(pairs)):
        out[k] = history[pairs[k, 0] - dynamic, column] - history[pairs[k, 1] - dynamic, column]
    return out


@kernel
def add_constraints(pairs: Indices, x: Vector, integers: Vector, variance: float, N: Matrix, b: Vector) -> None:
    """Add double differences as observations of this variance (cycles squared) to normal equations for corrections of x."""
    w = 1.0 / variance
    for k in range(pairs.shape[0]):
        i, r = pairs[k, 0], pairs[k, 1]
        y = integers[k] - (x[i] - x[r])
        N[i, i] += w
        N[r, r] += w
        N[i, r] -= w
        N[r, i] -= w
        b[i] += w * y
        b[r] -= w * y


@kernel
def compare_integers(keys_a: Indices, values_a: Vector, keys_b: Indices, values_b: Vector) -> tuple[int, int]:
    """Compare two sets of single-difference integers whose groups each have a free offset; keys are sorted, NaN is no value.

    Return how many double differences both sets know, and how many of these differ.
    """
    kinds, offsets = np.zeros(len(keys_a), np.int64), np.zeros(len(keys_a))
    groups, common, different = 0, 0, 0
    j = 0
    for i in range(len(keys_a)):
        while j < len(keys_b) and keys_b[j] < keys_a[i]:
            j += 1
        if j == len(keys_b):
            break
        if keys_b[j] != keys_a[i] or not isfinite(values_a[i]) or not isfinite(values_b[j]):
            continue
        kind = (keys_a[i] // 262144 // 64) * 262144 + keys_a[i] % 262144
        offset = values_b[j] - values_a[i]
        g = 0
        while g < groups and kinds[g] != kind:
            g += 1
        if g == groups:
            kinds[g], offsets[g] = kind, offset
            groups += 1
            continue
        common += 1
        if offset != offsets[g]:
            different += 1
    return common, different
