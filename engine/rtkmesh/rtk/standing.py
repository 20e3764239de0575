"""Where a rover stands, by all the fixes since it does.

Given its integers every epoch says where the rover is, and of one that stands all say the same. The filter itself forgets: its
ambiguities walk, so that errors of codes which last do not freeze in it, and a few epochs are all that a fix has of the past. So fixes
are averaged here, by the time that each is for and the covariance that it would be published with. Their errors are multipath, a
Gauss-Markov process of time constant tau: the mean of T seconds of it has about 1 / (1 + T / (2 tau)) of its variance (exactly
2 tau / T (1 - tau / T (1 - exp(-T / tau))), at most 14 % more; Gelb 1974, Applied Optimal Estimation, 2.2). Some of it lasts for as
long as the rover stands, and no mean makes that smaller.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel_in_place, scratch, scratch_table
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.normal_matrix import invert_positive_definite

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

LASTS_S: Final = 100.0  # time constant of what is averaged
LASTING: Final = 0.3  # share of a fix's variance that never is
LONGEST_S: Final = 60.0  # a fix is for no longer time than that
FIRST_S: Final = 1.0  # time that the first fix is for
LIMIT: Final = 25.0  # squared normalised distance (3 degrees of freedom) from which a fix is of another place
STRAYS: Final = 3  # fixes in a row of another place, after which the rover stands there

# What a mean is made of: the place of its first fix (m, ECEF, rover minus base), where the others are from there, each times its weight
# (seconds over covariance), the sum of the weights (3 x 3), the seconds; fixes in a row of another place, and where the base is (m, ECEF),
# NaN where there is no mean.
_ORIGIN_M, _SUMS, _WEIGHTS, _SECONDS, _STRAYS, _BASE_ECEF_M = 0, 3, 6, 15, 16, 17
_MEAN: Final = 20


class Standing:
    """The mean of the fixes of a rover that stands. Mutable; places are rover minus base (m, ECEF)."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Begin anew with the next fix."""
        self._time: GpsTime | None = None
        self._mean = np.full(_MEAN, np.nan)

    def place(self, time: GpsTime, base_ecef_m: Vector, baseline_m: Vector, cov_m2: Matrix) -> tuple[Vector, Matrix]:
        """Return where the rover is from the base, and the covariance (m, ECEF), by a fix that is there and all before it.

        Times rise or fall all the time. A fix of another place counts by itself; if more follow, the rover is taken to stand there. Where
        the base's position changes the mean begins anew. A fix whose covariance is none is returned as it is, and forgotten.
        """
        seconds = 0.0 if self._time is None else min(abs(time - self._time), LONGEST_S)
        place_m, place_cov_m2 = baseline_m.copy(), cov_m2.copy()
        if average(self._mean, base_ecef_m, seconds, place_m, place_cov_m2):
            self._time = time
        return place_m, place_cov_m2


@kernel_in_place
def average(mean: Vector, base_ecef_m: Vector, seconds: float, place_m: Vector, cov_m2: Matrix) -> bool:
    """Take a fix into a mean, and write the place and the covariance that this has then over its own; return whether it was taken.

    Nothing is written over a fix that begins a mean, nor over one that is not taken.
    """
    weight, there_m, sum_m2 = scratch_table(3, 3), scratch(3), scratch_table(3, 3)
    if not invert_positive_definite(cov_m2, weight):
        return False
    if not _has_base(mean, base_ecef_m):
        _begin(mean, base_ecef_m, place_m, weight)
        return True
    _write_mean(mean, there_m, sum_m2)
    for i in range(3):
        for j in range(3):
            sum_m2[i, j] += cov_m2[i, j]
    if _distance(place_m, there_m, sum_m2) > LIMIT:
        mean[_STRAYS] += 1.0
        begins = mean[_STRAYS] >= STRAYS
        if begins:
            _begin(mean, base_ecef_m, place_m, weight)
        return bool(begins)
    _take(mean, seconds, place_m, weight)
    _write_mean(mean, place_m, cov_m2)
    return True


@kernel_in_place
def _has_base(mean: Vector, base_ecef_m: Vector) -> bool:
    """Return whether there is a mean, and it is from this base."""
    same = True
    for i in range(3):
        same = same and mean[_BASE_ECEF_M + i] == base_ecef_m[i]
    return same


@kernel_in_place
def _begin(mean: Vector, base_ecef_m: Vector, place_m: Vector, weight: Matrix) -> None:
    """Let the mean be that of one fix."""
    mean[:] = 0.0
    for i in range(3):
        mean[_ORIGIN_M + i], mean[_BASE_ECEF_M + i] = place_m[i], base_ecef_m[i]
    _take(mean, FIRST_S, place_m, weight)


@kernel_in_place
def _take(mean: Vector, seconds: float, place_m: Vector, weight: Matrix) -> None:
    """Let a fix count for so long; ``weight`` is the inverse of its covariance."""
    mean[_SECONDS] += seconds
    mean[_STRAYS] = 0.0
    for i in range(3):
        for j in range(3):
            mean[_WEIGHTS + 3 * i + j] += seconds * weight[i, j]
            mean[_SUMS + i] += seconds * weight[i, j] * (place_m[j] - mean[_ORIGIN_M + j])


@kernel_in_place
def _write_mean(mean: Vector, place_m: Vector, cov_m2: Matrix) -> None:
    """Write the mean place and its covariance."""
    weights, inverse, seconds = scratch_table(3, 3), scratch_table(3, 3), mean[_SECONDS]
    for i in range(3):
        for j in range(3):
            weights[i, j] = mean[_WEIGHTS + 3 * i + j]
    invert_positive_definite(weights, inverse)
    factor = seconds * (LASTING + (1.0 - LASTING) / (1.0 + seconds / (2.0 * LASTS_S)))
    for i in range(3):
        off_m = 0.0
        for j in range(3):
            cov_m2[i, j] = factor * inverse[i, j]
            off_m += inverse[i, j] * mean[_SUMS + j]
        place_m[i] = mean[_ORIGIN_M + i] + off_m


@kernel_in_place
def _distance(place_m: Vector, other_m: Vector, cov_m2: Matrix) -> float:
    """Return the squared distance of two places in sigmas of this covariance of their difference."""
    weight, squares = scratch_table(3, 3), 0.0
    invert_positive_definite(cov_m2, weight)
    for i in range(3):
        for j in range(3):
            squares += (place_m[i] - other_m[i]) * weight[i, j] * (place_m[j] - other_m[j])
    return squares
