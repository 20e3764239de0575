"""The solid earth tide: how far the ground moves under sun and moon (up to 0.4 m), at one place as good as at its neighbour.

Between places it differs by millimetres per hundred kilometres, so it matters to long baselines alone.
"""

from math import cos, pi, sin, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place
from rtkmesh.gnss.constants import SECONDS_PER_DAY

Vector = NDArray[np.float64]

# IERS Conventions 2010 (Technical Note 36), table 1.1 and the text below equation 7.5.
_SUN_MASS: Final = 332946.0482  # of the earth's
_MOON_MASS: Final = 0.0123000371
_RADIUS_M: Final = 6378136.6
_H2, _H2_LATITUDE, _L2, _L2_LATITUDE = 0.6078, -0.0006, 0.0847, 0.0002
_H3, _L3 = 0.292, 0.015

_DEGREE: Final = pi / 180.0
_ARCSECOND: Final = _DEGREE / 3600.0
_CENTURY_DAYS: Final = 36525.0
_GPS_EPOCH_DAYS: Final = -7300.5  # 1980-01-06 00:00 before J2000.0 (2000-01-01 12:00)
_TT_MINUS_GPST_S: Final = 51.184
_GPST_MINUS_UT_S: Final = 18.0  # since 2017; a second turns the tide by 4 thousandths of a degree
_PRECESSION_DEG: Final = 1.3972  # per century


@kernel
def sun_and_moon(week: int, tow_s: float) -> tuple[Vector, Vector]:
    """Return geocentric positions (m) of sun and moon in the mean equator and equinox of date, at a GPST.

    Montenbruck and Gill 2000, Satellite Orbits, equations 3.43 to 3.51, with the moving perihelion of Meeus 1998 (25.2, 25.3): good to some
    arc minutes and 500 km of the moon's distance, which is half a millimetre of the tide.
    """
    century = (_GPS_EPOCH_DAYS + 7.0 * week + (tow_s + _TT_MINUS_GPST_S) / SECONDS_PER_DAY) / _CENTURY_DAYS
    precession = _PRECESSION_DEG * century * _DEGREE
    anomaly = (357.5256 + 35999.049 * century) * _DEGREE
    longitude = (282.9374 + 1.7195 * century) * _DEGREE + anomaly + (6892.0 * sin(anomaly) + 72.0 * sin(2.0 * anomaly)) * _ARCSECOND
    distance_m = (149.619 - 2.499 * cos(anomaly) - 0.021 * cos(2.0 * anomaly)) * 1e9
    return _from_ecliptic(longitude, 0.0, distance_m), _moon(century, precession)


@kernel
def _moon(century: float, precession: float) -> Vector:
    """Return the position (m) of the moon, see ``sun_and_moon``."""
    mean = (218.31617 + 481267.88088 * century) * _DEGREE - precession
    l = (134.96292 + 477198.86753 * century) * _DEGREE  # noqa: E741  the book's symbol
    s = (357.52543 + 35999.04944 * century) * _DEGREE
    F = (93.27283 + 483202.01873 * century) * _DEGREE
    D = (297.85027 + 445267.11135 * century) * _DEGREE
    away = (
        22640.0 * sin(l) + 769.0 * sin(2.0 * l) - 4586.0 * sin(l - 2.0 * D) + 2370.0 * sin(2.0 * D) - 668.0 * sin(s) - 412.0 * sin(2.0 * F)
        - 212.0 * sin(2.0 * l - 2.0 * D) - 206.0 * sin(l + s - 2.0 * D) + 192.0 * sin(l + 2.0 * D) - 165.0 * sin(s - 2.0 * D)
        + 148.0 * sin(l - s) - 125.0 * sin(D) - 110.0 * sin(l + s) - 55.0 * sin(2.0 * F - 2.0 * D)
    )  # fmt: skip
    argument = F + (away + 412.0 * sin(2.0 * F) + 541.0 * sin(s)) * _ARCSECOND
    latitude = (
        18520.0 * sin(argument) - 526.0 * sin(F - 2.0 * D) + 44.0 * sin(l + F - 2.0 * D) - 31.0 * sin(F - l - 2.0 * D)
        - 25.0 * sin(F - 2.0 * l) - 23.0 * sin(s + F - 2.0 * D) + 21.0 * sin(F - l) + 11.0 * sin(F - s - 2.0 * D)
    ) * _ARCSECOND  # fmt: skip
    distance_km = (
        385000.0 - 20905.0 * cos(l) - 3699.0 * cos(2.0 * D - l) - 2956.0 * cos(2.0 * D) - 570.0 * cos(2.0 * l)
        + 246.0 * cos(2.0 * l - 2.0 * D) - 205.0 * cos(s - 2.0 * D) - 171.0 * cos(l + 2.0 * D) - 152.0 * cos(l + s - 2.0 * D)
    )  # fmt: skip
    return _from_ecliptic(mean + precession + away * _ARCSECOND, latitude, 1e3 * distance_km)


