"""Where the last fix and the motion since put the rover: what it says against a fix, and for one that few satellites carry."""

from math import hypot, isfinite
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place, scratch, scratch_table
from rtkmesh.rtk.filter import take_value
from rtkmesh.rtk.separation import normalised_square
from rtkmesh.rtk.state import Filter

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

FULL_STEP_S: Final = 0.9  # from this step on an epoch counts in full: at 1 Hz all do
PREDICTION_FLOOR_M: Final = 0.02  # sigma of a prediction beside that of the motion since the last fix
# Sigma in 3D of a fix from which the last one has a say. The filter does not know the integers, so it forgets those of satellites that a
# house hides; the last fix knew them. Fixes of many satellites are better than any prediction, and stay as they are.
WEAK_M: Final = 0.03


@kernel_in_place
def share_of_step(step_s: float) -> float:
    """Return for how much an epoch counts that follows after so many seconds (NaN: the first one): in full from FULL_STEP_S on."""
    return step_s / FULL_STEP_S if step_s < FULL_STEP_S else 1.0


@kernel_in_place
def learn_fix(prediction: Vector, x: Vector, share: float) -> None:
    """Let the prediction begin with a fix, for its ``share``: what most fixes of the last second say is what the next one is held against.

    A phase that slowly becomes a reflected one moves the fix by little within a tenth of a second.
    """
    part = share if isfinite(prediction[3]) else 1.0
    for i in range(3):
        prediction[i] = x[i] if part == 1.0 else prediction[i] + part * (x[i] - prediction[i])
    prediction[3] = 0.0 if part == 1.0 else (1.0 - part) * prediction[3]


@kernel_in_place
def spread(prediction: Vector, sigma_m: float, share: float) -> None:
    """Let the prediction become less sure by a step of this sigma (m); errors of steps within a second take each other away."""
    prediction[3] = prediction[3] + sigma_m if share == 1.0 else hypot(prediction[3], sigma_m)


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
