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

from rtkmesh.gnss.time import GpsTime

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

LASTS_S: Final = 100.0  # time constant of what is averaged
LASTING: Final = 0.3  # share of a fix's variance that never is
LONGEST_S: Final = 60.0  # a fix is for no longer time than that
FIRST_S: Final = 1.0  # time that the first fix is for
LIMIT: Final = 25.0  # squared normalised distance (3 degrees of freedom) from which a fix is of another place
STRAYS: Final = 3  # fixes in a row of another place, after which the rover stands there


class Standing:
    """The mean of the fixes of a rover that stands. Mutable; places are rover minus base (m, ECEF)."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Begin anew with the next fix."""
        self._time: GpsTime | None = None
        self._base_ecef_m, self._origin_m, self._sums = np.full(3, np.nan), np.zeros(3), np.zeros(3)
        self._information, self._seconds, self._strays = np.zeros((3, 3)), 0.0, 0

    def place(self, time: GpsTime, base_ecef_m: Vector, baseline_m: Vector, cov_m2: Matrix) -> tuple[Vector, Matrix]:
        """Return where the rover is from the base, and the covariance (m, ECEF), by a fix that is there and all before it.

        Times rise or fall all the time. A fix of another place counts by itself; if more follow, the rover is taken to stand there. Where
        the base's position changes the mean begins anew. A covariance that is none is returned, and the fix forgotten.
        """
        if not np.isfinite(cov_m2).all() or not np.linalg.det(cov_m2) > 0.0:
            return baseline_m, cov_m2
        if self._time is None or not np.array_equal(base_ecef_m, self._base_ecef_m):
            return self._begin(time, base_ecef_m, baseline_m, cov_m2)
        mean_m, mean_cov_m2 = self._mean()
        apart_m = baseline_m - mean_m
        if apart_m @ np.linalg.solve(mean_cov_m2 + cov_m2, apart_m) > LIMIT:
            self._strays += 1
            return self._begin(time, base_ecef_m, baseline_m, cov_m2) if self._strays >= STRAYS else (baseline_m, cov_m2)
        self._take(min(abs(time - self._time), LONGEST_S), baseline_m, cov_m2)
        self._time, self._strays = time, 0
        return self._mean()

    def _begin(self, time: GpsTime, base_ecef_m: Vector, baseline_m: Vector, cov_m2: Matrix) -> tuple[Vector, Matrix]:
        self.forget()
        self._time, self._base_ecef_m, self._origin_m = time, base_ecef_m.copy(), baseline_m.copy()
        self._take(FIRST_S, baseline_m, cov_m2)
        return baseline_m, cov_m2

    def _take(self, seconds: float, baseline_m: Vector, cov_m2: Matrix) -> None:
        """Let a fix count for so long."""
        weight = seconds * np.linalg.inv(cov_m2)
        self._information += weight
        self._sums += weight @ (baseline_m - self._origin_m)
        self._seconds += seconds

    def _mean(self) -> tuple[Vector, Matrix]:
        """Return the mean place and its covariance."""
        inverse = np.linalg.inv(self._information)
        factor = LASTING + (1.0 - LASTING) / (1.0 + self._seconds / (2.0 * LASTS_S))
        return self._origin_m + inverse @ self._sums, 0.5 * factor * self._seconds * (inverse + inverse.T)
