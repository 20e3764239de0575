"""Where a vehicle is and how it stands at any time, as closed forms of absolute time: every process finds the same truth.

The vehicle moves in the east-north-up frame of a site. Its body frame is x forward, y right, z down; attitude is heading (clockwise
from north), pitch (nose up) and roll (right side down), applied in this order.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import atan2, cos, pi, sin
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.frames import ecef_from_geodetic, enu_from_ecef
from rtkmesh.simulation.surroundings import BLOCK_M

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_VELOCITY_STEP_S: Final = 0.001  # half-width of central differences; their error stays below 1e-6 m/s in all trajectories


@dataclass(frozen=True, slots=True)
class Pose:
    """Position of the body's origin in the site's ENU frame and attitude."""

    position_enu_m: tuple[float, float, float]
    heading_rad: float = 0.0
    pitch_rad: float = 0.0
    roll_rad: float = 0.0


Trajectory = Callable[[float], Pose]  # of seconds since the sky's REFERENCE


def static(_time_s: float) -> Pose:
    """Stand at the site, level, heading north-east."""
    return Pose((0.0, 0.0, 0.0), heading_rad=pi / 4.0)


_LOOP_S: Final = 120.0  # time of one figure of eight
_DRIVE_S: Final = 240.0  # two loops, then ...
_TURN_S: Final = 60.0  # ... one turn on the spot
_EAST_M, _NORTH_M = 145.0, 72.5  # half extents of the figure


def driving(time_s: float) -> Pose:
    """Drive figures of eight with stops (0 to 15 m/s), and between them turn on the spot by 360 degrees; cycle of 5 min."""
    phase_s = time_s % (_DRIVE_S + _TURN_S)
    if phase_s < _DRIVE_S:
        way = 2.0 * pi * phase_s / _LOOP_S
        theta = way - sin(4.0 * way) / 4.0  # speed from zero to twice its mean four times a loop
        spin = 0.0
    else:
        theta, part = 0.0, (phase_s - _DRIVE_S) / _TURN_S
        spin = 2.0 * pi * part - sin(2.0 * pi * part)
    east, north = _EAST_M * sin(theta), _NORTH_M * sin(2.0 * theta)
    heading = atan2(_EAST_M * cos(theta), 2.0 * _NORTH_M * cos(2.0 * theta)) + spin
    up = 0.5 * sin(theta) + 0.02 * sin(2.0 * pi * time_s / 3.0)
    return Pose((east, north, up), heading % (2.0 * pi), 0.03 * sin(2.0 * pi * time_s / 7.5), 0.02 * sin(2.0 * pi * time_s / 5.0))


def boat(time_s: float) -> Pose:
    """Circle slowly (radius 60 m, 1.9 m/s) on waves: heave, yaw, roll and pitch."""
    turn = 2.0 * pi * time_s / 200.0
    heading = (turn + 0.12 * sin(2.0 * pi * time_s / 8.0)) % (2.0 * pi)
    position = (-60.0 * cos(turn), 60.0 * sin(turn), 0.3 * sin(2.0 * pi * time_s / 4.0))
    return Pose(position, heading, 0.06 * sin(2.0 * pi * time_s / 4.0 + 1.0), 0.14 * sin(2.0 * pi * time_s / 5.0))


_WALK_S: Final = 240.0  # time of one round
_WALK_M: Final = 45.0  # radius: 1.2 m/s


def walking(time_s: float) -> Pose:
    """Walk in a circle at 1.2 m/s, swaying at every step; level."""
    turn = 2.0 * pi * time_s / _WALK_S
    sway = 0.03 * sin(2.0 * pi * time_s / 1.1)
    radius = _WALK_M + sway
    up = 0.02 * sin(2.0 * pi * time_s / 0.55)
    return Pose((-radius * cos(turn), radius * sin(turn), up), turn % (2.0 * pi))


_FLIGHT_S: Final = 80.0  # four legs of a square and a turn on the spot after each


def drone(time_s: float) -> Pose:
    """Fly a square of 60 m (4 m/s in the mean, nose down while it speeds up), turn by 90 degrees at the corners, buffeted by gusts."""
    leg, phase_s = divmod(time_s % _FLIGHT_S, _FLIGHT_S / 4.0)
    part, turned = min(phase_s / 15.0, 1.0), max(0.0, (phase_s - 15.0) / 5.0)
    way = 60.0 * (part - sin(2.0 * pi * part) / (2.0 * pi))
    heading = 0.5 * pi * (leg + turned - sin(2.0 * pi * turned) / (2.0 * pi))
    east, north = ((0.0, way), (way, 60.0), (60.0, 60.0 - way), (60.0 - way, 0.0))[int(leg)]
    speeding = 2.0 * pi * 60.0 / 15.0**2 * sin(2.0 * pi * part)  # m/s2, along the leg
    pitch = -speeding / 9.81 + 0.02 * sin(2.0 * pi * time_s / 1.7)
    roll = 0.03 * sin(2.0 * pi * time_s / 2.3) + 0.015 * sin(2.0 * pi * time_s / 0.9)
    return Pose((east, north, 30.0 + 0.2 * sin(2.0 * pi * time_s / 6.0)), heading % (2.0 * pi), pitch, roll)


_FURROW_S, _HEADLAND_S = 50.0, 12.0
_FIELD_MPS: Final = 2.5


def tractor(time_s: float) -> Pose:
    """Plough furrows of 125 m at 2.5 m/s, turn half round on the headland, back beside it; rough ground and small corrections of course."""
    row, phase_s = divmod(time_s % (2.0 * (_FURROW_S + _HEADLAND_S)), _FURROW_S + _HEADLAND_S)
    along, turned = min(phase_s, _FURROW_S) * _FIELD_MPS, max(0.0, (phase_s - _FURROW_S) / _HEADLAND_S)
    angle = pi * (turned - sin(2.0 * pi * turned) / (2.0 * pi))
    radius = _FIELD_MPS * _HEADLAND_S / pi
    east, north = radius * (1.0 - cos(angle)), along + radius * sin(angle)
    if row:
        east, north = 2.0 * radius - east, _FURROW_S * _FIELD_MPS - north
    steering = 0.01 * sin(2.0 * pi * time_s / 5.3)
    rough = 0.02 * sin(2.0 * pi * time_s / 1.9) + 0.01 * sin(2.0 * pi * time_s / 0.8), 0.025 * sin(2.0 * pi * time_s / 2.7)
    return Pose((east, north, 0.0), (pi * row + angle + steering) % (2.0 * pi), *rough)


_LEG_S: Final = 15.0  # from crossing to crossing: 6 m/s in the mean, 12 at most, 2.5 m/s2
_WAIT_S: Final = 4.0  # at a crossing
_ROUND: Final = ((1.0, 0.0), (1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (-1.0, 0.0), (0.0, -1.0))  # legs east and north


def streets(time_s: float) -> Pose:
    """Drive around two blocks of the city of ``surroundings``, stopping at every crossing; level, heading along the street."""
    leg, within_s = divmod(time_s % (len(_ROUND) * (_LEG_S + _WAIT_S)), _LEG_S + _WAIT_S)
    part = min(within_s / _LEG_S, 1.0)
    way = part - sin(2.0 * pi * part) / (2.0 * pi)
    east = BLOCK_M * (sum(step[0] for step in _ROUND[: int(leg)]) + way * _ROUND[int(leg)][0])
    north = BLOCK_M * (sum(step[1] for step in _ROUND[: int(leg)]) + way * _ROUND[int(leg)][1])
    return Pose((east, north, 0.0), atan2(_ROUND[int(leg)][0], _ROUND[int(leg)][1]) % (2.0 * pi))


def enu_from_body(pose: Pose) -> Matrix:
    """Return the rotation (3x3) that takes body vectors (forward, right, down) to east, north, up."""
    sh, ch = sin(pose.heading_rad), cos(pose.heading_rad)
    sp, cp, sr, cr = sin(pose.pitch_rad), cos(pose.pitch_rad), sin(pose.roll_rad), cos(pose.roll_rad)
    north = (ch * cp, ch * sp * sr - sh * cr, ch * sp * cr + sh * sr)
    east = (sh * cp, sh * sp * sr + ch * cr, sh * sp * cr - ch * sr)
    down = (-sp, cp * sr, cp * cr)
    return np.array((east, north, (-down[0], -down[1], -down[2])))


@dataclass(frozen=True, slots=True, eq=False)
class Site:
    """Origin of a site's ENU frame."""

    lat_rad: float
    lon_rad: float
    height_m: float

    def ecef_from_enu(self) -> Matrix:
        """Return the rotation (3x3) that takes ENU vectors of this site to ECEF."""
        return np.ascontiguousarray(enu_from_ecef(self.lat_rad, self.lon_rad).T)

    def origin_ecef_m(self) -> Vector:
        """Return the origin in ECEF."""
        return ecef_from_geodetic(self.lat_rad, self.lon_rad, self.height_m)


