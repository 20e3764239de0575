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
Axes = NDArray[np.float64]  # (k, k, 3, 3)

_STEPS: Final = 8
_CONVERGED_RAD: Final = 1e-7
_ENOUGH: Final = 1e-5  # of the chi-square: a step that gives less is the last
_PARALLEL: Final = 0.02  # sine of an angle between baselines that gives no rotation about them
_MOST_WORK: Final = 100_000  # combinations that are looked at, a fit is many of them: some ten milliseconds
_FIT_WORK: Final = 40
_UNSEEN: Final = 1e-9  # weight that keeps a rotation which nothing measures in its place


@kernel
def search_combinations(
    values_m: Stack, norms: Matrix, sizes: Indices, body_m: Matrix, weights: Stack, spread_m2: Stack, axes: Axes, loops: Indices,
    loop_weights: Stack, predicted: Matrix, predicted_weight: Matrix, tilt_rad: float, two: Indices, costs: Vector, best: Matrix,
) -> int:  # fmt: skip
    """Write the two combinations of least cost (2, k), their costs (infinite: none) and the rotation of the best; return how many fits that
    took.

    ``values_m`` (k, m, 3) and ``norms`` (k, m) are the first ``sizes`` candidates of each of k baselines (NED); ``body_m`` (k, 3) the
    baselines in the body; ``weights`` (k, 3k, 3k) the inverse joint covariance of the first 1, 2, .. k of them; ``spread_m2`` (k, k, 3)
    and ``axes`` (k, k, 3, 3) variances and axes (columns) of the covariance of each (diagonal) and of differences of two. ``loops``
    (l, 5): triangles, as which baseline is the sum of which two earlier ones and the signs of these, with the weights (l, 3, 3) of what
    they are open by. ``predicted`` is where the rotation is expected, with its weight (3, 3; 0: no knowledge); ``tilt_rad`` by how much
    the body's down axis may be off the vertical. Where that is too much work, the second has the cost of the best: nothing is sure.
    """
    k, fits, depth, work = len(body_m), 0, 0, 0
    chosen, place, step, rotation = np.empty((k, 3)), np.full(k, -1), np.full(k, -1), np.empty((3, 3))
    sums, rest, worst = np.zeros(k + 1), np.zeros(k + 1), np.zeros(k + 1)
    alone, order = _each_alone(values_m, norms, sizes, body_m, spread_m2, axes, tilt_rad)
    for j in range(k - 1, -1, -1):
        rest[j] = rest[j + 1] + norms[j, : sizes[j]].min()
    costs[:] = np.inf
    while depth >= 0:
        step[depth] += 1
        if step[depth] >= sizes[depth]:
            depth -= 1
            continue
        work += 1
        if work > _MOST_WORK:
            costs[1] = costs[0]  # nothing can be said of the others
            break
        place[depth] = order[depth, step[depth]]
        total, least = sums[depth] + norms[depth, place[depth]], max(worst[depth], alone[depth, place[depth]])
        if total + rest[depth + 1] + least >= costs[1]:
            continue
        chosen[depth] = values_m[depth, place[depth]]
        least = max(least, _least_misfit(chosen, body_m, spread_m2, axes, depth), _misclosure(chosen, loops, loop_weights, depth))
        if total + rest[depth + 1] + least >= costs[1]:
            continue
        if depth > 0 or k == 1:
            least = fit_rotation(chosen, body_m, weights[depth], predicted, predicted_weight, depth + 1, rotation)
            fits, work = fits + 1, work + _FIT_WORK
        if total + rest[depth + 1] + least >= costs[1]:
            continue
        if depth + 1 < k:
            depth += 1
            sums[depth], worst[depth], step[depth] = total, least, -1
        elif rotation[2, 2] >= cos(tilt_rad) or _straight(body_m):
            _take(total + least, place, rotation, two, costs, best)
    return fits


