"""By how much the codes' own places scatter around a float solution more than their residuals say.

Codes that arrive by reflections are late, all of them: together they move the place of an epoch and leave small residuals, and their
residuals are all that the noise of codes is learned from. But the surroundings change on the move, while the float solution is carried by
phases. The squared distance of the codes' own place from it, normalised by its covariance and averaged over a minute, is 1 or less where
residuals tell all, and 2 to 11 in streets.

What to expect of it: the solution's own error adds trace(N P) to the codes' three degrees of freedom, with N the codes' normal equations
and P the solution's covariance; what both errors have in common takes 2 trace(N C) away. If the codes' errors were new in every epoch, C
would be nearly 0; if they lasted longer than the solution is old, it would be P. Half of P leaves three.
"""

from math import exp, isfinite
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel_in_place, scratch
from rtkmesh.rtk.noise import PHASE
from rtkmesh.rtk.separation import UNKNOWNS, Epochwise
from rtkmesh.rtk.state import Filter

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

# Columns of the phases' row of the noise memory that belong to the places of codes: squared distances and their degrees of freedom.
PLACE_SQUARES, PLACE_DOF = 4, 5
MEMORY_S: Final = 60.0
CHANGE_S: Final = 2.0  # an epoch that follows sooner sees nearly the same reflections, and counts for less
PRIOR_DOF: Final = 3.0  # at a factor of 1: little more than an epoch
# What comes and goes is seen; of what stays the float solution has taken its part. Simulated streets ask for 8, two bad codes for more, one
# that drifts for 2; under open sky and trees there is nothing to multiply.
LASTING: Final = 12.0
CHANCE: Final = 1.3  # so much a minute of multipath that lasts for half a minute scatters by chance: a few squares are no mean
MOST_PER_DOF: Final = 60.0  # one code that is hundreds of metres off is no scatter


@kernel_in_place
def place_factor(scale: Matrix) -> float:
    """Return by what factor the variance of floats is larger than residuals say, 1 at least, as the places of codes scatter."""
    scatter = (PRIOR_DOF + scale[PHASE, PLACE_SQUARES]) / (PRIOR_DOF + scale[PHASE, PLACE_DOF])
    return max(1.0, 1.0 + LASTING * (scatter - CHANCE))


@kernel_in_place
def learn_place(scale: Matrix, epoch: Epochwise, f: Filter, modelled_m: Vector, turn: Matrix, step_s: float) -> None:
    """Take in the distance of an epoch's codes' own place from the float solution; ``modelled_m`` is the baseline (ECEF) that the
    differences were modelled for, ``step_s`` the time since the last epoch (NaN: none).
    """
    gap_m, dof, square = scratch(UNKNOWNS), float(UNKNOWNS), 0.0
    for i in range(UNKNOWNS):
        gap_m[i] = epoch.place[i]
        for a in range(3):
            gap_m[i] -= turn[i, a] * (f.x[a] - modelled_m[a])
    for i in range(UNKNOWNS):
        for j in range(UNKNOWNS):
            square += gap_m[i] * epoch.reduced[i, j] * gap_m[j]
    if not (isfinite(step_s) and isfinite(square)):
        return
    kept, share = exp(-step_s / MEMORY_S), min(step_s / CHANGE_S, 1.0)
    scale[PHASE, PLACE_SQUARES] = kept * scale[PHASE, PLACE_SQUARES] + share * min(square, MOST_PER_DOF * dof)
    scale[PHASE, PLACE_DOF] = kept * scale[PHASE, PLACE_DOF] + share * dof
