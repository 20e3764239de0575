"""What a measurement says against a predicted rotation: whole rotations, directions, azimuths and the plumb line.

Errors of rotations are small vectors in NED (rad), truth = exp([error]x) prediction. Where the measurement does not see a direction
it has no row: the azimuth of a baseline says nothing of the tilt, one line of antennas nothing of the rotation about it.
"""

from dataclasses import dataclass, replace
from math import atan2, cos, hypot, nan, pi, sin
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.baseline import Mounting
from rtkmesh.attitude.rigid_body import Fit, Shape
from rtkmesh.attitude.rotation import rotation_of, rotation_of_angles, vector_of, wrapped

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_DOWN: Final = np.array([0.0, 0.0, 1.0])
_VERTICAL: Final = 0.05  # of a baseline's length in the horizontal: shorter, it has no azimuth
_SMALLEST_SIGMA_RAD: Final = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Innovation:
    """Measured minus predicted (m), its derivative by the rotation's error (m, 3), and the measurement's covariance (m, m).

    ``turn_ned``: the rotation (vector) that would make the prediction agree; ``seen`` (3, k): orthonormal directions that it sets.
    """

    value: Vector
    jacobian: Matrix
    noise: Matrix
    turn_ned: Vector
    seen: Matrix

    def scaled(self, factor: float) -> "Innovation":
        """Return the same with the measurement's variance times a factor."""
        return replace(self, noise=factor * self.noise)


class Measurement(Protocol):
    """Something measured of a rotation."""

    @property
    def start(self) -> Matrix | None:
        """A rotation (3x3) to start from, for what this does not see; None: it cannot start a filter."""
        ...

    @property
    def sigma_rad(self) -> float:
        """The largest sigma of what is seen; not finite when anything of the measurement is not."""
        ...

    def innovation(self, ned_from_body: Matrix) -> Innovation | None:
        """Return what it says against a prediction; None when it says nothing there."""
        ...


def across(direction: Vector) -> Matrix:
    """Return two orthonormal directions (3, 2) across a unit vector."""
    _, _, vt = np.linalg.svd(direction[None, :])
    return vt[1:].T


def turn_between(start: Vector, end: Vector) -> Vector:
    """Return the shortest rotation (vector, rad) that takes one unit vector to another; half a turn about any axis across if opposite."""
    axis, cosine = np.cross(start, end), float(start @ end)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return np.zeros(3) if cosine > 0.0 else pi * across(start)[:, 0]
    return (atan2(sine, cosine) / sine) * axis


def line_of(mounting: Mounting) -> Vector:
    """Return the direction (unit vector; forward, right, down) of a baseline in the body."""
    c = cos(mounting.elevation_rad)
    return np.array([c * cos(mounting.azimuth_rad), c * sin(mounting.azimuth_rad), -sin(mounting.elevation_rad)])


def floored(covariance: Matrix) -> Matrix:
    """Return a covariance (m, m) that claims nothing better than a micro-radian."""
    return covariance + _SMALLEST_SIGMA_RAD**2 * np.eye(len(covariance))


def largest_sigma_rad(*values: Matrix | float) -> float:
    """Return the root of the largest eigenvalue of the last, a covariance; NaN when anything is not finite or it is not positive."""
    if not all(bool(np.all(np.isfinite(value))) for value in values):
        return nan
    eigenvalues = np.linalg.eigvalsh(np.atleast_2d(values[-1]))
    return nan if eigenvalues[0] < -1e-9 * abs(float(eigenvalues[-1])) or eigenvalues[-1] <= 0.0 else float(eigenvalues[-1]) ** 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Rotation:
    """A whole rotation with the covariance of its error in NED (3x3, rad2)."""

    ned_from_body: Matrix
    cov_rad2: Matrix

    @property
    def start(self) -> Matrix | None:
        """The rotation itself."""
        return self.ned_from_body

    @property
    def sigma_rad(self) -> float:
        """The largest sigma of any axis."""
        return largest_sigma_rad(self.ned_from_body, self.cov_rad2)

    def innovation(self, ned_from_body: Matrix) -> Innovation | None:
        """Return all three directions."""
        turn = vector_of(self.ned_from_body @ ned_from_body.T)
        return Innovation(turn, np.eye(3), floored(self.cov_rad2), turn, np.eye(3))


