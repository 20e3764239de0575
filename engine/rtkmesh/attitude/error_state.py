"""The state of the attitude filter: rotation, body rate and gyro bias, with the covariance of their nine errors.

The rotation's error is a small vector in NED applied from the left, so that it moves by ned_from_body times the rate's error alone. The
rate walks at random (a constant-rate model); a gyro *measures* rate plus bias at its own time, so that samples may stop, be gated or
come at any time without another model. The bias is a first-order Gauss-Markov process: without a gyro its variance stays bounded.
The Earth's rotation (15 deg/h) and the turning of NED along the way are left to the bias.
Source: J. Sola, "Quaternion kinematics for the error-state Kalman filter", sections 6 and 7 (global errors).
"""

from dataclasses import dataclass, replace
from math import exp, inf
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.estimation import GYRO_TELLS_S, learned_walk, updated
from rtkmesh.attitude.filter_options import FilterOptions
from rtkmesh.attitude.innovation import Innovation, turn_between
from rtkmesh.attitude.rotation import rotation_of, skew
from rtkmesh.attitude.spread import NOTHING_SEEN, Spread

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

TURN, RATE, BIAS = slice(0, 3), slice(3, 6), slice(6, 9)
GYRO_JACOBIAN: Final = np.hstack([np.zeros((3, 3)), np.eye(3), np.eye(3)])
_DOWN: Final = np.array([0.0, 0.0, 1.0])
_I3, _I9, _ONES = np.eye(3), np.eye(9), np.ones(3)


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Everything that the filter knows at ``time_s``.

    ``measured_s``: when a rotation (not a gyro) was last used, ``measured_before_s`` the one before; ``gyro_s``: when a gyro was.
    ``opened_s``: when it began or began anew, ``measurements`` since then. ``walk``: learned factor of the rate's walk; ``spread``:
    how far predictions went wrong; ``waiting``: those under way (``foresight``).
    """

    time_s: float
    measured_s: float
    ned_from_body: Matrix
    rate_body_radps: Vector
    bias_radps: Vector
    cov: Matrix
    walk: float = 1.0
    gyro_s: float = -inf
    measured_before_s: float = -inf
    opened_s: float = -inf
    measurements: int = 0
    spread: Spread = NOTHING_SEEN
    waiting: tuple["State | None", ...] = ()


def unaligned(time_s: float, start: Matrix, options: FilterOptions) -> State:
    """Return a state that stands level within its sigma, at a heading that nobody knows yet."""
    level, heading = options.level_sigma_rad**2, np.pi**2
    diagonal = [level, level, heading, *[options.rate_sigma_radps**2] * 3, *[options.bias_sigma_radps**2] * 3]
    return State(time_s, time_s, start, np.zeros(3), np.zeros(3), np.diag(diagonal))


def propagated(state: State, time_s: float, options: FilterOptions) -> State:
    """Return the state at a later time, turning at its rate."""
    dt = time_s - state.time_s
    if dt <= 0.0:
        return state
    half = rotation_of(0.5 * dt * state.rate_body_radps)
    middle = state.ned_from_body @ half
    decay = exp(-dt / options.bias_time_s)
    transition = _I9.copy()
    transition[TURN, RATE] = dt * middle
    transition[BIAS, BIAS] = decay * _I3
    factors = None if time_s - state.gyro_s < GYRO_TELLS_S else _factors(state, dt, options)
    start = state.cov if factors is None else _strayed(state.cov, factors)
    cov = transition @ start @ transition.T + _walked(dt, middle, decay, state.walk, options, factors)
    return replace(state, time_s=time_s, ned_from_body=middle @ half, bias_radps=decay * state.bias_radps, cov=cov)


def _factors(state: State, dt: float, options: FilterOptions) -> Vector | None:
    """Return by what the variances of rates and of their walk are to be scaled to look so far ahead."""
    ties = np.diag(state.ned_from_body.T @ state.cov[TURN, RATE])
    return state.spread.over(dt, np.diag(state.cov)[RATE], ties, (state.walk * options.rate_walk_radps_rts) ** 2, state.rate_body_radps)


def _strayed(cov: Matrix, factors: Vector) -> Matrix:
    """Return a covariance whose rates are less sure, or surer, by factors (3, of variances) along the body's axes."""
    scale = np.concatenate([_ONES, np.sqrt(factors), _ONES])
    return scale[:, None] * cov * scale


def _walked(dt: float, middle: Matrix, decay: float, walk: float, options: FilterOptions, factors: Vector | None) -> Matrix:
    """Return the covariance (9x9) that a time ``dt`` adds, times factors (3) along the body's axes."""
    q = (walk * options.rate_walk_radps_rts) ** 2 * (_ONES if factors is None else factors)
    scaled = middle * q
    added = np.zeros((9, 9))
    added[TURN, TURN] = (dt**3 / 3.0) * (scaled @ middle.T)
    added[TURN, RATE] = (dt**2 / 2.0) * scaled
    added[RATE, TURN] = added[TURN, RATE].T
    added[RATE, RATE] = dt * np.diag(q)
    added[BIAS, BIAS] = (options.bias_sigma_radps**2 * (1.0 - decay**2)) * _I3
    return added


