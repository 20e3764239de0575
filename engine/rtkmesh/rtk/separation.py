"""Solutions of one epoch with each satellite left out: what a fault of any one of them cannot have touched.

The epoch's single differences are taken as ranges: phases with their held integers, or codes. They have no past, so a fault that lasted
cannot hide in a filter. The clock of each group is eliminated per group (Schur complement), so that leaving a satellite out costs a few
sums. All positions are east-north-up (m) from the place that the ranges were modelled for.
"""

from math import isfinite, sqrt
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place, scratch, scratch_indices, scratch_table
from rtkmesh.gnss.frames import write_enu, write_geodetic
from rtkmesh.gnss.signals import SATELLITES_PER_SYSTEM
from rtkmesh.rtk.noise import code_factors
from rtkmesh.rtk.residuals import CHANNEL, CODE, CODE_VARIANCE, IONOSPHERE, PHASE, PHASE_VARIANCE, WAVELENGTH, Differences
from rtkmesh.rtk.state import INTEGER, Filter
from rtkmesh.rtk.update import Layout

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

# Columns of a range: partial derivatives by east, north and up, observed minus modelled (m), and 1 for the clock.
EAST, NORTH, UP, RANGE, CLOCK = range(5)
COLUMNS: Final = 5
UNKNOWNS: Final = 3
_SINGULAR: Final = 1e-9  # determinant over the product of the diagonal, from which three directions are no three


class Ranges(NamedTuple):
    """Ranges of an epoch, sorted by satellite, with their inverse variances (1/m2; 0: not used) and clock groups."""

    rows: Matrix
    weight: Vector
    group: Indices
    satellite: NDArray[np.int16]
    groups: int


class Epochwise(NamedTuple):
    """The solution of an epoch's ranges: sums per group, the normal equations without clocks, place, covariance, and the fit.

    ``dof`` below 0 or ``solved`` False: too few ranges.
    """

    sums: NDArray[np.float64]
    reduced: Matrix
    place: Vector
    cov: Matrix
    solved: bool
    chi2: float
    dof: int


class Codes(NamedTuple):
    """The codes of an epoch as ranges and their own solution; ``turn`` takes ECEF to east-north-up there."""

    turn: Matrix
    ranges: Ranges
    whole: Epochwise


@kernel
def codes_alone(d: Differences, used: NDArray[np.bool_], scale: Matrix, rover_ecef_m: Vector) -> Codes:
    """Return what the codes of an epoch say by themselves; the differences were modelled for a rover at ``rover_ecef_m``."""
    systems = scale.shape[1]
    geodetic, trial, factors, turn = scratch(3), scratch_table(2, systems), scratch(systems), np.empty((3, 3))
    trial[:, :] = 0.0
    code_factors(scale, trial, factors)
    write_geodetic(rover_ecef_m, geodetic)
    write_enu(geodetic[0], geodetic[1], turn)
    ranges = code_ranges(d, used, factors, turn)
    return Codes(turn, ranges, solve_epoch(ranges))


