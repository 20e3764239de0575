"""One candidate of every baseline so that all fit one rigid body: branch and bound over their combinations, as kernels.

The cost of a combination is the sum of the squared norms of its integers and the chi-square of the rigid body that fits its baselines
best, with their joint covariance. Leaving out baselines can only lower both, so the cost of a part bounds that of every whole.
"""

from math import acos, cos, sin, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]
Stack = NDArray[np.float64]  # (k, a, b)

_STEPS: Final = 8
_CONVERGED_RAD: Final = 1e-7
_ENOUGH: Final = 1e-5  # of the chi-square: a step that gives less is the last
_PARALLEL: Final = 0.02  # sine of an angle between baselines that gives no rotation about them
_UNSEEN: Final = 1e-9  # weight that keeps a rotation which nothing measures in its place


@kernel
def search_combinations(
    values_m: Stack, norms: Matrix, sizes: Indices, body_m: Matrix, weights: Stack, own_weights: Stack, spread_m2: Matrix,
    predicted: Matrix, predicted_weight: Matrix, tilt_rad: float, two: Indices, costs: Vector,
) -> int:  # fmt: skip
    """Write the two combinations of least cost (2, k) and their costs (infinite: none); return how many fits that took.

    ``values_m`` (k, m, 3) and ``norms`` (k, m) are the first ``sizes`` candidates of each of k baselines (NED), sorted by norm; ``body_m``
    (k, 3) the baselines in the body; ``weights`` (k, 3k, 3k) the inverse joint covariance of the first 1, 2, .. k of them,
    ``own_weights`` (k, 3, 3) that of each by itself; ``spread_m2`` (k, k) the largest variance of a component of each (diagonal) and of
    differences of two. ``predicted`` is where the rotation is expected, with its weight (3, 3; 0: no knowledge); ``tilt_rad`` by how
    much the body's down axis may be off the vertical.
    """
    k, fits, depth = len(body_m), 0, 0
    chosen, place, rotation = np.empty((k, 3)), np.full(k, -1), np.empty((3, 3))
    sums, rest, worst = np.zeros(k + 1), np.zeros(k + 1), np.zeros(k + 1)
    alone = _each_alone(values_m, sizes, body_m, own_weights, predicted, predicted_weight, tilt_rad)
    for j in range(k - 1, -1, -1):
        rest[j] = rest[j + 1] + norms[j, 0]
    costs[:] = np.inf
    while depth >= 0:
        place[depth] += 1
        if place[depth] >= sizes[depth]:
            depth -= 1
            continue
        total, least = sums[depth] + norms[depth, place[depth]], max(worst[depth], alone[depth, place[depth]])
        if total + rest[depth + 1] + least >= costs[1]:
            continue
        chosen[depth] = values_m[depth, place[depth]]
        if total + rest[depth + 1] + _least_misfit(chosen, body_m, spread_m2, depth) >= costs[1]:
            continue
        if depth > 0 or k == 1:
            least = fit_rotation(chosen, body_m, weights[depth], predicted, predicted_weight, depth + 1, rotation)
            fits += 1
        if total + rest[depth + 1] + least >= costs[1]:
            continue
        if depth + 1 < k:
            depth += 1
            sums[depth], worst[depth], place[depth] = total, least, -1
        elif rotation[2, 2] >= cos(tilt_rad) or _straight(body_m):
            _take(total + least, place, two, costs)
    return fits


@kernel
def _each_alone(
    values_m: Stack, sizes: Indices, body_m: Matrix, own_weights: Stack, predicted: Matrix, predicted_weight: Matrix, tilt_rad: float
) -> Matrix:
    """Return the chi-square (k, m) of each candidate by itself: of its length, and of its direction where that is expected; infinite for
    one that climbs too steeply.
    """
    k = len(body_m)
    alone, rotation = np.full((k, values_m.shape[1]), np.inf), np.empty((3, 3))
    for j in range(k):
        for c in range(sizes[j]):
            if _climb(values_m[j, c], body_m[j]) <= tilt_rad:
                one, its_body = values_m[j, c : c + 1], body_m[j : j + 1]
                alone[j, c] = fit_rotation(one, its_body, own_weights[j], predicted, predicted_weight, 1, rotation)
    return alone


