"""How far predictions go wrong, by how far ahead they look: learned from past predictions.

A rate that walks at random is right for a moment. A vehicle that swings strays faster than that over a second, one that keeps to its way
strays less. So predictions over ``LAGS_S`` are compared with what came, and the mean of their squared errors is the variance by which
the next prediction grows over such a time. Few predictions fit into a short past: a lag that has seen none scales the model's variance as
the lag before does, and the mean of few squares is raised to the variance that a value to come has by it (Student's t).

What a prediction goes wrong by depends on how sure of the rate the filter was and how quickly it turned: squares are kept in units of a
power of the model's variance, between the two extremes of a ratio (which follows every whim of the learned walk) and of a plain mean
square (which is blind to it).
"""

from dataclasses import dataclass, replace
from math import exp, log2
from typing import Final

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

LAGS_S: Final = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
_MEMORY_S: Final = 60.0  # longer than any outage that is coasted through
_USUAL_S: Final = 8.0  # time constant of what is usual for the rate's variance
_PRIOR: Final = 2.0  # so many squares is the ratio of the lag before worth
_TURNING: Final = 0.1  # variance of a turn to come, as a share of the square of the turn that the rate predicts
_BY_MODEL: Final = 0.65  # power of the model's variance that goes with the squares: 1: all of it, 0: none of it
_LEAST_RATIO: Final = 0.01
_LEAST_RAD2: Final = 1e-14
_SEEN: Final = 0.5  # a sum of weights: less is nothing
_FACTORS: Final = (0.01, 400.0)
_UNSETTLED: Final = 4.0  # a variance of the rate so many times its usual one is what it says
_LAGS: Final[Matrix] = np.array(LAGS_S)[:, None]


@dataclass(frozen=True, slots=True, eq=False)
class Spread:
    """Weighted sums of squares by which predictions grew (rad2; lags by body axes), their weights, and the usual variance of a rate."""

    squares: Matrix
    weights: Matrix
    rates: Vector

    def faded(self, since_s: float, rates: Vector) -> "Spread":
        """Return what is left of it after a time, with one more covariance of rates."""
        kept = exp(-min(since_s, _MEMORY_S) / _MEMORY_S)
        share = 1.0 - exp(-min(since_s, _MEMORY_S) / _USUAL_S)
        usual = rates if not self.weights.any() else (1.0 - share) * self.rates + share * rates
        return Spread(kept * self.squares, kept * self.weights, usual)

    def with_squares(self, lag: int, squares: Vector, model: Vector, weights: Vector) -> "Spread":
        """Return it with one more square per axis, each with its weight and the variance that the model had for it."""
        sums, counts = self.squares.copy(), self.weights.copy()
        sums[lag] += weights * squares / model**_BY_MODEL
        counts[lag] += weights
        return replace(self, squares=sums, weights=counts)

    def mean(self, lag: int, model: Vector) -> Vector:
        """Return the mean square (3) at a lag where the model's variance is this; that itself where next to nothing was seen."""
        known = np.maximum(self.weights[lag], 1.0)
        return np.where(self.weights[lag] > 1.0, model**_BY_MODEL * np.maximum(self.squares[lag], 0.0) / known, model)

    def over(self, ahead_s: float, rates: Vector, ties: Vector, walk: float, rate: Vector) -> Vector | None:
        """Return by what factors (3) rates and their walk are to be scaled for a prediction that looks so far ahead; None: by none.

        The model grows by rates t^2 + 2 ties t + walk t^3 / 3: variances of the rates (3), their covariances with the angles, and the walk.
        """
        if ahead_s <= 0.5 * LAGS_S[0] or not self.weights.any():
            return None
        own = rates * _LAGS**2 + walk * _LAGS**3 / 3.0
        factors = self._factors(own, 2.0 * ties * _LAGS, turning(rate, _LAGS))
        place = min(log2(2.0 * ahead_s / LAGS_S[0]), float(len(LAGS_S)))
        before = min(int(place), len(LAGS_S) - 1)
        share = place - before
        scale: Vector = (1.0 - share) * factors[before] + share * factors[before + 1]
        floor = np.where(rates > _UNSETTLED * self.rates, 1.0, 0.0)
        return np.asarray(np.maximum(scale, floor), dtype=np.float64)

    def _factors(self, own: Matrix, tied: Matrix, turned: Matrix) -> Matrix:
        """Return the factors (lags + 1, 3): 1 for what looks ahead by next to nothing, then from lag to lag."""
        found = np.ones((len(LAGS_S) + 1, len(self.rates)))
        models = np.maximum(own + tied + turned, _LEAST_RAD2)
        ratio = np.maximum(own[0] + tied[0], _LEAST_RAD2) / models[0]
        for lag in range(len(LAGS_S)):
            known = _PRIOR + self.weights[lag]
            ratio = np.maximum(_PRIOR * ratio + self.squares[lag] * models[lag] ** (_BY_MODEL - 1.0), _LEAST_RATIO) / known
            few = np.where(self.weights[lag] > _SEEN, known / (known - 1.0), 1.0)
            found[lag + 1] = np.clip(_scaled(own[lag], tied[lag], few * ratio * models[lag]), *_FACTORS)
        return found


def turning(rate_radps: Vector, lags_s: Vector | float) -> Matrix:
    """Return the variance by which a vehicle that turns may turn otherwise."""
    return _TURNING * np.square(rate_radps * lags_s)


def _scaled(own: Vector, tied: Vector, wanted: Vector) -> Vector:
    """Return the factor f of f own + sqrt(f) tied = wanted."""
    root = (-tied + np.sqrt(tied**2 + 4.0 * own * wanted)) / (2.0 * own)
    return np.square(np.maximum(root, 0.0))


NOTHING_SEEN: Final = Spread(np.zeros((len(LAGS_S), 3)), np.zeros((len(LAGS_S), 3)), np.zeros(3))
