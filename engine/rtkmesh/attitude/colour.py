"""Noise that is not white: how much less a mean of correlated values is worth than one of independent ones.

Multipath and a receiver's own filter make errors of neighbouring instants alike. The variance of their mean is larger by the integrated
autocorrelation, 1 + 2 sum(rho). Source: C. Geyer, "Practical Markov chain Monte Carlo", Statistical Science 7 (1992), initial positive
sequence (the sum ends where two neighbouring autocorrelations are no longer positive together).
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

LEAST_VALUES: Final = 20  # fewer say nothing of their correlation


def autocorrelation(values: Vector) -> Vector:
    """Return the autocorrelation of evenly sampled values, lags 0 to half of their number, about their mean."""
    centred = values - values.mean()
    n = len(centred)
    spectrum = np.fft.rfft(centred, 2 * n)
    cov = np.fft.irfft(np.abs(spectrum) ** 2)[: n // 2 + 1]
    return cov / cov[0] if cov[0] > 0.0 else np.eye(1, len(cov))[0]


def correlation_factor(values: Vector) -> float:
    """Return by which factor (1 or more) the variance of the mean is larger than that of independent values."""
    if len(values) < LEAST_VALUES:
        return 1.0
    rho = autocorrelation(values)
    pairs = rho[: len(rho) // 2 * 2].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pairs <= 0.0)
    kept = pairs[: int(ends[0])] if len(ends) else pairs
    kept = np.minimum.accumulate(kept) if len(kept) else kept
    return max(1.0, 2.0 * float(kept.sum()) - 1.0)


def coloured_cov(information: Matrix, scores: Matrix) -> tuple[Matrix, float]:
    """Return the covariance of an adjustment whose noise is correlated in time, and the largest variance factor in it.

    ``information`` (m, m) is what white noise of the told sigmas would give; ``scores`` (e, m) each instant's gradient, in order of time.
    In every eigendirection the variance is that of the scores themselves times their correlation factor, and at least the told one's.
    """
    values, vectors = np.linalg.eigh(information)
    seen = values > 1e-9 * values[-1]
    whitened = scores @ vectors[:, seen] / np.sqrt(values[seen])
    power = np.square(whitened).sum(axis=0) if len(scores) >= LEAST_VALUES else np.ones(int(seen.sum()))
    factors = np.array([correlation_factor(column) for column in whitened.T])
    spread = vectors[:, seen] * np.sqrt(np.maximum(power, 1.0) * factors / values[seen])
    return spread @ spread.T, float(factors.max(initial=1.0))
