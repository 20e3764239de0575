"""RTKLIB's .pos text: header and one line per solution, with RTKLIB 2.4.3's widths and column names.

Source: the files that rnx2rtkp 2.4.3 b34 writes, and RTKLIB 2.4.2 manual appendix B.1. Deviations are written as RTKLIB
does: sd = sqrt(variance), mixed terms sign(c) * sqrt(abs(c)). Order of axes: llh north-east-up, xyz, enu east-north-up.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from enum import StrEnum
from math import copysign, degrees, isfinite, sqrt
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.frames import enu_from_ecef, geodetic_from_ecef
from rtkmesh.gnss.time import GPS_ORIGIN, GpsTime, leap_seconds

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


class Coordinates(StrEnum):
    """What the three coordinates are: geodetic, ECEF, or baseline at the base."""

    LLH = "llh"
    XYZ = "xyz"
    ENU = "enu"


class TimeForm(StrEnum):
    """How time is written: calendar ``yyyy/mm/dd hh:mm:ss.sss`` or GPS week and seconds of week."""

    CALENDAR = "calendar"
    TOW = "tow"


class TimeSystem(StrEnum):
    """Time scale of the time column."""

    GPST = "gpst"
    UTC = "utc"


class Angles(StrEnum):
    """How latitude and longitude are written: decimal degrees, or degrees, minutes, seconds."""

    DEGREES = "deg"
    SEXAGESIMAL = "dms"


class Velocity(StrEnum):
    """Whether velocity columns follow (never in enu)."""

    LEFT_OUT = "off"
    WRITTEN = "on"


@dataclass(frozen=True, slots=True)
class PosFormat:
    """How solutions are written. ``separator`` stands between fields, which keep their widths."""

    coordinates: Coordinates = Coordinates.LLH
    time_form: TimeForm = TimeForm.CALENDAR
    time_system: TimeSystem = TimeSystem.GPST
    time_decimals: int = 3
    angles: Angles = Angles.DEGREES
    velocity: Velocity = Velocity.LEFT_OUT
    separator: str = " "


class PosSolution(Protocol):
    """What a line is made of: ``rtkmesh.rtk.solution.Solution`` is one. ECEF, metres and seconds; unknown is NaN."""

    @property
    def time(self) -> GpsTime:
        """The epoch."""
        ...

    @property
    def status(self) -> int:
        """RTKLIB's Q."""
        ...

    @property
    def satellites_used(self) -> int:
        """Number of satellites."""
        ...

    @property
    def position_ecef_m(self) -> Vector:
        """Position."""
        ...

    @property
    def position_cov_ecef_m2(self) -> Matrix:
        """Its covariance."""
        ...

    @property
    def velocity_ecef_mps(self) -> Vector:
        """Velocity."""
        ...

    @property
    def velocity_cov_ecef_m2ps2(self) -> Matrix:
        """Its covariance."""
        ...

    @property
    def base_ecef_m(self) -> Vector:
        """Base position."""
        ...

    @property
    def baseline_ecef_m(self) -> Vector:
        """Rover minus base."""
        ...

    @property
    def baseline_cov_ecef_m2(self) -> Matrix:
        """Its covariance."""
        ...

    @property
    def age_s(self) -> float:
        """Rover minus base epoch."""
        ...

    @property
    def ratio(self) -> float:
        """Of the integer search; 0: none."""
        ...


_LEGEND: Final = "Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites"
_FRAME: Final = {
    Coordinates.LLH: "lat/lon/height=WGS84/ellipsoidal",
    Coordinates.XYZ: "x/y/z-ecef=WGS84",
    Coordinates.ENU: "e/n/u-baseline=WGS84",
}
_AXES: Final = {
    Coordinates.LLH: ("n", "e", "u", "ne", "eu", "un"),
    Coordinates.XYZ: ("x", "y", "z", "xy", "yz", "zx"),
    Coordinates.ENU: ("e", "n", "u", "en", "nu", "ue"),
}
_COORDINATE_COLUMNS: Final = {
    Coordinates.LLH: (("latitude(deg)", 14), ("longitude(deg)", 14), ("height(m)", 10)),
    Coordinates.XYZ: (("x-ecef(m)", 14), ("y-ecef(m)", 14), ("z-ecef(m)", 14)),
    Coordinates.ENU: (("e-baseline(m)", 14), ("n-baseline(m)", 14), ("u-baseline(m)", 14)),
}


