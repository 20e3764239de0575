"""Least squares of single-point positioning: position and clocks from codes, with exclusion.

All residuals are observed minus modelled. A satellite takes part if USED of the work table is 1; WEIGHT is 1 / VARIANCE except while the
robust fit reweights. Nothing here depends on the order of satellites beyond rounding. Velocities are those of ``rate_adjustment``.
"""

from math import sin, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel_in_place, scratch, scratch_table
from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.models.code_selection import (
    CLOCKS,
    CODE,
    GAIN,
    GROUP,
    IONOSPHERE,
    NOISE,
    RESIDUAL,
    USED,
    VARIANCE,
    WEIGHT,
)
from rtkmesh.models.geometry import E_X, ELEVATION, IONOSPHERE_L1_M, RANGE, TROPOSPHERE_M, line_of_sight, receiver_geometry
from rtkmesh.models.normal_matrix import invert_positive_definite
from rtkmesh.models.orbit import STATE_CLOCK, STATE_OK, STATE_VARIANCE

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

UNKNOWNS: Final = 3 + CLOCKS
CHI2, FREEDOM, PDOP, RATE_CHI2, RATE_FREEDOM = range(5)  # of ``quality``: of codes, dilution, of range rates
QUALITY: Final = 5
CONVERGED, NO_EPHEMERIS, FEW_SATELLITES, NO_CONVERGENCE, INCONSISTENT, POOR_GEOMETRY = range(6)  # as SingleStatus has them

LEAST_SQUARES, LEAST_ABSOLUTE = 0.0, 1.0  # norms of a fit

# Limits of the test of normalised residuals. The scale of all residuals (robust, between 1 and _MOST_SCALE) multiplies it: with the
# noise of a whole street underestimated no satellite is worse than the others.
LIMIT: Final = 4.0
_MOST_SCALE = 4.0
GROSS: Final = 12.0  # without redundancy to say which satellite is wrong, up to here the solution is given with a larger covariance
_BACK = 3.0  # an excluded satellite comes back when its predicted residual is within this many sigmas
_ORBIT_PART = 0.4**2  # a broadcast accuracy is a bound: the signals of healthy satellites are 0.2 to 0.4 of it off
_IONOSPHERE_PART = 0.3  # of Klobuchar's delay; its error is a half, but most of that is common to all satellites
_TROPOSPHERE_SIGMA_M = 0.1  # at the zenith, of the standard atmosphere
_ITERATIONS = 12
_ROBUST_ITERATIONS = 25
_FAR_M = 1000.0  # the atmosphere and the elevations are computed anew when the position moved by more
_C = SPEED_OF_LIGHT_MPS


@kernel_in_place
def adjust_position(work: Matrix, states: Matrix, geometry: Matrix, week: int, tow_s: float, klobuchar: Vector, setup: Vector,
                    position: Vector, clocks_m: Vector, cofactor: Matrix, quality: Vector) -> int:  # fmt: skip
    """Find position (m, ECEF; in: where to start) and receiver clocks (m, one per group) with the inverse of their normal matrix.

    ``setup``: elevation mask (rad), a and b of the code's sigma (m), 1.0 to model the ionosphere, 1.0 to model the troposphere, largest
    PDOP, sigma of a range rate (m/s). ``quality`` gets chi-square, degrees of freedom, PDOP. Excluded satellites have USED 0; returns
    a status of this module.
    """
    for i in range(work.shape[0]):
        work[i, USED] = states[i, STATE_OK]
    status = _converge(work, states, geometry, week, tow_s, klobuchar, setup, LEAST_SQUARES, position, clocks_m, cofactor)
    if status == FEW_SATELLITES:
        return status
    if status != CONVERGED or _is_doubtful(work, geometry, cofactor):
        _robust_start(work, states, geometry, week, tow_s, klobuchar, setup, position, clocks_m, cofactor)
    _mask_low(work, geometry, setup[0])
    status = _exclude(work, states, geometry, week, tow_s, klobuchar, setup, position, clocks_m, cofactor)
    if status == CONVERGED and _take_back(work, states, geometry, setup[0], cofactor) > 0:
        status = _exclude(work, states, geometry, week, tow_s, klobuchar, setup, position, clocks_m, cofactor)
    if status == CONVERGED and not 6.2e6 < sqrt(position[0] ** 2 + position[1] ** 2 + position[2] ** 2) < 5.0e7:
        return NO_CONVERGENCE
    if status == CONVERGED:
        quality[CHI2], quality[FREEDOM], quality[PDOP] = _chi_square(work), _freedom(work), _dilution(work, geometry)
        return CONVERGED if quality[PDOP] <= setup[5] else POOR_GEOMETRY
    return status


