"""Partial resolution: the integers that all vectors have in common which cannot be ruled out.

A search whose best vector is not clear may still be clear of most integers: those in which the best one and all that come before a vector
of much lower odds are equal. Combinations that are as sure but no double differences of two signals (the most precise ambiguities of the
decorrelated space, Teunissen 1999) cannot be held, and hardly ever place the rover in centimetres where these do not.
"""

from math import sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place
from rtkmesh.models.odds import log_odds
from rtkmesh.rtk.ambiguity import NODE_LIMIT, Candidates, Search, condition, pairs_of, search_pairs
from rtkmesh.rtk.lambda_search import OK
from rtkmesh.rtk.state import DYNAMIC, Filter

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

KEPT: Final = 32  # vectors that are looked at
LEAST: Final = 5
# Integers in common either place the rover (sigma in 3D below 5 cm) or leave it where it was (0.3 m and more): such that do not are worse
# than none, for while they are held no others are looked for.
SIGMA_M: Final = 0.07


@kernel
def search_common(f: Filter, candidates: Candidates, asked: float) -> Search:
    """Return what all vectors have in common that come before the first one against which the best has the ``asked`` log odds.

    The norm is that of all integers of the best vector. Not resolved where there is no such vector among the best, and where too little is
    common to place the rover.
    """
    pairs, values = pairs_of(candidates), np.full(len(f.keys), np.nan)
    n = len(pairs)
    fixed, norms = np.zeros((KEPT, n)), np.zeros(KEPT)
    status, success = search_pairs(f.x, f.P, pairs, NODE_LIMIT, fixed, norms) if n >= LEAST else (-1, 0.0)
    rival = _first_unlikely(norms, n, asked) if status == OK else KEPT
    if rival == KEPT:
        return Search(pairs[:0], fixed[0, :0].copy(), values, np.inf, np.inf, success, -np.inf, False)
    common, integers = in_common(pairs, fixed[:rival])
    for k in range(len(common)):
        values[common[k, 1] - DYNAMIC], values[common[k, 0] - DYNAMIC] = 0.0, integers[k]
    resolved = len(common) >= LEAST and _sigma_m(f, common, integers) <= SIGMA_M
    return Search(common, integers, values, norms[0], norms[rival], success, log_odds(norms[0], norms[rival], n), resolved)


@kernel_in_place
def _first_unlikely(norms: Vector, count: int, asked: float) -> int:
    """Return the first vector against which the best has the log odds, how many there are if none."""
    for k in range(1, len(norms)):
        if log_odds(norms[0], norms[k], count) >= asked:
            return k
    return len(norms)


@kernel
def _sigma_m(f: Filter, pairs: Indices, integers: Vector) -> float:
    """Return the sigma in 3D (m) of the baseline under these integers."""
    x, P = np.zeros(3), np.zeros((3, 3))
    norm = condition(f.x, f.P, pairs, integers, 0.0, np.arange(3), x, P)
    return sqrt(max(P[0, 0] + P[1, 1] + P[2, 2], 0.0)) if norm < np.inf else np.inf


@kernel
def in_common(pairs: Indices, vectors: Matrix) -> tuple[Indices, Vector]:
    """Return the double differences of the first of the vectors that are the same in all of them, (state, reference) and integers.

    Two ambiguities of a group that differ from the first vector by equal numbers have a double difference in common. So the reference may
    be another one than that of ``pairs``: it is what most move along with.
    """
    n = len(pairs)
    out, integers, count, done = np.empty((n, 2), np.int64), np.empty(n), 0, np.zeros(n, np.bool_)
    for first in range(n):
        if done[first]:
            continue
        leader = _leader(pairs, vectors, pairs[first, 1])
        for k in range(first, n):
            if pairs[k, 1] != pairs[first, 1]:
                continue
            done[k] = True
            if k == leader or not _together(vectors, k, leader):
                continue
            out[count, 0], out[count, 1] = pairs[k, 0], pairs[first, 1] if leader < 0 else pairs[leader, 0]
            integers[count] = vectors[0, k] - (0.0 if leader < 0 else vectors[0, leader])
            count += 1
    return out[:count].copy(), integers[:count].copy()


@kernel_in_place
def _leader(pairs: Indices, vectors: Matrix, reference: int) -> int:
    """Return the row of the group of this reference that most others move along with, -1 for the reference itself."""
    leader, most = -1, _followers(pairs, vectors, reference, -1)
    for k in range(len(pairs)):
        if pairs[k, 1] == reference:
            followers = _followers(pairs, vectors, reference, k)
            if followers > most:
                leader, most = k, followers
    return leader


@kernel_in_place
def _followers(pairs: Indices, vectors: Matrix, reference: int, leader: int) -> int:
    """Return how many rows of a group move along with a row, or (-1) with the reference."""
    count = 0
    for k in range(len(pairs)):
        count += 1 if pairs[k, 1] == reference and k != leader and _together(vectors, k, leader) else 0
    return count


@kernel_in_place
def _together(vectors: Matrix, row: int, leader: int) -> bool:
    """Return whether two rows (-1: the reference) differ from the first vector by equal numbers in all of them."""
    for v in range(1, len(vectors)):
        moved = vectors[v, leader] - vectors[0, leader] if leader >= 0 else 0.0
        if vectors[v, row] - vectors[0, row] != moved:
            return False
    return True