def pos_header(form: PosFormat, program: str, notes: Sequence[tuple[str, str]] = ()) -> str:
    """Return the header: program, notes as (name, text) in RTKLIB's manner (``inp file``, ``ref pos``, ...), legend and column names."""
    lines = [f"% program   : {program}", *(f"% {name:<10}: {text}" for name, text in notes), "%"]
    lines.append(f"% ({_FRAME[form.coordinates]},{_LEGEND})")
    return "\n".join([*lines, _column_line(form)]) + "\n"


def time_note(time: GpsTime) -> str:
    """Return an instant as the header's ``obs start`` and ``obs end`` have it."""
    return f"{_calendar(time.to_calendar(), 1)} GPST (week{time.week:04d} {time.tow_s:8.1f}s)"


def position_note(position_ecef_m: Sequence[float]) -> str:
    """Return a position as the header's ``ref pos`` has it."""
    x, y, z = position_ecef_m
    return f"{x:14.4f} {y:14.4f} {z:14.4f}"


def pos_line(solution: PosSolution, form: PosFormat) -> str:
    """Return the line of a solution with its end of line; "" where there is nothing to print (no solution, no base for enu)."""
    if solution.status == 0 or not np.isfinite(solution.position_ecef_m).all():
        return ""
    coordinates, covariance, rotation = _coordinates(solution, form)
    if not coordinates:
        return ""
    age_s = solution.age_s if isfinite(solution.age_s) else 0.0
    ratio = solution.ratio if isfinite(solution.ratio) else 0.0
    fields = [
        _time(solution.time, form), *coordinates, f"{int(solution.status):3d}", f"{solution.satellites_used:3d}",
        *(f"{value:8.4f}" for value in _deviations(covariance)), f"{age_s:6.2f}", f"{ratio:6.1f}",
    ]  # fmt: skip
    if form.velocity is Velocity.WRITTEN and form.coordinates is not Coordinates.ENU:
        fields += _velocity(solution, rotation)
    return form.separator.join(fields) + "\n"


def _column_line(form: PosFormat) -> str:
    width = (16 if form.time_form is TimeForm.CALENDAR else 8) + form.time_decimals + 1
    axes = _AXES[form.coordinates]
    columns = _COORDINATE_COLUMNS[form.coordinates]
    if form.coordinates is Coordinates.LLH and form.angles is Angles.SEXAGESIMAL:
        columns = (("latitude(d'\")", 16), ("longitude(d'\")", 16), ("height(m)", 10))
    names = [f"{name:>{size}}" for name, size in columns]
    names += [f"{'Q':>3}", f"{'ns':>3}", *(f"{f'sd{axis}(m)':>8}" for axis in axes), f"{'age(s)':>6}", f"{'ratio':>6}"]
    if form.velocity is Velocity.WRITTEN and form.coordinates is not Coordinates.ENU:
        names += [f"{f'v{axis}(m/s)':>10}" for axis in axes[:3]]
        names += [f"{f'sdv{axis}':>{9 if k == 0 else 8}}" for k, axis in enumerate(axes)]
    return f"%  {form.time_system.upper():<{width}}{form.separator}{form.separator.join(names)}"


