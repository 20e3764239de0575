"""The ambiguities of one epoch by itself: their phases are as good as the phases of fixes have been.

The filter takes its phases for worse (``published``), so that floats of many epochs, whose errors hang together, are not believed too soon.
An epoch without a past has no such floats: what fixes have shown of its phases, multipath and all, is the scatter of its ambiguities.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place
from rtkmesh.rtk.ambiguity import Candidates, held_among, held_differences, norm_of, pairs_of
from rtkmesh.rtk.filter import factor
from rtkmesh.rtk.noise import PHASE, phase_factor
from rtkmesh.rtk.published import FIX_DOF, FIX_SQUARES
from rtkmesh.rtk.state import DYNAMIC, FIRST_PAIR_KEY, Filter

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

# The variance factor of phases before fixes have shown any: 0.04 (survey antennas) to 0.55 (M8P patches) on recordings, 0.02 to 0.07 in
# simulation, so this is that of the worst, and worth some epochs: more than where a fix is only described (``published``), for here
# integers are believed by it. With 1, single epochs of few satellites never became sure enough to show anything (boat: 83 % fixed).
PRIOR: Final = 0.5
PRIOR_DOF: Final = 10.0


@kernel_in_place
def sharpness(scale: Matrix) -> float:
    """Return by what (at most 1) the variance of one epoch's phases is smaller than the filter has it."""
    shown = (PRIOR_DOF * PRIOR + scale[PHASE, FIX_SQUARES]) / (PRIOR_DOF + scale[PHASE, FIX_DOF])
    return min(shown / phase_factor(scale), 1.0)


@kernel
def held_norm(f: Filter, candidates: Candidates) -> float:
    """Return the squared norm of what is held against float ambiguities whose phases are as the filter has them."""
    pairs = pairs_of(held_among(f, candidates))
    return norm_of(f, pairs, held_differences(f, pairs))


@kernel
def with_sharper_phases(f: Filter, sharper: float) -> Filter:
    """Return the filter of one epoch with phases whose variances are ``sharper`` times what it took them for.

    Given the position (and what else is shared) ambiguities are as uncertain as their phases: this part of their covariance is scaled.
    """
    first = 0
    while first < len(f.keys) and f.keys[first] < FIRST_PAIR_KEY:
        first += 1
    m, start = 3 + first, DYNAMIC + first
    shared = np.empty(m, np.int64)
    for i in range(m):
        shared[i] = i if i < 3 else DYNAMIC + i - 3
    Q, U, W = np.empty((m, m)), np.zeros((m, m)), np.empty((m, len(f.x)))
    for i in range(m):
        for j in range(m):
            Q[i, j] = f.P[shared[i], shared[j]]
    if factor(Q, U) != 0:
        return f
    for i in range(m):
        for j in range(start, len(f.x)):
            W[i, j] = f.P[shared[i], j]
            for k in range(i):
                W[i, j] -= U[k, i] * W[k, j]
            W[i, j] /= U[i, i]
    P = f.P.copy()
    for i in range(start, len(f.x)):
        for j in range(start, len(f.x)):
            by_place = 0.0
            for k in range(m):
                by_place += W[k, i] * W[k, j]
            P[i, j] = sharper * P[i, j] + (1.0 - sharper) * by_place
    return Filter(f.x, P, f.keys, f.history)