@kernel
def _from_ecliptic(longitude_rad: float, latitude_rad: float, distance_m: float) -> Vector:
    """Return the equatorial position of ecliptic coordinates."""
    obliquity = 23.43929111 * _DEGREE
    x, y, z = cos(longitude_rad) * cos(latitude_rad), sin(longitude_rad) * cos(latitude_rad), sin(latitude_rad)
    return distance_m * np.array((x, y * cos(obliquity) - z * sin(obliquity), y * sin(obliquity) + z * cos(obliquity)))


@kernel_in_place
def earth_rotation_rad(week: int, tow_s: float) -> float:
    """Return Greenwich mean sidereal time at a GPST (Aoki et al. 1982, linear part; UT1 is taken for UTC)."""
    days = _GPS_EPOCH_DAYS + 7.0 * week + (tow_s - _GPST_MINUS_UT_S) / SECONDS_PER_DAY
    return float((280.46061837 + 360.98564736629 * days) % 360.0) * _DEGREE


@kernel
def _turned(position_m: Vector, angle_rad: float) -> Vector:
    """Return a position of the equator of date in ECEF."""
    c, s = cos(angle_rad), sin(angle_rad)
    return np.array((c * position_m[0] + s * position_m[1], c * position_m[1] - s * position_m[0], position_m[2]))


@kernel
def tide_of(place_m: Vector, sun_m: Vector, moon_m: Vector) -> Vector:
    """Return the displacement (m) of a place under sun and moon; all vectors are geocentric, in one frame.

    IERS Conventions 2010, equations 7.5 and 7.6 (in phase, degrees 2 and 3), tide free. The frequency dependent and out-of-phase parts
    that are left out reach 15 mm, alike at both ends of a baseline to a tenth of a millimetre per hundred kilometres.
    """
    return _displacement(place_m, sun_m, _SUN_MASS) + _displacement(place_m, moon_m, _MOON_MASS)


@kernel
def _displacement(place_m: Vector, body_m: Vector, mass: float) -> Vector:
    radius_m = sqrt(place_m[0] ** 2 + place_m[1] ** 2 + place_m[2] ** 2)
    distance_m = sqrt(body_m[0] ** 2 + body_m[1] ** 2 + body_m[2] ** 2)
    up, towards = place_m / radius_m, body_m / distance_m
    c = up[0] * towards[0] + up[1] * towards[1] + up[2] * towards[2]
    latitude_term = 0.5 * (3.0 * up[2] ** 2 - 1.0)
    h2, l2 = _H2 + _H2_LATITUDE * latitude_term, _L2 + _L2_LATITUDE * latitude_term
    ratio = _RADIUS_M / distance_m
    second_m = mass * _RADIUS_M * ratio**3
    third_m = second_m * ratio
    radial = second_m * h2 * (1.5 * c * c - 0.5) + third_m * _H3 * (2.5 * c**3 - 1.5 * c)
    across = second_m * 3.0 * l2 * c + third_m * _L3 * (7.5 * c * c - 1.5)
    return radial * up + across * (towards - c * up)


@kernel
def solid_tides(week: int, tow_s: float, first_ecef_m: Vector, second_ecef_m: Vector) -> tuple[Vector, Vector]:
    """Return the displacements (m, ECEF) of two places at a GPST."""
    sun_m, moon_m = sun_and_moon(week, tow_s)
    angle = earth_rotation_rad(week, tow_s)
    sun_m, moon_m = _turned(sun_m, angle), _turned(moon_m, angle)
    return tide_of(first_ecef_m, sun_m, moon_m), tide_of(second_ecef_m, sun_m, moon_m)
