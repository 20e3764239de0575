"""Integer vectors by their squared norm and the misfit of a baseline's known length together.

The length is met only when all integers are chosen: the right vector may be thousands down the list of norms. So all that are near enough
to matter are looked at, and the best by both are kept. The walk is that of ``lambda_search``; the baseline goes along.
"""

from math import exp, isfinite, lgamma, log, pi, sqrt
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place, scratch, scratch_indices, scratch_table
from rtkmesh.models.odds import PRIOR_DOF
from rtkmesh.rtk.lambda_search import (
    FOUND,
    NOT_POSITIVE_DEFINITE,
    OK,
    TRIAL,
    WALK,
    Decorrelated,
    begin_walk,
    bootstrap_success,
    decorrelate,
    go_on,
    next_vector,
    restore,
)

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

ENOUGH: Final = 15.0  # log odds against the best from which a vector does not matter
FEWEST: Final = 10  # vectors that are looked at in any case
VECTORS: Final = 12000.0  # about so many are looked at, at most: some milliseconds


class Given(NamedTuple):
    """How the baseline follows from integers, ``mean_m`` + ``gain`` (3 x n) @ integers, its covariance, its known length and the sigma."""

    mean_m: Vector
    gain: Matrix
    cov_m2: Matrix
    length_m: float
    sigma_m: float


@kernel
def nearest_of_length(
    a: Vector, Q: Matrix, given: Given, nodes: int, fixed: Matrix, norms: Vector, totals: Vector
) -> tuple[int, float, float]:
    """Find integer vectors of float ambiguities ``a`` (cycles, n, covariance Q) by squared norm and misfit of the length; best first.

    ``fixed`` (m x n), ``norms`` and ``totals`` (with the misfit) receive the m best; infinite where there are fewer near enough. Return OK,
    NOT_POSITIVE_DEFINITE or NODE_LIMIT (then nothing is to be used), the total that all others exceed, and bootstrapping's success rate.
    """
    norms[:], totals[:] = np.inf, np.inf
    n = len(a)
    there = Decorrelated(scratch_table(n, n), scratch(n), scratch(n), scratch_table(n, n), scratch(n), scratch_indices(n))
    if not decorrelate(a, Q, there):
        return NOT_POSITIVE_DEFINITE, 0.0, 0.0
    candidates = np.zeros(fixed.shape)
    status, beyond = _enumerate(there, _by_decorrelated(there, given), nodes, candidates, norms, totals)
    if status != OK:
        return status, beyond, 0.0
    restore(candidates, there, fixed)
    order = np.argsort(totals)
    fixed[:, :], norms[:], totals[:] = fixed[order], norms[order], totals[order]
    return OK, beyond, bootstrap_success(there.D, 0)


@kernel
def _by_decorrelated(there: Decorrelated, given: Given) -> Given:
    """Return how the baseline follows from the integers of the decorrelated coordinates."""
    n = len(there.z)
    mean_m, gain = given.mean_m.copy(), np.zeros((3, n))
    for i in range(3):
        for j in range(n):
            g = given.gain[i, there.permutation[j]]
            mean_m[i] += g * there.whole[j]
            for k in range(n):
                gain[i, k] += g * there.back[k, j]
    return Given(mean_m, gain, given.cov_m2, given.length_m, given.sigma_m)


@kernel_in_place
def farthest(D: Vector) -> float:
    """Return the squared norm within which there are about VECTORS integer vectors: the volume of the ellipsoid is their number."""
    n = len(D)
    volume = 0.5 * n * log(pi) - lgamma(0.5 * n + 1.0)
    for variance in D:
        volume += 0.5 * log(variance)
    return exp(min(2.0 / n * (log(VECTORS) - volume), 600.0))


@kernel
def _enumerate(there: Decorrelated, given: Given, nodes: int, candidates: Matrix, norms: Vector, totals: Vector) -> tuple[int, float]:
    """Write the best vectors in any order; see ``nearest_of_length``."""
    n = len(there.z)
    walk, S = scratch_table(WALK, n), scratch_table(n, n)
    begin_walk(walk, S, there.D, there.z)
    seen, worst, best, limit, most, k, left = 0, 0, np.inf, np.inf, farthest(there.D), n - 1, nodes
    trial, place = walk[TRIAL], scratch(3)
    while True:
        status, norm, left = next_vector(there.L, S, walk, k, limit, left)
        if status != FOUND:
            return status, limit if status == OK else 0.0
        seen += 1
        with_length = norm + misfit_of(trial, given, place)
        best = min(best, with_length)
        if with_length < totals[worst]:
            candidates[worst], norms[worst], totals[worst] = trial, norm, with_length
            worst = np.argmax(totals)
        if seen >= FEWEST:
            limit = min(limit, most, enough(best, n), totals[worst])
        k = 0
        go_on(walk, k)


@kernel_in_place
def enough(best: float, count: int) -> float:
    """Return the squared norm that the best one's log odds are ENOUGH against (``models.odds``)."""
    return (PRIOR_DOF + best) * exp(2.0 * ENOUGH / (PRIOR_DOF + count)) - PRIOR_DOF


@kernel_in_place
def misfit_of(integers: Vector, given: Given, place: Vector) -> float:
    """Return the squared misfit of the length under these integers; ``place`` (3) receives the baseline (m) that they give."""
    for i in range(3):
        total_m = given.mean_m[i]
        for j in range(len(integers)):
            total_m += given.gain[i, j] * integers[j]
        place[i] = total_m
    return length_misfit(place, given.cov_m2, given.length_m, given.sigma_m)


@kernel_in_place
def length_misfit(vector_m: Vector, cov_m2: Matrix, length_m: float, sigma_m: float) -> float:
    """Return the squared misfit of a vector's length, in sigmas of the known length and the vector together; 0 where none is known."""
    if not isfinite(length_m):
        return 0.0
    square, variance = 0.0, 0.0
    for i in range(3):
        square += vector_m[i] * vector_m[i]
        for j in range(3):
            variance += vector_m[i] * cov_m2[i, j] * vector_m[j]
    return (sqrt(square) - length_m) ** 2 / (sigma_m * sigma_m + variance / max(square, 1e-12))