@kernel
def _each_alone(
    values_m: Stack, norms: Matrix, sizes: Indices, body_m: Matrix, spread_m2: Stack, axes: Axes, tilt_rad: float
) -> tuple[Matrix, Indices]:  # fmt: skip
    """Return what the length of each candidate (k, m) adds to its norm (infinite: it climbs too steeply) and the order of the sums."""
    k, m = norms.shape
    alone, order, none = np.full((k, m), np.inf), np.zeros((k, m), np.int64), np.zeros(3)
    for j in range(k):
        for c in range(sizes[j]):
            if _climb(values_m[j, c], body_m[j]) <= tilt_rad:
                alone[j, c] = _misfit_of_distance(values_m[j, c], none, length(body_m[j]), spread_m2[j, j], axes[j, j])
        order[j] = np.argsort(norms[j] + alone[j], kind="mergesort")
    return alone, order


@kernel
def _take(cost: float, place: Indices, rotation: Matrix, two: Indices, costs: Vector, best: Matrix) -> None:
    """Take a combination among the two best; it is better than the second."""
    at = 0 if cost < costs[0] else 1
    if at == 0:
        costs[1] = costs[0]
        two[1] = two[0]
        best[:, :] = rotation
    costs[at] = cost
    two[at] = place


@kernel
def _least_misfit(chosen: Matrix, body_m: Matrix, spread_m2: Stack, axes: Axes, last: int) -> float:
    """Return a lower bound of the chi-square by the distances of the last baseline's end to those before: no rotation is needed."""
    worst, apart = 0.0, np.empty(3)
    for j in range(last):
        for i in range(3):
            apart[i] = body_m[last, i] - body_m[j, i]
        worst = max(worst, _misfit_of_distance(chosen[last], chosen[j], length(apart), spread_m2[last, j], axes[last, j]))
    return worst


@kernel
def _misclosure(chosen: Matrix, loops: Indices, weights: Stack, last: int) -> float:
    """Return a lower bound of the chi-square by the triangles that a baseline is the last side of: no rotation closes them."""
    worst, gap = 0.0, np.empty(3)
    for n in range(len(loops)):
        if loops[n, 0] != last:
            continue
        for i in range(3):
            gap[i] = chosen[last, i] - loops[n, 3] * chosen[loops[n, 1], i] - loops[n, 4] * chosen[loops[n, 2], i]
        square = 0.0
        for i in range(3):
            square += gap[i] * (weights[n, i, 0] * gap[0] + weights[n, i, 1] * gap[1] + weights[n, i, 2] * gap[2])
        worst = max(worst, square)
    return worst


@kernel
def _misfit_of_distance(end_m: Vector, start_m: Vector, distance_m: float, variances_m2: Vector, axes: Matrix) -> float:
    """Return a lower bound of the squared misfit of a vector, end minus start, whose true length is known.

    Sought is the least of sum((y - x)^2 / e) with x as long as that, in the axes of the covariance. Lagrange's dual is below it for
    every multiplier, and next to it for one that is nearly right: two Newton steps.
    """
    y, x_square, slope, multiplier, bound = np.empty(3), 0.0, 0.0, 0.0, 0.0
    if not distance_m > 0.0:
        return 0.0
    lowest = -0.9 / max(variances_m2[0], variances_m2[1], variances_m2[2])
    for i in range(3):
        y[i] = axes[0, i] * (end_m[0] - start_m[0]) + axes[1, i] * (end_m[1] - start_m[1]) + axes[2, i] * (end_m[2] - start_m[2])
    for _ in range(2):
        x_square, slope = 0.0, 0.0
        for i in range(3):
            shrunk = 1.0 / (1.0 + multiplier * variances_m2[i])
            x_square += (y[i] * shrunk) ** 2
            slope += (y[i] * shrunk) ** 2 * shrunk * variances_m2[i]
        if not slope > 0.0:
            return 0.0
        multiplier = max(multiplier + (sqrt(x_square) / distance_m - 1.0) * x_square / slope, lowest)
    for i in range(3):
        bound += y[i] * y[i] / (1.0 + multiplier * variances_m2[i])
    return max(0.0, multiplier * (bound - distance_m * distance_m))