@kernel
def code_ranges(d: Differences, used: NDArray[np.bool_], factors: Vector, turn: Matrix) -> Ranges:
    """Return the codes; ``factors`` are those of code variances per system, ``turn`` takes ECEF to east-north-up."""
    out = _empty_ranges(d, turn)
    for k in range(len(out.weight)):
        variance = d.table[k, CODE_VARIANCE] * factors[int(d.pairs.satellite[k]) // SATELLITES_PER_SYSTEM]
        _put(out, k, d.table[k, CODE], variance, used[k])
    _take_clocks(out)
    return out


@kernel
def phase_ranges(
    f: Filter, d: Differences, layout: Layout, used: NDArray[np.bool_], factor: float, turn: Matrix, far: bool
) -> Ranges:  # fmt: skip
    """Return the phases whose integers are held; ``factor`` is that of phase variances.

    GLONASS phases are left out: their slope is the filter's. Where ionospheres are states of what places the rover (``far``), two bands
    are combined to be free of them.
    """
    out = _empty_ranges(d, turn)
    for k in range(len(out.weight)):
        place = layout.ambiguity[k]
        integer = f.history[place, INTEGER] if place >= 0 else np.nan
        usable = used[k] and d.table[k, CHANNEL] == 0.0
        _put(out, k, d.table[k, PHASE] - d.table[k, WAVELENGTH] * integer, d.table[k, PHASE_VARIANCE] * factor, usable)
    if far and len(layout.ionosphere) > 0 and layout.ionosphere.max() >= 0:
        _combine_bands(out, d)
    _take_clocks(out)
    return out


@kernel_in_place
def _combine_bands(out: Ranges, d: Differences) -> None:
    """Put in place of a satellite's first phase its ionosphere-free combination with the second; no others stay.

    With q = (f1 / f)^2 it is (q2 L1 - q1 L2) / (q2 - q1). A group is combined with one other group only, so that it keeps one clock.
    """
    partner, n, last = scratch_indices(out.groups), len(out.weight), -1
    partner[:] = -1
    for k in range(n):
        q1, w1 = d.table[k, IONOSPHERE], out.weight[k]
        out.weight[k] = 0.0
        if k + 1 == n or out.satellite[k + 1] != out.satellite[k] or out.satellite[k] == last or not w1 * out.weight[k + 1] > 0.0:
            continue
        q2, w2 = d.table[k + 1, IONOSPHERE], out.weight[k + 1]
        if partner[out.group[k]] < 0:
            partner[out.group[k]] = out.group[k + 1]
        if q1 == q2 or partner[out.group[k]] != out.group[k + 1]:
            continue
        last = out.satellite[k]
        out.rows[k, RANGE] = (q2 * out.rows[k, RANGE] - q1 * out.rows[k + 1, RANGE]) / (q2 - q1)
        out.weight[k] = (q2 - q1) ** 2 / (q2 * q2 / w1 + q1 * q1 / w2)


@kernel
def _empty_ranges(d: Differences, turn: Matrix) -> Ranges:
    n = len(d.pairs.satellite)
    rows = np.empty((n, COLUMNS))
    for k in range(n):
        x, y, z = d.rover_direction[k, 0], d.rover_direction[k, 1], d.rover_direction[k, 2]
        for i in range(3):
            rows[k, i] = -(turn[i, 0] * x + turn[i, 1] * y + turn[i, 2] * z)
        rows[k, CLOCK] = 1.0
    return Ranges(rows, np.zeros(n), d.pairs.group, d.pairs.satellite, d.pairs.groups)


@kernel_in_place
def _put(out: Ranges, k: int, value_m: float, variance_m2: float, used: bool) -> None:
    usable = used and isfinite(value_m) and variance_m2 > 0.0
    out.rows[k, RANGE], out.weight[k] = value_m if usable else 0.0, 1.0 / variance_m2 if usable else 0.0


@kernel_in_place
def _take_clocks(out: Ranges) -> None:
    """Take the first range of each group from all of it: clocks and integers of thousands of kilometres would eat the millimetres."""
    clock = scratch(out.groups)
    clock[:] = np.nan
    for k in range(len(out.weight)):
        if out.weight[k] > 0.0:
            if not isfinite(clock[out.group[k]]):
                clock[out.group[k]] = out.rows[k, RANGE]
            out.rows[k, RANGE] -= clock[out.group[k]]


@kernel
def solve_epoch(ranges: Ranges) -> Epochwise:
    """Return the weighted least squares place of an epoch's ranges."""
    sums, reduced = np.zeros((ranges.groups, COLUMNS, COLUMNS)), np.zeros((CLOCK, CLOCK))
    count = 0
    for k in range(len(ranges.weight)):
        if ranges.weight[k] > 0.0:
            count += 1
            _add_row(sums[ranges.group[k]], ranges.rows[k], ranges.weight[k])
    for g in range(ranges.groups):
        if sums[g, CLOCK, CLOCK] > 0.0:
            count -= 1
            _add_reduced(sums[g], 1.0, reduced)
    place, cov = np.zeros(3), np.zeros((3, 3))
    solved = solve_normal(reduced, place, cov)
    chi2 = reduced[RANGE, RANGE]
    for i in range(3):
        chi2 -= place[i] * reduced[i, RANGE]
    return Epochwise(sums, reduced, place, cov, solved, max(chi2, 0.0), count - UNKNOWNS)


@kernel_in_place
def _add_row(total: Matrix, row: Vector, weight: float) -> None:
    for i in range(COLUMNS):
        for j in range(COLUMNS):
            total[i, j] += weight * row[i] * row[j]


@kernel_in_place
def _add_reduced(total: Matrix, sign: float, reduced: Matrix) -> None:
    """Add a group's sums without its clock; ``sign`` -1 takes them away."""
    w = total[CLOCK, CLOCK]
    for i in range(CLOCK):
        for j in range(CLOCK):
            reduced[i, j] += sign * (total[i, j] - total[i, CLOCK] * total[CLOCK, j] / w)


class Rest(NamedTuple):
    """The place of the ranges that remain, and its covariance, in arrays that are written to, with room to work in."""

    place: Vector
    cov: Matrix
    reduced: Matrix
    less: Matrix


@kernel_in_place
def leave_out(ranges: Ranges, whole: Epochwise, first: int, last: int, rest: Rest) -> bool:
    """Write place and covariance of the solution without the rows ``first`` to ``last`` - 1 (one satellite: each row in a group of its
    own); return whether there is one.
    """
    reduced, less = rest.reduced, rest.less
    _copy(whole.reduced, reduced)
    for k in range(first, last):
        if not ranges.weight[k] > 0.0:
            continue
        total = whole.sums[ranges.group[k]]
        _add_reduced(total, -1.0, reduced)
        _copy(total, less)
        _add_row(less, ranges.rows[k], -ranges.weight[k])
        if less[CLOCK, CLOCK] > 1e-9 * total[CLOCK, CLOCK]:
            _add_reduced(less, 1.0, reduced)
    return solve_normal(reduced, rest.place, rest.cov)


@kernel_in_place
def _copy(source: Matrix, target: Matrix) -> None:
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]


