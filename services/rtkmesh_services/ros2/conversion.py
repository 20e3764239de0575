"""From our messages to the fields of ROS 2 messages, without ROS: plain values that tests can see.

Conventions (REP-103, REP-145, sensor_msgs): ENU, radians, yaw anticlockwise from east, altitude above the WGS 84 ellipsoid,
NavSatFix in the antenna's frame, stamp = the measurement's UTC.
"""

from dataclasses import dataclass
from math import cos, isfinite, nan, pi, sin
from typing import Final

from rtkmesh.gnss.time import GPS_ORIGIN, GpsTime, gps_minus_utc_s
from rtkmesh_schemas.attitude import AttitudeMessage
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_schemas.status import ServiceStatus, State

NONE, FIX, FLOAT, SBAS, DGPS, SINGLE = range(6)
# sensor_msgs/NavSatStatus: no fix -1, fix 0, SBAS 1, GBAS 2. RTK and DGPS are ground based augmentation.
_NAVSAT_STATUS: Final = {NONE: -1, FIX: 2, FLOAT: 2, SBAS: 1, DGPS: 2, SINGLE: 0}
_SERVICE_BITS: Final = {"G": 1, "R": 2, "C": 4, "E": 8}
COVARIANCE_UNKNOWN: Final = 0
COVARIANCE_KNOWN: Final = 3
UNSEEN_ANGLE_VARIANCE: Final = (pi / 2.0) ** 2  # roll or pitch that one baseline cannot see: level, one sigma a right angle
UNKNOWN_RATE_VARIANCE: Final = 1.0e6
UNIX_OF_GPS_S: Final = int(GPS_ORIGIN.timestamp())

OK, WARN, ERROR, STALE = range(4)  # diagnostic_msgs/DiagnosticStatus
_LEVELS: Final = {State.RUNNING: OK, State.STARTING: OK, State.WARMING: OK, State.STOPPED: WARN, State.DEGRADED: WARN, State.STALE: STALE}

_FLU_SIGNS: Final = [(s, t) for s in (1.0, -1.0, -1.0) for t in (1.0, -1.0, -1.0)]
Quaternion = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Stamp:
    """builtin_interfaces/Time."""

    sec: int
    nanosec: int


@dataclass(frozen=True, slots=True)
class Fix:
    """Fields of sensor_msgs/NavSatFix."""

    stamp: Stamp
    status: int
    service: int
    latitude: float
    longitude: float
    altitude: float
    position_covariance: tuple[float, ...]
    position_covariance_type: int


@dataclass(frozen=True, slots=True)
class Velocity:
    """Fields of geometry_msgs/TwistWithCovarianceStamped: linear ENU (m/s), 6x6 covariance row-major."""

    stamp: Stamp
    linear: tuple[float, float, float]
    covariance: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Orientation:
    """Fields of sensor_msgs/Imu that an attitude fills.

    Quaternion (x, y, z, w) of the body (forward, left, up) in ENU with its 3x3 covariance, and turn rates of these axes.
    """

    stamp: Stamp
    quaternion: Quaternion
    covariance: tuple[float, ...]
    rate: tuple[float, float, float] | None = None
    rate_covariance: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Diagnostic:
    """Fields of diagnostic_msgs/DiagnosticStatus."""

    level: int
    name: str
    message: str
    values: tuple[tuple[str, str], ...]


def stamp_of(week: int, tow_s: float) -> Stamp:
    """Return the UTC stamp of a GPS time, to the nanosecond that a double of seconds of week holds."""
    leap_s = gps_minus_utc_s(GpsTime(week, tow_s))
    whole = int(tow_s)
    nanosec = round((tow_s - whole) * 1e9)
    carry, nanosec = divmod(nanosec, 1_000_000_000)
    return Stamp(UNIX_OF_GPS_S + week * 604800 + whole + carry - leap_s, nanosec)


def fix_of(solution: SolutionMessage, systems: str = "GREC") -> Fix:
    """Return the NavSatFix of a solution; without one: status NO_FIX and NaN, never an old position."""
    known = isfinite(solution.lat_deg)
    covariance = solution.position_cov_enu_m2
    trusted = known and all(isfinite(value) for value in covariance)
    return Fix(
        stamp=stamp_of(solution.week, solution.tow_s),
        status=_NAVSAT_STATUS.get(solution.status, -1) if known else -1,
        service=sum(bit for letter, bit in _SERVICE_BITS.items() if letter in systems),
        latitude=solution.lat_deg,
        longitude=solution.lon_deg,
        altitude=solution.height_m,
        position_covariance=covariance if trusted else (0.0,) * 9,
        position_covariance_type=COVARIANCE_KNOWN if trusted else COVARIANCE_UNKNOWN,
    )


