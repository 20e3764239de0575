"""Integer ambiguities: double differences of the filter's ambiguities, the search, and what known integers do to the state.

Double differences are formed here and nowhere else, within one clock group each. Which ambiguity is the reference of its group does
not matter to any result.
"""

from math import isfinite
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place, scratch, scratch_flags, scratch_indices, scratch_table
from rtkmesh.gnss.signals import KEYS_PER_SATELLITE
from rtkmesh.models.odds import log_odds
from rtkmesh.rtk.filter import factor, posterior
from rtkmesh.rtk.lambda_search import NOT_POSITIVE_DEFINITE, OK, bootstrap_success, integer_least_squares
from rtkmesh.rtk.length_search import Given, nearest_of_length
from rtkmesh.rtk.matching import clock_group
from rtkmesh.rtk.state import DYNAMIC, INTEGER, Filter

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

NODE_LIMIT: Final = 50_000  # some 5 ms; a search that needs more has no clear winner


class Candidates(NamedTuple):
    """Ambiguities of an epoch that may become integers; all columns go together, sorted by satellite.

    ``row`` is the place in the filter's keys, ``group`` the clock group, ``weight`` says which makes the better reference.
    """

    row: Indices
    group: Indices
    satellite: Indices
    weight: Vector


class Search(NamedTuple):
    """Result of one free search: (state, reference) pairs, their integers, and how sure they are.

    ``values`` goes with the filter's keys: the integers with that of each group's reference set to 0, NaN for keys not in the search.
    """

    pairs: Indices
    integers: Vector
    values: Vector
    norm: float
    second: float
    success: float
    odds: float
    resolved: bool


@kernel
def take(candidates: Candidates, mask: NDArray[np.bool_]) -> Candidates:
    """Return those of the mask: the same ones, where that is all of them."""
    n = len(mask)
    kept, count = scratch_indices(n), 0
    for k in range(n):
        if mask[k]:
            kept[count] = k
            count += 1
    if count == n:
        return candidates
    row, group, satellite, weight = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count)
    for i in range(count):
        k = kept[i]
        row[i], group[i], satellite[i], weight[i] = candidates.row[k], candidates.group[k], candidates.satellite[k], candidates.weight[k]
    return Candidates(row, group, satellite, weight)


@kernel
def pairs_of(candidates: Candidates) -> Indices:
    """Return (state, reference) of all double differences that the candidates form."""
    n = len(candidates.row)
    states, out = scratch_indices(n), np.empty((n, 2), np.int64)
    for k in range(n):
        states[k] = candidates.row[k] + DYNAMIC
    return out[: choose_references(states, candidates.group, candidates.weight, out)]


@kernel
def search(f: Filter, candidates: Candidates, length_m: float, length_sigma_m: float) -> Search:
    """Search the integers of all double differences of the candidates; of a baseline of known length (NaN: unknown) with its misfit."""
    pairs = pairs_of(candidates)
    n = len(pairs)
    fixed, norms = np.zeros((2, n)), np.zeros(2)
    if n == 0:
        return nothing_found(f, pairs, 0.0)
    if isfinite(length_m):
        status, success = search_of_length(f, pairs, length_m, length_sigma_m, fixed, norms)
    else:
        status, success = search_pairs(f.x, f.P, pairs, NODE_LIMIT, fixed, norms)
    return found_best(f, pairs, fixed, norms, success) if status == OK else nothing_found(f, pairs, success)


@kernel
def found_best(f: Filter, pairs: Indices, fixed: Matrix, norms: Vector, success: float) -> Search:
    """Return the first of integer vectors, best first, as the result of a search."""
    n, values = len(pairs), np.full(len(f.keys), np.nan)
    for k in range(n):
        values[pairs[k, 1] - DYNAMIC], values[pairs[k, 0] - DYNAMIC] = 0.0, fixed[0, k]
    return Search(pairs, fixed[0].copy(), values, norms[0], norms[1], success, log_odds(norms[0], norms[1], n), True)


@kernel
def nothing_found(f: Filter, pairs: Indices, success: float) -> Search:
    """Return the result of a search without one."""
    return Search(pairs, np.zeros(len(pairs)), np.full(len(f.keys), np.nan), np.inf, np.inf, success, -np.inf, False)


@kernel_in_place
def search_of_length(f: Filter, pairs: Indices, length_m: float, sigma_m: float, fixed: Matrix, totals: Vector) -> tuple[int, float]:
    """Search the integers of a baseline of known length: as ``search_pairs``, with the misfit of the length in the squared norms.

    What was not looked at is taken to fit the length: the second total is no larger.
    """
    n = len(pairs)
    a, Q, gain, mean, cov = scratch(n), scratch_table(n, n), scratch_table(3, n), scratch(3), scratch_table(3, 3)
    norms = scratch(len(totals))
    difference(f.x, f.P, pairs, a, Q)
    if not gain_of(f.x, f.P, pairs, gain, mean, cov):
        return NOT_POSITIVE_DEFINITE, 0.0
    given = Given(mean, gain, cov, length_m, sigma_m)
    status, beyond, success = nearest_of_length(a, Q, given, NODE_LIMIT, fixed, norms, totals)
    totals[1] = min(totals[1], beyond)
    return status, success


@kernel_in_place
def choose_references(states: Indices, groups: Indices, weight: Vector, out: Indices) -> int:
    """Pick in each group the state with the largest weight as reference; write per double difference (state, reference); return how many.

    ``states`` are sorted by anything; ``groups`` are small numbers. A group with one member gives none.
    """
    if len(states) == 0:
        return 0
    largest = 0
    for group in groups:
        largest = max(largest, group)
    best = scratch_indices(largest + 1)
    best[:] = -1
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


@kernel_in_place
def difference(x: Vector, P: Matrix, pairs: Indices, a: Vector, Q: Matrix) -> None:
    """Write the double differences (cycles) of (state, reference) pairs (n x 2) and their covariance (n x n)."""
    for k in range(pairs.shape[0]):
        i, r = pairs[k, 0], pairs[k, 1]
        a[k] = x[i] - x[r]
        for m in range(k + 1):
            j, s = pairs[m, 0], pairs[m, 1]
            q = (P[i, j] - P[i, s]) - (P[r, j] - P[r, s])
            Q[k, m], Q[m, k] = q, q


@kernel_in_place
def search_pairs(x: Vector, P: Matrix, pairs: Indices, node_limit: int, fixed: Matrix, norms: Vector) -> tuple[int, float]:
    """Search the integers of double differences; write the two best (2 x n) and their squared norms.

    Return the status of ``integer_least_squares`` and the success rate of bootstrapping.
    """
    n = pairs.shape[0]
    a, Q, D = scratch(n), scratch_table(n, n), scratch(n)
    difference(x, P, pairs, a, Q)
    status = integer_least_squares(a, Q, node_limit, fixed, norms, D)
    return status, bootstrap_success(D, 0) if status == OK else 0.0


@kernel_in_place
def condition(x: Vector, P: Matrix, pairs: Indices, integers: Vector, slack: float, wanted: Indices, x_out: Vector, P_out: Matrix) -> float:
    """Write the mean and covariance of the wanted states given the integers of double differences; return their squared norm.

    ``slack`` (cycles squared) is added to the variance of every double difference. The norm is infinite where their covariance is not
    positive definite (nothing is written then).
    """
    n, m = pairs.shape[0], len(wanted)
    a, Q, U = scratch(n), scratch_table(n, n), scratch_table(n, n)
    difference(x, P, pairs, a, Q)
    for k in range(n):
        Q[k, k] += slack
    if factor(Q, U) != 0:
        return np.inf
    # rows of G: U^-T times (residual, covariance with the wanted states)
    G = scratch_table(n, m + 1)
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


@kernel_in_place
def norm_of(f: Filter, pairs: Indices, integers: Vector) -> float:
    """Return the squared norm of integers against the float ambiguities."""
    return condition(f.x, f.P, pairs, integers, 0.0, scratch_indices(0), scratch(0), scratch_table(0, 0))


@kernel_in_place
def gain_of(x: Vector, P: Matrix, pairs: Indices, gain: Matrix, mean: Vector, cov: Matrix) -> bool:
    """Write how the baseline follows from integers, mean + gain @ integers, and its covariance; False where nothing can be said."""
    n = len(pairs)
    a, Q, U, G = scratch(n), scratch_table(n, n), scratch_table(n, n), scratch_table(n, 3)
    difference(x, P, pairs, a, Q)
    if factor(Q, U) != 0:
        return False
    for k in range(n):
        for i in range(3):
            G[k, i] = P[i, pairs[k, 0]] - P[i, pairs[k, 1]]
            for j in range(k):
                G[k, i] -= U[j, k] * G[j, i]
            G[k, i] /= U[k, k]
    for i in range(3):
        for j in range(3):
            cov[i, j] = P[i, j]
            for k in range(n):
                cov[i, j] -= G[k, i] * G[k, j]
        for k in range(n - 1, -1, -1):
            gain[i, k] = G[k, i]
            for j in range(k + 1, n):
                gain[i, k] -= U[k, j] * gain[i, j]
            gain[i, k] /= U[k, k]
        mean[i] = x[i]
        for k in range(n):
            mean[i] -= gain[i, k] * a[k]
    return True


@kernel_in_place
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


@kernel_in_place
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
def held_among(f: Filter, candidates: Candidates) -> Candidates:
    """Return the candidates that have a held integer."""
    held = scratch_flags(len(candidates.row))
    for k in range(len(held)):
        held[k] = isfinite(f.history[candidates.row[k], INTEGER])
    return take(candidates, held)


@kernel
def held_differences(f: Filter, pairs: Indices) -> Vector:
    """Return the held integers of (state, reference) pairs."""
    out = np.empty(len(pairs))
    write_held_differences(f, pairs, out)
    return out


@kernel_in_place
def write_held_differences(f: Filter, pairs: Indices, out: Vector) -> None:
    """Write what ``held_differences`` returns."""
    for k in range(len(pairs)):
        out[k] = f.history[pairs[k, 0] - DYNAMIC, INTEGER] - f.history[pairs[k, 1] - DYNAMIC, INTEGER]


@kernel_in_place
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
def tell(f: Filter, pairs: Indices, integers: Vector, variance: float) -> None:
    """Tell the filter of the integers of double differences, as observations of this variance (cycles squared)."""
    n = len(f.x)
    N, b, P, dx = np.zeros((n, n)), np.zeros(n), np.empty((n, n)), np.empty(n)
    add_constraints(pairs, f.x, integers, variance, N, b)
    if posterior(f.P, N, b, P, dx) != 0:
        return
    for i in range(n):
        f.x[i] += dx[i]
        f.P[i, :] = P[i]


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
        kind = clock_group(keys_a[i] // KEYS_PER_SATELLITE, keys_a[i] % KEYS_PER_SATELLITE)
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
