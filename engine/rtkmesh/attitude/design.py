"""What a planned layout of antennas will give: sigmas of the attitude, with all antennas and without each, and the smallest faults seen.

Level vehicle, heading north; sigmas of the antennas' positions against each other. Source: seed_systems.md 3.2 (closed form), W. Baarda
(1968) for the smallest fault that a chi-square test finds with a given power.
"""

from dataclasses import dataclass
from math import inf, nan, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.chi_square import chi_square_limit
from rtkmesh.attitude.integrity import judged, noncentral_tail
from rtkmesh.attitude.protection import Guarding, levels
from rtkmesh.attitude.rigid_body import Fit, Layout, Measured, Shape, fit, positions

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_LARGEST_FAULT_M: Final = 100.0
_SEEN: Final = 1e-9


@dataclass(frozen=True, slots=True)
class Noise:
    """Sigmas (m) of one antenna's position against the others, horizontal and vertical; ``common_*``: what all share (the base's error)."""

    horizontal_m: float = 0.01
    vertical_m: float = 0.02
    common_horizontal_m: float = 0.0
    common_vertical_m: float = 0.0

    def cov_m2(self, antennas: int) -> Matrix:
        """Return the joint covariance (3n, 3n) of the positions in NED."""
        own = np.diag(np.square([self.horizontal_m, self.horizontal_m, self.vertical_m]))
        common = np.diag(np.square([self.common_horizontal_m, self.common_horizontal_m, self.common_vertical_m]))
        return np.kron(np.eye(antennas), own) + np.kron(np.ones((antennas, antennas)), common)


@dataclass(frozen=True, slots=True)
class Sigmas:
    """Sigmas of heading, pitch, roll (rad; NaN: not seen) and of a point of the body (m; horizontal worst axis, vertical)."""

    shape: Shape
    heading_rad: float
    pitch_rad: float
    roll_rad: float
    horizontal_m: float
    vertical_m: float
    redundancy: int


@dataclass(frozen=True, slots=True)
class Detectable:
    """The smallest faults (m) of an antenna along forward, right, down that the test finds with the power asked for; infinite: none."""

    forward_m: float
    right_m: float
    down_m: float


@dataclass(frozen=True, slots=True)
class Design:
    """What a layout gives: with everything, without each antenna, and what faults of each are seen.

    ``levels_rad``: protection levels of heading, pitch, roll of an epoch whose measurements agree to nothing; NaN: not seen.
    """

    whole: Sigmas
    without: dict[str, Sigmas]
    detectable: dict[str, Detectable]
    levels_rad: tuple[float, float, float]


def design(
    layout: Layout, noise: Noise, point_body_m: Vector, *, false_alarm: float = 1e-3, power: float = 0.9, guarding: Guarding | None = None
) -> Design:
    """Return what a layout gives for a point of the body (forward, right, down from the layout's origin)."""
    measured = positions(layout.positions_m, noise.cov_m2(len(layout.names)))
    without = {name: _sigmas(layout, measured.without(i), point_body_m) for i, name in enumerate(layout.names)}
    heading, pitch, roll = levels(layout, measured, judged(layout, measured, np.eye(3)), guarding or Guarding()).rad.tolist()
    detectable = _detectable(layout, measured, false_alarm, power)
    return Design(_sigmas(layout, measured, point_body_m), without, detectable, (heading, pitch, roll))


def _sigmas(layout: Layout, measured: Measured, point_body_m: Vector) -> Sigmas:
    found = fit(layout, measured, np.eye(3)) if len(measured.weights) else None
    if found is None:
        return Sigmas(Shape.POINT, nan, nan, nan, nan, nan, 0)
    cov = found.point(point_body_m)[1]
    horizontal = sqrt(max(float(np.linalg.eigvalsh(cov[:2, :2])[-1]), 0.0))
    return Sigmas(found.shape, *_angle_sigmas(found), horizontal, sqrt(max(float(cov[2, 2]), 0.0)), found.degrees)


def _angle_sigmas(found: Fit) -> tuple[float, float, float]:
    """Return sigmas of heading, pitch, roll; of antennas on one line those that turning about the line does not touch."""
    variances = np.array([found.cov[2, 2], found.cov[1, 1], found.cov[0, 0]])
    if found.unseen_ned is not None:
        variances[np.abs(found.unseen_ned[::-1]) > _SEEN] = nan
    heading, pitch, roll = np.sqrt(variances).tolist()
    return heading, pitch, roll


def _detectable(layout: Layout, measured: Measured, false_alarm: float, power: float) -> dict[str, Detectable]:
    found = fit(layout, measured, np.eye(3))
    if found is None or found.degrees < 1:
        return {name: Detectable(inf, inf, inf) for name in layout.names}
    needed = noncentrality_for(false_alarm, power, found.degrees)
    redundancy = _redundancy(layout, measured)
    variances = np.diag(redundancy)
    smallest = np.where(variances > _SEEN * variances.max(), np.sqrt(needed / np.maximum(variances, 1e-300)), inf)
    smallest[smallest > _LARGEST_FAULT_M] = inf
    return {name: Detectable(*smallest[3 * i : 3 * i + 3].tolist()) for i, name in enumerate(layout.names)}


def _redundancy(layout: Layout, measured: Measured) -> Matrix:
    """Return the matrix (3n, 3n) whose form in a fault of the positions is the chi-square that it adds, to first order."""
    arms = layout.positions_m
    turns = np.vstack([np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]) for x, y, z in arms.tolist()])
    jacobian = np.hstack([turns, np.kron(np.ones((len(arms), 1)), np.eye(3))])
    weight = np.linalg.inv(measured.cov_m2)
    seen = weight @ jacobian
    return weight - seen @ np.linalg.pinv(jacobian.T @ seen, rcond=1e-9, hermitian=True) @ seen.T


def noncentrality_for(false_alarm: float, power: float, degrees: int) -> float:
    """Return the noncentrality that a chi-square test of ``degrees`` finds with probability ``power``."""
    limit, low, high = chi_square_limit(false_alarm, degrees), 0.0, 1.0
    while noncentral_tail(limit, degrees, high) < power:
        low, high = high, 2.0 * high
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if noncentral_tail(limit, degrees, middle) < power else (low, middle)
    return high
