"""The best integer vectors of an epoch and the baseline that each of them gives: for those who know more than one baseline does.

Made when asked for, never per epoch. What a known shape of several antennas makes of them is ``attitude.search``.
"""

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.gnss.signals import GLONASS, KEYS_PER_SATELLITE, SATELLITES_PER_SYSTEM, SBAS, SIGNALS_PER_SATELLITE
from rtkmesh.rtk.ambiguity import NODE_LIMIT, Candidates, difference, gain_of, pairs_of
from rtkmesh.rtk.lambda_search import OK
from rtkmesh.rtk.length_search import Given, nearest_of_length
from rtkmesh.rtk.matching import clock_group
from rtkmesh.rtk.memory import TRUSTS_GLONASS
from rtkmesh.rtk.relative import Setup
from rtkmesh.rtk.single_epoch import sharpness, with_sharper_phases
from rtkmesh.rtk.solution import T_ELEVATION_RAD, T_LOCK_EPOCHS, T_STATE, USED_PHASE, SatelliteTable
from rtkmesh.rtk.state import ARC_EPOCHS, DYNAMIC, SEEN_S, Filter

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

KEPT: Final = 40


@dataclass(frozen=True, slots=True, eq=False)
class CandidateTable:
    """Integer vectors of one epoch, best first, at most KEPT.

    Columns: satellite and signal numbers (rover's and base's) of each ambiguity, sorted. ``integers`` (m, p) are single differences
    (cycles); of each system and pair of signals the one of the reference is 0. ``count`` is the number of double differences.
    ``baselines_ecef_m`` (m, 3) is rover minus base under each; ``cov_ecef_m2`` (3, 3) its covariance by the filter, the same for all
    (a fix publishes a smaller one). ``norms`` (m) are squared norms against the float ambiguities; ``beyond`` is the least squared norm
    of what is not in the table (with a known length: with its misfit).
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
    f: Filter, place: tuple[Vector, Matrix], satellites: SatelliteTable, memory: Vector, scale: Matrix, setup: Setup,
    length: tuple[float, float] | None = None,
) -> CandidateTable | None:  # fmt: skip
    """Return the best candidates of an epoch with this filter and satellite table; None where too little can be searched.

    ``place`` are states and covariance of the filter that says where integers put the rover. ``length`` (m) of the baseline and its sigma,
    if the filter's options do not tell it.
    """
    found = _usable(f, satellites, setup, glonass=memory[TRUSTS_GLONASS] > 0.0)
    if len(found.row) < 2:
        return None
    length_m, sigma_m = setup.resolve.length_m, setup.resolve.length_sigma_m
    if length is not None and not np.isfinite(length_m):
        length_m, sigma_m = length
    if (f.history[found.row, ARC_EPOCHS] <= 1.0).all():
        f = with_sharper_phases(f, sharpness(scale))
        place = f.x, f.P
    ranked = rank(f, *place, found, length_m, sigma_m)
    if not len(ranked.norms):
        return None
    keys, columns = f.keys[found.row], np.zeros(len(f.x), np.int64)
    columns[found.row + DYNAMIC] = np.arange(len(found.row))
    integers = np.zeros((len(ranked.norms), len(keys)), np.int64)
    integers[:, columns[ranked.pairs[:, 0]]] = np.rint(ranked.integers).astype(np.int64)
    satellite, signal = np.divmod(keys // SIGNALS_PER_SATELLITE, SIGNALS_PER_SATELLITE)
    return CandidateTable(
        satellite.astype(np.int16), signal.astype(np.int16), (keys % SIGNALS_PER_SATELLITE).astype(np.int16), integers, len(ranked.pairs),
        ranked.baselines_m, ranked.cov_m2, ranked.norms, ranked.beyond,
    )  # fmt: skip


def _usable(f: Filter, satellites: SatelliteTable, setup: Setup, *, glonass: bool) -> Candidates:
    """Return the ambiguities of the epoch that may become integers: as ``bookkeeping.find_candidates``, from the table."""
    packed, satellite = satellites.packed, satellites.satellite.astype(np.int64)
    system = satellite // SATELLITES_PER_SYSTEM
    usable = (packed[:, T_STATE].astype(np.int64) & USED_PHASE != 0) & (packed[:, T_ELEVATION_RAD] >= setup.ambiguity_mask_rad)
    usable &= (packed[:, T_LOCK_EPOCHS] > setup.minimum_lock_epochs) & (system != SBAS)
    usable &= glonass | (system != GLONASS)
    wanted = (satellite * SIGNALS_PER_SATELLITE + satellites.signal)[usable]
    order = np.argsort(wanted)
    seen_s = f.history[:, SEEN_S]
    row = np.flatnonzero(np.isin(f.keys // SIGNALS_PER_SATELLITE, wanted) & (seen_s == seen_s.max(initial=-np.inf)))
    _, group = np.unique([clock_group(key // KEYS_PER_SATELLITE, key % KEYS_PER_SATELLITE) for key in f.keys[row]], return_inverse=True)
    weight = packed[usable, T_ELEVATION_RAD][order][np.searchsorted(wanted[order], f.keys[row] // SIGNALS_PER_SATELLITE)]
    return Candidates(row, group.astype(np.int64), f.keys[row] // KEYS_PER_SATELLITE, weight)


@kernel
def rank(f: Filter, place_x: Vector, place_P: Matrix, candidates: Candidates, length_m: float, length_sigma_m: float) -> Ranked:
    """Search the integers of all double differences of the candidates and keep the KEPT best, by the length too where it is known; the
    filter of states ``place_x`` says where they put the rover.

    None where the covariance is not positive definite or the search does not end.
    """
    pairs = pairs_of(candidates)
    n = len(pairs)
    a, Q, gain, mean, cov = np.empty(n), np.empty((n, n)), np.zeros((3, n)), np.zeros(3), np.zeros((3, 3))
    fixed, norms, totals, status, beyond = np.zeros((KEPT, n)), np.zeros(KEPT), np.zeros(KEPT), -1, 0.0
    difference(f.x, f.P, pairs, a, Q)
    if n > 0 and gain_of(place_x, place_P, pairs, gain, mean, cov):
        given = Given(mean, gain, cov, length_m, length_sigma_m)
        status, beyond, _ = nearest_of_length(a, Q, given, NODE_LIMIT, fixed, norms, totals)
    kept = int(np.sum(np.isfinite(totals))) if status == OK else 0
    places = np.zeros((kept, 3))
    for k in range(kept):
        for i in range(3):
            places[k, i] = mean[i]
            for j in range(n):
                places[k, i] += gain[i, j] * fixed[k, j]
    return Ranked(pairs, fixed[:kept], places, cov, norms[:kept], beyond)
