"""The scalar heading filter: heading, its rate and the bias of a yaw gyro, for vehicles that stay about level.

What the rover stack's filter does, put right (seed_systems.md 2.2, faults 10 to 12): innovations are wrapped, receivers' sigmas are used,
process noise is per second, every input stands at its own time, staleness is seen, and a gyro that was stuck is believed again.
"""

from dataclasses import dataclass, replace
from math import exp, inf, isfinite, nan, pi, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.estimation import GYRO_TELLS_S, chi_square_of, learned_walk, updated
from rtkmesh.attitude.filter import AttitudeFilter
from rtkmesh.attitude.filter_inputs import FilterInputs, finite_fit
from rtkmesh.attitude.filter_options import TRUSTED, Estimate, FilterOptions, Kind, Outcome, Trust, Update, Why, nothing
from rtkmesh.attitude.innovation import Innovation, Measurement
from rtkmesh.attitude.rigid_body import Fit
from rtkmesh.attitude.rotation import angles_of, rotation_of_angles
from rtkmesh.gnss.time import GpsTime

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_GYRO_ROW: Final = np.array([[0.0, 1.0, 1.0]])


@dataclass(frozen=True, slots=True, eq=False)
class HeadingState:
    """What is known at ``time_s``: heading (rad, in [0, 2 pi)), rate (clockwise positive), bias, and their covariance (3x3)."""

    time_s: float
    measured_s: float
    heading_rad: float
    rate_radps: float
    bias_radps: float
    cov: Matrix
    walk: float = 1.0
    gyro_s: float = -inf


class HeadingFilter(FilterInputs[HeadingState]):
    """Heading along time; pitch and roll are taken as level within ``level_sigma_rad``."""

    def __init__(self, options: FilterOptions) -> None:
        super().__init__(HeadingModel(options), options)

    def yaw_increment(self, start: GpsTime, end: GpsTime, increment_rad: float, sigma_rad: float) -> Update:
        """Take by how much an IMU's own yaw grew (rad, clockwise) from one of its times to the next: the mean rate, at mid-time."""
        between_s = end - start
        if not (isfinite(between_s) and between_s > 0.0):
            return Update(Outcome.REFUSED, Why.INVALID)
        rate = np.array([0.0, 0.0, increment_rad / between_s])
        return self.gyro(start + 0.5 * between_s, rate, sigma_rad / between_s)

    def rotation(self, time: GpsTime, fit: Fit, trust: Trust = TRUSTED) -> Update:
        """Take the heading of a rigid-body fit; antennas on one line tell that of a level vehicle."""
        if not finite_fit(fit):
            return Update(Outcome.REFUSED, Why.INVALID)
        heading_rad, _, _ = angles_of(fit.ned_from_body)
        return self.heading(time, heading_rad, sqrt(max(0.0, float(fit.cov[2, 2]))), trust=trust)

    def predicted(self, time: GpsTime) -> Estimate:
        """Return the attitude at a time: from the last state before it, turned at its rate; level."""
        before, time_s, age_s, why = self._fresh(time)
        if before is None:
            return nothing(why, age_s)
        state = propagated(before, time_s, self._options)
        if sqrt(float(state.cov[0, 0])) > self._options.max_heading_sigma_rad:
            return nothing(Why.SIGMA, age_s)
        return self._estimate(state, age_s)

    def _estimate(self, state: HeadingState, age_s: float) -> Estimate:
        level = self._options.level_sigma_rad**2
        cov = np.diag([level, level, float(state.cov[0, 0])])
        rate_cov = np.diag([nan, nan, float(state.cov[1, 1])])
        rotation = rotation_of_angles(state.heading_rad, 0.0, 0.0)
        return Estimate(rotation, cov, np.array([nan, nan, state.rate_radps]), rate_cov, age_s, Why.OK)


def filter_of(options: FilterOptions) -> AttitudeFilter | HeadingFilter:
    """Return the filter that options ask for."""
    return HeadingFilter(options) if options.kind is Kind.HEADING else AttitudeFilter(options)