def corrected(state: State, innovation: Innovation) -> State:
    """Return the state after a measurement of its rotation, at the state's own time."""
    jacobian = np.hstack([innovation.jacobian, np.zeros((len(innovation.value), 6))])
    step, cov, mean_square = updated(state.cov, jacobian, innovation.noise, innovation.value)
    walk = state.walk if state.time_s - state.gyro_s < GYRO_TELLS_S else learned_walk(state.walk, mean_square, state.measurements)
    counted = state.measurements + 1
    return _moved(state, step, cov, measured_s=state.time_s, measured_before_s=state.measured_s, measurements=counted, walk=walk)


def with_gyro(state: State, rate_body_radps: Vector, sigma_radps: float) -> State:
    """Return the state after a gyro's sample (rad/s, body), at the state's own time."""
    value = rate_body_radps - state.rate_body_radps - state.bias_radps
    step, cov, mean_square = updated(state.cov, GYRO_JACOBIAN, sigma_radps**2 * _I3, value)
    return _moved(state, step, cov, gyro_s=state.time_s, walk=learned_walk(state.walk, mean_square))


def gyro_innovation(state: State, rate_body_radps: Vector, sigma_radps: float) -> tuple[Vector, Matrix]:
    """Return a gyro's sample minus the predicted one (rad/s, body) and the covariance (3x3) of that."""
    across, p = state.cov[RATE, BIAS], state.cov
    cov = p[RATE, RATE] + p[BIAS, BIAS] + across + across.T + sigma_radps**2 * _I3
    return rate_body_radps - state.rate_body_radps - state.bias_radps, cov


def _moved(state: State, step: Vector, cov: Matrix, **changes: Any) -> State:
    """Put a step of the errors into the state, with other changes; the covariance of the rotation's error turns by half the step."""
    rotation = rotation_of(step[TURN]) @ state.ned_from_body
    rotation = 1.5 * rotation - 0.5 * rotation @ rotation.T @ rotation  # rounding must not grow over a million steps
    turned = _I3 + 0.5 * skew(step[TURN])
    cov[TURN, :] = turned @ cov[TURN, :]
    cov[:, TURN] = cov[:, TURN] @ turned.T
    rate, bias = state.rate_body_radps + step[RATE], state.bias_radps + step[BIAS]
    return replace(state, ned_from_body=rotation, rate_body_radps=rate, bias_radps=bias, cov=cov, **changes)


def levelled(state: State, options: FilterOptions) -> State:
    """Return the state with no tilt less sure than that the vehicle is about level.

    It is as if levelness were measured again, only as much as was forgotten since: sigmas stay at ``level_sigma_rad`` and do not average
    down.
    """
    limit = options.level_sigma_rad**2
    if float(state.cov[0, 0] + state.cov[1, 1]) <= limit:
        return state
    values, vectors = np.linalg.eigh(state.cov[:2, :2])
    for variance, axis in zip(values.tolist(), vectors.T, strict=True):
        if variance > limit * (1.0 + 1e-6):
            state = _level_about(state, np.array([axis[0], axis[1], 0.0]), 1.0 / (1.0 / limit - 1.0 / variance))
    return state


def _level_about(state: State, axis_ned: Vector, variance_rad2: float) -> State:
    turn = turn_between(state.ned_from_body[:, 2], _DOWN)
    jacobian = np.concatenate([axis_ned, np.zeros(6)])[None, :]
    step, cov, _ = updated(state.cov, jacobian, np.array([[variance_rad2]]), np.array([axis_ned @ turn]))
    return _moved(state, step, cov)


def reopened(state: State, options: FilterOptions, *, bias: bool) -> State:
    """Return the state with its rate (and bias) as unsure as at the start, and tied to nothing else."""
    cov = state.cov.copy()
    opened = [(RATE, options.rate_sigma_radps), *([(BIAS, options.bias_sigma_radps)] if bias else [])]
    for part, sigma in opened:
        cov[part, :], cov[:, part] = 0.0, 0.0
        cov[part, part] = sigma**2 * _I3
    return replace(state, cov=cov)


def doubted(state: State) -> State:
    """Return the state with the walk of any vehicle, whatever was learned, unless a gyro tells of it."""
    if state.time_s - state.gyro_s < GYRO_TELLS_S:
        return state
    return replace(state, walk=max(1.0, state.walk), spread=NOTHING_SEEN, waiting=())


def restarted(state: State, innovation: Innovation, options: FilterOptions, *, bias: bool) -> State:
    """Return the state turned to agree with a measurement, as sure as this is where it sees and as before where it does not."""
    unseen = _I3 - innovation.seen @ innovation.seen.T
    opened = reopened(state, options, bias=bias)
    cov = opened.cov
    turn = unseen @ cov[TURN, TURN] @ unseen + innovation.seen @ innovation.noise @ innovation.seen.T
    cov[TURN, :], cov[:, TURN] = 0.0, 0.0
    cov[TURN, TURN] = turn
    rotation = rotation_of(innovation.turn_ned) @ state.ned_from_body
    return levelled(
        replace(opened, measured_s=state.time_s, opened_s=state.time_s, measurements=0, waiting=(), ned_from_body=rotation, cov=cov),
        options,
    )


def moved_to(state: State, time_s: float, longest_s: float, options: FilterOptions) -> State:
    """Return the state at a time however far away, propagated for no longer than ``longest_s``."""
    start = min(time_s, state.time_s + longest_s)
    return replace(levelled(propagated(state, start, options), options), time_s=time_s)
