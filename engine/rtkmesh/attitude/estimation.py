"""Linear steps that the attitude filters share: the update in Joseph's form, and the test of an innovation."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from rtkmesh.attitude.innovation import Innovation

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


def updated(cov: Matrix, jacobian: Matrix, noise: Matrix, value: Vector) -> tuple[Vector, Matrix]:
    """Return the step of the states (n) and their covariance (n, n) after a measurement.

    Joseph's form keeps the covariance positive whatever the gain's rounding: R. Bucy, P. Joseph, "Filtering for stochastic processes".
    """
    cross = jacobian @ cov
    gain = np.linalg.solve(cross @ jacobian.T + noise, cross).T
    kept = np.eye(len(cov)) - gain @ jacobian
    after = kept @ cov @ kept.T + gain @ noise @ gain.T
    return gain @ value, 0.5 * (after + after.T)


def chi_square_of(cov: Matrix, innovation: "Innovation") -> float:
    """Return the innovation's square in units of its covariance; ``cov`` is of what its jacobian is by."""
    j, z = innovation.jacobian, innovation.value
    return float(z @ np.linalg.solve(j @ cov @ j.T + innovation.noise, z))
