"""Cycle slips: what the receivers say, and time differences of the phase that do not fit the others.

The test of time differences (TDCP) is made per receiver on undifferenced phases: from one epoch to the next a receiver's phases change by
its own motion (3), its clock (1) and by millimetres otherwise. A robust fit to many satellites finds slips of single cycles on one
frequency, which a geometry-free combination cannot.
"""

from math import isfinite
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.rtk.residuals import BASE_PHASE, ROVER_PHASE, WAVELENGTH, Differences
from rtkmesh.rtk.state import BASE_LOCK_S, BASE_M, BASE_S, ISSUE, ROVER_LOCK_S, ROVER_M, ROVER_S, SEEN_S

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

DRIFT_MPS: Final = 0.004  # what atmosphere and satellite clocks may add to a time difference per second
_FLOOR_M: Final = 0.004  # below this residuals count alike in the robust fit
_ITERATIONS: Final = 12
REPAIR_REDUNDANCY: Final = 3  # from here on the size of a jump is taken from the residual

UNTESTED: Final = -1  # too few satellites for a test
SLOW_S: Final = 2.5  # from this interval on, phases of both receivers are tested as one: the atmosphere moves too much for one alone

# What happened to the phase of a pair. KNOWN_SLIP: the size of the jump was measured.
NO_SLIP, KNOWN_SLIP, LOST = range(3)


@kernel
def lost_lock(lock_s: float, previous_lock_s: float, elapsed_s: float) -> bool:
    """Return whether lock times say that tracking was interrupted. ``lock_s`` may be a lower bound within a factor of 2 (RTCM DF407)."""
    if not isfinite(lock_s) or not isfinite(previous_lock_s):
        return False
    return lock_s < previous_lock_s - 1e-3 or 2.0 * lock_s + 0.5 < elapsed_s


class SlipSetup(NamedTuple):
    """Threshold of the time-difference test (cycles), longest gap that ambiguities survive (s), and who moves."""

    threshold_cyc: float
    maximum_gap_s: float
    base_moves: bool
    rover_moves: bool


@kernel
def find_slips(
    d: Differences, history: Matrix, place: Indices, times_s: Vector, setup: SlipSetup, slip: Indices, jump_cyc: Vector, motion: Vector,
    motion_cov: Matrix,
) -> int:  # fmt: skip
    """Write per pair NO_SLIP, KNOWN_SLIP (with the jump in cycles) or LOST; the motion of the rover (m, against its model positions).

    ``place`` are rows of ``history`` (-1: no phase); ``times_s`` are now rover, now base, last rover, last base. Return the redundancy of
    the rover's test, in satellites: two bands of one satellite witness the same thing.
    """
    n, wavelength = len(place), d.table[:, WAVELENGTH]
    rover_dt, base_dt = times_s[0] - times_s[2], times_s[1] - times_s[3]
    together = rover_dt > SLOW_S and abs(rover_dt - base_dt) < 0.1
    change, threshold, residual = np.full(n, np.nan), np.empty(n), np.empty(n)
    base_change, base_residual = np.full(n, np.nan), np.full(n, np.nan)
    for k in range(n):
        slip[k], jump_cyc[k], threshold[k] = NO_SLIP, 0.0, np.nan
        if place[k] < 0:
            continue
        h = history[place[k]]
        threshold[k] = setup.threshold_cyc * wavelength[k] + (0.25 if together else 1.0) * DRIFT_MPS * rover_dt
        if h[ISSUE] == d.issue[k] and h[ROVER_S] == times_s[2]:
            change[k] = d.table[k, ROVER_PHASE] - h[ROVER_M]
        if h[ISSUE] == d.issue[k] and h[BASE_S] == times_s[3] and d.base_s[k] == times_s[1] and base_dt > 0.0:
            base_change[k] = d.table[k, BASE_PHASE] - h[BASE_M]
        if together:
            change[k] -= base_change[k]
    redundancy = time_difference_test(change, d.rover_direction, threshold, setup.rover_moves, residual, motion, motion_cov)
    if redundancy != UNTESTED:
        redundancy = min(redundancy, _agreeing(d.pairs.satellite, residual, threshold) - (4 if setup.rover_moves else 1))
    base_redundancy = UNTESTED
    if not together and base_dt > 0.0:
        base_redundancy = _test_base(d, base_change, base_dt, setup, base_residual, slip)
    for k in range(n):
        if place[k] < 0:
            continue
        if redundancy != UNTESTED and abs(residual[k]) > threshold[k]:
            slip[k] = KNOWN_SLIP
        _hear_receivers(d, k, history[place[k]], times_s, setup.maximum_gap_s, slip)
        if slip[k] != KNOWN_SLIP:
            continue
        jump = residual[k] if redundancy >= REPAIR_REDUNDANCY else np.nan
        if not together and d.base_s[k] != history[place[k], BASE_S]:
            jump -= base_residual[k] if base_redundancy >= REPAIR_REDUNDANCY else np.nan
        jump_cyc[k] = jump / wavelength[k]
        if not isfinite(jump):
            slip[k] = LOST
    return redundancy


