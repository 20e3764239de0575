"""What float ambiguities have taken from the codes' errors, and so by how much the filter misjudges a float solution.

A float solution is off by what its ambiguities took from codes, and code multipath lasts for minutes: averaging helps less, or (on the
move) more, than the filter thinks, who inflates the codes of every receiver alike. The codes' own position of an epoch has residuals that
no ambiguity has swallowed. Each ambiguity keeps their mean as the filter averages codes into it, with the variance that the filter believes
it to have by then. Were the filter right, the squares of these means over their variances would add up to the redundancy of the codes.
What all codes have in common is in no residual: that is a factor of its own (``code_places``).

GLONASS has no say: its codes are shifted by channel between makes, a lasting error that its learned noise keeps out of the position.
"""

from math import isfinite, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel_in_place, scratch_flags
from rtkmesh.gnss.signals import GLONASS, SATELLITES_PER_SYSTEM
from rtkmesh.rtk.code_places import learn_place, place_factor
from rtkmesh.rtk.residuals import WAVELENGTH, Differences
from rtkmesh.rtk.separation import CLOCK, RANGE, UNKNOWNS, Codes, Epochwise, Ranges
from rtkmesh.rtk.state import ARC_EPOCHS, TAKEN_M, TAKEN_M2, Filter
from rtkmesh.rtk.update import Layout

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

# What the variance of floats is multiplied by before codes have shown anything, and what that is worth in degrees of freedom. The filter
# alone is right within a factor of two (simulated open sky asks for 0.5 to 0.9, recordings for 0.6 to 1.6), and a mean of minutes is one
# sample of few degrees: so the start counts for as much as the redundancy of one band. (A start of 0.25 made the few satellites of one band
# and of streets 2 to 5 times too sure.)
PRIOR: Final = 1.0
PRIOR_DOF: Final = 6.0
LEAST: Final = 0.05
MOST: Final = 20.0
FAR_M: Final = 5e3  # from here on what the atmosphere does to floats, which no code shows, is not to be made less


@kernel_in_place
def float_factor(
    f: Filter, d: Differences, layout: Layout, codes: Codes, scale: Matrix, walk_cyc: float, step_s: float, modelled_m: Vector
) -> float:
    """Let the ambiguities take this epoch's code residuals; return the factor of the float position's variance.

    ``walk_cyc`` is the filter's random walk of ambiguities (per square root of second), ``step_s`` the time since the last epoch (NaN:
    none); the differences were modelled for ``modelled_m`` as baseline (ECEF).
    """
    ranges, epoch = codes.ranges, codes.whole
    if not epoch.solved:
        return place_factor(scale)
    learn_place(scale, epoch, f, modelled_m, codes.turn, step_s)
    lasting = place_factor(scale)
    squares, count, groups, judged = 0.0, 0, 0, scratch_flags(ranges.groups)
    judged[:] = False
    for k in range(len(ranges.weight)):
        if not ranges.weight[k] > 0.0 or layout.ambiguity[k] < 0 or d.pairs.satellite[k] // SATELLITES_PER_SYSTEM == GLONASS:
            continue
        row, walk_m = f.history[layout.ambiguity[k]], walk_cyc * d.table[k, WAVELENGTH]
        inflation = layout.code_inflation[k] if row[ARC_EPOCHS] > 1.0 else 1.0
        take(row, residual(ranges, epoch, k), inflation / ranges.weight[k], walk_m * walk_m * step_s)
        squares += row[TAKEN_M] ** 2 / row[TAKEN_M2]
        count += 1
        groups += 0 if judged[ranges.group[k]] else 1
        judged[ranges.group[k]] = True
    redundancy = count - groups - UNKNOWNS
    if redundancy <= 0:
        return lasting
    factor, length_m = lasting * factor_of(squares, float(redundancy)), sqrt(f.x[0] ** 2 + f.x[1] ** 2 + f.x[2] ** 2)
    return factor if length_m < FAR_M else max(factor, 1.0)


@kernel_in_place
def residual(ranges: Ranges, epoch: Epochwise, k: int) -> float:
    """Return the residual (m) of a range against its epoch's own position and clock."""
    sums, row = epoch.sums[ranges.group[k]], ranges.rows[k]
    value = row[RANGE] - sums[RANGE, CLOCK] / sums[CLOCK, CLOCK]
    for i in range(UNKNOWNS):
        value -= epoch.place[i] * (row[i] - sums[i, CLOCK] / sums[CLOCK, CLOCK])
    return value


@kernel_in_place
def take(row: Vector, residual_m: float, variance_m2: float, grown_m2: float) -> None:
    """Average a code residual into what an ambiguity has taken, as the filter does; a new ambiguity takes all of it."""
    if row[ARC_EPOCHS] <= 1.0 or not isfinite(row[TAKEN_M2] + grown_m2):
        row[TAKEN_M], row[TAKEN_M2] = residual_m, variance_m2
        return
    believed = row[TAKEN_M2] + grown_m2
    gain = believed / (believed + variance_m2)
    row[TAKEN_M] += gain * (residual_m - row[TAKEN_M])
    row[TAKEN_M2] = (1.0 - gain) * believed


@kernel_in_place
def factor_of(squares: float, dof: float) -> float:
    """Return the expected factor: of a variance that is known from squares with so many degrees of freedom, 1 / variance is larger by
    dof / (dof - 2).
    """
    raw = (PRIOR_DOF * PRIOR + squares) / max(PRIOR_DOF + dof - 2.0, 1.0)
    return min(max(raw, LEAST), MOST)