def velocity_of(solution: SolutionMessage) -> Velocity | None:
    """Return the velocity of a solution in ENU, or None when there is none."""
    linear = solution.velocity_enu_mps
    if not all(isfinite(value) for value in (*linear, *solution.velocity_cov_enu_m2ps2)):
        return None
    covariance = [0.0] * 36
    for row in range(3):
        for column in range(3):
            covariance[6 * row + column] = solution.velocity_cov_enu_m2ps2[3 * row + column]
        covariance[6 * (row + 3) + row + 3] = UNKNOWN_RATE_VARIANCE
    return Velocity(stamp_of(solution.week, solution.tow_s), linear, tuple(covariance))


def orientation_of(attitude: AttitudeMessage) -> Orientation | None:
    """Return the orientation of an attitude that passed its integrity tests, else None.

    The angle that the antennas cannot see is level with a variance that says so. Pitch changes sign from nose up to ROS's
    axes (forward, left, up). Turn rates are those of a filtered attitude.
    """
    if attitude.integrity != "ok" or not isfinite(attitude.yaw_enu_rad):
        return None
    forward, right, down = attitude.rate_radps
    return Orientation(
        stamp=stamp_of(attitude.week, attitude.tow_s),
        quaternion=_quaternion_of(attitude),
        covariance=_orientation_covariance(attitude.covariance_rad2),
        rate=(forward, -right, -down) if isfinite(forward + right + down) else None,
        rate_covariance=tuple(s * t * c for (s, t), c in zip(_FLU_SIGNS, attitude.rate_cov_rad2ps2, strict=True)),
    )


def _quaternion_of(attitude: AttitudeMessage) -> Quaternion:
    """Return (x, y, z, w): what the attitude says, or that of its angles, unseen ones level."""
    w, x, y, z = attitude.quaternion_enu_from_flu
    if isfinite(w + x + y + z):
        return x, y, z, w
    roll = attitude.roll_rad if isfinite(attitude.roll_rad) else 0.0
    pitch = -attitude.pitch_rad if isfinite(attitude.pitch_rad) else 0.0
    return _quaternion(roll, pitch, attitude.yaw_enu_rad)


def _orientation_covariance(heading_pitch_roll: tuple[float, ...]) -> tuple[float, ...]:
    """Return the covariance (3x3) of roll, FLU pitch and ENU yaw: yaw and pitch change sign, products of both keep it."""
    order, signs = (2, 1, 0), (1.0, -1.0, -1.0)
    found = [heading_pitch_roll[3 * order[i] + order[j]] * signs[i] * signs[j] for i in range(3) for j in range(3)]
    unseen = [UNSEEN_ANGLE_VARIANCE if i == j else 0.0 for i in range(3) for j in range(3)]
    return tuple(value if isfinite(value) else instead for value, instead in zip(found, unseen, strict=True))


def diagnostic_of(status: ServiceStatus, solution: SolutionMessage | None) -> Diagnostic:
    """Return what a process tells of itself, with the figures of its newest solution."""
    values = [("state", status.state.value), ("reason", status.reason), ("uptime_s", f"{status.uptime_s:.0f}"), ("pid", str(status.pid))]
    level, message = _LEVELS.get(status.state, ERROR), status.reason or status.state.value
    if solution is not None:
        values += _figures(solution)
        message = solution.status_name if level == OK else message
        level = max(level, WARN) if solution.status in (NONE, SINGLE) and solution.mode != "single" else level
        if solution.integrity == "failed":
            level, message = max(level, WARN), f"{message}, integrity failed: {solution.integrity_reason}"
    for stream in status.inputs:
        age = nan if stream.age_s is None else stream.age_s
        values.append((f"input {stream.name}", f"{stream.state}, {stream.messages} messages, {stream.lost} lost, age {age:.1f} s"))
    return Diagnostic(level, f"rtkmesh/{status.role}: {status.id}", message, tuple(values))


def _figures(solution: SolutionMessage) -> list[tuple[str, str]]:
    return [
        ("solution", solution.status_name),
        ("ratio", f"{solution.ratio:.1f}"),
        ("age_s", f"{solution.age_s:.2f}"),
        ("satellites", str(solution.satellites_used)),
        ("satellites_rover", str(solution.satellites_rover)),
        ("satellites_base", str(solution.satellites_base)),
        ("ambiguities_fixed", f"{solution.ambiguities_fixed}/{solution.ambiguities}"),
        ("grade", str(solution.grade)),
        ("fix_probability", f"{solution.fix_probability:.6f}"),
        ("integrity", solution.integrity),
        ("integrity_reason", solution.integrity_reason),
        ("protection_horizontal_m", f"{solution.protection_horizontal_m:.3f}"),
        ("protection_vertical_m", f"{solution.protection_vertical_m:.3f}"),
        ("waited_s", f"{solution.waited_s:.3f}"),
    ]


def _quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """Return (x, y, z, w) of the rotation Z(yaw) Y(pitch) X(roll)."""
    cr, sr, cp, sp, cy, sy = cos(roll / 2), sin(roll / 2), cos(pitch / 2), sin(pitch / 2), cos(yaw / 2), sin(yaw / 2)
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )
