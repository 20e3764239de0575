"""Attitude and position of a rigid body from its antennas: weighted fit with full covariances.

The antennas' places in the body are known (``Layout``); measured are positions, baselines between antennas, or any linear mix of
them (``Measured``), jointly, with one covariance. Start: weighted Kabsch (SVD); then Gauss-Newton on the rotation, R <- exp([d]x) R,
and on the translation where something measured is absolute. Source: seed_systems.md 3.3; W. Kabsch, Acta Cryst. A32 (1976) 922.

All vectors are in NED and in the body's forward-right-down axes, metres.
"""

from dataclasses import dataclass
from enum import StrEnum
from math import atan2, nan
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.rotation import angles_of, angles_per_error, rotation_of, skew
from rtkmesh.errors import OptionError

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_STEPS: Final = 60
_CONVERGED_RAD: Final = 1e-10
_SHRINKING: Final = 0.7
_LARGEST_LAST_RAD: Final = 1e-6
_FLAT: Final = 1e-3  # a layout whose next singular value is smaller than this share of the first is flat (or straight)


class Shape(StrEnum):
    """What antennas span: a line (the rotation about it cannot be seen), a plane, or space."""

    POINT = "point"
    LINE = "line"
    PLANE = "plane"
    SPACE = "space"


def shape_of(positions_m: Matrix) -> Shape:
    """Return what antennas at these places (n, 3) span."""
    singular = np.linalg.svd(positions_m - positions_m.mean(axis=0), compute_uv=False) if len(positions_m) else np.zeros(3)
    singular = np.append(singular, np.zeros(max(0, 3 - len(singular))))
    if singular[0] < 1e-9:
        return Shape.POINT
    rank = int(np.sum(singular > _FLAT * singular[0]))
    return (Shape.POINT, Shape.LINE, Shape.PLANE, Shape.SPACE)[rank]


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """Where antennas are in the body: ``positions_m`` (n, 3), forward-right-down, and the joint covariance of that (3n, 3n), 0 if exact."""

    names: tuple[str, ...]
    positions_m: Matrix
    cov_m2: Matrix | None = None

    def __post_init__(self) -> None:
        n = len(self.names)
        if len(set(self.names)) != n or self.positions_m.shape != (n, 3):
            raise OptionError(f"a layout of {n} different names needs {n} positions of 3, not {self.positions_m.shape}")
        if self.cov_m2 is not None and self.cov_m2.shape != (3 * n, 3 * n):
            raise OptionError(f"the covariance of {n} antennas is {3 * n} by {3 * n}, not {self.cov_m2.shape}")

    @property
    def shape(self) -> Shape:
        """What the antennas span."""
        return shape_of(self.positions_m)

    def only(self, names: tuple[str, ...]) -> "Layout":
        """Return the layout of some of its antennas."""
        index = [self.names.index(name) for name in names]
        rows = np.repeat(3 * np.array(index), 3) + np.tile(np.arange(3), len(index))
        cov = None if self.cov_m2 is None else self.cov_m2[np.ix_(rows, rows)]
        return Layout(names, self.positions_m[index], cov)


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """What was measured at one instant: each of k vectors is a mix ``weights`` (k, n) of the antennas' positions.

    A row of weights with sum 1 is a position (or a mean of positions), one with sum 0 a baseline. ``values_ned_m`` (k, 3), about an
    origin of one's choice for positions; ``cov_m2`` (3k, 3k) is joint: baselines that share an antenna, positions that share a base.
    """

    weights: Matrix
    values_ned_m: Matrix
    cov_m2: Matrix

    @property
    def absolute(self) -> bool:
        """Whether it says something of where the body is."""
        return bool(np.any(np.abs(self.weights.sum(axis=1)) > 1e-9))

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Which antennas (n) it says something of."""
        return np.any(np.abs(self.weights) > 1e-12, axis=0)

    def without(self, antenna: int) -> "Measured":
        """Return everything that it says without one antenna: the mixes from which this one drops out."""
        column = self.weights[:, antenna : antenna + 1]
        if not np.any(column):
            return self
        _, _, v = np.linalg.svd(column.T)
        return self.mixed(v[1:])

    def mixed(self, mix: Matrix) -> "Measured":
        """Return linear combinations (rows of ``mix``, of the k vectors) with the covariance that follows."""
        wide = np.kron(mix, np.eye(3))
        return Measured(mix @ self.weights, mix @ self.values_ned_m, wide @ self.cov_m2 @ wide.T)


def positions(values_ned_m: Matrix, cov_m2: Matrix) -> Measured:
    """Return measured positions (n, 3) of all antennas with their joint covariance (3n, 3n)."""
    return Measured(np.eye(len(values_ned_m)), values_ned_m, cov_m2)


def baselines(pairs: tuple[tuple[int, int], ...], antennas: int, values_ned_m: Matrix, cov_m2: Matrix) -> Measured:
    """Return measured baselines: ``pairs`` are (from, to) numbers of antennas, values (k, 3), joint covariance (3k, 3k)."""
    weights = np.zeros((len(pairs), antennas))
    for row, (start, end) in enumerate(pairs):
        weights[row, start] -= 1.0
        weights[row, end] += 1.0
    return Measured(weights, values_ned_m, cov_m2)


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """What a fit gives. ``cov`` is of the rotation's error in NED (rad) and, where position is known, of the origin (m): 3x3 or 6x6.

    ``origin_ned_m`` is where the body's origin is, NaN when only baselines were measured. ``chi_square`` has ``degrees`` of freedom.
    ``shape`` LINE: the rotation about the antennas' line is not seen; ``unseen_ned`` is its direction and ``cov`` is without it.
    """

    ned_from_body: Matrix
    cov: Matrix
    origin_ned_m: Vector
    residuals_m: Matrix
    chi_square: float
    degrees: int
    shape: Shape
    unseen_ned: Vector | None = None

    @property
    def angles_rad(self) -> tuple[float, float, float]:
        """Heading, pitch, roll."""
        return angles_of(self.ned_from_body)

    @property
    def angles_cov_rad2(self) -> Matrix:
        """Covariance (3x3) of heading, pitch, roll; NaN where a line of antennas leaves all three open."""
        if self.shape is Shape.LINE:
            return np.full((3, 3), nan)
        jacobian = angles_per_error(self.ned_from_body)
        return jacobian @ self.cov[:3, :3] @ jacobian.T

    def point(self, body_m: Vector) -> tuple[Vector, Matrix]:
        """Return where a point of the body (forward, right, down) is in NED (m), with covariance (3x3)."""
        if len(self.cov) < 6:
            return np.full(3, nan), np.full((3, 3), nan)
        arm = self.ned_from_body @ body_m
        jacobian = np.hstack([-skew(arm), np.eye(3)])
        return self.origin_ned_m + arm, jacobian @ self.cov @ jacobian.T


def fit(layout: Layout, measured: Measured, start: Matrix | None = None, near: Matrix | None = None) -> Fit | None:
    """Return the rotation (and origin) that fits best; None when what was measured does not see a direction in space.

    ``start``: a rotation (3x3) near the answer; without one the SVD gives it. Antennas on one line have an answer, about which the
    body may still turn freely: it is the one next to ``start``, else to level; what the fit says of points off the line is
    said as if the body did not turn about it. ``near``: a rotation that is nearly the answer (on a line but for the turn about it).
    """
    body = measured.weights @ layout.positions_m
    shape = _directions(body, measured.weights)
    if shape is Shape.POINT or (shape is not Shape.LINE and not _enough(body, measured)):
        return None
    if start is None or shape is not Shape.LINE:
        start = kabsch(body, measured) if near is None else near
        start = start if shape is not Shape.LINE else _levelled(start, _line(body, measured.weights.sum(axis=1)))
    return _refined(layout, measured, body, shape, start)


def kabsch(body: Matrix, measured: Measured) -> Matrix:
    """Return the rotation (3x3) that takes body vectors (k, 3) to the measured ones, each weighted by its own mean variance."""
    weights = 3.0 / np.einsum("kii->k", measured.cov_m2.reshape(len(body), 3, len(body), 3)[range(len(body)), :, range(len(body))])
    share = measured.weights.sum(axis=1)
    absolute = weights * share**2
    total = float(absolute.sum())
    b, m = body, measured.values_ned_m
    if total > 0.0:
        b = b - np.outer(share, (weights * share) @ b / total)
        m = m - np.outer(share, (weights * share) @ m / total)
    u, _, vt = np.linalg.svd((weights[:, None] * m).T @ b)
    return u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt


def _directions(body: Matrix, weights: Matrix) -> Shape:
    """Return what the vectors of the body span, once the unknown origin is taken out."""
    share = weights.sum(axis=1)
    free = body - np.outer(share, share @ body / max(float(share @ share), 1e-300))
    singular = np.append(np.linalg.svd(free, compute_uv=False), np.zeros(3))[:3]
    if singular[0] < 1e-9:
        return Shape.POINT
    return (Shape.POINT, Shape.LINE, Shape.PLANE, Shape.SPACE)[int(np.sum(singular > _FLAT * singular[0]))]


def _enough(body: Matrix, measured: Measured) -> bool:
    return 3 * len(body) >= (6 if measured.absolute else 3)


def _refined(layout: Layout, measured: Measured, body: Matrix, shape: Shape, start: Matrix) -> Fit | None:
    """Gauss-Newton from ``start``; None if it does not converge."""
    absolute, share = measured.absolute, measured.weights.sum(axis=1)
    line = _line(body, share) if shape is Shape.LINE else None
    rotation, origin = start, _first_origin(measured, body, start) if absolute else np.zeros(3)
    weight, cov, step, share_of_step = np.eye(0), np.eye(0), np.full(3, np.inf), 1.0
    for number in range(_STEPS):
        if number == 0 or layout.cov_m2 is not None:
            weight = np.linalg.inv(misfit_covariance(layout, measured, rotation))
        turned = body @ rotation.T
        jacobian = jacobian_of(turned, share, absolute=absolute)
        residuals = measured.values_ned_m - turned - np.outer(share, origin)
        weighted = jacobian.T @ weight
        cov = _seen_inverse(weighted @ jacobian, None if line is None else rotation @ line)
        before, step = float(np.abs(step[:3]).max()), cov @ (weighted @ residuals.ravel())
        if float(np.abs(step[:3]).max()) > _SHRINKING * before:  # large residuals make it overshoot, and swing about the answer
            share_of_step *= 0.5
        step = share_of_step * step
        rotation = rotation_of(step[:3]) @ rotation
        origin = origin + step[3:] if absolute else origin
        if float(np.abs(step).max()) < _CONVERGED_RAD:
            break
    if float(np.abs(step[:3]).max()) > _LARGEST_LAST_RAD:
        return None
    residuals = measured.values_ned_m - body @ rotation.T - np.outer(share, origin)
    return Fit(
        ned_from_body=rotation,
        cov=cov,
        origin_ned_m=origin if absolute else np.full(3, nan),
        residuals_m=residuals,
        chi_square=float(residuals.ravel() @ weight @ residuals.ravel()),
        degrees=3 * len(body) - len(cov) + (line is not None),
        shape=shape,
        unseen_ned=None if line is None else rotation @ line,
    )


def _seen_inverse(information: Matrix, unseen: Vector | None) -> Matrix:
    """Return the inverse of an information matrix, without a turn (NED, unit) that is not seen."""
    if unseen is None:
        return np.linalg.inv(information).astype(np.float64)
    seen = _seen_directions(unseen, len(information))
    return seen @ np.linalg.inv(seen.T @ information @ seen) @ seen.T


def _seen_directions(unseen: Vector, unknowns: int) -> Matrix:
    """Return an orthonormal basis (unknowns, m) of what can be solved for: the rotations across a line of antennas, and the origin."""
    basis = np.eye(unknowns)
    _, _, vt = np.linalg.svd(unseen[None, :])
    across = np.vstack([vt[1:].T, np.zeros((unknowns - 3, 2))])
    return np.hstack([across, basis[:, 3:]])


def jacobian_of(turned: Matrix, share: Vector, *, absolute: bool) -> Matrix:
    """Return the derivative (3k, 3 or 6) of the predicted vectors by the rotation's error and the origin."""
    k = len(turned)
    out = np.zeros((k, 3, 6 if absolute else 3))
    out[:, 0, 1], out[:, 1, 2], out[:, 2, 0] = turned[:, 2], turned[:, 0], turned[:, 1]
    out[:, 1, 0], out[:, 2, 1], out[:, 0, 2] = -turned[:, 2], -turned[:, 0], -turned[:, 1]
    if absolute:
        for axis in range(3):
            out[:, axis, 3 + axis] = share
    return out.reshape(3 * k, -1)


