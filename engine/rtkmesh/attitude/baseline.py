"""Heading and one tilt angle from one antenna baseline, with full covariances.

Conventions: heading is the navigation azimuth, clockwise from true north, in [0, 2 pi); pitch is nose up positive; roll is right side
down positive (body axes forward, right, down). ENU yaw (REP-103) is anticlockwise from east. Equations: rtkrcv_ros paper (2) to (5)
with the quadrant and the covariance term put right: heading = atan2(e, n), sigma^2 = gradient P gradient'.
"""

from dataclasses import dataclass
from math import atan2, cos, hypot, inf, nan, pi, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.integrity import Integrity

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_STEP_RAD = 1e-6


@dataclass(frozen=True, slots=True)
class Mounting:
    """Where the baseline (base antenna to rover antenna) points in the vehicle, and how long it is.

    ``azimuth_rad``: clockwise from the nose, seen from above (0: rover antenna ahead; pi/2: to the right); ``elevation_rad``: above the
    vehicle's horizontal plane; ``length_m`` None when unknown; a measured length further off than ``tolerance_m`` fails integrity.
    """

    azimuth_rad: float = 0.0
    elevation_rad: float = 0.0
    length_m: float | None = None
    tolerance_m: float = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class BaselineAttitude:
    """Attitude from one baseline. ``cov_rad2`` is of (heading, pitch, roll), 3x3; the angle that one baseline cannot see is NaN."""

    heading_rad: float
    pitch_rad: float
    roll_rad: float
    cov_rad2: Matrix
    length_m: float
    length_sigma_m: float

    @property
    def yaw_enu_rad(self) -> float:
        """Return the yaw of REP-103: anticlockwise from east, in (-pi, pi]."""
        return yaw_enu(self.heading_rad)


def yaw_enu(heading_rad: float) -> float:
    """Return the ENU yaw (rad, anticlockwise from east, in (-pi, pi]) of a navigation heading."""
    yaw = (pi / 2.0 - heading_rad) % (2.0 * pi)
    return yaw - 2.0 * pi if yaw > pi else yaw


def direction(baseline_enu_m: Vector, cov_enu_m2: Matrix) -> tuple[float, float, float, Matrix]:
    """Return azimuth, elevation (rad), length (m) of a baseline and the covariance of these three (3x3).

    ``baseline_enu_m`` (3) and its full covariance ``cov_enu_m2`` (3x3). A vertical baseline has no azimuth: NaN.
    """
    e, n, u = baseline_enu_m.tolist()
    h, length = hypot(e, n), sqrt(e * e + n * n + u * u)
    if h <= 1e-9:
        return nan, nan, length, np.full((3, 3), nan)
    jacobian = np.array(
        [
            [n / h**2, -e / h**2, 0.0],
            [-u * e / (length**2 * h), -u * n / (length**2 * h), h / length**2],
            [e / length, n / length, u / length],
        ]
    )
    return atan2(e, n) % (2.0 * pi), atan2(u, h), length, jacobian @ cov_enu_m2 @ jacobian.T


def baseline_attitude(baseline_enu_m: Vector, cov_enu_m2: Matrix, mounting: Mounting) -> BaselineAttitude:
    """Return the attitude that a baseline gives: heading, and pitch (baseline along the nose) or roll (across it).

    A baseline along the nose cannot see roll, one across it cannot see pitch; the unseen angle is taken as zero for the heading and
    reported as NaN.
    """
    azimuth, elevation, length, cov = direction(baseline_enu_m, cov_enu_m2)
    offset, tilt = _offset_and_tilt(elevation, mounting)
    ahead, behind = _offset_and_tilt(elevation + _STEP_RAD, mounting), _offset_and_tilt(elevation - _STEP_RAD, mounting)
    jacobian = np.array([[1.0, -(ahead[0] - behind[0]) / (2.0 * _STEP_RAD)], [0.0, (ahead[1] - behind[1]) / (2.0 * _STEP_RAD)]])
    angles = jacobian @ cov[:2, :2] @ jacobian.T
    along = _along_nose(mounting)
    seen = [0, 1] if along else [0, 2]
    full = np.full((3, 3), nan)
    full[np.ix_(seen, seen)] = angles
    heading = (azimuth - offset) % (2.0 * pi)
    return BaselineAttitude(heading, tilt if along else nan, nan if along else tilt, full, length, sqrt(max(0.0, float(cov[2, 2]))))


def length_error_m(attitude: BaselineAttitude, mounting: Mounting) -> float:
    """Return measured minus known baseline length (m); NaN when the length is not known."""
    return nan if mounting.length_m is None else attitude.length_m - mounting.length_m


def length_integrity(attitude: BaselineAttitude, mounting: Mounting) -> Integrity:
    """Return FAILED when the measured length contradicts the known one, OK when it agrees or none is known."""
    error = abs(length_error_m(attitude, mounting))
    return Integrity.FAILED if error > (mounting.tolerance_m if mounting.length_m is not None else inf) else Integrity.OK


def _along_nose(mounting: Mounting) -> bool:
    return abs(cos(mounting.azimuth_rad)) >= abs(sin(mounting.azimuth_rad))


def _offset_and_tilt(elevation_rad: float, mounting: Mounting) -> tuple[float, float]:
    """Return (azimuth of the baseline minus heading, tilt): tilt is pitch for a baseline along the nose, else roll."""
    c, s = cos(mounting.azimuth_rad), sin(mounting.azimuth_rad)
    up = sin(elevation_rad - mounting.elevation_rad)
    if _along_nose(mounting):
        pitch = _arcsin(up / c)
        return atan2(s, cos(pitch) * c), pitch
    roll = _arcsin(-up / s)
    return atan2(cos(roll) * s, c), roll


def _arcsin(value: float) -> float:
    return atan2(value, sqrt(max(0.0, 1.0 - value * value)))
