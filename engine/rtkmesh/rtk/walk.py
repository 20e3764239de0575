"""How far the rover has walked since the last epoch, as time differences of its phases say: what one epoch tells of it."""

from math import nan
from typing import Final

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

# Of a walk, NaN where there is none: how long it took by the tags (s, filter's clock), how far it led (m, ECEF), its cofactors (3 x 3;
# times the variance of a time difference its covariance), squared residuals of the phases (m2, sum) and their degrees of freedom.
WALK_S, WALK_M, WALK_COFACTOR, WALK_SQUARES_M2, WALK_FREEDOM = 0, 1, 4, 13, 14
WALK: Final = 15


def no_walk() -> Vector:
    """Return room for a walk."""
    return np.full(WALK, nan)
