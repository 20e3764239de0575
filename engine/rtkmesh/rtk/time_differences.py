"""Time differences of the phases of one receiver: from epoch to epoch they change by its motion (3), its clock (1) and by millimetres.

The fit is robust in three ways: phases that are doubted do not vote, the rest is fitted towards the L1 norm, and where that leaves a
contradiction among few satellites, every motion that some of them agree on is tried (the L1 norm gives way to one satellite that stands
alone in its part of the sky), and the one that Dopplers speak for is preferred.
"""

from math import isfinite, sqrt
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place, scratch, scratch_indices, scratch_table
from rtkmesh.rtk.ordered import sort_finite

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

UNTESTED: Final = -1  # too few satellites for a test
_FLOOR_M: Final = 0.004  # below this residuals count alike in the robust fit
_ITERATIONS: Final = 12
_SIGMA_M: Final = 0.003  # of a time difference, at least
_UNKNOWNS: Final = 4
_SHARP: Final = 0.3  # part of the threshold within which a phase agrees with a motion without reserve
_TRIES: Final = 130  # motions that are tried: all of nine satellites (126)
_ENUMERATED: Final = 9  # up to so many satellites all subsets of four are tried, then random ones
_SURPLUS: Final = 3  # so many more satellites that agree than determine the motion or contradict it leave no doubt
_UNEXPECTED: Final = 3.0  # sigmas by which a motion may differ from what Dopplers let expect
_NOT_WHOLE: Final = 1.5  # what a contradiction costs that is no whole number of cycles
_WHOLE_CYC: Final = 0.12
_BETTER: Final = 0.2  # phases by which another motion must be agreed on more
_DOPPLER_PHASES: Final = 3.0  # how many phases the Dopplers can outvote


class Voices(NamedTuple):
    """Phases of one receiver: satellites (sorted), unit vectors to them (n x 3), and which may vote; ``moving``: the receiver moves.

    ``expected`` is the displacement (m) that Dopplers let expect, and its sigma; NaN where they do not. Wavelengths in m.
    """

    satellite: NDArray[np.int16]
    direction: Matrix
    votes: NDArray[np.bool_]
    moving: bool
    expected: Vector
    wavelength_m: Vector


class Motion(NamedTuple):
    """What a test found, in arrays that it writes to: residuals (m, n), displacement against the model's and clock (m, 4), covariance;
    ``fit``: squared residuals of the phases that fit (m2, sum), and their degrees of freedom.
    """

    residual_m: Vector
    step_m: Vector
    cov_m2: Matrix
    fit: Vector


@kernel
def no_motion(count: int) -> Motion:
    """Return room for the motion that so many phases show."""
    return Motion(np.full(count, np.nan), np.zeros(_UNKNOWNS), np.full((_UNKNOWNS, _UNKNOWNS), np.nan), np.zeros(2))


@kernel_in_place
def time_difference_test(change_m: Vector, threshold_m: Vector, voices: Voices, found: Motion) -> int:
    """Fit motion and clock to phase changes and write what was found; return the redundancy of the inliers, or UNTESTED.

    ``change_m`` (n, NaN: none) are changes of observed minus modelled phase. A residual beyond ``threshold_m`` is a slip.
    """
    weight, unknowns = scratch(len(change_m)), _UNKNOWNS if voices.moving else 1
    weight[:], found.residual_m[:], found.step_m[:], found.cov_m2[:, :], found.fit[:] = 0.0, np.nan, 0.0, np.nan, 0.0
    tested = _voting(change_m, voices.votes, weight)
    if tested < unknowns + 1 or np.sum(weight) < unknowns:
        return UNTESTED
    A, y = scratch_table(_UNKNOWNS, _UNKNOWNS), scratch(_UNKNOWNS)
    y[:] = 0.0
    if not voices.moving:
        y[3] = _median(change_m, weight)
    elif not _fit_robustly(change_m, voices, weight, found.residual_m, A, y):
        return UNTESTED
    _residuals(change_m, voices, y, found.residual_m)
    if voices.moving and _contradictory(voices, weight, threshold_m, found.residual_m, y):
        _seek_consent(change_m, voices, weight, threshold_m, found.residual_m, A, y)
    used = 0
    for k in range(len(change_m)):
        weight[k] = 1.0 if abs(found.residual_m[k]) <= threshold_m[k] else 0.0
        used += 1 if weight[k] > 0.0 else 0
    if used < unknowns or not _fit(change_m, voices, weight, A, y):
        return UNTESTED
    _residuals(change_m, voices, y, found.residual_m)
    _spread(weight, used - unknowns, A, found)
    for i in range(_UNKNOWNS):
        found.step_m[i] = y[i]
    return used - unknowns


@kernel_in_place
def _voting(change_m: Vector, votes: NDArray[np.bool_], weight: Vector) -> int:
    """Write 1 as the weight of all phases that vote; return how many there are at all."""
    tested = 0
    for k in range(len(change_m)):
        if isfinite(change_m[k]):
            tested += 1
            weight[k] = 1.0 if votes[k] else 0.0
    return tested