class HeadingModel:
    """Heading that turns at a rate that walks at random, and a gyro that measures this rate with a bias."""

    def __init__(self, options: FilterOptions) -> None:
        self._options = options

    def started(self, measurement: Measurement, time_s: float) -> HeadingState | None:
        """Return a state at the heading that the measurement starts with, as if nobody knew it."""
        start, o = measurement.start, self._options
        cov = np.diag([pi**2, o.rate_sigma_radps**2, o.bias_sigma_radps**2])
        return None if start is None else HeadingState(time_s, time_s, angles_of(start)[0], 0.0, 0.0, cov)

    def propagated(self, state: HeadingState, time_s: float) -> HeadingState:
        """Return the state at a later time."""
        return propagated(state, time_s, self._options)

    def moved_to(self, state: HeadingState, time_s: float) -> HeadingState:
        """Return the state at any time."""
        longest = min(time_s, state.time_s + self._options.max_coast_s)
        return replace(propagated(state, longest, self._options), time_s=time_s)

    def innovation(self, state: HeadingState, measurement: Measurement) -> Innovation | None:
        """Return what a measurement says against the heading of a level vehicle."""
        said = measurement.innovation(rotation_of_angles(state.heading_rad, 0.0, 0.0))
        return None if said is None else replace(said, jacobian=said.jacobian[:, 2:])

    def chi_square(self, state: HeadingState, innovation: Innovation) -> float:
        """Return the innovation's square in units of its variance."""
        return chi_square_of(state.cov[:1, :1], innovation)

    def corrected(self, state: HeadingState, innovation: Innovation) -> HeadingState:
        """Return the state after a measurement."""
        jacobian = np.hstack([innovation.jacobian, np.zeros((1, 2))])
        step, cov, mean_square = updated(state.cov, jacobian, innovation.noise, innovation.value)
        walk = state.walk if state.time_s - state.gyro_s < GYRO_TELLS_S else learned_walk(state.walk, mean_square)
        return _moved(replace(state, measured_s=state.time_s, walk=walk), step, cov)

    def restarted(self, state: HeadingState, innovation: Innovation, drift_ned_radps: Vector, *, bias: bool) -> HeadingState:
        """Return the state made to agree."""
        opened = self.reopened(state)
        cov = np.diag([float(innovation.noise[0, 0]), float(opened.cov[1, 1]), float(opened.cov[2, 2])])
        if bias:
            cov[2, 2] = self._options.bias_sigma_radps**2
        heading = (state.heading_rad + float(innovation.turn_ned[2])) % (2.0 * pi)
        rate = state.rate_radps + float(drift_ned_radps[2])
        return replace(opened, measured_s=state.time_s, heading_rad=heading, rate_radps=rate, cov=cov)

    def gyro_chi_square(self, state: HeadingState, rate_body_radps: Vector, sigma_radps: float) -> tuple[float, int]:
        """Return how far a sample is beyond what the vehicle may do."""
        value = float(rate_body_radps[2]) - state.rate_radps - state.bias_radps
        variance = float(state.cov[1:, 1:].sum()) + sigma_radps**2 + self._options.rate_sigma_radps**2
        return value**2 / variance, 1

    def with_gyro(self, state: HeadingState, rate_body_radps: Vector, sigma_radps: float) -> HeadingState:
        """Return the state after a gyro's sample."""
        value = rate_body_radps[2:] - state.rate_radps - state.bias_radps
        step, cov, mean_square = updated(state.cov, _GYRO_ROW, np.array([[sigma_radps**2]]), value)
        return _moved(replace(state, gyro_s=state.time_s, walk=learned_walk(state.walk, mean_square)), step, cov)

    def reopened(self, state: HeadingState) -> HeadingState:
        """Return the state with its rate unsure."""
        cov = state.cov.copy()
        cov[1, :], cov[:, 1] = 0.0, 0.0
        cov[1, 1] = self._options.rate_sigma_radps**2
        return replace(state, cov=cov)

    def doubted(self, state: HeadingState) -> HeadingState:
        """Return the state with the walk of any vehicle, unless a gyro tells of it."""
        return state if state.time_s - state.gyro_s < GYRO_TELLS_S else replace(state, walk=max(1.0, state.walk))


def propagated(state: HeadingState, time_s: float, options: FilterOptions) -> HeadingState:
    """Return the state at a later time, turning at its rate."""
    dt = time_s - state.time_s
    if dt <= 0.0:
        return state
    decay, q = exp(-dt / options.bias_time_s), (state.walk * options.rate_walk_radps_rts) ** 2
    transition = np.array([[1.0, dt, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, decay]])
    across, bias = q * dt**2 / 2.0, options.bias_sigma_radps**2 * (1.0 - decay**2)
    walked = np.array([[q * dt**3 / 3.0, across, 0.0], [across, q * dt, 0.0], [0.0, 0.0, bias]])
    heading = (state.heading_rad + dt * state.rate_radps) % (2.0 * pi)
    cov = transition @ state.cov @ transition.T + walked
    return replace(state, time_s=time_s, heading_rad=heading, bias_radps=decay * state.bias_radps, cov=cov)


def _moved(state: HeadingState, step: Vector, cov: Matrix) -> HeadingState:
    heading, rate, bias = step.tolist()
    return replace(
        state,
        heading_rad=(state.heading_rad + heading) % (2.0 * pi),
        rate_radps=state.rate_radps + rate,
        bias_radps=state.bias_radps + bias,
        cov=cov,
    )