@dataclass(frozen=True, slots=True, eq=False)
class Direction:
    """Where a line of the body points in NED (unit vectors); ``cov_rad2`` (2x2) of rotations about the two directions ``seen`` (3, 2)."""

    line_body: Vector
    line_ned: Vector
    seen: Matrix
    cov_rad2: Matrix
    start: Matrix | None

    @property
    def sigma_rad(self) -> float:
        """The larger sigma."""
        return largest_sigma_rad(self.line_body, self.line_ned, self.seen, self.cov_rad2)

    def innovation(self, ned_from_body: Matrix) -> Innovation | None:
        """Return the two directions across the line."""
        turn = turn_between(ned_from_body @ self.line_body, self.line_ned)
        return Innovation(self.seen.T @ turn, self.seen.T, floored(self.cov_rad2), turn, self.seen)


@dataclass(frozen=True, slots=True, eq=False)
class Azimuth:
    """The azimuth (rad, clockwise from north) of a line of the body, and its sigma (rad)."""

    mounting: Mounting
    azimuth_rad: float
    azimuth_sigma_rad: float

    @property
    def start(self) -> Matrix | None:
        """Level, with the heading that follows."""
        return rotation_of_angles(self.azimuth_rad - self.mounting.azimuth_rad, 0.0, 0.0)

    @property
    def sigma_rad(self) -> float:
        """The sigma of the azimuth."""
        return largest_sigma_rad(self.azimuth_rad, self.azimuth_sigma_rad, np.array([[self.azimuth_sigma_rad**2]]))

    def innovation(self, ned_from_body: Matrix) -> Innovation | None:
        """Return the azimuth's row; None when the line is predicted to be vertical."""
        north, east, down = (ned_from_body @ line_of(self.mounting)).tolist()
        level = hypot(north, east)
        if level < _VERTICAL:
            return None
        value = wrapped(self.azimuth_rad - atan2(east, north))
        jacobian = np.array([[-down * north / level**2, -down * east / level**2, 1.0]])
        return Innovation(np.array([value]), jacobian, floored(np.array([[self.azimuth_sigma_rad**2]])), value * _DOWN, _DOWN[:, None])


@dataclass(frozen=True, slots=True, eq=False)
class Plumb:
    """Where down is in the body (unit vector), as a resting accelerometer has it, and its sigma (rad)."""

    down_body: Vector
    tilt_sigma_rad: float
    start: Matrix | None = None

    @property
    def sigma_rad(self) -> float:
        """The sigma of either tilt."""
        return largest_sigma_rad(self.down_body, self.tilt_sigma_rad, np.array([[self.tilt_sigma_rad**2]]))

    def innovation(self, ned_from_body: Matrix) -> Innovation | None:
        """Return the rotations about north and east."""
        turn = turn_between(ned_from_body @ self.down_body, _DOWN)
        seen = np.eye(3)[:, :2]
        return Innovation(turn[:2], seen.T, floored(self.tilt_sigma_rad**2 * np.eye(2)), turn, seen)


def of_fit(fit: Fit) -> Measurement:
    """Return what a rigid-body fit measures: the rotation, or where the line of its antennas points."""
    cov = fit.cov[:3, :3]
    if fit.shape is not Shape.LINE or fit.unseen_ned is None:
        return Rotation(fit.ned_from_body, cov)
    seen = across(fit.unseen_ned)
    return Direction(fit.ned_from_body.T @ fit.unseen_ned, fit.unseen_ned, seen, seen.T @ cov @ seen, fit.ned_from_body)


def of_direction(azimuth_rad: float, elevation_rad: float, cov_rad2: Matrix, mounting: Mounting) -> Measurement:
    """Return what azimuth and elevation (rad, with their covariance 2x2) of a baseline measure."""
    ca, sa, ce, se = cos(azimuth_rad), sin(azimuth_rad), cos(elevation_rad), sin(elevation_rad)
    line = np.array([ce * ca, ce * sa, -se])
    raising, turning = np.array([-sa, ca, 0.0]), np.array([se * ca, se * sa, ce])
    scale = np.array([ce, 1.0])
    start = rotation_of_angles(azimuth_rad - mounting.azimuth_rad, 0.0, 0.0)
    body = line_of(mounting)
    start = rotation_of(turn_between(start @ body, line)) @ start
    return Direction(body, line, np.column_stack([turning, raising]), np.outer(scale, scale) * cov_rad2, start)
