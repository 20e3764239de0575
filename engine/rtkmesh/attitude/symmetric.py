"""Eigenvalues of small symmetric matrices, compiled without LAPACK."""

from math import hypot, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_SWEEPS: Final = 40
_NOTHING: Final = 1e-40  # of the diagonal: its ratio to that would overflow
_DONE: Final = 1e-30  # of the sum of squares: what is off the diagonal is nothing


@kernel
def eigen(matrix: Matrix) -> tuple[Vector, Matrix]:
    """Return the eigenvalues (n, ascending) of a symmetric matrix and its eigenvectors (columns).

    Jacobi's rotations, cyclic: Golub and Van Loan, Matrix Computations, 8.5.
    """
    n, a, vectors = len(matrix), 0.5 * (matrix + matrix.T), np.eye(len(matrix))
    for _ in range(_SWEEPS):
        off = 0.0
        for i in range(n):
            for j in range(i):
                off += a[i, j] * a[i, j]
        if not off > _DONE * np.sum(a * a):
            break
        for i in range(n):
            for j in range(i):
                _rotate(a, vectors, j, i)
    values = np.empty(n)
    for i in range(n):
        values[i] = a[i, i]
    order, sorted_vectors = np.argsort(values), np.empty((n, n))
    for i in range(n):
        sorted_vectors[:, i] = vectors[:, order[i]]
    return values[order], sorted_vectors


@kernel
def _rotate(a: Matrix, vectors: Matrix, p: int, q: int) -> None:
    """Turn the axes p and q until the element between them is zero."""
    if abs(a[p, q]) <= _NOTHING * (abs(a[p, p]) + abs(a[q, q])):
        a[p, q] = a[q, p] = 0.0
        return
    ratio = 0.5 * (a[q, q] - a[p, p]) / a[p, q]
    t = (1.0 if ratio >= 0.0 else -1.0) / (abs(ratio) + hypot(1.0, ratio))
    c = 1.0 / sqrt(1.0 + t * t)
    s = t * c
    for k in range(len(a)):
        x, y = a[k, p], a[k, q]
        a[k, p], a[k, q] = c * x - s * y, s * x + c * y
    for k in range(len(a)):
        x, y = a[p, k], a[q, k]
        a[p, k], a[q, k] = c * x - s * y, s * x + c * y
        x, y = vectors[k, p], vectors[k, q]
        vectors[k, p], vectors[k, q] = c * x - s * y, s * x + c * y
    a[p, q] = a[q, p] = 0.0


@kernel
def product(first: Matrix, second: Matrix) -> Matrix:
    """Return the product of two matrices."""
    out = np.zeros((len(first), second.shape[1]))
    for i in range(len(first)):
        for k in range(len(second)):
            factor = first[i, k]
            if factor != 0.0:
                for j in range(second.shape[1]):
                    out[i, j] += factor * second[k, j]
    return out


@kernel
def applied(matrix: Matrix, vector: Vector) -> Vector:
    """Return the product of a matrix and a vector."""
    out = np.zeros(len(matrix))
    for i in range(len(matrix)):
        for j in range(len(vector)):
            out[i] += matrix[i, j] * vector[j]
    return out


@kernel
def squared(x: Matrix, weight: Matrix) -> Matrix:
    """Return x' weight x."""
    weighted = product(weight, x)
    out = np.zeros((x.shape[1], x.shape[1]))
    for k in range(len(x)):
        for i in range(x.shape[1]):
            factor = x[k, i]
            if factor != 0.0:
                for j in range(x.shape[1]):
                    out[i, j] += factor * weighted[k, j]
    return out
