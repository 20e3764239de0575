"""Frames for texts, in plain floats and in RTKLIB's order of operations, so that the last printed digit is its own.

The engine's frames are compiled kernels; a process that only writes texts does without them. Matrices are nine numbers, row by row.
"""

from collections.abc import Sequence
from math import atan, atan2, cos, isfinite, pi, sin, sqrt
from typing import Final

from rtkmesh.gnss.constants import WGS84_A_M, WGS84_E2

Vector = tuple[float, float, float]
Matrix = Sequence[float]

# RTKLIB ends its iteration below this change of z (m); heights are then good to a micrometre.
_CONVERGED_M: Final = 1e-4
_AXIS_M2: Final = 1e-12


def known(values: Sequence[float]) -> bool:
    """Return whether all numbers are finite."""
    return all(map(isfinite, values))


def geodetic(position_ecef_m: Vector) -> Vector:
    """Return latitude (rad), longitude (rad) and ellipsoidal height (m), as RTKLIB's ecef2pos (2.4.3)."""
    x, y, z0 = position_ecef_m
    r2 = x * x + y * y
    z, last, v = z0, 0.0, WGS84_A_M
    while abs(z - last) >= _CONVERGED_M:
        last = z
        sin_lat = z / sqrt(r2 + z * z)
        v = WGS84_A_M / sqrt(1.0 - WGS84_E2 * sin_lat * sin_lat)
        z = z0 + v * WGS84_E2 * sin_lat
    if r2 > _AXIS_M2:
        return atan(z / sqrt(r2)), atan2(y, x), sqrt(r2 + z * z) - v
    return (pi / 2.0 if z0 > 0.0 else -pi / 2.0), 0.0, sqrt(r2 + z * z) - v


def enu_rotation(lat_rad: float, lon_rad: float) -> Matrix:
    """Return the rotation that takes ECEF vectors to east, north, up."""
    sin_lat, cos_lat, sin_lon, cos_lon = sin(lat_rad), cos(lat_rad), sin(lon_rad), cos(lon_rad)
    return (
        -sin_lon, cos_lon, 0.0,
        -sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat,
        cos_lat * cos_lon, cos_lat * sin_lon, sin_lat,
    )  # fmt: skip


def turned(rotation: Matrix, vector: Sequence[float]) -> Vector:
    """Return a vector in another frame. Sums begin at 0.0, as RTKLIB's do: they are never -0.0 then."""
    a, b, c, d, e, f, g, h, i = rotation
    x, y, z = vector
    return 0.0 + a * x + b * y + c * z, 0.0 + d * x + e * y + f * z, 0.0 + g * x + h * y + i * z


def turned_covariance(rotation: Matrix, covariance: Matrix) -> Matrix:
    """Return a covariance in another frame: R C Rᵀ."""
    half = [turned(rotation, covariance[column::3]) for column in range(3)]
    rows = [(half[0][row], half[1][row], half[2][row]) for row in range(3)]
    turned_rows = [turned(rotation, row) for row in rows]
    return [value for row in turned_rows for value in row]
