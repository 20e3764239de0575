"""A base's position as the mean of its receiver's fixes, and how good that is.

Fixes of a few minutes err alike (satellites, atmosphere and reflections change slowly): a mean of ten thousand is hardly better than one.
Errors are taken as a Gauss-Markov process of standard deviation s and correlation time T; a mean over the time t then has the variance
s^2 2T/t (1 - T/t (1 - exp(-t/T))) (integral of the autocovariance; Papoulis, Probability, random variables and stochastic processes, 9-2).
"""

from dataclasses import dataclass
from math import exp, isfinite, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.ephemeris import ReceiverFix
from rtkmesh.gnss.frames import ecef_from_geodetic, enu_from_ecef_at
from rtkmesh_services.ingest.receivers.survey import Position

MINIMUM_FIXES: Final = 10
MAXIMUM_FIXES: Final = 8192  # then every second one goes, and from then on only every second one is taken
OUTLIER_SIGMAS: Final = 4.0
_MAD_TO_SIGMA: Final = 1.4826
_SPREAD_FLOOR_M: Final = 0.005


@dataclass(frozen=True, slots=True)
class FixClass:
    """Fixes that err alike: sigmas (m) that no receiver is better than, whatever it says, and the time for which errors last."""

    horizontal_m: float
    vertical_m: float
    correlation_s: float


CODE: Final = FixClass(1.5, 3.0, 1800.0)  # without corrections, or with DGPS: ionosphere, orbits, reflections
FLOAT: Final = FixClass(0.4, 0.6, 900.0)
FIXED: Final = FixClass(0.01, 0.02, 300.0)
_CLASSES: Final = {3: CODE, 4: CODE, 5: FLOAT, 6: FIXED}


@dataclass(frozen=True, slots=True)
class Mean:
    """A mean position with its sigmas (east, north, up, m); ``accuracy_m`` is their root of the sum of squares."""

    position_ecef_m: Position
    sigma_enu_m: tuple[float, float, float]
    duration_s: float
    observations: int

    @property
    def accuracy_m(self) -> float:
        """One sigma in three dimensions."""
        return sqrt(sum(sigma * sigma for sigma in self.sigma_enu_m))


class _Series:
    """The fixes of one class, east, north, up about the first one; bounded."""

    def __init__(self, kind: FixClass) -> None:
        self.kind = kind
        self.count = 0
        self._origin: NDArray[np.float64] | None = None
        self._enu_m: list[NDArray[np.float64]] = []
        self._sigmas_m: list[tuple[float, float]] = []
        self._every = 1
        self._first_s = self._last_s = 0.0

    def add(self, fix: ReceiverFix, now_s: float) -> None:
        """Take a fix that came at an instant (monotonic seconds)."""
        position = ecef_from_geodetic(fix.lat_rad, fix.lon_rad, fix.height_m)
        if self._origin is None:
            self._origin, self._first_s = position, now_s
        self._last_s = now_s
        self.count += 1
        if self.count % self._every:
            return
        self._enu_m.append(enu_from_ecef_at(self._origin) @ (position - self._origin))
        self._sigmas_m.append((_claimed(fix.horizontal_sigma_m), _claimed(fix.vertical_sigma_m)))
        if len(self._enu_m) > MAXIMUM_FIXES:
            self._enu_m, self._sigmas_m, self._every = self._enu_m[::2], self._sigmas_m[::2], 2 * self._every

    def mean(self) -> Mean | None:
        """Return the mean without outliers, None before there are enough fixes."""
        if self._origin is None or len(self._enu_m) < MINIMUM_FIXES:
            return None
        enu_m = np.array(self._enu_m)
        middle = np.median(enu_m, axis=0)
        spread = np.maximum(_SPREAD_FLOOR_M, _MAD_TO_SIGMA * np.median(np.abs(enu_m - middle), axis=0))
        kept = (np.abs(enu_m - middle) <= OUTLIER_SIGMAS * spread).all(axis=1)
        mean = enu_m[kept].mean(axis=0) if kept.any() else middle
        horizontal_m, vertical_m = np.median(np.array(self._sigmas_m), axis=0).tolist()
        floors = (self.kind.horizontal_m, self.kind.horizontal_m, self.kind.vertical_m)
        single = np.maximum(np.maximum(floors, spread), (horizontal_m / sqrt(2.0), horizontal_m / sqrt(2.0), vertical_m))
        duration_s = self._last_s - self._first_s
        east, north, up = (single * mean_factor(duration_s, self.kind.correlation_s)).tolist()
        x, y, z = (self._origin + enu_from_ecef_at(self._origin).T @ mean).tolist()
        return Mean((x, y, z), (east, north, up), duration_s, self.count)


def mean_factor(duration_s: float, correlation_s: float) -> float:
    """Return what an error of correlation time T keeps of its sigma in a mean over a duration: 1 for none, sqrt(2T/t) for a long one."""
    ratio = duration_s / correlation_s
    if ratio < 1e-3:  # the series: 1 - ratio/3
        return sqrt(1.0 - ratio / 3.0)
    return sqrt(2.0 / ratio * (1.0 - (1.0 - exp(-ratio)) / ratio))


def _claimed(sigma_m: float) -> float:
    return sigma_m if isfinite(sigma_m) else 0.0


class PositionAverage:
    """The mean of a receiver's fixes: of the best class of which there are enough."""

    def __init__(self) -> None:
        self._series: dict[FixClass, _Series] = {}

    def add(self, fix: ReceiverFix, now_s: float) -> None:
        """Take a fix; those without three dimensions count for nothing."""
        kind = _CLASSES.get(fix.fix)
        if kind is not None and isfinite(fix.lat_rad + fix.lon_rad + fix.height_m):
            self._series.setdefault(kind, _Series(kind)).add(fix, now_s)

    def mean(self) -> Mean | None:
        """Return the mean of the class with the best accuracy, None before there are enough fixes."""
        means = [mean for series in self._series.values() if (mean := series.mean()) is not None]
        return min(means, key=lambda mean: mean.accuracy_m, default=None)
