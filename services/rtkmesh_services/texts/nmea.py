"""NMEA 0183 sentences of a solution: RMC, GGA, GST. With ``nmea = "rtklib"`` they are RTKLIB's to the byte.

Where RTKLIB writes what NMEA 0183 (4.11) does not mean, the rule ``nmea`` has it right: docs/reference/texts.md lists the differences.
"""

from dataclasses import dataclass
from math import atan2, degrees, hypot, isfinite, sqrt
from typing import Final

from rtkmesh.gnss.ellipse import error_ellipse
from rtkmesh.gnss.sentences import sentence
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_services.texts.geodesy import Vector, enu_rotation, geodetic, turned, turned_covariance
from rtkmesh_services.texts.geoid import geoid_height_m
from rtkmesh_services.texts.lines import sexagesimal
from rtkmesh_services.texts.options import TextOptions
from rtkmesh_services.texts.sky import Dops
from rtkmesh_services.texts.times import nmea_time

_KNOT_MPS: Final = 0.514444444  # RTKLIB's
_COURSE_FROM_MPS: Final = 1.0  # below, the course is the last one
_UNIT_S: Final = 0.1**7
_MINUTES: Final = 59.99999995  # and more are written as 60.0000000
_FIX, _FLOAT, _SBAS, _DGPS, _SINGLE, _PPP, _DEAD_RECKONING = range(1, 8)
_QUALITY: Final = {_SINGLE: 1, _DGPS: 2, _PPP: 3, _FIX: 4, _FLOAT: 5, _DEAD_RECKONING: 6}  # RTKLIB's: SBAS is none
_RTKLIB_MODE: Final = {_DGPS: "D", _SBAS: "D", _FLOAT: "R", _FIX: "R", _PPP: "P"}
_MODE: Final = _RTKLIB_MODE | {_FLOAT: "F", _DEAD_RECKONING: "E"}
_OLD_MODE: Final = dict.fromkeys((_DGPS, _FLOAT, _FIX), "D")


@dataclass(slots=True)
class Course:
    """The last course over ground at more than 1 m/s (degrees), held while slower; NaN before the first. Mutable."""

    degrees: float = float("nan")

    def follow(self, east_mps: float, north_mps: float, speed_mps: float) -> float:
        """Return the course of a velocity."""
        if speed_mps >= _COURSE_FROM_MPS:
            course = degrees(atan2(east_mps, north_mps))
            self.degrees = course + 360.0 if course < 0.0 else course
        return self.degrees


@dataclass(frozen=True, slots=True)
class Fix:
    """A solution in the terms of sentences; ``place`` is latitude, longitude (rad) and ellipsoidal height (m)."""

    solution: SolutionMessage
    options: TextOptions
    place: Vector
    clock: str
    date: str

    @property
    def is_rtklibs(self) -> bool:
        """Whether RTKLIB's habits are wanted."""
        return self.options.nmea == "rtklib"

    @property
    def is_old(self) -> bool:
        """Whether they are those of RTKLIB 2.4.2."""
        return self.is_rtklibs and self.options.dialect == "2.4"

    @property
    def position(self) -> str:
        """The four fields of latitude and longitude."""
        lat_rad, lon_rad, _ = self.place
        return f"{self._angle(lat_rad, 2)},{'N' if lat_rad >= 0.0 else 'S'},{self._angle(lon_rad, 3)},{'E' if lon_rad >= 0.0 else 'W'}"

    def _angle(self, angle_rad: float, digits: int) -> str:
        whole, minutes, seconds = sexagesimal(degrees(abs(angle_rad)), _UNIT_S)
        minutes += seconds / 60.0
        if minutes >= _MINUTES and not self.is_rtklibs:
            whole, minutes = whole + 1.0, 0.0
        return f"{whole:0{digits}.0f}{minutes:010.7f}"


def fix_of(solution: SolutionMessage, options: TextOptions) -> Fix:
    """Return what sentences say of a solution that has a position."""
    return Fix(solution, options, geodetic(solution.position_ecef_m), *nmea_time(solution.week, solution.tow_s))


def rmc(fix: Fix, course: Course) -> str:
    """Return RMC. RTKLIB's speed is that in space, its course 0 before the first, its variation 0 east, and its mode R for floats too."""
    rotation = enu_rotation(*fix.place[:2])
    east, north, up = (value if isfinite(value) else 0.0 for value in turned(rotation, fix.solution.velocity_ecef_mps))
    speed_mps = sqrt(east * east + north * north + up * up) if fix.is_rtklibs else hypot(east, north)
    course_deg = course.follow(east, north, speed_mps)
    body = f"{fix.options.talker}RMC,{fix.clock},A,{fix.position}"
    if not fix.is_rtklibs:
        known = isfinite(fix.solution.velocity_ecef_mps[0])
        speed = f"{speed_mps / _KNOT_MPS:4.2f}" if known else ""
        return sentence(f"{body},{speed},{_number(course_deg, 2)},{fix.date},,,{_MODE.get(fix.solution.status, 'A')},V")
    body += f",{speed_mps / _KNOT_MPS:4.2f},{course_deg if isfinite(course_deg) else 0.0:4.2f},{fix.date},0.0,E"
    if fix.is_old:
        return sentence(f"{body},{_OLD_MODE.get(fix.solution.status, 'A')}")
    return sentence(f"{body},{_RTKLIB_MODE.get(fix.solution.status, 'A')},V")


def gga(fix: Fix, dilutions: Dops) -> str:
    """Return GGA. RTKLIB's HDOP is 1.0 always, and solutions by SBAS are none to it."""
    solution, height_m = fix.solution, fix.place[2]
    geoid_m = geoid_height_m(*fix.place[:2])
    heights = f"{height_m - geoid_m:.3f},M,{geoid_m:.3f},M"
    quality, hdop = _QUALITY.get(solution.status, 0), "1.0"
    age, station = f"{solution.age_s if isfinite(solution.age_s) else 0.0:.1f}", f"{solution.base_station_id:04d}"
    if fix.is_old:
        station = ""
    elif not fix.is_rtklibs:
        quality, hdop = (2 if solution.status == _SBAS else quality), _number(dilutions.hdop, 1)
        age, station = ("", "") if solution.status == _SINGLE else (age, station)
    status = f"{quality},{solution.satellites_used:02d},{hdop}"
    return sentence(f"{fix.options.talker}GGA,{fix.clock},{fix.position},{status},{heights},{age},{station}")


def gst(fix: Fix) -> str:
    """Return GST: the ranges' root mean square (RTKLIB: 0), the ellipse of one sigma, sigmas of latitude, longitude and height."""
    covariance = turned_covariance(enu_rotation(*fix.place[:2]), fix.solution.position_cov_ecef_m2)
    east_m2, north_m2, up_m2, north_east_m2 = (value if isfinite(value) else 0.0 for value in (*covariance[::4], covariance[3]))
    rms = "0.000" if fix.is_rtklibs else _number(fix.solution.code_rms_m, 3)
    major_m, minor_m, direction_deg = error_ellipse(north_m2, east_m2, north_east_m2)
    sigmas = ",".join(f"{sqrt(max(value, 0.0)):.3f}" for value in (north_m2, east_m2, up_m2))
    return sentence(f"{fix.options.talker}GST,{fix.clock},{rms},{major_m:.3f},{minor_m:.3f},{direction_deg:.1f},{sigmas}")


def _number(value: float, decimals: int) -> str:
    """Return a number, or nothing where it is not known: NMEA's null field."""
    return f"{value:.{decimals}f}" if isfinite(value) else ""