@kernel_in_place
def solve_normal(reduced: Matrix, place: Vector, cov: Matrix) -> bool:
    """Write the inverse of the leading 3 x 3 and its product with the fourth column; return False where it is singular."""
    a, b, c, d, e, f = reduced[0, 0], reduced[0, 1], reduced[0, 2], reduced[1, 1], reduced[1, 2], reduced[2, 2]
    cov[0, 0], cov[0, 1], cov[0, 2] = d * f - e * e, c * e - b * f, b * e - c * d
    cov[1, 1], cov[1, 2], cov[2, 2] = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * cov[0, 0] + b * cov[0, 1] + c * cov[0, 2]
    if not determinant > _SINGULAR * a * d * f:
        return False
    cov[1, 0], cov[2, 0], cov[2, 1] = cov[0, 1], cov[0, 2], cov[1, 2]
    for i in range(3):
        place[i] = 0.0
        for j in range(3):
            cov[i, j] /= determinant
            place[i] += cov[i, j] * reduced[j, RANGE]
    return True


@kernel_in_place
def horizontal_sigma(cov: Matrix) -> float:
    """Return the largest standard deviation of any horizontal direction."""
    middle, half = 0.5 * (cov[0, 0] + cov[1, 1]), 0.5 * (cov[0, 0] - cov[1, 1])
    return sqrt(max(middle + sqrt(half * half + cov[0, 1] * cov[0, 1]), 0.0))


@kernel_in_place
def normalised_square(difference: Vector, cov: Matrix) -> float:
    """Return difference' cov^-1 difference of three components; infinite where the covariance is singular."""
    work, place, inverse = scratch_table(CLOCK, CLOCK), scratch(3), scratch_table(3, 3)
    for i in range(3):
        for j in range(3):
            work[i, j] = cov[i, j]
        work[i, RANGE] = difference[i]
    if not solve_normal(work, place, inverse):
        return np.inf
    return difference[0] * place[0] + difference[1] * place[1] + difference[2] * place[2]
