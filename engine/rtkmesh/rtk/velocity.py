"""Velocity from Dopplers as an observation of the filter's velocity."""

from math import isfinite

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel_in_place, scratch, scratch_table

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_LIMIT = 16.3  # chi-square of 3 degrees of freedom at 0.1 %
_FLOOR_MPS = 0.03  # Doppler velocity is the mean over the receiver's loop time, not of the instant


@kernel_in_place
def add_velocity(x: Vector, P: Matrix, velocity_mps: Vector, covariance: Matrix, N: Matrix, b: Vector) -> float:
    """Add a velocity (m/s, ECEF, relative to the base) to normal equations for corrections of x; return its chi-square against the
    prediction.

    A velocity that contradicts the prediction gets its covariance scaled until it does not.
    """
    A, S, inverse, d = scratch_table(3, 3), scratch_table(3, 3), scratch_table(3, 3), scratch(3)
    for i in range(3):
        d[i] = velocity_mps[i] - x[3 + i]
        for j in range(3):
            A[i, j] = covariance[i, j] + (_FLOOR_MPS**2 if i == j else 0.0)
            S[i, j] = A[i, j] + P[3 + i, 3 + j]
    if not isfinite(d[0] + d[1] + d[2] + A[0, 0] + A[1, 1] + A[2, 2]):
        return np.nan
    invert3_into(S, inverse)
    chi2 = 0.0
    for i in range(3):
        for j in range(3):
            chi2 += d[i] * inverse[i, j] * d[j]
    scale = max(1.0, chi2 / _LIMIT)
    invert3_into(A, inverse)
    for i in range(3):
        for j in range(3):
            N[3 + i, 3 + j] += inverse[i, j] / scale
            b[3 + i] += inverse[i, j] / scale * d[j]
    return chi2


@kernel_in_place
def invert3_into(A: Matrix, out: Matrix) -> float:
    """Write the inverse of a symmetric 3 x 3 matrix by cofactors; return the determinant."""
    out[0, 0] = A[1, 1] * A[2, 2] - A[1, 2] * A[2, 1]
    out[0, 1] = A[0, 2] * A[2, 1] - A[0, 1] * A[2, 2]
    out[0, 2] = A[0, 1] * A[1, 2] - A[0, 2] * A[1, 1]
    out[1, 1] = A[0, 0] * A[2, 2] - A[0, 2] * A[2, 0]
    out[1, 2] = A[0, 2] * A[1, 0] - A[0, 0] * A[1, 2]
    out[2, 2] = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
    determinant = A[0, 0] * out[0, 0] + A[0, 1] * out[0, 1] + A[0, 2] * out[0, 2]
    for i in range(3):
        for j in range(i, 3):
            out[i, j] /= determinant
            out[j, i] = out[i, j]
    return float(determinant)