@kernel
def _agreeing(satellite: NDArray[np.int16], residual_m: Vector, threshold_m: Vector) -> int:
    """Return how many satellites (sorted) have a phase that fits."""
    count, last = 0, -1
    for k in range(len(satellite)):
        if abs(residual_m[k]) <= threshold_m[k] and satellite[k] != last:
            last = satellite[k]
            count += 1
    return count


@kernel
def _test_base(d: Differences, change_m: Vector, dt_s: float, setup: SlipSetup, residual_m: Vector, slip: Indices) -> int:
    """Test the phases of the base by themselves; mark its slips; return the redundancy."""
    spare, spare_cov, threshold = np.empty(3), np.empty((3, 3)), np.empty(len(slip))
    for k in range(len(slip)):
        threshold[k] = setup.threshold_cyc * d.table[k, WAVELENGTH] + DRIFT_MPS * dt_s
    redundancy = time_difference_test(change_m, d.base_direction, threshold, setup.base_moves, residual_m, spare, spare_cov)
    if redundancy != UNTESTED:
        for k in range(len(slip)):
            if abs(residual_m[k]) > threshold[k]:
                slip[k] = KNOWN_SLIP
    return redundancy


@kernel
def _hear_receivers(d: Differences, k: int, history: Vector, times_s: Vector, longest_gap_s: float, slip: Indices) -> None:
    """Mark what the receivers say of pair k: slips, lock times, gaps."""
    rover_dt = times_s[0] - times_s[2]
    if d.flagged[k, 0] or lost_lock(d.lock_s[k, 0], history[ROVER_LOCK_S], times_s[0] - history[ROVER_S]):
        slip[k] = KNOWN_SLIP
    new_base = d.base_s[k] != history[BASE_S]  # what a base epoch says counts once, however long it is used
    if new_base and (d.flagged[k, 1] or lost_lock(d.lock_s[k, 1], history[BASE_LOCK_S], d.base_s[k] - history[BASE_S])):
        slip[k] = KNOWN_SLIP
    gap_s = times_s[0] - history[SEEN_S]
    if gap_s > max(longest_gap_s, 2.5 * rover_dt) or (gap_s > 1.5 * rover_dt and not d.lock_s[k, 0] > gap_s):
        slip[k] = LOST


