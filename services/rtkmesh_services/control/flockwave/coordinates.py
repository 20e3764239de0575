"""Positions as Flockwave writes them: whole millimetres, and whole 1e-7 degrees. Without the engine: control is a light process."""

from math import atan2, degrees, hypot, sin, sqrt
from typing import Final

_A_M: Final = 6378137.0  # WGS 84
_E2: Final = 6.69437999014e-3
_STEPS: Final = 8

Position = tuple[float, float, float]


def millimetres(position_ecef_m: Position) -> Position:
    """Return an ECEFCoordinate (whole mm) of an ECEF position in metres."""
    x, y, z = (round(value_m * 1e3) for value_m in position_ecef_m)
    return x, y, z


def coordinate(position_ecef_m: Position) -> list[int | None]:
    """Return a GPSCoordinate of an ECEF position in metres.

    Latitude and longitude (1e-7 degrees), height (mm), height above home (not known). The first height is the one above the ellipsoid, as
    Skybrush has it, though the protocol says mean sea level.
    """
    lat_rad, lon_rad, height_m = geodetic(position_ecef_m)
    lon = round(degrees(lon_rad) * 1e7)
    return [round(degrees(lat_rad) * 1e7), lon if lon < 1_800_000_000 else lon - 3_600_000_000, round(height_m * 1e3), None]


def geodetic(position_ecef_m: Position) -> Position:
    """Return latitude and longitude (rad) and ellipsoidal height (m) of a place near the earth's surface.

    Fixed-point iteration on the latitude; its error shrinks by e2 with each step.
    """
    x, y, z = position_ecef_m
    across = hypot(x, y)
    lat_rad = atan2(z, across * (1.0 - _E2))
    for _ in range(_STEPS):
        lat_rad = atan2(z + _radius(lat_rad) * _E2 * sin(lat_rad), across)
    north = z + _radius(lat_rad) * _E2 * sin(lat_rad)
    return lat_rad, atan2(y, x), hypot(across, north) - _radius(lat_rad)


def _radius(lat_rad: float) -> float:
    """Return the radius of curvature in the prime vertical, m."""
    return _A_M / sqrt(1.0 - _E2 * sin(lat_rad) ** 2)
