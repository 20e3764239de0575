"""Linear steps that the attitude filters share: the update in Joseph's form, and the test of an innovation."""

from math import exp
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from rtkmesh.attitude.innovation import Innovation

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_UNIT: Final = {n: np.eye(n) for n in (3, 9)}
_LEARNING: Final = 0.1  # of the logarithm, per measurement and unit of the mean square
_MANY: Final = 1000
_LARGEST: Final = 10.0  # a mean square that counts
_WALK_FACTORS: Final = (0.01, 10.0)
GYRO_TELLS_S: Final = 1.0  # for so long after a gyro's sample it alone tells of the walk


def learned_walk(walk: float, mean_square: float, measurements: int = _MANY) -> float:
    """Return the factor of the rate's walk after an innovation whose square, per degree of freedom, was this in units of its covariance.

    It is 1 in the mean when the walk is right. The factor rises in a few samples and falls slowly, between bounds; at first, after few
    ``measurements``, it moves more quickly.
    """
    least, most = _WALK_FACTORS
    return min(most, max(least, walk * exp(max(_LEARNING, 2.0 / (2.0 + measurements)) * (min(mean_square, _LARGEST) - 1.0))))


def updated(cov: Matrix, jacobian: Matrix, noise: Matrix, value: Vector) -> tuple[Vector, Matrix, float]:
    """Return the step of the states (n), their covariance (n, n) after a measurement, and the innovation's square per degree of freedom.

    Joseph's form keeps the covariance positive whatever the gain's rounding: R. Bucy, P. Joseph, "Filtering for stochastic processes".
    """
    cross = jacobian @ cov
    weight = np.linalg.inv(cross @ jacobian.T + noise)
    gain = cross.T @ weight
    kept = _UNIT[len(cov)] - gain @ jacobian
    after = kept @ cov @ kept.T + gain @ noise @ gain.T
    return gain @ value, 0.5 * (after + after.T), float(value @ weight @ value) / len(value)


def chi_square_of(cov: Matrix, innovation: "Innovation") -> float:
    """Return the innovation's square in units of its covariance; ``cov`` is of what its jacobian is by."""
    return square(innovation.value, innovation.jacobian @ cov @ innovation.jacobian.T + innovation.noise)


def square(value: Vector, cov: Matrix) -> float:
    """Return the square of a vector (n) in units of its covariance (n, n)."""
    return float(value @ np.linalg.solve(cov, value))
