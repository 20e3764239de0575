"""The arithmetic of ``rigid_body``, compiled: what vectors span, where to start, Gauss-Newton. NED, metres, radians."""

from math import atan2, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.attitude.combinations import cross, length, turned
from rtkmesh.attitude.symmetric import applied, eigen, product, squared
from rtkmesh.models.normal_matrix import invert_positive_definite

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_STEPS: Final = 60
_CONVERGED_RAD: Final = 1e-10
_SHRINKING: Final = 0.7
_LARGEST_LAST_RAD: Final = 1e-6
_POINT_M: Final = 1e-9
_STRAIGHT: Final = 1e-9  # of the first singular value: there is no second direction


@kernel
def spanned(body: Matrix, share: Vector, flat: float, line: Vector) -> int:
    """Return how many directions vectors (k, 3) of the body span once the unknown origin is taken out of them; write the longest.

    ``share`` (k) of the origin in each; ``flat``: share of the longest direction below which another is none.
    """
    free = _without_mean(body, share, share)
    values, vectors = eigen(product(free.T, free))
    line[:] = vectors[:, 2]
    longest, count = sqrt(max(values[2], 0.0)), 0
    if longest < _POINT_M:
        return 0
    for value in values:
        count += sqrt(max(value, 0.0)) > flat * longest
    return count


@kernel
def _without_mean(vectors: Matrix, share: Vector, weights: Vector) -> Matrix:
    """Return vectors (k, 3), of which each has a ``share`` of the origin, about the weighted mean origin."""
    out, total = vectors.copy(), np.sum(weights * share)
    for axis in range(3):
        out[:, axis] -= share * (np.sum(weights * vectors[:, axis]) / max(total, 1e-300))
    return out


@kernel
def kabsch_rotation(body: Matrix, share: Vector, values: Matrix, cov: Matrix) -> Matrix:
    """Return the rotation (3x3) that takes body vectors (k, 3) to the measured ones, each weighted by its own mean variance.

    The singular vectors of the two largest singular values, and their cross products: that is a rotation, no reflection.
    """
    k, weights = len(body), np.empty(len(body))
    for i in range(k):
        weights[i] = 3.0 / (cov[3 * i, 3 * i] + cov[3 * i + 1, 3 * i + 1] + cov[3 * i + 2, 3 * i + 2])
    b, m = _without_mean(body, share, weights * share), _without_mean(values, share, weights * share)
    for i in range(k):
        m[i] *= weights[i]
    mixed = product(m.T, b)
    _, v = eigen(product(mixed.T, mixed))
    first, second = v[:, 2].copy(), v[:, 1].copy()
    u = _unit(applied(mixed, first))
    w = applied(mixed, second)
    w -= np.sum(w * u) * u
    w = _unit(w) if length(w) > _STRAIGHT * length(applied(mixed, first)) else _across(u)
    third, last = cross(first, second), cross(u, w)
    return np.outer(u, first) + np.outer(w, second) + np.outer(last, third)


@kernel
def _unit(v: Vector) -> Vector:
    return v / max(length(v), 1e-300)


@kernel
def _across(v: Vector) -> Vector:
    """Return a unit vector at right angles to a vector."""
    axis = np.zeros(3)
    axis[np.argmin(np.abs(v))] = 1.0
    return _unit(cross(v, axis))


@kernel
def level_turn(rotation: Matrix, line_ned: Vector) -> float:
    """Return the turn (rad) about a line (NED, unit) after which the body's down axis points down as far as it can."""
    x, y, z = rotation[0, 2], rotation[1, 2], rotation[2, 2]
    towards = z - line_ned[2] * (line_ned[0] * x + line_ned[1] * y + line_ned[2] * z)
    return atan2(line_ned[0] * y - line_ned[1] * x, towards)


@kernel
def levelled(rotation: Matrix, line_body: Vector) -> Matrix:
    """Return the rotation turned about a line of the body until it is as level as it can be."""
    line, out = applied(rotation, line_body), np.empty((3, 3))
    turned(line * level_turn(rotation, line), rotation, out)
    return out


@kernel
def misfit_covariance(weights: Matrix, cov: Matrix, layout_cov: Matrix, rotation: Matrix) -> Matrix:
    """Return the covariance (3k, 3k) of measured minus predicted: the measurements', and what is not known of the layout (empty: exact)."""
    out, (k, n), placed = cov.copy(), weights.shape, np.empty((3, 3))
    if len(layout_cov) == 0:
        return out
    for i in range(k):
        for j in range(k):
            placed[:, :] = 0.0
            for a in range(n):
                for b in range(n):
                    share = weights[i, a] * weights[j, b]
                    if share != 0.0:
                        placed += share * layout_cov[3 * a : 3 * a + 3, 3 * b : 3 * b + 3]
            out[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] += product(product(rotation, placed), rotation.T)
    return out


