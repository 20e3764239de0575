"""Two estimates of one vector made into one, when how much they share is known in part only.

Split covariance intersection (Julier and Uhlmann 2001, General decentralized data fusion with covariance intersection; Li, Nashashibi and
Yang 2013, Split covariance intersection filter): each covariance P = D + I has a part D whose correlation with the other estimate is not
known and a part I that is independent of it. For any w between 0 and 1

    P1 = D1 / w + I1        P2 = D2 / (1 - w) + I2
    P^-1 = P1^-1 + P2^-1    x = P (P1^-1 x1 + P2^-1 x2)

and P is not too small whatever the correlation is; w is chosen for the least trace. With D = 0 this is the weighted mean of independent
estimates, with I = 0 plain covariance intersection, which never claims more than the better of both alone.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Vectors = NDArray[np.float64]  # (n, 3)
Matrices = NDArray[np.float64]  # (n, 3, 3)
Shares = NDArray[np.float64]  # (n,)

_WEIGHTS: Final = (0.5, 0.4, 0.6, 0.3, 0.7, 0.2, 0.8, 0.1, 0.9, 0.03, 0.97)


class Estimate(NamedTuple):
    """Estimates with their covariances; ``shared`` is the part of the covariance (0 to 1) that may be correlated with another's."""

    x: Vectors
    P: Matrices
    shared: Shares


def fuse(first: Estimate, second: Estimate) -> tuple[Vectors, Matrices]:
    """Return the fused vectors and covariances, of each row by itself; all must be finite and positive definite."""
    better = (_trace(first.P) <= _trace(second.P))[:, None]
    x, P = np.where(better, first.x, second.x), np.where(better[..., None], first.P, second.P)
    for weight in _WEIGHTS:
        P1, P2 = _inflated(first, weight), _inflated(second, 1.0 - weight)
        gain = P1 @ np.linalg.inv(P1 + P2)
        fused = P1 - gain @ P1
        chosen = _trace(fused) < _trace(P)
        x[chosen] = (first.x + (gain @ (second.x - first.x)[..., None])[..., 0])[chosen]
        P[chosen] = (0.5 * (fused + fused.transpose(0, 2, 1)))[chosen]
    return x, P


def misfit(difference: Vectors, P: Matrices) -> Shares:
    """Return the squared difference in sigmas, d' P^-1 d (chi-square of 3 degrees of freedom); NaN where something is not known."""
    out = np.full(len(difference), np.nan)
    known = np.isfinite(difference).all(axis=1) & np.isfinite(P).all(axis=(1, 2))
    d = difference[known][..., None]
    out[known] = (d.transpose(0, 2, 1) @ np.linalg.solve(P[known], d))[:, 0, 0]
    return out


def _inflated(estimate: Estimate, weight: float) -> Matrices:
    return estimate.P * (1.0 - estimate.shared + estimate.shared / weight)[:, None, None]


def _trace(P: Matrices) -> Shares:
    return np.trace(P, axis1=1, axis2=2)
