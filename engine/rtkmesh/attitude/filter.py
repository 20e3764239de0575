"""Heading and attitude filter on SO(3): an error-state Kalman filter of rotation, body rate and gyro bias.

Inputs in any order of time, at their own GNSS times: rigid-body fits, azimuths (and elevations) of baselines, samples of a gyro, the
plumb line of a resting accelerometer. Angles have no seam at 180 deg: everything is a rotation. Pure: equal inputs give equal bits.
Sources: J. Sola, "Quaternion kinematics for the error-state Kalman filter"; seed_systems.md 2.2 for what it must not do.
"""

from dataclasses import replace
from math import hypot, isfinite, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude import error_state, foresight
from rtkmesh.attitude.baseline import Mounting
from rtkmesh.attitude.error_state import RATE, TURN, State
from rtkmesh.attitude.estimation import chi_square_of, square
from rtkmesh.attitude.filter_inputs import AHEAD, FilterInputs, finite_fit
from rtkmesh.attitude.filter_options import TRUSTED, Estimate, FilterOptions, Outcome, Trust, Update, Why, nothing
from rtkmesh.attitude.innovation import Innovation, Measurement, Plumb, of_direction, of_fit
from rtkmesh.attitude.rigid_body import Fit
from rtkmesh.gnss.time import GpsTime

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_GRAVITY_MPS2: Final = 9.81
_RESTING_MPS2: Final = 0.5  # specific force further from gravity than this is an acceleration, too


class AttitudeFilter(FilterInputs[State]):
    """Attitude along time, from what measures it and what measures its rate."""

    def __init__(self, options: FilterOptions) -> None:
        super().__init__(RotationModel(options), options)

    def rotation(self, time: GpsTime, fit: Fit, trust: Trust = TRUSTED) -> Update:
        """Take a rigid-body fit; of antennas on one line only the two directions that it sees."""
        if not finite_fit(fit):
            return Update(Outcome.REFUSED, Why.INVALID)
        return self._keeper.measure(time, of_fit(fit), trust)

    def direction(
        self, time: GpsTime, azimuth_rad: float, elevation_rad: float, cov_rad2: Matrix, mounting: Mounting = AHEAD, trust: Trust = TRUSTED
    ) -> Update:
        """Take azimuth and elevation (rad) of a baseline, with their covariance (2x2)."""
        if not (isfinite(azimuth_rad) and isfinite(elevation_rad) and bool(np.all(np.isfinite(cov_rad2)))):
            return Update(Outcome.REFUSED, Why.INVALID)
        return self._keeper.measure(time, of_direction(azimuth_rad, elevation_rad, cov_rad2, mounting), trust)

    def tilt(self, time: GpsTime, force_body_mps2: Vector, sigma_rad: float, trust: Trust = TRUSTED) -> Update:
        """Take the specific force (m/s2; forward, right, down) of a vehicle that does not accelerate: it points up."""
        if not bool(np.all(np.isfinite(force_body_mps2))):
            return Update(Outcome.REFUSED, Why.INVALID)
        size = float(np.linalg.norm(force_body_mps2))
        if abs(size - _GRAVITY_MPS2) > _RESTING_MPS2:
            return Update(Outcome.REFUSED, Why.ACCELERATED)
        return self._keeper.measure(time, Plumb(-force_body_mps2 / size, sigma_rad), trust)

    def predicted(self, time: GpsTime) -> Estimate:
        """Return the attitude at a time: from the last state before it, turned at its rate."""
        before, time_s, age_s, why = self._fresh(time)
        if before is None:
            return nothing(why, age_s)
        state = error_state.levelled(error_state.propagated(before, time_s, self._options), self._options)
        cov = state.cov[TURN, TURN].copy()
        if not self._sure(cov):
            return nothing(Why.SIGMA, age_s)
        return Estimate(state.ned_from_body, cov, state.rate_body_radps, state.cov[RATE, RATE].copy(), age_s, Why.OK)

    def _sure(self, cov: Matrix) -> bool:
        tilt = sqrt(float(np.linalg.eigvalsh(cov[:2, :2])[1]))
        return sqrt(float(cov[2, 2])) <= self._options.max_heading_sigma_rad and tilt <= self._options.max_tilt_sigma_rad


class RotationModel:
    """The model of the rotation filter: see ``error_state``."""

    def __init__(self, options: FilterOptions) -> None:
        self._options = options

    def started(self, measurement: Measurement, time_s: float) -> State | None:
        """Return a level state of unknown heading, or None."""
        start = measurement.start
        return None if start is None else error_state.unaligned(time_s, start, self._options)

    def propagated(self, state: State, time_s: float) -> State:
        """Return the state at a later time."""
        return error_state.propagated(state, time_s, self._options)

    def moved_to(self, state: State, time_s: float) -> State:
        """Return the state at any time."""
        return error_state.moved_to(state, time_s, self._options.max_coast_s, self._options)

    def innovation(self, state: State, measurement: Measurement) -> Innovation | None:
        """Return what a measurement says against the state."""
        return measurement.innovation(state.ned_from_body)

    def chi_square(self, state: State, innovation: Innovation) -> float:
        """Return the innovation's square in units of its covariance."""
        return chi_square_of(state.cov[TURN, TURN], innovation)

    def corrected(self, state: State, innovation: Innovation) -> State:
        """Return the state after a measurement."""
        corrected = error_state.levelled(error_state.corrected(state, innovation), self._options)
        return foresight.learned(state, innovation, corrected, self._options)

    def restarted(self, state: State, innovation: Innovation, drift_ned_radps: Vector, *, bias: bool) -> State:
        """Return the state made to agree."""
        restarted = error_state.restarted(state, innovation, self._options, bias=bias)
        return replace(restarted, rate_body_radps=restarted.rate_body_radps + restarted.ned_from_body.T @ drift_ned_radps)

    def gyro_chi_square(self, state: State, rate_body_radps: Vector, sigma_radps: float) -> tuple[float, int]:
        """Return how far a sample is beyond what the vehicle may do."""
        return square(*error_state.gyro_innovation(state, rate_body_radps, hypot(sigma_radps, self._options.rate_sigma_radps))), 3

    def with_gyro(self, state: State, rate_body_radps: Vector, sigma_radps: float) -> State:
        """Return the state after a gyro's sample."""
        return error_state.with_gyro(state, rate_body_radps, sigma_radps)

    def reopened(self, state: State) -> State:
        """Return the state with its rate unsure."""
        return error_state.reopened(state, self._options, bias=False)

    def doubted(self, state: State) -> State:
        """Return the state with the walk of any vehicle."""
        return error_state.doubted(state)