@kernel_in_place
def _converge(work: Matrix, states: Matrix, geometry: Matrix, week: int, tow_s: float, klobuchar: Vector, setup: Vector, norm: float,
              position: Vector, clocks_m: Vector, cofactor: Matrix) -> int:  # fmt: skip
    """Iterate the adjustment of the used satellites to the least sum of residuals in this norm."""
    modelled_at, step = scratch(3), scratch(UNKNOWNS)
    modelled_at[0] = np.inf
    for _ in range(_ITERATIONS if norm == LEAST_SQUARES else _ROBUST_ITERATIONS):
        moved = abs(position[0] - modelled_at[0]) + abs(position[1] - modelled_at[1]) + abs(position[2] - modelled_at[2])
        if not moved < _FAR_M:
            receiver_geometry(states, week, tow_s, position, klobuchar, geometry)
            _variances(work, states, geometry, setup)
            for k in range(3):
                modelled_at[k] = position[k]
        else:
            _ranges_only(states, position, geometry)
        _residuals(work, states, geometry, setup, clocks_m)
        if norm == LEAST_ABSOLUTE:
            _centre_clocks(work, clocks_m)
        _weights(work, norm)
        status = _solve(work, geometry, cofactor, step)
        if status != CONVERGED:
            return status
        for k in range(3):
            position[k] += step[k]
        for k in range(CLOCKS):
            clocks_m[k] += step[3 + k]
        if abs(step[0]) + abs(step[1]) + abs(step[2]) < (1e-4 if norm == LEAST_SQUARES else 1e-2):
            _ranges_only(states, position, geometry)
            _residuals(work, states, geometry, setup, clocks_m)
            return CONVERGED
    return NO_CONVERGENCE


@kernel_in_place
def _ranges_only(states: Matrix, position: Vector, geometry: Matrix) -> None:
    for i in range(states.shape[0]):
        if states[i, STATE_OK] != 0.0:
            line_of_sight(states[i], position, geometry[i])


@kernel_in_place
def _variances(work: Matrix, states: Matrix, geometry: Matrix, setup: Vector) -> None:
    """Write the variance (m2) of each code: noise by elevation and C/N0, broadcast accuracy, ionosphere and troposphere models."""
    for i in range(work.shape[0]):
        sine = max(sin(geometry[i, ELEVATION]), 0.05)
        noise = work[i, NOISE] + work[i, GAIN] * (setup[1] ** 2 + (setup[2] / sine) ** 2)
        ionosphere = _IONOSPHERE_PART * work[i, IONOSPHERE] * geometry[i, IONOSPHERE_L1_M]
        work[i, VARIANCE] = noise + _ORBIT_PART * states[i, STATE_VARIANCE] + ionosphere**2 + (_TROPOSPHERE_SIGMA_M / sine) ** 2


@kernel_in_place
def _residuals(work: Matrix, states: Matrix, geometry: Matrix, setup: Vector, clocks_m: Vector) -> None:
    for i in range(work.shape[0]):
        delay = setup[3] * work[i, IONOSPHERE] * geometry[i, IONOSPHERE_L1_M] + setup[4] * geometry[i, TROPOSPHERE_M]
        modelled = geometry[i, RANGE] - _C * states[i, STATE_CLOCK] + delay + clocks_m[int(work[i, GROUP])]
        work[i, RESIDUAL] = work[i, CODE] - modelled


@kernel_in_place
def _centre_clocks(work: Matrix, clocks_m: Vector) -> None:
    """Move each clock, and the residuals of its satellites, to their median: the exact L1 solution at this position."""
    sizes = scratch(work.shape[0])
    for k in range(CLOCKS):
        count = 0
        for i in range(work.shape[0]):
            if work[i, USED] != 0.0 and work[i, GROUP] == k:
                sizes[count] = work[i, RESIDUAL]
                count += 1
        if count == 0:
            continue
        shift = _median(sizes[:count])
        clocks_m[k] += shift
        for i in range(work.shape[0]):
            if work[i, GROUP] == k:
                work[i, RESIDUAL] -= shift


@kernel_in_place
def _weights(work: Matrix, norm: float) -> None:
    """Write 1 / VARIANCE, times sigma / |residual| beyond one sigma for the L1 norm (by reweighting)."""
    for i in range(work.shape[0]):
        size = abs(work[i, RESIDUAL])
        sigma = sqrt(work[i, VARIANCE])
        part = sigma / size if norm == LEAST_ABSOLUTE and size > sigma else 1.0
        work[i, WEIGHT] = part / work[i, VARIANCE]