@kernel
def _take(cost: float, place: Indices, two: Indices, costs: Vector) -> None:
    """Take a combination among the two best; it is better than the second."""
    at = 0 if cost < costs[0] else 1
    if at == 0:
        costs[1] = costs[0]
        two[1] = two[0]
    costs[at] = cost
    two[at] = place


@kernel
def _least_misfit(chosen: Matrix, body_m: Matrix, spread_m2: Matrix, last: int) -> float:
    """Return a lower bound of the chi-square by the distances of the last baseline's end to those before: no rotation is needed.

    The variance of a length is at most the largest one of the vector's components.
    """
    worst = 0.0
    for j in range(last):
        apart = _length(chosen[last] - chosen[j]) - _length(body_m[last] - body_m[j])
        worst = max(worst, apart**2 / spread_m2[last, j])
    return worst


@kernel
def _length(v: Vector) -> float:
    return sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


@kernel
def _climb(v: Vector, body: Vector) -> float:
    """Return the difference of two vectors' elevations (rad): the tilt of the body is at least this."""
    first, second = -v[2] / max(_length(v), 1e-9), -body[2] / max(_length(body), 1e-9)
    return abs(acos(min(1.0, max(-1.0, first))) - acos(min(1.0, max(-1.0, second))))


@kernel
def cross(a: Vector, b: Vector) -> Vector:
    """Return the cross product."""
    return np.array((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))


@kernel
def _straight(body_m: Matrix) -> bool:
    """Return whether all baselines of the body are parallel."""
    return _partner(body_m, len(body_m)) == 0


@kernel
def _partner(body_m: Matrix, count: int) -> int:
    """Return the first of ``count`` baselines that is not parallel to the first one, 0 if there is none."""
    for j in range(1, count):
        if _length(cross(body_m[0], body_m[j])) > _PARALLEL * _length(body_m[0]) * _length(body_m[j]):
            return j
    return 0


@kernel
def _frame(first: Vector, second: Vector, out: Matrix) -> None:
    """Write the orthonormal axes (columns) of two vectors: along the first, across both, and the third."""
    along, across = first / max(_length(first), 1e-9), cross(first, second)
    across = across / max(_length(across), 1e-12)
    out[:, 0], out[:, 1], out[:, 2] = along, across, cross(along, across)


@kernel
def _start(chosen: Matrix, body_m: Matrix, predicted: Matrix, count: int, rotation: Matrix) -> None:
    """Write a rotation that takes the body's first baselines to the chosen ones: of two directions, or the shortest from the predicted."""
    other, ours, theirs = _partner(body_m, count), np.empty((3, 3)), np.empty((3, 3))
    if other > 0:
        _frame(body_m[0], body_m[other], ours)
        _frame(chosen[0], chosen[other], theirs)
    else:
        turned = _times(predicted, body_m[0])
        axis = cross(turned, chosen[0])
        if _length(axis) < 1e-9 * _length(turned):
            axis = cross(turned, np.array((0.31, 0.52, 0.79)))
        _frame(turned, axis, theirs)
        for i in range(3):
            for j in range(3):
                ours[i, j] = predicted[0, i] * theirs[0, j] + predicted[1, i] * theirs[1, j] + predicted[2, i] * theirs[2, j]
        _frame(chosen[0], axis, theirs)
    for i in range(3):
        for j in range(3):
            rotation[i, j] = theirs[i, 0] * ours[j, 0] + theirs[i, 1] * ours[j, 1] + theirs[i, 2] * ours[j, 2]


@kernel
def _times(matrix: Matrix, v: Vector) -> Vector:
    out = np.empty(3)
    for i in range(3):
        out[i] = matrix[i, 0] * v[0] + matrix[i, 1] * v[1] + matrix[i, 2] * v[2]
    return out


