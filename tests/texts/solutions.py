"""Solutions to be written: one that RTKLIB's files have, and any by hypothesis, as plain numbers that both sides take."""

import struct
from dataclasses import dataclass, replace
from math import cos, nan, radians, sin, sqrt
from typing import Any

from hypothesis import strategies as st

from rtkmesh.gnss.constants import WGS84_A_M, WGS84_E2
from rtkmesh_schemas.solution import SatellitesMessage, SolutionMessage
from rtkmesh_services.texts import TextOptions

UNKNOWN = (nan,) * 9
ZERO = (0.0, 0.0, 0.0)
Row = tuple[str, str, int, float, float, float]


def ecef(lat_deg: float, lon_deg: float, height_m: float) -> tuple[float, float, float]:
    """Return an ECEF position."""
    lat, lon = radians(lat_deg), radians(lon_deg)
    n = WGS84_A_M / sqrt(1.0 - WGS84_E2 * sin(lat) ** 2)
    return (n + height_m) * cos(lat) * cos(lon), (n + height_m) * cos(lat) * sin(lon), (n * (1.0 - WGS84_E2) + height_m) * sin(lat)


def message(**values: Any) -> SolutionMessage:
    """Return a solution with these values; the others are dull."""
    dull: dict[str, Any] = {
        "source": "s", "start_id": "x", "sequence": 0, "week": 2149, "tow_s": 475219.0, "status": 1, "status_name": "FIX", "reason": "ok",
        "lat_deg": nan, "lon_deg": nan, "height_m": nan, "position_ecef_m": ZERO, "position_cov_ecef_m2": UNKNOWN,
        "position_cov_enu_m2": UNKNOWN, "velocity_ecef_mps": (nan,) * 3, "velocity_cov_ecef_m2ps2": UNKNOWN, "velocity_enu_mps": (nan,) * 3,
        "velocity_cov_enu_m2ps2": UNKNOWN, "base_ecef_m": (nan,) * 3, "baseline_ecef_m": (nan,) * 3, "baseline_enu_m": (nan,) * 3,
        "baseline_cov_enu_m2": UNKNOWN, "age_s": nan, "ratio": 0.0, "ratio_threshold": 3.0, "success_rate": 1.0, "grade": 0,
        "ambiguities": 0, "ambiguities_fixed": 0, "satellites_used": 21, "satellites_rover": 21, "satellites_base": 21, "code_rms_m": nan,
        "phase_rms_m": nan, "nis_per_observation": nan, "receiver_clock_s": nan, "resets": 0,
    }  # fmt: skip
    return SolutionMessage(**dull | values)


def table(
    rows: list[tuple[str, str, int, float, float, float]], week: int = 2149, tow_s: float = 475219.0, **more: Any
) -> SatellitesMessage:
    """Return satellites of rows: id, signal, state, azimuth, elevation (degrees), C/N0."""
    zeros: list[Any] = [0.0] * len(rows)
    columns: list[list[Any]] = [list(column) for column in zip(*rows, strict=True)] or [[] for _ in range(6)]
    names = ("satellite", "signal", "state", "azimuth_deg", "elevation_deg", "cn0_dbhz")
    values: dict[str, Any] = dict(zip(names, columns, strict=True))
    values |= dict.fromkeys(("code_residual_m", "phase_residual_m", "ambiguity_cyc", "lock_s"), zeros) | {"slips": [0] * len(rows)}
    return SatellitesMessage(source="s", week=week, tow_s=tow_s, **values | more)


