"""The best integer vectors of an epoch and the baseline that each of them gives: for those who know more than one baseline does.

Made when asked for, never per epoch. What a known shape of several antennas makes of them is ``attitude.search``.
"""

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.gnss.signals import BEIDOU, GLONASS, SATELLITES_PER_SYSTEM, SBAS
from rtkmesh.models.odds import log_odds
from rtkmesh.rtk.ambiguity import CONSTRAINED_CANDIDATES, NODE_LIMIT, Candidates, difference, pairs_of, search_pairs
from rtkmesh.rtk.filter import factor
from rtkmesh.rtk.lambda_search import OK
from rtkmesh.rtk.memory import TRUSTS_GLONASS
from rtkmesh.rtk.relative import Setup
from rtkmesh.rtk.solution import T_ELEVATION_RAD, T_LOCK_EPOCHS, T_STATE, USED_PHASE, SatelliteTable
from rtkmesh.rtk.state import DYNAMIC, SEEN_S, Filter

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

KEPT: Final = CONSTRAINED_CANDIDATES
SEARCHED: Final = 400  # with a known length: the right one may be far down the list, the length brings it up
_FEW: Final = 16  # double differences of which so many are searched: with more the right one is among the first (algorithms.md A4)
_CLEAR: Final = 15.0  # log odds of the best against what is not kept: then the right one is kept
_SIGNAL: Final = 512  # a key is (satellite * 512 + rover signal) * 512 + base signal


@dataclass(frozen=True, slots=True, eq=False)
class CandidateTable:
    """Integer vectors of one epoch, best first, at most KEPT.

    Columns: satellite and signal numbers (rover's and base's) of each ambiguity, sorted. ``integers`` (m, p) are single differences
    (cycles); of each system and pair of signals the one of the reference is 0. ``count`` is the number of double differences.
    ``baselines_ecef_m`` (m, 3) is rover minus base under each; ``cov_ecef_m2`` (3, 3) its covariance, the same for all. ``norms`` (m)
    are squared norms against the float ambiguities; ``beyond`` is the least squared norm of what is not in the table (with a known
    length: with its misfit).
    """

    satellite: NDArray[np.int16]
    signal: NDArray[np.int16]
    base_signal: NDArray[np.int16]
    integers: Indices
    count: int
    baselines_ecef_m: Matrix
    cov_ecef_m2: Matrix
    norms: Vector
    beyond: float


class Ranked(NamedTuple):
    """What ``rank`` gives: candidates by squared norm with the misfit of the length, and what the best left-out one has."""

    pairs: Indices
    integers: Matrix
    baselines_m: Matrix
    cov_m2: Matrix
    norms: Vector
    beyond: float


