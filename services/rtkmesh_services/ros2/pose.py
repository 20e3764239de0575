"""The body's pose, motion and heading as fields of ROS messages, without ROS.

Conventions (REP-103, REP-105, geometry_msgs): the pose is of the base frame in the map, whose axes are east, north and up at its origin;
its covariance is of position and of rotations about these fixed axes. The twist is in the base frame (forward, left, up). The
heading's quaternion is a turn about up alone, as drivers of GPS receivers publish it, with REP-103's yaw.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import cos, isfinite, radians, sin, sqrt
from typing import Final

from rtkmesh.gnss.constants import WGS84_A_M, WGS84_E2
from rtkmesh_schemas.attitude import AttitudeMessage, BodyPoint
from rtkmesh_services.ros2.conversion import UNKNOWN_RATE_VARIANCE, Quaternion, Stamp, stamp_of
from rtkmesh_services.texts.geodesy import Matrix, Vector, enu_rotation, known, turned, turned_covariance

_ENU_FROM_NED: Final = (0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, -1.0)
_FLU_FROM_FRD: Final = (1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0)


@dataclass(frozen=True, slots=True)
class Pose:
    """Fields of geometry_msgs/PoseWithCovarianceStamped: position (m) and quaternion (x, y, z, w) in the map, covariance 6x6."""

    stamp: Stamp
    position: Vector
    quaternion: Quaternion
    covariance: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Twist:
    """Fields of geometry_msgs/TwistWithCovarianceStamped in the base frame: m/s, rad/s, covariance 6x6."""

    stamp: Stamp
    linear: Vector
    angular: Vector
    covariance: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class HeadingQuaternion:
    """Fields of geometry_msgs/QuaternionStamped: the heading alone."""

    stamp: Stamp
    quaternion: Quaternion


class Map:
    """The map's frame: east, north and up at its origin."""

    def __init__(self, lat_deg: float, lon_deg: float, height_m: float) -> None:
        lat, lon = radians(lat_deg), radians(lon_deg)
        radius_m = WGS84_A_M / sqrt(1.0 - WGS84_E2 * sin(lat) ** 2)
        level_m = (radius_m + height_m) * cos(lat)
        self._origin = level_m * cos(lon), level_m * sin(lon), (radius_m * (1.0 - WGS84_E2) + height_m) * sin(lat)
        self._from_ecef = enu_rotation(lat, lon)

    def position(self, ecef_m: Vector) -> Vector:
        """Return a position (m) in the map."""
        x, y, z = ecef_m
        x0, y0, z0 = self._origin
        return turned(self._from_ecef, (x - x0, y - y0, z - z0))

    def from_enu_at(self, point: BodyPoint) -> Matrix:
        """Return the rotation that takes vectors of east, north and up at a point to those of the map."""
        there = enu_rotation(radians(point.lat_deg), radians(point.lon_deg))
        return [sum(self._from_ecef[3 * i + k] * there[3 * j + k] for k in range(3)) for i in range(3) for j in range(3)]


def pose_of(attitude: AttitudeMessage, point: BodyPoint, frame: Map) -> Pose | None:
    """Return the pose of the body at one of its points; None unless position and attitude are known, with covariances."""
    w, x, y, z = attitude.quaternion_enu_from_flu
    told = (w, x, y, z, *point.position_ecef_m, *point.cov_enu_m2, *attitude.rotation_cov_ned_rad2)
    if attitude.integrity != "ok" or not known(told):
        return None
    turn = frame.from_enu_at(point)
    place = turned_covariance(turn, point.cov_enu_m2)
    rotation = turned_covariance(turn, turned_covariance(_ENU_FROM_NED, attitude.rotation_cov_ned_rad2))
    quaternion = _product(_quaternion_of(turn), (x, y, z, w))
    return Pose(stamp_of(attitude.week, attitude.tow_s), frame.position(point.position_ecef_m), quaternion, _blocks(place, rotation))


def twist_of(attitude: AttitudeMessage, point: BodyPoint) -> Twist | None:
    """Return the body's motion at one of its points in its own axes; turn rates that are not known are 0 with a variance that says so."""
    w, x, y, z = attitude.quaternion_enu_from_flu
    if attitude.integrity != "ok" or not known((w, x, y, z, *point.velocity_enu_mps, *point.velocity_cov_enu_m2ps2)):
        return None
    flu_from_enu = _matrix_of((-x, -y, -z, w))
    linear = turned(flu_from_enu, point.velocity_enu_mps)
    cov = turned_covariance(flu_from_enu, point.velocity_cov_enu_m2ps2)
    angular, rate_cov = (0.0, 0.0, 0.0), [UNKNOWN_RATE_VARIANCE if k % 4 == 0 else 0.0 for k in range(9)]
    if known((*attitude.rate_radps, *attitude.rate_cov_rad2ps2)):
        angular = turned(_FLU_FROM_FRD, attitude.rate_radps)
        rate_cov = turned_covariance(_FLU_FROM_FRD, attitude.rate_cov_rad2ps2)
    return Twist(stamp_of(attitude.week, attitude.tow_s), linear, angular, _blocks(cov, rate_cov))


def heading_quaternion_of(attitude: AttitudeMessage) -> HeadingQuaternion | None:
    """Return the heading of an attitude that passed its tests as a turn about up, yaw anticlockwise from east; else None."""
    if attitude.integrity != "ok" or not isfinite(attitude.yaw_enu_rad):
        return None
    half = attitude.yaw_enu_rad / 2.0
    return HeadingQuaternion(stamp_of(attitude.week, attitude.tow_s), (0.0, 0.0, sin(half), cos(half)))


def _blocks(first: Sequence[float], second: Sequence[float]) -> tuple[float, ...]:
    """Return the covariance (6x6) of two independent vectors."""
    found = [0.0] * 36
    for row in range(3):
        found[6 * row : 6 * row + 3] = first[3 * row : 3 * row + 3]
        found[6 * row + 21 : 6 * row + 24] = second[3 * row : 3 * row + 3]
    return tuple(found)


def _matrix_of(q: Quaternion) -> Matrix:
    x, y, z, w = q
    return (
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


def _quaternion_of(small: Matrix) -> Quaternion:
    """Return (x, y, z, w) of a rotation well below half a turn."""
    w = sqrt(max(0.0, 1.0 + small[0] + small[4] + small[8])) / 2.0
    return (small[7] - small[5]) / (4.0 * w), (small[2] - small[6]) / (4.0 * w), (small[3] - small[1]) / (4.0 * w), w


def _product(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the rotation b, then a."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )
