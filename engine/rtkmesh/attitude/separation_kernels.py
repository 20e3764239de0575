"""Attitudes without some antennas, and how far they let the published one be off, compiled (``protection``). NED, metres, radians."""

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.attitude.body_kernels import level_turn, misfit_weight, turn_jacobian
from rtkmesh.attitude.symmetric import applied, eigen, product, squared

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

_UNSEEN = 1e-8  # a direction with a smaller share of the information is not seen
_SAME = 1e-10  # of what is not asked for: a mix of antennas that says nothing


@kernel
def normal_equations(
    weights: Matrix, places: Matrix, values: Matrix, cov: Matrix, layout_cov: Matrix, rotation: Matrix, origin: Vector
) -> Matrix:  # fmt: skip
    """Return X' W X of the fit to first order about a rotation.

    The columns of X are derivatives of the misfit by every antenna's place (3 each), by the ``origin`` (3; none where it is empty) and by
    the rotation (3), and the misfit itself.
    """
    k, n = weights.shape
    turned, weight = product(product(weights, places), rotation.T), np.empty((3 * k, 3 * k))
    x = np.zeros((3 * k, 3 * n + len(origin) + 4))
    turn_jacobian(turned, x[:, 3 * n + len(origin) :])
    for i in range(k):
        share = np.sum(weights[i])
        for axis in range(3):
            row = 3 * i + axis
            for j in range(n):
                x[row, 3 * j + axis] = weights[i, j]
            x[row, -1] = values[i, axis] - turned[i, axis]
            if len(origin) > 0:
                x[row, 3 * n + axis] = share
                x[row, -1] -= share * origin[axis]
    if not misfit_weight(weights, cov, layout_cov, rotation, weight):
        return np.zeros((len(x.T), len(x.T)))  # nothing is seen
    return squared(x, weight)


@kernel
def bounds_without(
    told: Matrix, antennas: int, sets: Indices, scales: Vector, rotation: Matrix, turn: Matrix, inflation: float, unseen_sigma_rad: float
) -> Matrix:
    """Return how far each angle may be off (h, 3) if the attitude without each row (m antennas, -1: none) of ``sets`` is not touched.

    Infinite where that leaves more than one direction open. ``told``: normal equations; ``turn``: derivative of the angles by the
    rotation's error. What is not asked for, places and origin, is eliminated (Schur complement).
    """
    out, n = np.full((len(sets), 3), np.inf), len(told)
    scale = told[n - 4, n - 4] + told[n - 3, n - 3] + told[n - 2, n - 2]
    for h in range(len(sets)):
        reduced = _reduced(told, _free(sets[h], antennas, n))
        values, vectors = eigen(reduced[:3, :3])
        if not values[1] > _UNSEEN * scale:
            continue
        cov, first = np.zeros((3, 3)), 0 if values[0] > _UNSEEN * scale else 1
        for i in range(first, 3):
            cov += np.outer(vectors[:, i], vectors[:, i]) / values[i]
        off, unseen = applied(cov, reduced[:3, 3]), np.zeros(3)
        if first == 1:
            unseen[:] = vectors[:, 0]
            off += level_turn(rotation, unseen) * unseen
        out[h] = np.abs(applied(turn, off)) + scales[h] * inflated_sigmas(turn, cov, unseen, inflation, unseen_sigma_rad)
    return out


@kernel
def inflated_sigmas(turn: Matrix, cov: Matrix, unseen: Vector, inflation: float, unseen_sigma_rad: float) -> Vector:
    """Return the inflated sigmas of the angles; what only the level says of an ``unseen`` direction (0: none) is not inflated."""
    spread, level = product(product(turn, cov), turn.T), applied(turn, unseen) * unseen_sigma_rad
    out = np.empty(3)
    for i in range(3):
        out[i] = sqrt(max(inflation * inflation * spread[i, i] + level[i] * level[i], 0.0))
    return out


@kernel
def _free(gone: Indices, antennas: int, n: int) -> Indices:
    """Return the columns of the places of antennas and of the origin."""
    known = gone[gone >= 0]
    m, count = 3 * len(known), n - 4 - 3 * antennas
    out = np.empty(m + count, np.int64)
    for i in range(m):
        out[i] = 3 * known[i // 3] + i % 3
    for i in range(count):
        out[m + i] = 3 * antennas + i
    return out


@kernel
def _reduced(told: Matrix, free: Indices) -> Matrix:
    """Return the last four rows and columns of normal equations (rotation and right side) without the ``free`` unknowns."""
    f, n = len(free), len(told)
    theirs, ours, out = np.empty((f, f)), np.empty((f, 4)), told[n - 4 :, n - 4 :].copy()
    for i in range(f):
        ours[i] = told[free[i], n - 4 :]
        for j in range(f):
            theirs[i, j] = told[free[i], free[j]]
    values, vectors = eigen(theirs)
    projected = product(vectors.T, ours)
    for i in range(f):
        if values[i] > _SAME * values[-1]:
            out -= np.outer(projected[i], projected[i]) / values[i]
    return out
