"""Covariances of edges that share receivers, compiled (``joint``)."""

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.attitude.symmetric import eigen

Matrix = NDArray[np.float64]
Stack = NDArray[np.float64]  # (k, 3, 3)
Indices = NDArray[np.int64]


@kernel
def variances_of_receivers(members: Matrix, inverse: Matrix, covs_m2: Stack, floor_share: float) -> Stack:
    """Return the covariances (m, 3, 3) of receivers whose sums over an edge's ``members`` (k, m) are nearest to the edges' (k, 3, 3).

    ``inverse`` (m, k) of the members; what the edges leave open is shared equally between the ends, and no eigenvalue is less than
    ``floor_share`` of the mean variance.
    """
    k, m = members.shape
    mean, out = np.zeros((3, 3)), np.empty((m, 3, 3))
    for i in range(k):
        mean += covs_m2[i] / (2.0 * k)
    floor = floor_share * (mean[0, 0] + mean[1, 1] + mean[2, 2]) / 3.0
    for j in range(m):
        found = mean.copy()
        for i in range(k):
            found += inverse[j, i] * (covs_m2[i] - np.sum(members[i]) * mean)
        values, vectors = eigen(found)
        found[:, :] = 0.0
        for axis in range(3):
            found += max(values[axis], floor) * np.outer(vectors[:, axis], vectors[:, axis])
        out[j] = found
    return out


@kernel
def add_shared(signs: Matrix, variances: Stack, rows: Indices, total: Matrix) -> None:
    """Add to the covariance (3n, 3n) of n edges what the ``rows`` of them (k) share by their receivers: ``signs`` (k, m) of these."""
    k, m = signs.shape
    for a in range(k):
        for b in range(k):
            for j in range(m):
                sign = signs[a, j] * signs[b, j]
                if sign != 0.0:
                    total[3 * rows[a] : 3 * rows[a] + 3, 3 * rows[b] : 3 * rows[b] + 3] += sign * variances[j]