@dataclass(frozen=True, slots=True)
class Drawn:
    """Numbers of a solution as RTKLIB's sol_t takes them: covariances are xx, yy, zz, xy, yz, zx in single precision."""

    week: int
    tow_s: float
    status: int
    satellites: int
    position_ecef_m: tuple[float, float, float]
    velocity_ecef_mps: tuple[float, float, float]
    base_ecef_m: tuple[float, float, float]
    covariance: tuple[float, ...]
    velocity_covariance: tuple[float, ...]
    age_s: float
    ratio: float

    def message(self) -> SolutionMessage:
        """Return the same as a message."""
        x, y, z = (a - b for a, b in zip(self.position_ecef_m, self.base_ecef_m, strict=True))
        return message(
            week=self.week, tow_s=self.tow_s, status=self.status, satellites_used=self.satellites, position_ecef_m=self.position_ecef_m,
            position_cov_ecef_m2=matrix(self.covariance), velocity_ecef_mps=self.velocity_ecef_mps,
            velocity_cov_ecef_m2ps2=matrix(self.velocity_covariance), base_ecef_m=self.base_ecef_m, baseline_ecef_m=(x, y, z),
            baseline_cov_ecef_m2=matrix(self.covariance), age_s=self.age_s, ratio=self.ratio,
        )  # fmt: skip


def matrix(terms: tuple[float, ...]) -> tuple[float, ...]:
    """Return nine numbers, row by row, of xx, yy, zz, xy, yz, zx."""
    a, b, c, ab, bc, ca = terms
    return a, ab, ca, ab, b, bc, ca, bc, c


def single(value: float) -> float:
    """Return a number as RTKLIB's single precision has it."""
    return struct.unpack("f", struct.pack("f", value))[0]


def _numbers(low: float, high: float) -> st.SearchStrategy[float]:
    """Return numbers of any size between bounds, with round ones."""
    return st.one_of(st.floats(low, high, allow_nan=False), st.integers(round(low), round(high)).map(float))


_singles = _numbers(-4.0, 4.0).map(lambda root: single(root * abs(root)))
_variances = st.one_of(_numbers(0.0, 10.0).map(lambda root: single(root * root)), _singles)
_covariances = st.tuples(_variances, _variances, _variances, _singles, _singles, _singles)
# Seconds of the week, with those that are a hair before a whole second, minute or week.
_seconds = st.one_of(
    st.integers(0, 604799).map(float),
    st.floats(0.0, 604799.99),
    st.builds(lambda minute, digits: minute * 60.0 - 10.0**-digits, st.integers(1, 10080), st.integers(1, 13)),
)


@st.composite
def drawn(draw: st.DrawFn) -> Drawn:
    """Return a solution anywhere, at any time, of any kind."""
    place = ecef(draw(_numbers(-90.0, 90.0)), draw(_numbers(-180.0, 180.0)), draw(_numbers(-400.0, 20000.0)))
    offset = draw(st.tuples(*[_numbers(-5000.0, 5000.0)] * 3))
    x, y, z = (a + b for a, b in zip(place, offset, strict=True))
    speed = draw(st.sampled_from((0.0, 1.0, 60.0)))
    u, v, w = (speed * part for part in draw(st.tuples(*[_numbers(-1.0, 1.0)] * 3)))
    return Drawn(
        draw(st.integers(1, 2600)), draw(_seconds), draw(st.integers(0, 7)), draw(st.integers(0, 80)), place, (u, v, w), (x, y, z),
        draw(_covariances), draw(_covariances), single(draw(_numbers(-5.0, 100.0))), single(draw(_numbers(0.0, 999.0))),
    )  # fmt: skip


line_options = st.builds(
    TextOptions,
    format=st.sampled_from(("llh", "xyz", "enu")),
    time_system=st.sampled_from(("gpst", "utc", "jst")),
    time_form=st.sampled_from(("hms", "tow")),
    time_decimals=st.integers(0, 12),
    angles=st.sampled_from(("deg", "dms")),
    separator=st.sampled_from((" ", "", ",", ";", "\\t", " , ")),
    height=st.sampled_from(("ellipsoidal", "geodetic")),
    velocity=st.booleans(),
    header=st.sampled_from(("on", "off")),
)


def sentences(**values: Any) -> TextOptions:
    """Return options of NMEA."""
    return replace(TextOptions(format="nmea"), **values)
