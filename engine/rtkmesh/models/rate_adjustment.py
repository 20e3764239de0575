"""Velocity and clock rate of a receiver by least squares from Dopplers, with exclusion: what single-point positioning does after the
position (``single_adjustment``).

A satellite takes part if RATE_USED of the work table is 1. Nothing here depends on the order of satellites beyond rounding.
"""

from math import sin, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel_in_place, scratch, scratch_table
from rtkmesh.gnss.constants import OMEGA_EARTH_GPS_RADPS, SPEED_OF_LIGHT_MPS
from rtkmesh.models.code_selection import RATE, RATE_RESIDUAL, RATE_USED
from rtkmesh.models.geometry import E_X, E_Y, E_Z, ELEVATION, RANGE
from rtkmesh.models.normal_matrix import invert_positive_definite
from rtkmesh.models.orbit import STATE_CLOCK_RATE, STATE_OK
from rtkmesh.models.single_adjustment import (
    CONVERGED,
    FEW_SATELLITES,
    GROSS,
    INCONSISTENT,
    LIMIT,
    NO_CONVERGENCE,
    POOR_GEOMETRY,
    RATE_CHI2,
    RATE_FREEDOM,
    scale_of,
)

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_C: Final = SPEED_OF_LIGHT_MPS
_OMEGA: Final = OMEGA_EARTH_GPS_RADPS


@kernel_in_place
def adjust_velocity(work: Matrix, states: Matrix, geometry: Matrix, setup: Vector, position: Vector, velocity: Vector,
                    cofactor: Matrix, quality: Vector) -> int:  # fmt: skip
    """Find velocity (m/s, ECEF) and receiver clock rate (m/s) in ``velocity`` (4) from range rates, with their covariance (4, 4).

    ``setup`` as for ``adjust_position``, which comes first. The sigma of a range rate is its last (1 + 1 / sin elevation) / 2. Dopplers
    have their own exclusion (RATE_USED); the covariance is multiplied by the variance of unit weight if that exceeds 1. ``quality`` gets
    chi-square and degrees of freedom of range rates.
    """
    sigma_mps = setup[6]
    for k in range(4):
        velocity[k] = 0.0
    for i in range(work.shape[0]):
        seen = states[i, STATE_OK] != 0.0 and geometry[i, ELEVATION] >= setup[0]
        work[i, RATE_USED] = 1.0 if seen and np.isfinite(work[i, RATE]) else 0.0
    for _ in range(work.shape[0] + 1):
        used = 0
        for _pass in range(2):  # the second only serves the product of both velocities
            _rate_residuals(work, states, geometry, position, velocity)
            used = _solve_rates(work, geometry, sigma_mps, cofactor, velocity)
            if used < 0:
                return FEW_SATELLITES if used == -1 else POOR_GEOMETRY
        _rate_residuals(work, states, geometry, position, velocity)
        worst, largest, chi2 = _worst_rate(work, geometry, sigma_mps, cofactor)
        if worst >= 0 and used > 5:
            work[worst, RATE_USED] = 0.0
            continue
        if worst >= 0 and largest > GROSS:
            return INCONSISTENT
        quality[RATE_CHI2], quality[RATE_FREEDOM] = chi2, used - 4.0
        if used > 4:
            scale = max(1.0, chi2 / (used - 4))
            for a in range(4):
                for b in range(4):
                    cofactor[a, b] *= scale
        return CONVERGED
    return NO_CONVERGENCE


@kernel_in_place
def _rate_residuals(work: Matrix, states: Matrix, geometry: Matrix, position: Vector, velocity: Vector) -> None:
    """Write observed minus modelled range rates (m/s): derivative of the range between transmission and reception.

    The satellite's velocity is turned into the frame of reception; a range that shrinks shortens the flight, hence 1 - radial / c.
    """
    for i in range(work.shape[0]):
        if work[i, RATE_USED] == 0.0:
            continue
        e_x, e_y, e_z = geometry[i, E_X], geometry[i, E_Y], geometry[i, E_Z]
        angle = _OMEGA * geometry[i, RANGE] / _C
        v_x, v_y, v_z = states[i, 3] + angle * states[i, 4], states[i, 4] - angle * states[i, 3], states[i, 5]
        reach = geometry[i, RANGE]
        x, y = position[0] + reach * e_x, position[1] + reach * e_y
        radial = e_x * (v_x - _OMEGA * y) + e_y * (v_y + _OMEGA * x) + e_z * v_z
        rate = e_x * (v_x - velocity[0]) + e_y * (v_y - velocity[1]) + e_z * (v_z - velocity[2])
        modelled = rate * (1.0 - radial / _C) - _C * states[i, STATE_CLOCK_RATE] + velocity[3]
        work[i, RATE_RESIDUAL] = work[i, RATE] - modelled


@kernel_in_place
def _rate_variance(geometry: Matrix, sigma_mps: float, i: int) -> float:
    return (0.5 * sigma_mps * (1.0 + 1.0 / max(sin(geometry[i, ELEVATION]), 0.05))) ** 2


@kernel_in_place
def _solve_rates(work: Matrix, geometry: Matrix, sigma_mps: float, cofactor: Matrix, velocity: Vector) -> int:
    """Add the solution of the range rates to ``velocity``; return how many were used, -1 if too few, -2 if singular."""
    normal, right, h = scratch_table(4, 4), scratch(4), scratch(4)
    normal[:, :], right[:], h[3] = 0.0, 0.0, 1.0
    used = 0
    for i in range(work.shape[0]):
        if work[i, RATE_USED] == 0.0:
            continue
        used += 1
        weight = 1.0 / _rate_variance(geometry, sigma_mps, i)
        for a in range(3):
            h[a] = -geometry[i, E_X + a]
        for a in range(4):
            right[a] += weight * h[a] * work[i, RATE_RESIDUAL]
            for b in range(a + 1):
                normal[a, b] += weight * h[a] * h[b]
    if used < 4:
        return -1
    if not invert_positive_definite(normal, cofactor):
        return -2
    for a in range(4):
        for b in range(4):
            velocity[a] += cofactor[a, b] * right[b]
    return used


@kernel_in_place
def _worst_rate(work: Matrix, geometry: Matrix, sigma_mps: float, cofactor: Matrix) -> tuple[int, float, float]:
    """Return the satellite with the largest normalised range-rate residual if beyond the limit (else -1), that value, and chi-square."""
    count, worst, largest, chi2 = 0, -1, 0.0, 0.0
    values, h = scratch(work.shape[0]), scratch(4)
    h[3] = 1.0
    for i in range(work.shape[0]):
        if work[i, RATE_USED] == 0.0:
            continue
        for a in range(3):
            h[a] = -geometry[i, E_X + a]
        variance = _rate_variance(geometry, sigma_mps, i)
        chi2 += work[i, RATE_RESIDUAL] ** 2 / variance
        free = variance
        for a in range(4):
            for b in range(4):
                free -= h[a] * h[b] * cofactor[a, b]
        value = abs(work[i, RATE_RESIDUAL]) / sqrt(free) if free > 1e-6 * variance else 0.0
        values[count] = value
        count += 1
        if value > largest:
            largest, worst = value, i
    if count == 0 or largest <= LIMIT * scale_of(values[:count]):
        return -1, largest, chi2
    return worst, largest, chi2
