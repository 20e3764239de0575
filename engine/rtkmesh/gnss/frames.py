"""Earth frames: geodetic, ECEF, local east-north-up. Angles in radians, WGS 84 ellipsoid."""

from math import atan2, cos, hypot, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place
from rtkmesh.gnss.constants import WGS84_A_M, WGS84_E2

_A = WGS84_A_M
_E2 = WGS84_E2

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


@kernel
def ecef_from_geodetic(lat_rad: float, lon_rad: float, height_m: float) -> Vector:
    """Return the ECEF position (m, shape 3) of geodetic coordinates (height above the ellipsoid)."""
    n = _A / sqrt(1.0 - _E2 * sin(lat_rad) ** 2)
    out = np.empty(3)
    out[0] = (n + height_m) * cos(lat_rad) * cos(lon_rad)
    out[1] = (n + height_m) * cos(lat_rad) * sin(lon_rad)
    out[2] = (n * (1.0 - _E2) + height_m) * sin(lat_rad)
    return out


@kernel
def geodetic_from_ecef(position_ecef_m: Vector) -> Vector:
    """Return latitude (rad), longitude (rad) and ellipsoidal height (m) of an ECEF position, as an array of 3.

    Fixed-point iteration on the geodetic latitude; converges to better than 1e-4 m for all points above -5000 km.
    """
    out = np.empty(3)
    write_geodetic(position_ecef_m, out)
    return out


@kernel_in_place
def write_geodetic(position_ecef_m: Vector, out: Vector) -> None:
    """Write what ``geodetic_from_ecef`` returns."""
    x, y, z = position_ecef_m[0], position_ecef_m[1], position_ecef_m[2]
    p2 = x * x + y * y
    zk, v = z, _A
    for _ in range(30):
        sin_lat = zk / sqrt(p2 + zk * zk) if p2 + zk * zk > 0.0 else 0.0
        v = _A / sqrt(1.0 - _E2 * sin_lat * sin_lat)
        last = zk
        zk = z + v * _E2 * sin_lat
        if abs(zk - last) < 1e-5:
            break
    if p2 > 1e-12:
        out[0] = atan2(zk, sqrt(p2))
        out[1] = atan2(y, x)
    else:
        out[0] = np.pi / 2.0 if z > 0.0 else -np.pi / 2.0
        out[1] = 0.0
    out[2] = sqrt(p2 + zk * zk) - v


@kernel
def enu_from_ecef(lat_rad: float, lon_rad: float) -> Matrix:
    """Return the rotation (3x3) that takes ECEF vectors to east, north, up at a geodetic latitude and longitude."""
    out = np.empty((3, 3))
    write_enu(lat_rad, lon_rad, out)
    return out


@kernel_in_place
def write_enu(lat_rad: float, lon_rad: float, out: Matrix) -> None:
    """Write what ``enu_from_ecef`` returns."""
    sl, cl, so, co = sin(lat_rad), cos(lat_rad), sin(lon_rad), cos(lon_rad)
    out[0, 0], out[0, 1], out[0, 2] = -so, co, 0.0
    out[1, 0], out[1, 1], out[1, 2] = -sl * co, -sl * so, cl
    out[2, 0], out[2, 1], out[2, 2] = cl * co, cl * so, sl


def enu_from_ecef_at(origin_ecef_m: Vector) -> Matrix:
    """Return the rotation (3x3) that takes ECEF vectors to east, north, up at an ECEF origin."""
    lat_rad, lon_rad, _ = geodetic_from_ecef(origin_ecef_m)
    return enu_from_ecef(lat_rad, lon_rad)


@kernel
def azimuth_elevation(line_of_sight_enu: Vector) -> Vector:
    """Return azimuth (rad, clockwise from north, in [0, 2 pi)) and elevation (rad) of an ENU direction, as an array of 2."""
    e, n, u = line_of_sight_enu[0], line_of_sight_enu[1], line_of_sight_enu[2]
    out = np.empty(2)
    azimuth = atan2(e, n)
    out[0] = azimuth + 2.0 * np.pi if azimuth < 0.0 else azimuth
    out[1] = atan2(u, hypot(e, n))
    return out