@kernel
def fit_rotation(
    chosen: Matrix, body_m: Matrix, weight: Matrix, predicted: Matrix, predicted_weight: Matrix, count: int, rotation: Matrix
) -> float:
    """Write the rotation (3x3) that takes ``count`` body vectors best to the chosen ones; return the chi-square, with the prediction's.

    Gauss-Newton, with one shorter step where a step does not lower it: ``rigid_body.fit`` without its covariances.
    """
    _start(chosen, body_m, predicted, count, rotation)
    N, g, trial = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    chi = _linearised(chosen, body_m, weight, predicted, predicted_weight, count, rotation, N, g)
    for _ in range(_STEPS):
        step = _solved(N, g)
        size = _length(step)
        if not size > _CONVERGED_RAD:
            break
        _turned(step, rotation, trial)
        now = _linearised(chosen, body_m, weight, predicted, predicted_weight, count, trial, N, g)
        if now > chi:
            _turned(0.3 * step, rotation, trial)
            now = _linearised(chosen, body_m, weight, predicted, predicted_weight, count, trial, N, g)
            if now > chi:
                break
        rotation[:, :] = trial
        done = chi - now < _ENOUGH * (1.0 + now)
        chi = now
        if done:
            break
    return chi


@kernel
def _linearised(
    chosen: Matrix, body_m: Matrix, weight: Matrix, predicted: Matrix, predicted_weight: Matrix, count: int, rotation: Matrix, N: Matrix,
    g: Vector,
) -> float:  # fmt: skip
    """Write the normal equations for a small turn of the rotation; return the chi-square there."""
    n = 3 * count
    r, J, chi = np.empty(n), np.zeros((n, 3)), 0.0
    for k in range(count):
        v = _times(rotation, body_m[k])
        for i in range(3):
            r[3 * k + i] = chosen[k, i] - v[i]
        J[3 * k, 1], J[3 * k, 2], J[3 * k + 1, 0] = v[2], -v[1], -v[2]
        J[3 * k + 1, 2], J[3 * k + 2, 0], J[3 * k + 2, 1] = v[0], v[1], -v[0]
    off = _turn_between(rotation, predicted)
    pull = _times(predicted_weight, off)
    for a in range(3):
        chi += off[a] * pull[a]
        g[a] = pull[a]
        for b in range(3):
            N[a, b] = predicted_weight[a, b]
        N[a, a] += _UNSEEN
    for i in range(n):
        wr, w0, w1, w2 = 0.0, 0.0, 0.0, 0.0
        for j in range(n):
            w = weight[i, j]
            wr += w * r[j]
            w0 += w * J[j, 0]
            w1 += w * J[j, 1]
            w2 += w * J[j, 2]
        chi += r[i] * wr
        for a in range(3):
            g[a] += J[i, a] * wr
            N[a, 0] += J[i, a] * w0
            N[a, 1] += J[i, a] * w1
            N[a, 2] += J[i, a] * w2
    return chi


@kernel
def _turn_between(rotation: Matrix, other: Matrix) -> Vector:
    """Return the turn (rad, a vector) that takes ``rotation`` to ``other``, applied from the left."""
    E = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            E[i, j] = other[i, 0] * rotation[j, 0] + other[i, 1] * rotation[j, 1] + other[i, 2] * rotation[j, 2]
    out = np.array((E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]))
    double_sine = _length(out)
    angle = acos(min(1.0, max(-1.0, 0.5 * (E[0, 0] + E[1, 1] + E[2, 2] - 1.0))))
    return out * (0.5 if angle < 1e-6 else angle / max(double_sine, 1e-9))


@kernel
def _turned(step: Vector, rotation: Matrix, out: Matrix) -> None:
    """Write the rotation turned by a vector (rad): Rodrigues' formula, column by column."""
    angle = max(_length(step), 1e-12)
    s, c = sin(angle) / angle, (1.0 - cos(angle)) / angle**2
    for j in range(3):
        v = rotation[:, j].copy()
        once = cross(step, v)
        twice = cross(step, once)
        for i in range(3):
            out[i, j] = v[i] + s * once[i] + c * twice[i]


@kernel
def _solved(N: Matrix, g: Vector) -> Vector:
    """Return the solution of three symmetric equations (Cramer)."""
    a, b, c, d, e, f = N[0, 0], N[0, 1], N[0, 2], N[1, 1], N[1, 2], N[2, 2]
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    s, t, u = a * f - c * c, b * c - a * e, a * d - b * b
    det = a * p + b * q + c * r
    x, y, z = p * g[0] + q * g[1] + r * g[2], q * g[0] + s * g[1] + t * g[2], r * g[0] + t * g[1] + u * g[2]
    return np.array((x, y, z)) / det if det > 0.0 else np.zeros(3)