class AntennaPath:
    """The motion of one antenna: fixed in the body of a moving vehicle, or standing at a place of the site (no trajectory)."""

    def __init__(self, site: Site, trajectory: Trajectory | None, offset_m: tuple[float, float, float]) -> None:
        """``offset_m``: lever arm in the body (forward, right, down) or, without a trajectory, the place in ENU."""
        self._origin_ecef_m = site.origin_ecef_m()
        self._turn = site.ecef_from_enu()
        self._trajectory = trajectory
        self._offset = np.array(offset_m)

    def offset_enu_m(self, time_s: float) -> Vector:
        """Return the antenna's position in the site's ENU frame."""
        if self._trajectory is None:
            return self._offset
        pose = self._trajectory(time_s)
        return np.array(pose.position_enu_m) + enu_from_body(pose) @ self._offset

    def position_ecef_m(self, time_s: float) -> Vector:
        """Return the antenna's position."""
        return self.ecef_of(self.offset_enu_m(time_s))

    def ecef_of(self, offset_enu_m: Vector) -> Vector:
        """Return the ECEF position of a place in the site's ENU frame."""
        return self._origin_ecef_m + self._turn @ offset_enu_m

    def velocity_enu_mps(self, time_s: float) -> Vector:
        """Return the antenna's velocity in the site's ENU frame (central difference)."""
        if self._trajectory is None:
            return np.zeros(3)
        h = _VELOCITY_STEP_S
        return (self.offset_enu_m(time_s + h) - self.offset_enu_m(time_s - h)) / (2.0 * h)

    def velocity_ecef_mps(self, time_s: float) -> Vector:
        """Return the antenna's velocity."""
        return self._turn @ self.velocity_enu_mps(time_s)