@kernel_in_place
def _solve(work: Matrix, geometry: Matrix, cofactor: Matrix, step: Vector) -> int:
    """Solve the normal equations; a clock without satellites gets a unit row and stays."""
    normal, right = scratch_table(UNKNOWNS, UNKNOWNS), scratch(UNKNOWNS)
    normal[:, :], right[:] = 0.0, 0.0
    used = 0
    for i in range(work.shape[0]):
        if work[i, USED] == 0.0:
            continue
        used += 1
        group, weight = 3 + int(work[i, GROUP]), work[i, WEIGHT]
        for a in range(3):
            h = -geometry[i, E_X + a] * weight
            right[a] += h * work[i, RESIDUAL]
            normal[group, a] += h
            for b in range(a + 1):
                normal[a, b] -= h * geometry[i, E_X + b]
        right[group] += weight * work[i, RESIDUAL]
        normal[group, group] += weight
    groups = 0
    for k in range(3, UNKNOWNS):
        if normal[k, k] == 0.0:
            normal[k, k] = 1.0
        else:
            groups += 1
    if used < 3 + groups:
        return FEW_SATELLITES
    if not invert_positive_definite(normal, cofactor):
        return POOR_GEOMETRY
    for a in range(UNKNOWNS):
        step[a] = 0.0
        for b in range(UNKNOWNS):
            step[a] += cofactor[a, b] * right[b]
    return CONVERGED


@kernel_in_place
def _part_of_fit(work: Matrix, geometry: Matrix, cofactor: Matrix, i: int) -> float:
    """Return h Q h' (m2): the variance of the modelled code of a satellite."""
    group = 3 + int(work[i, GROUP])
    total = cofactor[group, group]
    for a in range(3):
        total -= 2.0 * geometry[i, E_X + a] * cofactor[a, group]
        for b in range(3):
            total += geometry[i, E_X + a] * geometry[i, E_X + b] * cofactor[a, b]
    return total


@kernel_in_place
def _normalised(work: Matrix, geometry: Matrix, cofactor: Matrix, i: int) -> float:
    """Return residual over its own sigma (Baarda's w); 0 where no other satellite controls it."""
    variance = work[i, VARIANCE] - _part_of_fit(work, geometry, cofactor, i)
    if variance < 1e-6 * work[i, VARIANCE]:
        return 0.0
    return abs(work[i, RESIDUAL]) / sqrt(variance)


@kernel_in_place
def _is_doubtful(work: Matrix, geometry: Matrix, cofactor: Matrix) -> bool:
    """Return whether any normalised residual is beyond the limit at the modelled noise: many outliers raise the scale that hides them."""
    largest = 0.0
    for i in range(work.shape[0]):
        if work[i, USED] != 0.0:
            largest = max(largest, _normalised(work, geometry, cofactor, i))
    return largest > LIMIT


@kernel_in_place
def _scaled_worst(work: Matrix, geometry: Matrix, cofactor: Matrix) -> int:
    """Return the used satellite with the largest normalised residual if that is beyond the limit, else -1."""
    count, worst = 0, -1
    values = scratch(work.shape[0])
    largest = 0.0
    for i in range(work.shape[0]):
        if work[i, USED] == 0.0:
            continue
        value = _normalised(work, geometry, cofactor, i)
        values[count] = value
        count += 1
        if value > largest:
            largest, worst = value, i
    if count == 0:
        return -1
    return worst if largest > LIMIT * scale_of(values[:count]) else -1


@kernel_in_place
def scale_of(sizes: Vector) -> float:
    """Return the robust scale (median of absolute normalised residuals over that of a normal variable) between 1 and _MOST_SCALE."""
    return min(max(1.4826 * _median(sizes), 1.0), _MOST_SCALE)


