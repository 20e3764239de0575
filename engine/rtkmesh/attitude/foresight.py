"""Predictions of the attitude filter that wait for what will come, and what is learned of them.

For every lag of ``spread`` two predictions are under way, half a lag apart. The measurement that comes when one's time is up is compared
with it, as the filter would have predicted it then, and another starts from there. Predictions without a gyro only: with one the rate is
measured, and what is learned here is not used.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.error_state import RATE, TURN, State, propagated
from rtkmesh.attitude.estimation import GYRO_TELLS_S
from rtkmesh.attitude.filter_options import FilterOptions
from rtkmesh.attitude.innovation import Innovation
from rtkmesh.attitude.rotation import vector_of
from rtkmesh.attitude.spread import LAGS_S, NOTHING_SEEN, Spread, turning

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_SLOTS: Final = tuple((lag, half) for lag in range(len(LAGS_S)) for half in (False, True))
_LONGEST: Final = 1.5  # of a lag: what waited for longer says something of the next one
_SETTLED_S, _SETTLED_COUNT = 3.0, 10  # before that predictions are worse than they will be
_SURER: Final = 10.0  # a prediction whose variance was more than so many times what it would be now counts for less
_LEAST_SHARE: Final = 0.25  # of the model's variance that a prediction grows by at least, when it is asked how much a measurement tells
_LEAST_RAD2: Final = 1e-14
_EARLY: Final = 1e-3  # of a lag: times are rounded
_EMPTY: Final[tuple[State | None, ...]] = (None,) * len(_SLOTS)


def learned(before: State, innovation: Innovation, after: State, options: FilterOptions) -> State:
    """Return the state after a measurement with what this says of past predictions. ``before`` is the state that it was compared with."""
    if after.time_s - after.gyro_s < GYRO_TELLS_S:
        return after if not after.waiting else replace(after, waiting=())
    if after.time_s - after.opened_s < _SETTLED_S or after.measurements < _SETTLED_COUNT:
        return after
    spread = after.spread.faded(after.time_s - after.measured_before_s, np.diag(after.cov)[RATE])
    waiting = list(after.waiting or _EMPTY)
    said = _Said(before, innovation, replace(after, spread=NOTHING_SEEN, waiting=()), options)
    for slot, (lag, half) in enumerate(_SLOTS):
        start = waiting[slot]
        if start is None:
            waiting[slot] = said.after if not half or _is_half_way(waiting[slot - 1], after.time_s, lag) else None
            continue
        waited = (after.time_s - start.time_s) / LAGS_S[lag]
        if waited >= 1.0 - _EARLY:
            spread = said.compared(spread, lag, start) if waited <= _LONGEST else spread
            waiting[slot] = said.after
    return replace(after, spread=spread, waiting=tuple(waiting))


def _is_half_way(first: State | None, time_s: float, lag: int) -> bool:
    return first is not None and time_s - first.time_s >= (0.5 - _EARLY) * LAGS_S[lag]


@dataclass(frozen=True, slots=True, eq=False)
class _Said:
    """A measurement, the state that it was compared with and the one that came of it."""

    before: State
    innovation: Innovation
    after: State
    options: FilterOptions

    def compared(self, spread: Spread, lag: int, start: State) -> Spread:
        """Return the spread with the squared errors of a prediction, along the body's axes, by how well the measurement tells them."""
        predicted = propagated(start, self.after.time_s, self.options)
        turn = vector_of(self.before.ned_from_body @ predicted.ned_from_body.T)
        value, noise, axes = _in_body(self.innovation.value + self.innovation.jacobian @ turn, self.innovation, predicted)
        known = noise + np.einsum("ij,jk,ik->i", axes, _in_axes(start), axes)
        turned = turning(start.rate_body_radps, LAGS_S[lag])
        model = np.maximum(np.diag(_in_axes(predicted) - _in_axes(start)) + turned, _LEAST_RAD2)
        now = self._now(LAGS_S[lag])
        shares = np.square(axes)
        grown = shares @ np.maximum(spread.mean(lag, model), _LEAST_SHARE * now)
        tells = np.square(grown / (grown + known) * (shares @ np.minimum(1.0, _SURER * now / model)))
        weights = shares.T @ tells
        squares = shares.T @ (tells * (np.square(value) - known)) / np.maximum(weights, 1e-12)
        return spread.with_squares(lag, squares, model, weights)

    def _now(self, lag_s: float) -> Vector:
        """Return the variance by which a prediction that begins now grows by the model."""
        walk = (self.after.walk * self.options.rate_walk_radps_rts) ** 2
        return turning(self.after.rate_body_radps, lag_s) + np.diag(self.after.cov)[RATE] * lag_s**2 + walk * lag_s**3 / 3.0


def _in_axes(state: State) -> Matrix:
    """Return the covariance of the rotation's error along the body's axes."""
    return state.ned_from_body.T @ state.cov[TURN, TURN] @ state.ned_from_body


def _in_body(value: Vector, innovation: Innovation, predicted: State) -> tuple[Vector, Vector, Matrix]:
    """Return the rows of an innovation, their noise variances and their directions in the body; a whole rotation's along its axes."""
    axes = innovation.jacobian @ predicted.ned_from_body
    if len(value) < 3:
        return value, np.diag(innovation.noise), axes
    return axes.T @ value, np.diag(axes.T @ innovation.noise @ axes), np.eye(3)
