"""What several solvers measured at one instant, with one covariance."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.rigid_body import Measured

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_OWN: Final = 0.1  # part of a baseline's variance that is not of its two antennas: closed triangles stay solvable
_LEAST_M: Final = 1e-4  # no sigma is smaller


@dataclass(frozen=True, slots=True, eq=False)
class Vectored:
    """A position of antenna ``end`` (``start`` None) or the baseline from ``start`` to ``end``: NED metres, covariance (3x3)."""

    start: int | None
    end: int
    vector_ned_m: Vector
    cov_m2: Matrix


def jointly(vectors: Sequence[Vectored], antennas: int) -> Measured:
    """Return positions and baselines of one instant as one measurement.

    Baselines that share an antenna share its noise, half of the variance of each; positions are taken as independent (what they share,
    the base's error, moves the body as a whole and is not told apart from its motion). Source: seed_systems.md 3.3.
    """
    weights = np.zeros((len(vectors), antennas))
    for row, vector in enumerate(vectors):
        weights[row, vector.end] += 1.0
        if vector.start is not None:
            weights[row, vector.start] -= 1.0
    roots = [_root(vector.cov_m2) for vector in vectors]
    alike = _alike(weights)
    blocks = [[alike[i, j] * (roots[i] @ roots[j].T) for j in range(len(vectors))] for i in range(len(vectors))]
    return Measured(weights, np.array([vector.vector_ned_m for vector in vectors]), np.block(blocks))


def _alike(weights: Matrix) -> Matrix:
    """Return the correlations of the vectors: those of baselines by the antennas that they share."""
    baseline = np.abs(weights.sum(axis=1)) < 1e-9
    both = np.outer(baseline, baseline)
    alike = (1.0 - _OWN) * 0.5 * (weights @ weights.T) * both
    return alike - np.diag(np.diag(alike)) + np.eye(len(weights))


def _root(cov_m2: Matrix) -> Matrix:
    """Return a matrix whose square, root @ root.T, is the covariance, made positive where rounding in a file left it not so."""
    values, vectors = np.linalg.eigh(0.5 * (cov_m2 + cov_m2.T))
    return vectors * np.sqrt(np.maximum(values, _LEAST_M**2))
