"""Where a receiver sees its satellites, and what the models say of the way in between."""

from math import atan2, hypot, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel_in_place, scratch, scratch_table
from rtkmesh.gnss.constants import OMEGA_EARTH_GPS_RADPS, SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.frames import write_enu, write_geodetic
from rtkmesh.models.atmosphere import TROPOSPHERE, ionosphere_l1_m, troposphere_at, troposphere_m
from rtkmesh.models.orbit import STATE_OK, satellite_states

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

# Columns of the geometry of one receiver, one row per satellite. RANGE (m) is geometric, with the earth's rotation during the flight;
# E_X to E_Z the unit vector from receiver to satellite (ECEF at reception); azimuth and elevation in radians; TROPOSPHERE_M the slant
# delay; IONOSPHERE_L1_M the delay of a code at 1575.42 MHz. A code is RANGE - c clock + TROPOSPHERE_M + IONOSPHERE_L1_M (f1 / f)^2
# (+ group delay + receiver clock); a phase has minus the ionosphere. NaN where the satellite's state is not OK.
RANGE, E_X, E_Y, E_Z, AZIMUTH, ELEVATION, TROPOSPHERE_M, IONOSPHERE_L1_M = range(8)
GEOMETRY: Final = 8

_C = SPEED_OF_LIGHT_MPS
_OMEGA = OMEGA_EARTH_GPS_RADPS
_NEAR_EARTH_M = (6.3e6, 6.5e6)  # distances from the geocentre where there is an atmosphere to model


@kernel_in_place
def receiver_model(
    rows: Matrix,
    week: int,
    tow_s: float,
    pseudoranges_m: Vector,
    receiver_ecef_m: Vector,
    klobuchar: Vector,
    states: Matrix,
    geometry: Matrix,
) -> int:
    """Write states (n, STATE) and geometry (n, GEOMETRY) of all satellites of one receiver in one call; return how many are OK.

    ``rows`` (n, ROW) of ``EphemerisTable.select``; the time is the receiver's tag (GPST); ``klobuchar`` of ``klobuchar_vector``.
    """
    valid = satellite_states(rows, week, tow_s, pseudoranges_m, states)
    receiver_geometry(states, week, tow_s, receiver_ecef_m, klobuchar, geometry)
    return valid


@kernel_in_place
def receiver_geometry(states: Matrix, week: int, tow_s: float, receiver_ecef_m: Vector, klobuchar: Vector, geometry: Matrix) -> None:
    """Write the geometry (n, GEOMETRY) of satellite states (n, STATE) seen from a receiver position.

    Away from the earth's surface (an iteration's start at the geocentre) both delays are 0.
    """
    radius = sqrt(receiver_ecef_m[0] ** 2 + receiver_ecef_m[1] ** 2 + receiver_ecef_m[2] ** 2)
    near_earth = _NEAR_EARTH_M[0] < radius < _NEAR_EARTH_M[1]
    geodetic, turn, troposphere = scratch(3), scratch_table(3, 3), scratch(TROPOSPHERE)
    write_geodetic(receiver_ecef_m, geodetic)
    write_enu(geodetic[0], geodetic[1], turn)
    troposphere_at(geodetic[0], geodetic[2], week, tow_s, troposphere)
    for i in range(states.shape[0]):
        for k in range(GEOMETRY):
            geometry[i, k] = np.nan
        if states[i, STATE_OK] == 0.0:
            continue
        line_of_sight(states[i], receiver_ecef_m, geometry[i])
        _look_angles(turn, geometry[i])
        geometry[i, TROPOSPHERE_M], geometry[i, IONOSPHERE_L1_M] = 0.0, 0.0
        if near_earth:
            azimuth, elevation = geometry[i, AZIMUTH], geometry[i, ELEVATION]
            geometry[i, TROPOSPHERE_M] = troposphere_m(troposphere, elevation)
            geometry[i, IONOSPHERE_L1_M] = ionosphere_l1_m(klobuchar, geodetic[0], geodetic[1], azimuth, elevation, tow_s)


@kernel_in_place
def line_of_sight(state: Vector, receiver_ecef_m: Vector, out: Vector) -> None:
    """Write range and unit vector (RANGE to E_Z) to a satellite whose position is in the ECEF frame of its time of transmission.

    The satellite is turned into the frame of reception by the earth's rotation during the flight (IS-GPS-200N 20.3.3.4.3.4); the
    rotation angle (5e-6 rad) is developed to second order, which is exact to 1e-9 m.
    """
    x, y = state[0], state[1]
    distance = 0.0
    for _ in range(3):
        dx, dy, dz = x - receiver_ecef_m[0], y - receiver_ecef_m[1], state[2] - receiver_ecef_m[2]
        distance = sqrt(dx * dx + dy * dy + dz * dz)
        angle = _OMEGA * distance / _C
        x = state[0] * (1.0 - 0.5 * angle * angle) + state[1] * angle
        y = state[1] * (1.0 - 0.5 * angle * angle) - state[0] * angle
        out[RANGE] = distance
        out[E_X], out[E_Y], out[E_Z] = dx / distance, dy / distance, dz / distance


@kernel_in_place
def _look_angles(turn: Matrix, out: Vector) -> None:
    """Write azimuth (in [0, 2 pi)) and elevation of a unit vector; ``turn`` is enu_from_ecef."""
    e = turn[0, 0] * out[E_X] + turn[0, 1] * out[E_Y] + turn[0, 2] * out[E_Z]
    n = turn[1, 0] * out[E_X] + turn[1, 1] * out[E_Y] + turn[1, 2] * out[E_Z]
    u = turn[2, 0] * out[E_X] + turn[2, 1] * out[E_Y] + turn[2, 2] * out[E_Z]
    azimuth = atan2(e, n)
    out[AZIMUTH] = azimuth + 2.0 * np.pi if azimuth < 0.0 else azimuth
    out[ELEVATION] = atan2(u, hypot(e, n))