@kernel
def time_difference_test(
    change_m: Vector, direction: Matrix, threshold_m: Vector, moving: bool, residual_m: Vector, motion: Vector, motion_cov: Matrix
) -> int:
    """Fit motion and clock to phase changes robustly (iterated re-weighting towards the L1 norm); write the residuals.

    ``change_m`` (n, NaN: none) are changes of observed minus modelled phase, ``direction`` (n x 3) the unit vectors receiver to satellite,
    ``motion`` (3) receives the displacement (m) against the model's and ``motion_cov`` its covariance from the inliers. A residual beyond
    ``threshold_m`` is a slip. Return the redundancy of the inliers, or UNTESTED.
    """
    n, unknowns = len(change_m), 4 if moving else 1
    weight = np.zeros(n)
    used = 0
    for k in range(n):
        residual_m[k] = np.nan
        if isfinite(change_m[k]):
            weight[k] = 1.0
            used += 1
    motion[:] = 0.0
    motion_cov[:, :] = np.nan
    if used < unknowns + 1:
        return UNTESTED
    A, y = np.zeros((4, 4)), np.zeros(4)
    clock = _median(change_m)
    for k in range(n):
        if weight[k] > 0.0 and not moving:
            residual_m[k] = change_m[k] - clock
    iterations = _ITERATIONS if moving else 0
    for step in range(iterations + 1):
        last = step == iterations
        if last:
            for k in range(n):
                if weight[k] > 0.0:
                    inside = abs(residual_m[k]) <= threshold_m[k] if step > 0 or not moving else True
                    weight[k] = 1.0 if inside else 0.0
        used = 0
        for k in range(n):
            used += 1 if weight[k] > 0.0 else 0
        if last and used < unknowns:
            return UNTESTED
        if not _fit(change_m, direction, weight, moving, A, y):
            return UNTESTED
        for k in range(n):
            if isfinite(change_m[k]):
                residual_m[k] = change_m[k] - y[3]
                for i in range(3):
                    residual_m[k] += direction[k, i] * y[i]
                if weight[k] > 0.0 and not last:
                    weight[k] = 1.0 / max(abs(residual_m[k]), _FLOOR_M)
    redundancy = used - unknowns
    _spread(weight, residual_m, redundancy, A, motion_cov)
    for i in range(3):
        motion[i] = y[i]
    return redundancy


@kernel
def _fit(change_m: Vector, direction: Matrix, weight: Vector, moving: bool, A: Matrix, y: Vector) -> bool:
    """Solve the weighted normal equations of (motion, clock) into ``y``; ``A`` receives the inverse. False if singular."""
    A[:, :] = 0.0
    y[:] = 0.0
    h = np.zeros(4)
    h[3] = 1.0
    for k in range(len(change_m)):
        w = weight[k]
        if not w > 0.0:
            continue
        for i in range(3):
            h[i] = -direction[k, i] if moving else 0.0
        for i in range(4):
            y[i] += w * h[i] * change_m[k]
            for j in range(4):
                A[i, j] += w * h[i] * h[j]
    if not moving:
        for i in range(3):
            A[i, i] = 1.0
    return _invert(A, y)


@kernel
def _invert(A: Matrix, y: Vector) -> bool:
    """Gauss-Jordan with a symmetric positive definite A, in place; ``y`` becomes the solution."""
    n = len(y)
    trace = 0.0
    for i in range(n):
        trace += A[i, i]
    for k in range(n):
        pivot = A[k, k]
        if not pivot > 1e-9 * trace:
            return False
        for j in range(n):
            A[k, j] /= pivot
        A[k, k] = 1.0 / pivot
        y[k] /= pivot
        for i in range(n):
            if i == k:
                continue
            f = A[i, k]
            for j in range(n):
                if j != k:
                    A[i, j] -= f * A[k, j]
            A[i, k] = -f / pivot
            y[i] -= f * y[k]
    return True


@kernel
def _spread(weight: Vector, residual_m: Vector, redundancy: int, A: Matrix, motion_cov: Matrix) -> None:
    """Write the covariance of the motion: the inverse normal matrix times the variance of unit weight (at least (3 mm)^2)."""
    total = 0.0
    for k in range(len(weight)):
        if weight[k] > 0.0:
            total += residual_m[k] ** 2
    unit = max(total / max(redundancy, 1), 0.003**2)
    for i in range(3):
        for j in range(3):
            motion_cov[i, j] = A[i, j] * unit


@kernel
def _median(values: Vector) -> float:
    """Return the median of the finite values (0 if there are none); insertion sort, for they are few."""
    kept = np.empty(len(values))
    n = 0
    for k in range(len(values)):
        if not isfinite(values[k]):
            continue
        place = n
        while place > 0 and kept[place - 1] > values[k]:
            kept[place] = kept[place - 1]
            place -= 1
        kept[place] = values[k]
        n += 1
    if n == 0:
        return 0.0
    return kept[n // 2] if n % 2 == 1 else 0.5 * (kept[n // 2 - 1] + kept[n // 2])