@kernel
def misfit_weight(weights: Matrix, cov: Matrix, layout_cov: Matrix, rotation: Matrix, out: Matrix) -> bool:
    """Write the inverse of the covariance of measured minus predicted; False if that is no covariance."""
    return invert_positive_definite(misfit_covariance(weights, cov, layout_cov, rotation), out)


@kernel
def turn_jacobian(v: Matrix, columns: Matrix) -> None:
    """Write the derivative (3k, 3) of vectors (k, 3) by a turn of the body."""
    for i in range(len(v)):
        columns[3 * i, 1], columns[3 * i + 1, 2], columns[3 * i + 2, 0] = v[i, 2], v[i, 0], v[i, 1]
        columns[3 * i + 1, 0], columns[3 * i + 2, 1], columns[3 * i, 2] = -v[i, 2], -v[i, 0], -v[i, 1]


@kernel
def refine(
    body: Matrix, share: Vector, weights: Matrix, values: Matrix, cov: Matrix, layout_cov: Matrix, line: Vector, rotation: Matrix,
    origin: Vector, covariance: Matrix, residuals: Matrix,
) -> float:  # fmt: skip
    """Gauss-Newton from ``rotation``, written over; return the chi-square, NaN if it does not converge or a covariance is none.

    ``line`` (3; body axes): direction about which a turn is not seen, empty without; ``origin`` (3; m, written): empty where nothing
    measured is absolute. Written are the covariance (3 or 6) of the rotation's error in NED (rad) and of the origin, and residuals (k, 3).
    """
    k, u = len(body), 3 + len(origin)
    weight, jacobian, after, largest, part = np.empty((3 * k, 3 * k)), np.zeros((3 * k, u)), np.empty((3, 3)), np.inf, 1.0
    for i in range(k):
        for axis in range(len(origin)):
            jacobian[3 * i + axis, 3 + axis] = share[i]
    for axis in range(len(origin)):
        origin[axis] = np.sum(share * (values[:, axis] - product(body, rotation.T)[:, axis])) / np.sum(share * share)
    for number in range(_STEPS):
        if (number == 0 or len(layout_cov) > 0) and not misfit_weight(weights, cov, layout_cov, rotation, weight):
            return np.nan
        predicted = product(body, rotation.T)
        turn_jacobian(predicted, jacobian)
        _subtract(values, predicted, share, origin, residuals)
        if not _inverse_of_seen(squared(jacobian, weight), rotation, line, covariance):
            return np.nan
        step = applied(covariance, applied(jacobian.T, applied(weight, residuals.ravel())))
        before, largest = largest, np.abs(step[:3]).max()
        part *= 0.5 if largest > _SHRINKING * before else 1.0  # large residuals make it overshoot, and swing about the answer
        step, largest = part * step, part * largest
        turned(step[:3], rotation, after)
        rotation[:, :] = after
        origin += step[3:]
        if np.abs(step).max() < _CONVERGED_RAD:
            break
    _subtract(values, product(body, rotation.T), share, origin, residuals)
    flat = residuals.ravel()
    return np.sum(flat * applied(weight, flat)) if largest <= _LARGEST_LAST_RAD else np.nan


@kernel
def _subtract(values: Matrix, predicted: Matrix, share: Vector, origin: Vector, residuals: Matrix) -> None:
    """Write measured minus predicted vectors."""
    residuals[:, :] = values - predicted
    for axis in range(len(origin)):
        residuals[:, axis] -= share * origin[axis]


@kernel
def _inverse_of_seen(information: Matrix, rotation: Matrix, line: Vector, out: Matrix) -> bool:
    """Write the inverse of an information matrix, without the turn about a line of the body that is not seen; False if there is none."""
    if len(line) == 0:
        return invert_positive_definite(information, out)
    seen = _seen_directions(applied(rotation, line), len(information))
    small = np.empty((len(information) - 1, len(information) - 1))
    found = invert_positive_definite(squared(seen, information), small)
    out[:, :] = product(product(seen, small), seen.T)
    return found


@kernel
def _seen_directions(unseen: Vector, unknowns: int) -> Matrix:
    """Return an orthonormal basis (unknowns, m) of what can be solved for: the rotations across a line (NED, unit), and the origin."""
    basis, across = np.zeros((unknowns, unknowns - 1)), _across(unseen)
    basis[:3, 0], basis[:3, 1] = across, cross(unseen, across)
    for i in range(3, unknowns):
        basis[i, i - 1] = 1.0
    return basis