@kernel_in_place
def _fit_robustly(change_m: Vector, voices: Voices, voting: Vector, residual_m: Vector, A: Matrix, y: Vector) -> bool:
    """Fit by least squares, re-weighted towards the L1 norm; False if singular."""
    weight = scratch(len(voting))
    for k in range(len(voting)):
        weight[k] = voting[k]
    for _ in range(_ITERATIONS):
        if not _fit(change_m, voices, weight, A, y):
            return False
        _residuals(change_m, voices, y, residual_m)
        for k in range(len(weight)):
            if weight[k] > 0.0:
                weight[k] = 1.0 / max(abs(residual_m[k]), _FLOOR_M)
    return True


@kernel_in_place
def _residuals(change_m: Vector, voices: Voices, y: Vector, residual_m: Vector) -> None:
    direction, dx, dy, dz, clock = voices.direction, y[0], y[1], y[2], y[3]
    for k in range(len(change_m)):
        residual_m[k] = change_m[k] - clock + direction[k, 0] * dx + direction[k, 1] * dy + direction[k, 2] * dz


@kernel_in_place
def predicted_change_m(direction: Matrix, k: int, step_m: Vector) -> float:
    """Return how much a motion and a clock (m, 4) change phase k."""
    return step_m[3] - direction[k, 0] * step_m[0] - direction[k, 1] * step_m[1] - direction[k, 2] * step_m[2]


@kernel_in_place
def prediction_sigma_m(direction: Matrix, k: int, found: Motion) -> float:
    """Return the sigma of that (m), with that of the phase's own time difference."""
    total = _SIGMA_M**2
    for i in range(_UNKNOWNS):
        for j in range(_UNKNOWNS):
            a = 1.0 if i == 3 else -direction[k, i]
            total += a * found.cov_m2[i, j] * (1.0 if j == 3 else -direction[k, j])
    return sqrt(total)


@kernel_in_place
def agreeing(satellite: NDArray[np.int16], residual_m: Vector, threshold_m: Vector) -> int:
    """Return how many satellites (sorted) have a phase that fits."""
    count, last = 0, -1
    for k in range(len(satellite)):
        if abs(residual_m[k]) <= threshold_m[k] and satellite[k] != last:
            last = satellite[k]
            count += 1
    return count


# --- where the robust fit leaves a contradiction ---


@kernel_in_place
def _contradictory(voices: Voices, voting: Vector, threshold_m: Vector, residual_m: Vector, y: Vector) -> bool:
    """Return whether phases that vote do not fit (or the Dopplers), with too few satellites that do to be sure whose fault it is.

    Among few satellites the fit hides most of a slip, and what stands out is enough to look.
    """
    fitting = agreeing(voices.satellite, residual_m, threshold_m)
    limit = 1.0 if fitting >= _UNKNOWNS + _SURPLUS else _SHARP
    against, last = 1 if _surprise(voices, y) > _UNEXPECTED else 0, -1
    for k in range(len(voting)):
        if voting[k] > 0.0 and abs(residual_m[k]) > limit * threshold_m[k] and voices.satellite[k] != last:
            last = voices.satellite[k]
            against += 1
    return against > 0 and fitting < _UNKNOWNS + _SURPLUS + against


@kernel_in_place
def _surprise(voices: Voices, y: Vector) -> float:
    """Return by how many sigmas a motion differs from what Dopplers let expect; 0 where they do not."""
    if not isfinite(voices.expected[3]):
        return 0.0
    return sqrt((y[0] - voices.expected[0]) ** 2 + (y[1] - voices.expected[1]) ** 2 + (y[2] - voices.expected[2]) ** 2) / voices.expected[3]


@kernel_in_place
def _seek_consent(change_m: Vector, voices: Voices, voting: Vector, threshold_m: Vector, residual_m: Vector, A: Matrix, y: Vector) -> None:
    """Try the motions that four satellites determine; keep the residuals of the one that most phases and the Dopplers agree with."""
    phases = scratch_indices(2 * len(voting))
    satellites = _one_each(voices.satellite, voting, phases)
    if satellites <= _UNKNOWNS:
        return
    trial, weight = scratch(len(voting)), scratch(len(voting))
    best, state = _disagreement(residual_m, threshold_m, voting, voices, _surprise(voices, y)), 1
    four = scratch_indices(_UNKNOWNS)
    for band in range(2):
        for i in range(_UNKNOWNS):
            four[i] = i
        for _ in range(_TRIES):
            weight[:] = 0.0
            for i in range(_UNKNOWNS):
                weight[phases[band * len(voting) + four[i]]] = 1.0
            if _fit(change_m, voices, weight, A, y):
                _residuals(change_m, voices, y, trial)
                cost = _disagreement(trial, threshold_m, voting, voices, _surprise(voices, y))
                if cost < best - _BETTER:
                    best = cost
                    for k in range(len(trial)):
                        residual_m[k] = trial[k]
            if satellites > _ENUMERATED:
                state = _random_subset(four, satellites, state)
            elif not _next_subset(four, satellites):
                break


