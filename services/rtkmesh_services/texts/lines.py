"""Lines of llh, xyz, enu and vel_enu: the time, three numbers, Q, ns, six deviations, age, ratio, velocity.

Deviations are written as RTKLIB does: sd = sqrt(variance), 0 if it is negative; mixed terms sign(c) * sqrt(abs(c)). Order of axes: llh
north-east-up, the others as they are called. What is not known is written as 0.
"""

from collections.abc import Sequence
from math import degrees, floor, isfinite, sqrt
from typing import Final

from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_services.texts.geodesy import Matrix, Vector, enu_rotation, geodetic, known, turned, turned_covariance
from rtkmesh_services.texts.geoid import geoid_height_m
from rtkmesh_services.texts.options import TextOptions
from rtkmesh_services.texts.times import time_column

# Elements of a covariance, row by row, in the order of the columns: RTKLIB reads those below the diagonal.
_OF_ECEF: Final = (0, 4, 8, 1, 5, 2)
_OF_ENU: Final = (0, 4, 8, 3, 7, 6)
_OF_NEU: Final = (4, 0, 8, 3, 6, 7)
_DMS_UNIT: Final = 0.1**5


def line(solution: SolutionMessage, options: TextOptions) -> str:
    """Return the line of a solution without its end; "" where there is nothing to print (no solution, no base for enu)."""
    if solution.status <= 0 or not known(solution.position_ecef_m):
        return ""
    fields = _FIELDS[options.format](solution, options)
    if not fields:
        return ""
    return options.field_separator.join((time_column(solution.week, solution.tow_s, options), *fields))


def _llh(solution: SolutionMessage, options: TextOptions) -> list[str]:
    lat_rad, lon_rad, height_m = geodetic(solution.position_ecef_m)
    rotation = enu_rotation(lat_rad, lon_rad)
    if options.height == "geodetic":
        height_m -= geoid_height_m(lat_rad, lon_rad)
    deviations = _deviations(turned_covariance(rotation, solution.position_cov_ecef_m2), _OF_NEU)
    fields = [*_angle(degrees(lat_rad), options), *_angle(degrees(lon_rad), options), f"{height_m:10.4f}"]
    fields += _quality(solution, deviations)
    if options.velocity:
        east, north, up = turned(rotation, solution.velocity_ecef_mps)
        covariance = turned_covariance(rotation, solution.velocity_cov_ecef_m2ps2)
        fields += _velocity((north, east, up), _deviations(covariance, _OF_NEU))
    return fields


def _xyz(solution: SolutionMessage, options: TextOptions) -> list[str]:
    fields = _three(solution.position_ecef_m) + _quality(solution, _deviations(solution.position_cov_ecef_m2, _OF_ECEF))
    if options.velocity:
        fields += _velocity(solution.velocity_ecef_mps, _deviations(solution.velocity_cov_ecef_m2ps2, _OF_ECEF))
    return fields


def _enu(solution: SolutionMessage, options: TextOptions) -> list[str]:
    """Return the fields of the baseline in the base's horizon. RTKLIB's lines have no velocity here, whatever is asked for."""
    del options
    if not known(solution.base_ecef_m):
        return []
    baseline, covariance = _baseline(solution)
    rotation = enu_rotation(*geodetic(solution.base_ecef_m)[:2])
    return _three(turned(rotation, baseline)) + _quality(solution, _deviations(turned_covariance(rotation, covariance), _OF_ENU))


def _vel_enu(solution: SolutionMessage, options: TextOptions) -> list[str]:
    """Return the fields of the velocity in the base's horizon; rtkrcv_ros writes them with four decimals."""
    del options
    if not known(solution.base_ecef_m) or not known(solution.velocity_ecef_mps):
        return []
    rotation = enu_rotation(*geodetic(solution.base_ecef_m)[:2])
    covariance = turned_covariance(rotation, solution.velocity_cov_ecef_m2ps2)
    return _three(turned(rotation, solution.velocity_ecef_mps)) + _quality(solution, _deviations(covariance, _OF_ENU))


_FIELDS: Final = {"llh": _llh, "xyz": _xyz, "enu": _enu, "vel_enu": _vel_enu}


def _baseline(solution: SolutionMessage) -> tuple[Vector, Matrix]:
    """Return the baseline and its covariance; from the positions where only they are known."""
    if known(solution.baseline_ecef_m):
        return solution.baseline_ecef_m, solution.baseline_cov_ecef_m2
    x, y, z = (a - b for a, b in zip(solution.position_ecef_m, solution.base_ecef_m, strict=True))
    return (x, y, z), solution.position_cov_ecef_m2


def _three(values: Vector) -> list[str]:
    return [f"{value:14.4f}" for value in values]


def _quality(solution: SolutionMessage, deviations: Sequence[float]) -> list[str]:
    age_s = solution.age_s if isfinite(solution.age_s) else 0.0
    ratio = solution.ratio if isfinite(solution.ratio) else 0.0
    sigmas = [f"{value:8.4f}" for value in deviations]
    return [f"{solution.status:3d}", f"{solution.satellites_used:3d}", *sigmas, f"{age_s:6.2f}", f"{ratio:6.1f}"]


def _velocity(velocity: Vector, deviations: Sequence[float]) -> list[str]:
    first, *others = deviations
    values = [value if isfinite(value) else 0.0 for value in velocity]
    return [*(f"{value:10.5f}" for value in values), f"{first:9.5f}", *(f"{value:8.5f}" for value in others)]


def _deviations(covariance: Matrix, order: Sequence[int]) -> list[float]:
    a, b, c, *mixed = (covariance[k] if isfinite(covariance[k]) else 0.0 for k in order)
    return [0.0 if x < 0.0 else sqrt(x) for x in (a, b, c)] + [-sqrt(-x) if x < 0.0 else sqrt(x) for x in mixed]


def _angle(angle_deg: float, options: TextOptions) -> list[str]:
    if options.angles == "deg":
        return [f"{angle_deg:14.9f}"]
    whole, minutes, seconds = sexagesimal(angle_deg, _DMS_UNIT)
    return [f"{whole:4.0f}", f"{minutes:02.0f}", f"{seconds:08.5f}"]


def sexagesimal(angle_deg: float, unit_s: float) -> Vector:
    """Return degrees (with the sign, -0.0 too), minutes and seconds rounded to a unit; 60 never stands there (RTKLIB's deg2dms)."""
    rest = abs(angle_deg)
    whole = floor(rest)
    rest = (rest - whole) * 60.0
    minutes = floor(rest)
    seconds = floor((rest - minutes) * 60.0 / unit_s + 0.5) * unit_s
    if seconds >= 60.0:
        minutes, seconds = minutes + 1, 0.0
    if minutes >= 60:
        whole, minutes = whole + 1, 0
    return (-float(whole) if angle_deg < 0.0 else float(whole)), float(minutes), seconds
