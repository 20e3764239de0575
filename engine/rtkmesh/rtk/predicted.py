"""Where the last fix and the motion since put the rover: what it says against a fix, and for one that few satellites carry."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place, scratch, scratch_table
from rtkmesh.rtk.filter import take_value
from rtkmesh.rtk.separation import normalised_square
from rtkmesh.rtk.state import Filter

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

PREDICTION_FLOOR_M: Final = 0.02  # sigma of a prediction beside that of the motion since the last fix
# Sigma in 3D of a fix from which the last one has a say. The filter does not know the integers, so it forgets those of satellites that a
# house hides; the last fix knew them. Fixes of many satellites are better than any prediction, and stay as they are.
WEAK_M: Final = 0.03


@kernel
def with_prediction(f: Filter, prediction: Vector) -> Filter:
    """Return the filter that also knows where the last fix and the phases since put the rover."""
    x, P = f.x.copy(), f.P.copy()
    take_place(x, P, prediction, (PREDICTION_FLOOR_M + prediction[3]) ** 2)
    return Filter(x, P, f.keys, f.history)


@kernel_in_place
def take_place(x: Vector, P: Matrix, place_m: Vector, variance_m2: float) -> None:
    """Take in, as an observation with this variance of each coordinate, where the rover is (m; the first three states)."""
    for i in range(3):
        take_value(x, P, i, place_m[i], variance_m2)


@kernel_in_place
def carry(x: Vector, P: Matrix, prediction: Vector, last_sigma_m: float) -> None:
    """Let the last fix, with this sigma in 3D (m), help one that few satellites carry: where it is moved on to is an observation."""
    take_place(x, P, prediction, last_sigma_m**2 + (PREDICTION_FLOOR_M + prediction[3]) ** 2)


@kernel_in_place
def departure(x: Vector, P: Matrix, prediction: Vector) -> float:
    """Return the squared distance of a fix from the prediction (m, ECEF, and its sigma), normalised by the covariance of both.

    A satellite whose phase is a reflected one, or that has slipped, moves the fix only when few others are left: away from where the last
    fix and the motion since put the rover.
    """
    gap_m, cov_m2 = scratch(3), scratch_table(3, 3)
    for i in range(3):
        gap_m[i] = x[i] - prediction[i]
        for j in range(3):
            cov_m2[i, j] = P[i, j]
        cov_m2[i, i] += (PREDICTION_FLOOR_M + prediction[3]) ** 2
    return normalised_square(gap_m, cov_m2)
