"""Rotations of a vehicle: body axes forward-right-down (FRD) against north-east-down (NED).

An error of a rotation is a small vector of angles in NED (rad), applied from the left: R <- exp([error]x) R. Euler angles are the
aerospace sequence (heading about down, pitch about right, roll about forward); heading is the navigation azimuth, clockwise from
true north. Covariances of angles are in the order (heading, pitch, roll). Source: J. Sola, "A micro Lie theory", section on SO(3).
"""

from math import asin, atan2, cos, pi, sin, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

# Takes vectors of either frame to the other one: it is its own inverse.
NED_FROM_ENU: Final[Matrix] = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_SMALL_RAD: Final = 1e-8


def skew(v: Vector) -> Matrix:
    """Return the matrix (3x3) whose product with w is the cross product v x w."""
    x, y, z = v.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_of(vector_rad: Vector) -> Matrix:
    """Return the rotation (3x3) about a vector's direction by its length (rad): Rodrigues' formula."""
    x, y, z = vector_rad.tolist()
    angle = sqrt(x * x + y * y + z * z)
    a, b = (1.0, 0.5) if angle < _SMALL_RAD else (sin(angle) / angle, (1.0 - cos(angle)) / angle**2)
    return np.array(
        [
            [1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)],
        ]
    )


def vector_of(rotation: Matrix) -> Vector:
    """Return the vector (rad, length in [0, pi]) whose rotation this is; by way of the quaternion, so also right near pi."""
    w, *xyz = quaternion_of(rotation).tolist()
    part = np.array(xyz)
    length = float(np.linalg.norm(part))
    return 2.0 * part if length < _SMALL_RAD else (2.0 * atan2(length, w) / length) * part


def quaternion_of(rotation: Matrix) -> Vector:
    """Return the unit quaternion (w, x, y, z), w not negative: the eigenvector of Bar-Itzhack's matrix, exact for rotations."""
    r = rotation
    trace = float(r[0, 0] + r[1, 1] + r[2, 2])
    candidates = np.array([trace, r[0, 0], r[1, 1], r[2, 2]])
    which = int(np.argmax(candidates))
    if which == 0:
        q = np.array([1.0 + trace, r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    else:
        i, j, k = [(0, 1, 2), (1, 2, 0), (2, 0, 1)][which - 1]
        q = np.empty(4)
        q[0] = r[k, j] - r[j, k]
        q[1 + i] = 1.0 + 2.0 * r[i, i] - trace
        q[1 + j] = r[j, i] + r[i, j]
        q[1 + k] = r[k, i] + r[i, k]
    q /= sqrt(float(q @ q))
    return -q if q[0] < 0.0 else q


def rotation_of_quaternion(quaternion: Vector) -> Matrix:
    """Return the rotation (3x3) of a quaternion (w, x, y, z) of any length but zero."""
    w, x, y, z = (quaternion / np.linalg.norm(quaternion)).tolist()
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def rotation_of_angles(heading_rad: float, pitch_rad: float, roll_rad: float) -> Matrix:
    """Return ``ned_from_body`` (3x3) of heading, pitch and roll (rad)."""
    ch, sh, cp, sp = cos(heading_rad), sin(heading_rad), cos(pitch_rad), sin(pitch_rad)
    cr, sr = cos(roll_rad), sin(roll_rad)
    return np.array(
        [
            [ch * cp, ch * sp * sr - sh * cr, ch * sp * cr + sh * sr],
            [sh * cp, sh * sp * sr + ch * cr, sh * sp * cr - ch * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def angles_of(ned_from_body: Matrix) -> tuple[float, float, float]:
    """Return heading in [0, 2 pi), pitch in [-pi/2, pi/2] and roll in (-pi, pi] (rad); straight up or down, roll is zero."""
    r = ned_from_body
    pitch = asin(min(1.0, max(-1.0, -float(r[2, 0]))))
    if abs(float(r[2, 0])) > 1.0 - 1e-12:
        return atan2(-float(r[0, 1]), float(r[1, 1])) % (2.0 * pi), pitch, 0.0
    return atan2(float(r[1, 0]), float(r[0, 0])) % (2.0 * pi), pitch, atan2(float(r[2, 1]), float(r[2, 2]))


def angles_per_error(ned_from_body: Matrix) -> Matrix:
    """Return the derivative (3x3) of (heading, pitch, roll) by the rotation's error in NED.

    Reference: seed_systems.md 3.3, T for ZYX angles, rows in our order. Infinite where the nose points straight up or down.
    """
    heading, pitch, _ = angles_of(ned_from_body)
    ch, sh, cp, tp = cos(heading), sin(heading), cos(pitch), sin(pitch) / max(cos(pitch), 1e-300)
    return np.array([[ch * tp, sh * tp, 1.0], [-sh, ch, 0.0], [ch / max(cp, 1e-300), sh / max(cp, 1e-300), 0.0]])


def wrapped(angle_rad: float) -> float:
    """Return the angle in (-pi, pi]."""
    return -((pi - angle_rad) % (2.0 * pi) - pi)
