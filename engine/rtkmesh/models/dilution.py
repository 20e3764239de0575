"""Dilution of precision: how a geometry of satellites magnifies errors of ranges (one receiver clock)."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


class Dilution(NamedTuple):
    """Geometric, position, horizontal and vertical dilution; NaN with fewer than four satellites or in a plane."""

    gdop: float = float("nan")
    pdop: float = float("nan")
    hdop: float = float("nan")
    vdop: float = float("nan")


def dilution(azimuth_rad: Vector, elevation_rad: Vector) -> Dilution:
    """Return the dilutions of satellites in these directions, each counted once.

    Kaplan and Hegarty, Understanding GPS/GNSS, 3rd edition, 11.2.1: roots of sums of the diagonal of (H'H)^-1.
    """
    if len(azimuth_rad) < 4:
        return Dilution()
    level, ones = np.cos(elevation_rad), np.ones(len(azimuth_rad))
    H = np.column_stack((level * np.sin(azimuth_rad), level * np.cos(azimuth_rad), np.sin(elevation_rad), ones))
    normal = H.T @ H
    if not np.isfinite(normal).all() or np.linalg.cond(normal) > 1e12:
        return Dilution()
    east, north, up, clock = np.diag(np.linalg.inv(normal)).tolist()
    roots = np.sqrt((east + north + up + clock, east + north + up, east + north, up)).tolist()
    return Dilution(*roots)