def candidate_table(
    f: Filter, satellites: SatelliteTable, memory: Vector, setup: Setup, length: tuple[float, float] | None = None
) -> CandidateTable | None:
    """Return the best candidates of an epoch with this filter and satellite table; None where too little can be searched.

    ``length`` (m) of the baseline and its sigma, if the filter's options do not tell it.
    """
    found = _usable(f, satellites, setup, glonass=memory[TRUSTS_GLONASS] > 0.0)
    if len(found.row) < 2:
        return None
    length_m, sigma_m = setup.resolve.length_m, setup.resolve.length_sigma_m
    if length is not None and not np.isfinite(length_m):
        length_m, sigma_m = length
    ranked = rank(f, found, length_m, sigma_m)
    if not len(ranked.norms):
        return None
    keys, columns = f.keys[found.row], np.zeros(len(f.x), np.int64)
    columns[found.row + DYNAMIC] = np.arange(len(found.row))
    integers = np.zeros((len(ranked.norms), len(keys)), np.int64)
    integers[:, columns[ranked.pairs[:, 0]]] = np.rint(ranked.integers).astype(np.int64)
    satellite, signal = np.divmod(keys // _SIGNAL, _SIGNAL)
    return CandidateTable(
        satellite.astype(np.int16), signal.astype(np.int16), (keys % _SIGNAL).astype(np.int16), integers, len(ranked.pairs),
        ranked.baselines_m, ranked.cov_m2, ranked.norms, ranked.beyond,
    )  # fmt: skip


def _usable(f: Filter, satellites: SatelliteTable, setup: Setup, *, glonass: bool) -> Candidates:
    """Return the ambiguities of the epoch that may become integers: as ``bookkeeping.find_candidates``, from the table."""
    packed, satellite = satellites.packed, satellites.satellite.astype(np.int64)
    system, number = np.divmod(satellite, SATELLITES_PER_SYSTEM)
    usable = (packed[:, T_STATE].astype(np.int64) & USED_PHASE != 0) & (packed[:, T_ELEVATION_RAD] >= setup.ambiguity_mask_rad)
    usable &= (packed[:, T_LOCK_EPOCHS] > setup.minimum_lock_epochs) & (system != SBAS)
    usable &= ~((system == BEIDOU) & ((number <= 5) | (number >= 59)))
    usable &= glonass | (system != GLONASS)
    wanted = (satellite * _SIGNAL + satellites.signal)[usable]
    order = np.argsort(wanted)
    seen_s = f.history[:, SEEN_S]
    row = np.flatnonzero(np.isin(f.keys // _SIGNAL, wanted) & (seen_s == seen_s.max(initial=-np.inf)))
    kind = f.keys[row] // _SIGNAL**2 // SATELLITES_PER_SYSTEM * _SIGNAL**2 + f.keys[row] % _SIGNAL**2
    _, group = np.unique(kind, return_inverse=True)
    weight = packed[usable, T_ELEVATION_RAD][order][np.searchsorted(wanted[order], f.keys[row] // _SIGNAL)]
    return Candidates(row, group.astype(np.int64), f.keys[row] // _SIGNAL**2, weight)


@kernel
def rank(f: Filter, candidates: Candidates, length_m: float, length_sigma_m: float) -> Ranked:
    """Search the integers of all double differences of the candidates and keep the KEPT best, by the length too where it is known.

    None where the covariance is not positive definite or the search does not end.
    """
    pairs, none = pairs_of(candidates), np.zeros((0, 3))
    n, searched = len(pairs), KEPT + 1
    fixed, norms = np.zeros((searched, n)), np.zeros(searched)
    status = search_pairs(f.x, f.P, pairs, NODE_LIMIT, fixed, norms)[0] if n > 0 else -1
    if status == OK and n <= _FEW and np.isfinite(length_m) and log_odds(norms[0], norms[KEPT], n) < _CLEAR:
        many, their_norms = np.zeros((SEARCHED, n)), np.zeros(SEARCHED)
        if search_pairs(f.x, f.P, pairs, NODE_LIMIT, many, their_norms)[0] == OK:
            searched, fixed, norms = SEARCHED, many, their_norms
    gain, mean, cov = np.zeros((3, n)), np.zeros(3), np.zeros((3, 3))
    if status != OK or not _gain_of(f, pairs, gain, mean, cov):
        return Ranked(pairs, fixed[:0], none, cov, norms[:0], np.inf)
    places, totals = np.zeros((searched, 3)), norms.copy()
    for k in range(searched):
        for i in range(3):
            places[k, i] = mean[i]
            for j in range(n):
                places[k, i] += gain[i, j] * fixed[k, j]
        if np.isfinite(length_m):
            totals[k] += length_misfit(places[k], cov, length_m, length_sigma_m)
    order = np.argsort(totals)
    kept = order[: min(KEPT, searched - 1)]
    return Ranked(pairs, fixed[kept], places[kept], cov, norms[kept], min(totals[order[len(kept)]], norms[searched - 1]))


@kernel
def length_misfit(vector_m: Vector, cov_m2: Matrix, length_m: float, sigma_m: float) -> float:
    """Return the squared misfit of a vector's length, in sigmas of the known length and the vector together."""
    square, variance = 0.0, 0.0
    for i in range(3):
        square += vector_m[i] * vector_m[i]
        for j in range(3):
            variance += vector_m[i] * cov_m2[i, j] * vector_m[j]
    return (np.sqrt(square) - length_m) ** 2 / (sigma_m * sigma_m + variance / max(square, 1e-12))


@kernel
def _gain_of(f: Filter, pairs: Indices, gain: Matrix, mean: Vector, cov: Matrix) -> bool:
    """Write how the baseline follows from integers, mean + gain @ integers, and its covariance; False where nothing can be said."""
    n = len(pairs)
    a, Q, U, G = np.empty(n), np.empty((n, n)), np.empty((n, n)), np.empty((n, 3))
    difference(f.x, f.P, pairs, a, Q)
    if factor(Q, U) != 0:
        return False
    for k in range(n):
        for i in range(3):
            G[k, i] = f.P[i, pairs[k, 0]] - f.P[i, pairs[k, 1]]
            for j in range(k):
                G[k, i] -= U[j, k] * G[j, i]
            G[k, i] /= U[k, k]
    for i in range(3):
        for j in range(3):
            cov[i, j] = f.P[i, j]
            for k in range(n):
                cov[i, j] -= G[k, i] * G[k, j]
        for k in range(n - 1, -1, -1):
            gain[i, k] = G[k, i]
            for j in range(k + 1, n):
                gain[i, k] -= U[k, j] * gain[i, j]
            gain[i, k] /= U[k, k]
        mean[i] = f.x[i]
        for k in range(n):
            mean[i] -= gain[i, k] * a[k]
    return True
