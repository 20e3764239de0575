"""The slopes of GLONASS phases over the frequency channels, one on each band.

Between receivers of two makes phases are shifted by the channel times a slope (Wanninger 2012, J. Geodesy 86:139-148). In metres it is
nearly, not quite, the same on both bands: most of it is a delay in how receivers process signals (Sleewaegen et al. 2012, Inside GNSS
7(3):52-61).
"""

from math import hypot, isfinite, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place, scratch_table
from rtkmesh.rtk.ambiguity import condition, held_differences
from rtkmesh.rtk.filter import reset_state, take_out
from rtkmesh.rtk.memory import SLOPE_G1, SLOPE_SIGMA_G1
from rtkmesh.rtk.state import ARC_EPOCHS, DYNAMIC, SLOPE_KEYS, Filter, place_of

Vector = NDArray[np.float64]
Indices = NDArray[np.int64]
Slopes = tuple[tuple[float, float], tuple[float, float]]

SLOPE_CHANGE_M: Final = 5e-4  # what a slope may change over a reset
SLOPES_APART_M: Final = 0.003  # sigma of what the two bands' differ by, our choice: two recorded pairs have 0.4 and 1.2 mm


@kernel_in_place
def begin_slope(f: Filter, row: int, slopes: Slopes) -> None:
    """Give a value to a new slope (row of the keys): what was learned of its band (``slopes``: value and sigma, m); before that it is like
    the other band's, if that is in the filter.
    """
    band = int(f.keys[row]) - SLOPE_KEYS[0]
    other, i = place_of(f.keys, SLOPE_KEYS[1 - band]), DYNAMIC + row
    reset_state(f.x, f.P, i, slopes[band][0], slopes[band][1] ** 2)
    if slopes[band][1] <= SLOPES_APART_M or other < 0 or not f.history[other, ARC_EPOCHS] >= 0.0:
        return
    j = DYNAMIC + other
    for k in range(len(f.x)):
        f.P[i, k] = f.P[j, k]
        f.P[k, i] = f.P[j, k]
    f.x[i], f.P[i, i] = f.x[j], f.P[j, j] + SLOPES_APART_M**2


@kernel
def slope_states(f: Filter) -> Indices:
    """Return which states are slopes."""
    states, count = np.empty(len(SLOPE_KEYS), np.int64), 0
    for key in SLOPE_KEYS:
        row = place_of(f.keys, key)
        if row >= 0:
            states[count] = DYNAMIC + row
            count += 1
    return states[:count].copy()


@kernel
def learn_slopes(f: Filter, held: Indices, memory: Vector) -> None:
    """Remember the slopes that follow from the held integers; a band of which nothing is known is like the other."""
    states = slope_states(f)
    x, P = np.empty(len(states)), np.empty((len(states), len(states)))
    if not isfinite(condition(f.x, f.P, held, held_differences(f, held), 0.0, states, x, P)):
        return
    for k in range(len(states)):
        band = int(f.keys[states[k] - DYNAMIC]) - SLOPE_KEYS[0]
        memory[SLOPE_G1 + band], memory[SLOPE_SIGMA_G1 + band] = x[k], sqrt(max(P[k, k], 0.0)) + SLOPE_CHANGE_M
        other = 1 - band
        if len(states) == 1 and memory[SLOPE_SIGMA_G1 + other] > SLOPES_APART_M:
            memory[SLOPE_G1 + other], memory[SLOPE_SIGMA_G1 + other] = x[k], hypot(memory[SLOPE_SIGMA_G1 + band], SLOPES_APART_M)


@kernel
def without_slopes(f: Filter) -> Filter:
    """Return the filter under the hypothesis that GLONASS phases have no slope on either band (receivers of one make)."""
    states = slope_states(f)
    if len(states) == 0:
        return f
    x, P, room = f.x.copy(), f.P.copy(), scratch_table(2, len(f.x))
    for i in states:
        take_out(x, P, i, room)
    for i in states:
        reset_state(x, P, i, 0.0, SLOPE_CHANGE_M**2)
    return Filter(x, P, f.keys, f.history)
