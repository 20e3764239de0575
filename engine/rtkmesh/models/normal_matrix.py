"""Small symmetric systems of least squares, solved in place without LAPACK."""

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel_in_place

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


@kernel_in_place
def invert_positive_definite(matrix: Matrix, out: Matrix) -> bool:
    """Write the inverse of a symmetric positive definite matrix (n, n); False, with ``out`` spoilt, if it is none to working precision.

    Cholesky L L' of the matrix (its lower triangle is read), inversion of L, product L'^-1 L^-1.
    """
    n = matrix.shape[0]
    for j in range(n):
        pivot = matrix[j, j]
        for k in range(j):
            pivot -= out[j, k] * out[j, k]
        if not pivot > 1e-13 * matrix[j, j] or not np.isfinite(pivot):
            return False
        out[j, j] = sqrt(pivot)
        for i in range(j + 1, n):
            value = matrix[i, j]
            for k in range(j):
                value -= out[i, k] * out[j, k]
            out[i, j] = value / out[j, j]
    for j in range(n):
        out[j, j] = 1.0 / out[j, j]
        for i in range(j + 1, n):
            value = 0.0
            for k in range(j, i):
                value -= out[i, k] * out[k, j]
            out[i, j] = value / out[i, i]
    for i in range(n):
        for j in range(i + 1):
            value = 0.0
            for k in range(i, n):
                value += out[k, i] * out[k, j]
            out[i, j] = value
            out[j, i] = value
    return True
