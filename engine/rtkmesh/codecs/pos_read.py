"""RTKLIB's .pos text, read: llh (degrees or d m s), xyz and enu, calendar or week time, GPST or UTC, any separator.

Source: RTKLIB 2.4.2 manual, appendix B.1. A line that is not one of solutions is left out and counted; nothing in a file raises.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum
from math import copysign, isfinite, radians
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.frames import ecef_from_geodetic, enu_from_ecef_at
from rtkmesh.gnss.time import GpsTime

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


class Coordinates(StrEnum):
    """What the three coordinates are: geodetic, ECEF, or the baseline at the base."""

    LLH = "llh"
    XYZ = "xyz"
    ENU = "enu"


_KINDS: Final = {"latitude": Coordinates.LLH, "x-ecef": Coordinates.XYZ, "e-baseline": Coordinates.ENU}
_NORTH_EAST: Final = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_LARGEST: Final = 1e9


@dataclass(frozen=True, slots=True, eq=False)
class PosRow:
    """A solution: position in ECEF, or baseline in east-north-up (m); covariance always in east-north-up."""

    time: GpsTime
    status: int
    vector_m: Vector
    cov_enu_m2: Matrix


@dataclass(slots=True)
class PosFile:
    """The solutions of one file; ``skipped``: lines that are none."""

    kind: Coordinates = Coordinates.LLH
    rows: list[PosRow] = field(default_factory=list[PosRow])
    skipped: int = 0


def read_pos(lines: Iterable[str]) -> PosFile:
    """Return the solutions of the lines of a file. Without column names the coordinates are taken to be latitude, longitude, height."""
    found, utc, sexagesimal = PosFile(), False, False
    for line in lines:
        if line.startswith("%"):
            kind = next((kind for word, kind in _KINDS.items() if word in line), None)
            if kind is not None:
                found.kind, utc, sexagesimal = kind, line[1:].split()[0] == "UTC", "latitude(d'" in line
            continue
        row = _row(line.replace(",", " ").replace(";", " ").split(), found.kind, utc=utc, sexagesimal=sexagesimal)
        if row is not None:
            found.rows.append(row)
        elif line.strip():
            found.skipped += 1
    return found


def _row(words: list[str], kind: Coordinates, *, utc: bool, sexagesimal: bool) -> PosRow | None:
    try:
        time = _time(words[0], words[1], utc=utc)
        numbers = [float(word) for word in words[2:]]
        if sexagesimal:
            numbers = [_degrees(*numbers[:3]), _degrees(*numbers[3:6]), *numbers[6:]]
        vector, status, deviations = np.array(numbers[:3]), int(numbers[3]), numbers[5:11]
        cov = _covariance(deviations)
    except (ValueError, IndexError, TypeError, OverflowError):
        return None
    if len(deviations) < 6 or not all(isfinite(value) and abs(value) < _LARGEST for value in (*numbers[:3], *deviations)):
        return None
    if kind is Coordinates.LLH and not (abs(numbers[0]) <= 90.0 and abs(numbers[1]) <= 360.0):
        return None
    return PosRow(time, status, *_in_axes(vector, cov, kind))


def _in_axes(vector: Vector, cov: Matrix, kind: Coordinates) -> tuple[Vector, Matrix]:
    """Return position in ECEF or baseline in ENU, and the covariance in ENU."""
    if kind is Coordinates.ENU:
        return vector, cov
    if kind is Coordinates.XYZ:
        turn = enu_from_ecef_at(vector)
        return vector, turn @ cov @ turn.T
    lat_deg, lon_deg, height_m = vector.tolist()
    return ecef_from_geodetic(radians(lat_deg), radians(lon_deg), height_m), _NORTH_EAST @ cov @ _NORTH_EAST


def _covariance(deviations: list[float]) -> Matrix:
    """Return the covariance of sd and signed roots of covariances, in the file's own order of axes."""
    a, b, c, ab, bc, ca = (value * abs(value) for value in deviations)
    return np.array([[abs(a), ab, ca], [ab, abs(b), bc], [ca, bc, abs(c)]])


def _degrees(degrees: float, minutes: float, seconds: float) -> float:
    return copysign(abs(degrees) + minutes / 60.0 + seconds / 3600.0, degrees)  # -0 degrees too are west or south


def _time(day: str, time: str, *, utc: bool) -> GpsTime:
    if "/" not in day:
        return GpsTime.normalized(int(day), float(time))
    year, month, of_month = (int(part) for part in day.split("/"))
    hour, minute, second = time.split(":")
    if utc:
        whole, part = divmod(float(second), 1.0)
        return GpsTime.from_utc(datetime(year, month, of_month, int(hour), int(minute), int(whole), tzinfo=UTC)) + part
    return GpsTime.from_calendar(year, month, of_month, int(hour), int(minute), float(second))
