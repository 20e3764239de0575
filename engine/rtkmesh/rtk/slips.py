"""Cycle slips: what the receivers say, and time differences of the phase that do not fit the others.

The test of time differences (TDCP) is made per receiver on undifferenced phases: from one epoch to the next a receiver's phases change by
its own motion (3), its clock (1) and by millimetres otherwise. A robust fit to many satellites finds slips of single cycles on one
frequency, which a geometry-free combination cannot.
"""

from math import isfinite, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.rtk.residuals import BASE_PHASE, ROVER_PHASE, WAVELENGTH
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


@kernel
def find_slips(
    differences: Matrix,
    history: Matrix,
    place: Indices,
    issue: Vector,
    flagged: NDArray[np.bool_],
    lock_s: Matrix,
    base_s: Vector,
    rover_direction: Matrix,
    base_direction: Matrix,
    times_s: Vector,
    setup: Vector,
    slip: Indices,
    jump_cyc: Vector,
    motion: Vector,
    motion_cov: Matrix,
) -> int:
    """Write per pair NO_SLIP, KNOWN_SLIP (with the jump in cycles) or LOST; the motion of the rover (m, against its model positions).

    ``place`` are rows of ``history`` (-1: no phase); ``flagged`` and ``lock_s`` (n x 2) are the words of rover and base; ``base_s`` is
    the time of each pair's base epoch; ``times_s`` are now rover, now base, last rover, last base; ``setup`` is threshold (cycles),
    longest gap (s), 1.0 if the base moves, 1.0 if the rover moves. Return the redundancy of the rover's test.
    """
    n = len(place)
    threshold_cyc, longest_gap_s, base_moves = setup[0], setup[1], setup[2] > 0.0
    rover_dt, base_dt = times_s[0] - times_s[2], times_s[1] - times_s[3]
    together = rover_dt > SLOW_S and abs(rover_dt - base_dt) < 0.1
    change, threshold, residual = np.full(n, np.nan), np.empty(n), np.empty(n)
    base_change, base_residual = np.full(n, np.nan), np.full(n, np.nan)
    for k in range(n):
        slip[k], jump_cyc[k], threshold[k] = NO_SLIP, 0.0, np.nan
        if place[k] < 0:
            continue
        h, wavelength = history[place[k]], differences[k, WAVELENGTH]
        threshold[k] = threshold_cyc * wavelength + (0.25 if together else 1.0) * DRIFT_MPS * rover_dt
        if h[ISSUE] == issue[k] and h[ROVER_S] == times_s[2]:
            change[k] = differences[k, ROVER_PHASE] - h[ROVER_M]
        if h[ISSUE] == issue[k] and h[BASE_S] == times_s[3] and base_s[k] == times_s[1] and base_dt > 0.0:
            base_change[k] = differences[k, BASE_PHASE] - h[BASE_M]
        if together:
            change[k] -= base_change[k]
    redundancy = time_difference_test(change, rover_direction, threshold, setup[3] > 0.0, residual, motion, motion_cov)
    base_redundancy = UNTESTED
    if not together and base_dt > 0.0:
        spare, spare_cov, base_threshold = np.empty(3), np.empty((3, 3)), np.empty(n)
        for k in range(n):
            base_threshold[k] = threshold_cyc * differences[k, WAVELENGTH] + DRIFT_MPS * base_dt
        base_redundancy = time_difference_test(base_change, base_direction, base_threshold, base_moves, base_residual, spare, spare_cov)
        if base_redundancy != UNTESTED:
            for k in range(n):
                if abs(base_residual[k]) > base_threshold[k]:
                    slip[k] = KNOWN_SLIP
    for k in range(n):
        if place[k] < 0:
            continue
        h, wavelength = history[place[k]], differences[k, WAVELENGTH]
        if redundancy != UNTESTED and abs(residual[k]) > threshold[k]:
            slip[k] = KNOWN_SLIP
        if flagged[k, 0] or lost_lock(lock_s[k, 0], h[ROVER_LOCK_S], times_s[0] - h[ROVER_S]):
            slip[k] = KNOWN_SLIP
        new_base = base_s[k] != h[BASE_S]  # what a base epoch says counts once, however long it is used
        if new_base and (flagged[k, 1] or lost_lock(lock_s[k, 1], h[BASE_LOCK_S], base_s[k] - h[BASE_S])):
            slip[k] = KNOWN_SLIP
        gap_s = times_s[0] - h[SEEN_S]
        if gap_s > max(longest_gap_s, 2.5 * rover_dt) or (gap_s > 1.5 * rover_dt and not lock_s[k, 0] > gap_s):
            slip[k] = LOST
        if slip[k] != KNOWN_SLIP:
            continue
        jump = residual[k] if redundancy >= REPAIR_REDUNDANCY else np.nan
        if not together and new_base:
            jump -= base_residual[k] if base_redundancy >= REPAIR_REDUNDANCY else np.nan
        jump_cyc[k] = jump / wavelength
        if not isfinite(jump):
            slip[k] = LOST
    return redundancy


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


def rms(values: Vector) -> float:
    """Return the root mean square of the finite values; NaN if there are none."""
    kept = values[np.isfinite(values)]
    return sqrt(float(np.add.reduce(kept * kept)) / len(kept)) if len(kept) else float("nan")