@kernel_in_place
def _median(values: Vector) -> float:
    """Return the (upper) median and leave the values sorted (own insertion sort: np.sort costs two seconds of compilation)."""
    for i in range(1, len(values)):
        value, k = values[i], i
        while k > 0 and values[k - 1] > value:
            values[k] = values[k - 1]
            k -= 1
        values[k] = value
    return values[len(values) // 2]


@kernel_in_place
def _robust_start(work: Matrix, states: Matrix, geometry: Matrix, week: int, tow_s: float, klobuchar: Vector, setup: Vector,
                  position: Vector, clocks_m: Vector, cofactor: Matrix) -> None:  # fmt: skip
    """Fit to the least sum of absolute residuals and put aside whatever lies far off it.

    Several outliers at once hide each other from one-by-one tests; the L1 fit follows the majority. Without a degree of freedom to
    control what remains, nothing is put aside.
    """
    _converge(work, states, geometry, week, tow_s, klobuchar, setup, LEAST_ABSOLUTE, position, clocks_m, cofactor)
    count = 0
    sizes = scratch(work.shape[0])
    for i in range(work.shape[0]):
        if work[i, USED] != 0.0:
            sizes[count] = abs(work[i, RESIDUAL]) / sqrt(work[i, VARIANCE])
            count += 1
    if count == 0:
        return
    limit = 1.5 * LIMIT * scale_of(sizes[:count])
    for i in range(work.shape[0]):
        if work[i, USED] != 0.0 and not abs(work[i, RESIDUAL]) < limit * sqrt(work[i, VARIANCE]):
            work[i, USED] = 0.0
    if _freedom(work) < 1:
        for i in range(work.shape[0]):
            work[i, USED] = states[i, STATE_OK]


@kernel_in_place
def _mask_low(work: Matrix, geometry: Matrix, mask_rad: float) -> None:
    for i in range(work.shape[0]):
        if not geometry[i, ELEVATION] >= mask_rad:
            work[i, USED] = 0.0


@kernel_in_place
def _exclude(work: Matrix, states: Matrix, geometry: Matrix, week: int, tow_s: float, klobuchar: Vector, setup: Vector, position: Vector,
             clocks_m: Vector, cofactor: Matrix) -> int:  # fmt: skip
    """Adjust, drop the worst satellite, again, until no normalised residual is beyond the limit."""
    for _ in range(work.shape[0] + 1):
        status = _converge(work, states, geometry, week, tow_s, klobuchar, setup, LEAST_SQUARES, position, clocks_m, cofactor)
        if status != CONVERGED:
            return status
        worst = _scaled_worst(work, geometry, cofactor)
        if worst < 0:
            return CONVERGED
        if _freedom(work) < 2:
            return INCONSISTENT if _normalised(work, geometry, cofactor, worst) > GROSS else CONVERGED
        work[worst, USED] = 0.0
    return NO_CONVERGENCE


@kernel_in_place
def _take_back(work: Matrix, states: Matrix, geometry: Matrix, mask_rad: float, cofactor: Matrix) -> int:
    """Use again what was put aside but fits the solution of the others; return how many."""
    has_clock = scratch(CLOCKS)
    has_clock[:] = 0.0
    for i in range(work.shape[0]):
        if work[i, USED] != 0.0:
            has_clock[int(work[i, GROUP])] = 1.0
    count = 0
    for i in range(work.shape[0]):
        if work[i, USED] != 0.0 or states[i, STATE_OK] == 0.0 or not geometry[i, ELEVATION] >= mask_rad:
            continue
        variance = work[i, VARIANCE] + _part_of_fit(work, geometry, cofactor, i)
        if has_clock[int(work[i, GROUP])] != 0.0 and abs(work[i, RESIDUAL]) < _BACK * sqrt(variance):
            work[i, USED] = 1.0
            count += 1
    return count


@kernel_in_place
def _freedom(work: Matrix) -> int:
    """Return the degrees of freedom of the adjustment: satellites minus 3 minus receiver clocks."""
    has_clock = scratch(CLOCKS)
    has_clock[:] = 0.0
    free = -3
    for i in range(work.shape[0]):
        if work[i, USED] != 0.0:
            free += 1
            has_clock[int(work[i, GROUP])] = 1.0
    for k in range(CLOCKS):
        free -= int(has_clock[k])
    return free


@kernel_in_place
def _chi_square(work: Matrix) -> float:
    """Return the weighted sum of squared code residuals of the used satellites."""
    total = 0.0
    for i in range(work.shape[0]):
        if work[i, USED] != 0.0:
            total += work[i, RESIDUAL] ** 2 / work[i, VARIANCE]
    return total


@kernel_in_place
def _dilution(work: Matrix, geometry: Matrix) -> float:
    """Return the PDOP of the used satellites, with one clock per group; infinite if singular."""
    cofactor, step = scratch_table(UNKNOWNS, UNKNOWNS), scratch(UNKNOWNS)
    for i in range(work.shape[0]):
        work[i, WEIGHT] = 1.0
    status = _solve(work, geometry, cofactor, step)
    for i in range(work.shape[0]):
        work[i, WEIGHT] = 1.0 / work[i, VARIANCE]
    if status != CONVERGED:
        return np.inf
    return sqrt(cofactor[0, 0] + cofactor[1, 1] + cofactor[2, 2])
