"""Attitude and position of a rigid body from its antennas: weighted fit with full covariances.

The antennas' places in the body are known (``Layout``); measured are positions, baselines between antennas, or any linear mix of
them (``Measured``), jointly, with one covariance. Start: weighted Kabsch (SVD); then Gauss-Newton on the rotation, R <- exp([d]x) R,
and on the translation where something measured is absolute. Source: seed_systems.md 3.3; W. Kabsch, Acta Cryst. A32 (1976) 922.

All vectors are in NED and in the body's forward-right-down axes, metres.
"""

from dataclasses import dataclass
from enum import StrEnum
from math import isfinite, nan
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.body_kernels import kabsch_rotation, levelled, refine, spanned
from rtkmesh.attitude.rotation import angles_of, angles_per_error, skew
from rtkmesh.errors import OptionError

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

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
    def covariance_m2(self) -> Matrix:
        """The joint covariance of the positions as kernels take it: empty if they are exact."""
        return np.empty((0, 0)) if self.cov_m2 is None else plain(self.cov_m2)

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
    if not len(measured.weights):
        return None
    body, share, line = plain(measured.weights @ layout.positions_m), measured.weights.sum(axis=1), np.empty(3)
    shape = (Shape.POINT, Shape.LINE, Shape.PLANE, Shape.SPACE)[spanned(body, share, _FLAT, line)]
    if shape is Shape.POINT or (shape is not Shape.LINE and not _enough(body, measured)):
        return None
    if start is None or shape is not Shape.LINE:
        start = kabsch(body, measured) if near is None else near
        start = start if shape is not Shape.LINE else levelled(plain(start), line)
    return _refined(layout, measured, (body, share), (shape, line), start)


def kabsch(body: Matrix, measured: Measured) -> Matrix:
    """Return the rotation (3x3) that takes body vectors (k, 3) to the measured ones, each weighted by its own mean variance."""
    return kabsch_rotation(plain(body), measured.weights.sum(axis=1), plain(measured.values_ned_m), plain(measured.cov_m2))


def plain(array: Matrix) -> Matrix:
    """Return the numbers as kernels take them: one after the other."""
    return np.ascontiguousarray(array, np.float64)


def _enough(body: Matrix, measured: Measured) -> bool:
    return 3 * len(body) >= (6 if measured.absolute else 3)


def _refined(layout: Layout, measured: Measured, vectors: tuple[Matrix, Vector], span: tuple[Shape, Vector], start: Matrix) -> Fit | None:
    """Gauss-Newton from ``start``; None if it does not converge."""
    (body, share), (shape, line) = vectors, span
    rotation, origin = np.array(start, np.float64), np.zeros(3 if measured.absolute else 0)
    line = line if shape is Shape.LINE else np.empty(0)
    numbers = plain(measured.weights), plain(measured.values_ned_m), plain(measured.cov_m2), layout.covariance_m2
    cov, residuals = np.empty((3 + len(origin), 3 + len(origin))), np.empty_like(body)
    chi_square = refine(body, share, *numbers, line, rotation, origin, cov, residuals)
    if not isfinite(chi_square):
        return None
    return Fit(
        ned_from_body=rotation,
        cov=cov,
        origin_ned_m=origin if measured.absolute else np.full(3, nan),
        residuals_m=residuals,
        chi_square=chi_square,
        degrees=3 * len(body) - len(cov) + (shape is Shape.LINE),
        shape=shape,
        unseen_ned=None if shape is not Shape.LINE else rotation @ line,
    )