def misfit_covariance(layout: Layout, measured: Measured, rotation: Matrix) -> Matrix:
    """Return the covariance of measured minus predicted: the measurements', and what is not known of the layout."""
    if layout.cov_m2 is None:
        return measured.cov_m2
    k, n = measured.weights.shape
    wide = (measured.weights[:, None, :, None] * rotation[None, :, None, :]).reshape(3 * k, 3 * n)
    return measured.cov_m2 + wide @ layout.cov_m2 @ wide.T


def level_turn(rotation: Matrix, line_ned: Vector) -> float:
    """Return the turn (rad) about a line (NED, unit) after which the body's down axis points down as far as it can."""
    down = rotation[:, 2]
    towards = float(down[2] - line_ned[2] * (line_ned @ down))
    across = float(line_ned[0] * down[1] - line_ned[1] * down[0])
    return atan2(across, towards)


def _levelled(rotation: Matrix, line_body: Vector) -> Matrix:
    """Return the rotation turned about a line of the body until it is as level as it can be."""
    line = rotation @ line_body
    return rotation_of(line * level_turn(rotation, line)) @ rotation


def _first_origin(measured: Measured, body: Matrix, rotation: Matrix) -> Vector:
    share = measured.weights.sum(axis=1)
    return share @ (measured.values_ned_m - body @ rotation.T) / float(share @ share)


def _line(body: Matrix, share: Vector) -> Vector:
    """Return the direction (body axes) of antennas on one line."""
    free = body - np.outer(share, share @ body / max(float(share @ share), 1e-300))
    _, _, vt = np.linalg.svd(free)
    return vt[0]
