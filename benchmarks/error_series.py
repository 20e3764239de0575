"""Errors of codes and phases as series in time: how large by elevation, and how long they hang together."""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

ELEVATIONS_DEG: Final = ((15.0, 30.0), (30.0, 50.0), (50.0, 90.0))
LAGS_S: Final = (1.0, 5.0, 20.0, 60.0, 180.0)
_FEWEST_PAIRS: Final = 200  # of errors a lag apart, below which nothing is said


@dataclass(slots=True)
class Collected:
    """Errors (m) of many signals; ``add`` takes those of one epoch."""

    rows: dict[int, list[tuple[float, float, float]]] = field(default_factory=lambda: defaultdict(list[tuple[float, float, float]]))

    def add(self, time_s: float, keys: Iterable[int], elevation_rad: Vector, error_m: Vector) -> None:
        """Take in the errors of an epoch's signals, each with a key that stays the same as long as the signal is followed."""
        for key, elevation, error in zip(keys, elevation_rad.tolist(), error_m.tolist(), strict=True):
            if np.isfinite(error):
                self.rows[key].append((time_s, elevation, error))

    def series(self) -> list["Series"]:
        """Return one series per signal."""
        return [Series(*np.array(rows).T) for rows in self.rows.values() if len(rows) > 1]


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """One signal's errors (m) with times (s) and elevations (rad)."""

    time_s: Vector
    elevation_rad: Vector
    error_m: Vector

    def without_mean(self) -> "Series":
        """Return the series about its own mean."""
        return Series(self.time_s, self.elevation_rad, self.error_m - self.error_m.mean())


@dataclass(frozen=True, slots=True)
class Described:
    """Standard deviations (m) per range of elevations, autocorrelations at LAGS_S, and the number of errors."""

    sigma_m: tuple[float, ...]
    correlation: tuple[float, ...]
    number: int


def describe(series: Iterable[Series]) -> Described:
    """Return size and memory of errors; the memory is that of errors in units of the sigma of their elevation."""
    known = list(series)
    if not known:
        return Described((np.nan,) * len(ELEVATIONS_DEG), (np.nan,) * len(LAGS_S), 0)
    elevation_deg = np.degrees(np.concatenate([s.elevation_rad for s in known]))
    error_m = np.concatenate([s.error_m for s in known])
    bands = [(elevation_deg >= low) & (elevation_deg < high) for low, high in ELEVATIONS_DEG]
    sigma_m = tuple(_root_mean_square(error_m[band]) for band in bands)
    scaled = [Series(s.time_s, s.elevation_rad, s.error_m / _sigma_at(s.elevation_rad, sigma_m)) for s in known]
    return Described(sigma_m, tuple(_correlation(scaled, lag_s) for lag_s in LAGS_S), len(error_m))


def _root_mean_square(error_m: Vector) -> float:
    return float(np.sqrt(np.mean(error_m**2))) if len(error_m) else float("nan")


def _sigma_at(elevation_rad: Vector, sigma_m: tuple[float, ...]) -> Vector:
    """Return the sigma of each elevation's range; NaN outside of all."""
    out = np.full(len(elevation_rad), np.nan)
    for (low, high), sigma in zip(ELEVATIONS_DEG, sigma_m, strict=True):
        out[(np.degrees(elevation_rad) >= low) & (np.degrees(elevation_rad) < high)] = sigma
    return out


def _correlation(scaled: list[Series], lag_s: float) -> float:
    """Return the mean product of errors of one signal a lag apart, relative to their mean square."""
    products, squares, count = 0.0, 0.0, 0
    for one in scaled:
        later = np.searchsorted(one.time_s, one.time_s + (lag_s - 0.05))
        there = later < len(one.time_s)
        first, second = np.flatnonzero(there), later[there]
        exact = np.abs(one.time_s[second] - one.time_s[first] - lag_s) < 0.05
        a, b = one.error_m[first[exact]], one.error_m[second[exact]]
        both = np.isfinite(a) & np.isfinite(b)
        products += float(np.sum(a[both] * b[both]))
        squares += float(np.sum(a[both] ** 2 + b[both] ** 2)) / 2.0
        count += int(both.sum())
    return products / squares if count >= _FEWEST_PAIRS and squares > 0.0 else float("nan")