@kernel_in_place
def _one_each(satellite: NDArray[np.int16], voting: Vector, out: Indices) -> int:
    """Write the first voting phase of each satellite, in the second half of ``out`` the last one; return how many satellites these are."""
    count, last = 0, -1
    for k in range(len(satellite)):
        if not voting[k] > 0.0:
            continue
        if satellite[k] != last:
            last = satellite[k]
            out[count] = k
            count += 1
        out[len(satellite) + count - 1] = k
    return count


@kernel_in_place
def _disagreement(residual_m: Vector, threshold_m: Vector, voting: Vector, voices: Voices, surprise: float) -> float:
    """Return the sum of squared residuals of voting phases and Dopplers, each cut off where it contradicts: slips are whole cycles."""
    total = min((surprise / _UNEXPECTED) ** 2, 1.0) * _DOPPLER_PHASES
    for k in range(len(voting)):
        if voting[k] > 0.0:
            square, cycles = (residual_m[k] / (_SHARP * threshold_m[k])) ** 2, residual_m[k] / voices.wavelength_m[k]
            if square > 1.0:
                square = min(square, 1.0 if abs(cycles - np.rint(cycles)) <= _WHOLE_CYC else _NOT_WHOLE)
            total += square
    return total


@kernel_in_place
def _next_subset(chosen: Indices, n: int) -> bool:
    """Write the next subset of the numbers below n in the order of the alphabet; False after the last."""
    size = len(chosen)
    i = size - 1
    while i >= 0 and chosen[i] == n - size + i:
        i -= 1
    if i < 0:
        return False
    chosen[i] += 1
    for j in range(i + 1, size):
        chosen[j] = chosen[j - 1] + 1
    return True


@kernel_in_place
def _random_subset(chosen: Indices, n: int, state: int) -> int:
    """Write different numbers below n; return the state of the generator (Park and Miller 1988), for runs must repeat themselves."""
    count = 0
    while count < len(chosen):
        state = state * 16807 % 2147483647
        number, known = state % n, False
        for i in range(count):
            known = known or chosen[i] == number
        if not known:
            chosen[count] = number
            count += 1
    return state


# --- arithmetic ---


@kernel_in_place
def _fit(change_m: Vector, voices: Voices, weight: Vector, A: Matrix, y: Vector) -> bool:
    """Solve the weighted normal equations of (motion, clock) into ``y``; ``A`` receives the inverse. False if singular."""
    A[:, :] = 0.0
    y[:] = 0.0
    direction, scale = voices.direction, -1.0 if voices.moving else 0.0
    for k in range(len(change_m)):
        w = weight[k]
        if not w > 0.0:
            continue
        h = (scale * direction[k, 0], scale * direction[k, 1], scale * direction[k, 2], 1.0)
        for i in range(_UNKNOWNS):
            a = w * h[i]
            y[i] += a * change_m[k]
            for j in range(i + 1):
                A[i, j] += a * h[j]
    for i in range(_UNKNOWNS):
        for j in range(i):
            A[j, i] = A[i, j]
    if not voices.moving:
        for i in range(3):
            A[i, i] = 1.0
    return _invert(A, y)


@kernel_in_place
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


@kernel_in_place
def _spread(weight: Vector, redundancy: int, A: Matrix, found: Motion) -> None:
    """Write the covariance: the inverse normal matrix times the variance of unit weight (at least _SIGMA_M squared)."""
    total = 0.0
    for k in range(len(weight)):
        if weight[k] > 0.0:
            total += found.residual_m[k] ** 2
    unit = max(total / max(redundancy, 1), _SIGMA_M**2)
    found.fit[0], found.fit[1] = total, float(redundancy)
    for i in range(_UNKNOWNS):
        for j in range(_UNKNOWNS):
            found.cov_m2[i, j] = A[i, j] * unit


@kernel_in_place
def unit_variance_m2(fit: Vector) -> float:
    """Return the variance of unit weight in the covariance of a motion with this fit."""
    return max(fit[0] / max(fit[1], 1.0), _SIGMA_M**2)


@kernel_in_place
def _median(values: Vector, weight: Vector) -> float:
    """Return the median of the values that have a weight (0 if there are none)."""
    voting, kept = scratch(len(values)), scratch(len(values))
    for k in range(len(values)):
        voting[k] = values[k] if weight[k] > 0.0 else np.nan
    n = sort_finite(voting, kept)
    if n == 0:
        return 0.0
    return kept[n // 2] if n % 2 == 1 else 0.5 * (kept[n // 2 - 1] + kept[n // 2])