@kernel
def length(v: Vector) -> float:
    """Return the length of a vector of three."""
    return sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


@kernel
def _climb(v: Vector, body: Vector) -> float:
    """Return the difference of two vectors' elevations (rad): the tilt of the body is at least this."""
    first, second = -v[2] / max(length(v), 1e-9), -body[2] / max(length(body), 1e-9)
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
        if length(cross(body_m[0], body_m[j])) > _PARALLEL * length(body_m[0]) * length(body_m[j]):
            return j
    return 0


@kernel
def _frame(first: Vector, second: Vector, out: Matrix) -> None:
    """Write the orthonormal axes (columns) of two vectors: along the first, across both, and the third."""
    along, across = first / max(length(first), 1e-9), cross(first, second)
    across = across / max(length(across), 1e-12)
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
        if length(axis) < 1e-9 * length(turned):
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
    N, g, trial, expected = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.any(predicted_weight != 0.0)
    r, J = np.empty(3 * count), np.zeros((3 * count, 3))
    chi = _linearised(chosen, body_m, weight, count, rotation, r, J, N, g)
    chi += _pulled(predicted, predicted_weight, rotation, N, g) if expected else 0.0
    for _ in range(_STEPS):
        step, now = _solved(N, g), np.inf
        if not length(step) > _CONVERGED_RAD:
            break
        for share in (1.0, 0.3):
            turned(share * step, rotation, trial)
            now = _linearised(chosen, body_m, weight, count, trial, r, J, N, g)
            now += _pulled(predicted, predicted_weight, trial, N, g) if expected else 0.0
            if now <= chi:
                break
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
    chosen: Matrix, body_m: Matrix, weight: Matrix, count: int, rotation: Matrix, r: Vector, J: Matrix, N: Matrix, g: Vector
) -> float:
    """Write residuals, their derivatives and the normal equations for a small turn of the rotation; return the chi-square there."""
    n, chi = 3 * count, 0.0
    for k in range(count):
        x, y, z = body_m[k, 0], body_m[k, 1], body_m[k, 2]
        for i in range(3):
            v = rotation[i, 0] * x + rotation[i, 1] * y + rotation[i, 2] * z
            r[3 * k + i] = chosen[k, i] - v
            J[3 * k + (i + 1) % 3, (i + 2) % 3], J[3 * k + (i + 2) % 3, (i + 1) % 3] = v, -v
    for a in range(3):
        g[a] = 0.0
        for b in range(3):
            N[a, b] = _UNSEEN if a == b else 0.0
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
def _pulled(predicted: Matrix, predicted_weight: Matrix, rotation: Matrix, N: Matrix, g: Vector) -> float:
    """Add what the prediction says to the normal equations; return its chi-square."""
    off, chi = _turn_between(rotation, predicted), 0.0
    pull = _times(predicted_weight, off)
    for a in range(3):
        chi += off[a] * pull[a]
        g[a] += pull[a]
        for b in range(3):
            N[a, b] += predicted_weight[a, b]
    return chi


@kernel
def _turn_between(rotation: Matrix, other: Matrix) -> Vector:
    """Return the turn (rad, a vector) that takes ``rotation`` to ``other``, applied from the left."""
    E = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            E[i, j] = other[i, 0] * rotation[j, 0] + other[i, 1] * rotation[j, 1] + other[i, 2] * rotation[j, 2]
    out = np.array((E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]))
    double_sine = length(out)
    angle = acos(min(1.0, max(-1.0, 0.5 * (E[0, 0] + E[1, 1] + E[2, 2] - 1.0))))
    return out * (0.5 if angle < 1e-6 else angle / max(double_sine, 1e-9))


@kernel
def turned(step: Vector, rotation: Matrix, out: Matrix) -> None:
    """Write the rotation turned by a vector (rad): Rodrigues' formula, column by column."""
    angle = max(length(step), 1e-12)
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
