"""Positions of antennas in plain floats: ECEF metres, degrees, offsets east, north, up."""

from math import cos, degrees, radians, sin, sqrt
from typing import Final

from rtkmesh.gnss.constants import WGS84_A_M, WGS84_E2
from rtkmesh_services.texts.geodesy import Vector, enu_rotation, geodetic, turned

_LEAST_RADIUS_M: Final = 6.2e6


def ecef(lat_deg: float, lon_deg: float, height_m: float) -> Vector:
    """Return the ECEF position (m) of geodetic coordinates (ellipsoidal height)."""
    lat_rad, lon_rad = radians(lat_deg), radians(lon_deg)
    n = WGS84_A_M / sqrt(1.0 - WGS84_E2 * sin(lat_rad) ** 2)
    horizontal = (n + height_m) * cos(lat_rad)
    return horizontal * cos(lon_rad), horizontal * sin(lon_rad), (n * (1.0 - WGS84_E2) + height_m) * sin(lat_rad)


def llh(position_ecef_m: Vector) -> Vector:
    """Return latitude, longitude (deg) and ellipsoidal height (m)."""
    lat_rad, lon_rad, height_m = geodetic(position_ecef_m)
    return degrees(lat_rad), degrees(lon_rad), height_m


def moved(position_ecef_m: Vector, offset_enu_m: Vector) -> Vector:
    """Return a position that is moved east, north and up (m)."""
    lat_rad, lon_rad, _ = geodetic(position_ecef_m)
    r = enu_rotation(lat_rad, lon_rad)
    x, y, z = turned((r[0], r[3], r[6], r[1], r[4], r[7], r[2], r[5], r[8]), offset_enu_m)
    return position_ecef_m[0] + x, position_ecef_m[1] + y, position_ecef_m[2] + z


def on_earth(position_ecef_m: Vector) -> bool:
    """Return whether a position is one: RTKLIB writes 0, 0, 0 (lat 90, height -6335367.6) where there is none."""
    return sqrt(sum(value * value for value in position_ecef_m)) > _LEAST_RADIUS_M