def _time(time: GpsTime, form: PosFormat) -> str:
    """Return the time column, rounded to its decimals in integers so that 59.9996 becomes the next minute."""
    ticks = 10**form.time_decimals
    count = round(time.tow_s * ticks)
    weeks, count = divmod(count, 604800 * ticks)
    week = time.week + weeks
    calendar = GPS_ORIGIN + timedelta(weeks=week, seconds=count // ticks)
    if form.time_system is TimeSystem.UTC:
        leap = leap_seconds(calendar - timedelta(seconds=leap_seconds(calendar)))
        calendar -= timedelta(seconds=leap)
        week, count = (week, count - leap * ticks) if count >= leap * ticks else (week - 1, count + (604800 - leap) * ticks)
    part = f".{count % ticks:0{form.time_decimals}d}" if form.time_decimals else ""
    if form.time_form is TimeForm.TOW:
        return f"{week:4d}{form.separator}{count // ticks:6d}{part}"
    return f"{calendar:%Y/%m/%d %H:%M:%S}{part}"


def _calendar(calendar: datetime, decimals: int) -> str:
    tenths = calendar.microsecond // 10 ** (6 - decimals)
    return f"{calendar:%Y/%m/%d %H:%M:%S}.{tenths:0{decimals}d}"


def _coordinates(solution: PosSolution, form: PosFormat) -> tuple[list[str], Matrix, Matrix]:
    """Return the coordinate fields, the covariance in the order of the columns, and the rotation from ECEF to them."""
    if form.coordinates is Coordinates.XYZ:
        return [f"{value:14.4f}" for value in solution.position_ecef_m.tolist()], solution.position_cov_ecef_m2, np.eye(3)
    if form.coordinates is Coordinates.ENU:
        if not np.isfinite(solution.baseline_ecef_m).all() or not np.isfinite(solution.base_ecef_m).all():
            return [], np.eye(3), np.eye(3)
        lat, lon, _ = geodetic_from_ecef(solution.base_ecef_m).tolist()
        rotation = enu_from_ecef(lat, lon)
        baseline = rotation @ solution.baseline_ecef_m
        return [f"{value:14.4f}" for value in baseline.tolist()], rotation @ solution.baseline_cov_ecef_m2 @ rotation.T, rotation
    lat, lon, height_m = geodetic_from_ecef(solution.position_ecef_m).tolist()
    rotation = enu_from_ecef(lat, lon)[[1, 0, 2]]
    angles = [_angle(degrees(lat), form), _angle(degrees(lon), form)]
    return [*angles, f"{height_m:10.4f}"], rotation @ solution.position_cov_ecef_m2 @ rotation.T, rotation


def _angle(value_deg: float, form: PosFormat) -> str:
    if form.angles is Angles.DEGREES:
        return f"{value_deg:14.9f}"
    hundred_thousandths = round(abs(value_deg) * 3600.0 * 1e5)
    minutes, rest = divmod(hundred_thousandths, 60 * 100000)
    whole, minutes = divmod(minutes, 60)
    sign = "-" if value_deg < 0.0 and hundred_thousandths else ""
    return f"{sign + str(whole):>4}{form.separator}{minutes:02d}{form.separator}{rest / 1e5:08.5f}"


def _deviations(covariance: Matrix) -> list[float]:
    """Return sqrt of the variances (0 if negative) and the signed roots of the terms 01, 12, 20; 0 where not known."""
    terms = [float(covariance[i, j]) for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0))]
    terms = [term if isfinite(term) else 0.0 for term in terms]
    return [sqrt(max(term, 0.0)) for term in terms[:3]] + [copysign(sqrt(abs(term)), term) for term in terms[3:]]


def _velocity(solution: PosSolution, rotation: Matrix) -> list[str]:
    velocity = rotation @ solution.velocity_ecef_mps
    values = [value if isfinite(value) else 0.0 for value in velocity.tolist()]
    first, *others = _deviations(rotation @ solution.velocity_cov_ecef_m2ps2 @ rotation.T)
    return [*(f"{value:10.5f}" for value in values), f"{first:9.5f}", *(f"{value:8.5f}" for value in others)]
