"""Broadcast orbits and clocks of all satellites of one receiver, at their own times of transmission."""

from math import atan2, cos, radians, sin, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel_in_place
from rtkmesh.gnss.beidou import is_geostationary
from rtkmesh.gnss.constants import (
    BDT_MINUS_GPST_S,
    MU_BEIDOU_M3_S2,
    MU_GALILEO_M3_S2,
    MU_GPS_M3_S2,
    OMEGA_EARTH_BEIDOU_RADPS,
    OMEGA_EARTH_GALILEO_RADPS,
    OMEGA_EARTH_GPS_RADPS,
    SECONDS_PER_WEEK,
    SPEED_OF_LIGHT_MPS,
)
from rtkmesh.gnss.signals import ATTRIBUTES, BEIDOU, GALILEO, GLONASS, SATELLITES_PER_SYSTEM
from rtkmesh.models.ephemeris_table import (
    ACCELERATION,
    ACCURACY,
    AF0,
    AF1,
    AF2,
    CIC,
    CIS,
    CRC,
    CRS,
    CUC,
    CUS,
    DELAY_1,
    DELAY_2,
    DELTA_N,
    ECCENTRICITY,
    I0,
    IDOT,
    KEPLERIAN,
    KIND,
    M0,
    MESSAGE,
    NO_EPHEMERIS,
    OMEGA,
    OMEGA0,
    OMEGA_DOT,
    POSITION,
    SATELLITE,
    SQRT_A,
    TOC_TOW,
    TOC_WEEK,
    TOE_TOW,
    TOE_WEEK,
)
from rtkmesh.models.glonass_orbit import Six, propagate_state

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

# Columns of a satellite's state. Position (m) and velocity (m/s) in the ECEF frame of the instant of transmission; clock (s) and
# its rate (s/s) with the relativistic term and without group delays; variance (m2) of the range by the broadcast accuracy; OK is
# 1.0 where all of it is valid, else 0.0.
STATE_X, STATE_Y, STATE_Z, STATE_VX, STATE_VY, STATE_VZ, STATE_CLOCK, STATE_CLOCK_RATE, STATE_VARIANCE, STATE_OK = range(10)
STATE: Final = 10

SHORTEST_RANGE_M: Final = 1.0e6
LONGEST_RANGE_M: Final = 1.0e8  # geosynchronous 4.2e7 m plus a receiver clock that is off by 0.2 s

_C = SPEED_OF_LIGHT_MPS
_GLONASS_SIGMA_M = 5.0  # where no accuracy word came
_GEO_TILT_RAD = radians(-5.0)  # BDS-SIS-ICD-B1I-3.0 table 5-11
_FNAV = 2.0  # NavigationMessage.FNAV as a row holds it


@kernel_in_place
def satellite_states(rows: Matrix, week: int, tow_s: float, pseudoranges_m: Vector, out: Matrix) -> int:
    """Write the state (n, STATE) of each satellite when it sent what was received at a receiver time tag; return how many are OK.

    ``rows`` (n, ROW) are of ``EphemerisTable.select``; ``pseudoranges_m`` (n) are as measured at the tag (GPST ``week``, ``tow_s``):
    tag minus pseudorange / c is the satellite's own clock reading at transmission, whatever the receiver's clock was
    (IS-GPS-200N 20.3.3.3.3.1). Without a plausible pseudorange or an ephemeris the row is NaN and OK 0.
    """
    valid = 0
    for i in range(rows.shape[0]):
        for k in range(STATE):
            out[i, k] = np.nan
        out[i, STATE_OK] = 0.0
        if rows[i, KIND] == NO_EPHEMERIS or not SHORTEST_RANGE_M < pseudoranges_m[i] < LONGEST_RANGE_M:
            continue
        sent_tow_s = tow_s - pseudoranges_m[i] / _C
        sent_tow_s -= satellite_clock_s(rows[i], week, sent_tow_s)
        satellite_state(rows[i], week, sent_tow_s, out[i])
        if np.isfinite(out[i, STATE_X] + out[i, STATE_Y] + out[i, STATE_Z] + out[i, STATE_CLOCK]):
            out[i, STATE_OK] = 1.0
            valid += 1
    return valid


@kernel_in_place
def satellite_clock_s(row: Vector, week: int, tow_s: float) -> float:
    """Return the broadcast clock polynomial (s) when the satellite's own clock reads this; relativistic term left out.

    IS-GPS-200N 20.3.3.3.3.1 equation 2, GLONASS ICD 5.1 3.3.3.
    """
    reading_s = (week - row[TOC_WEEK]) * SECONDS_PER_WEEK + (tow_s - row[TOC_TOW])
    dt = reading_s
    for _ in range(2):
        dt = reading_s - (row[AF0] + row[AF1] * dt + row[AF2] * dt * dt)
    return row[AF0] + row[AF1] * dt + row[AF2] * dt * dt


@kernel_in_place
def satellite_state(row: Vector, week: int, tow_s: float, out: Vector) -> None:
    """Write position, velocity, clock, clock rate and variance (STATE) at a GPST instant; OK is left to the caller."""
    dt = (week - row[TOC_WEEK]) * SECONDS_PER_WEEK + (tow_s - row[TOC_TOW])
    tk = (week - row[TOE_WEEK]) * SECONDS_PER_WEEK + (tow_s - row[TOE_TOW])
    out[STATE_CLOCK] = row[AF0] + row[AF1] * dt + row[AF2] * dt * dt
    out[STATE_CLOCK_RATE] = row[AF1] + 2.0 * row[AF2] * dt
    out[STATE_VARIANCE] = row[ACCURACY] ** 2
    if row[KIND] == KEPLERIAN:
        _kepler_state(row, tk, out)
        return
    out[STATE_VARIANCE] = max(out[STATE_VARIANCE], _GLONASS_SIGMA_M**2)
    for k in range(6):
        out[k] = row[POSITION + k]
    propagate_state(out[:6], row[ACCELERATION : ACCELERATION + 3], tk)


@kernel_in_place
def _kepler_state(row: Vector, tk: float, out: Vector) -> None:
    """Write position and velocity, and add the relativistic clock term; ``tk`` is the time (s) from toe."""
    satellite, toe_s = int(row[SATELLITE]), row[TOE_TOW]
    system = satellite // SATELLITES_PER_SYSTEM
    mu, omega_earth = MU_GPS_M3_S2, OMEGA_EARTH_GPS_RADPS
    if system == GALILEO:
        mu, omega_earth = MU_GALILEO_M3_S2, OMEGA_EARTH_GALILEO_RADPS
    elif system == BEIDOU:
        mu, omega_earth, toe_s = MU_BEIDOU_M3_S2, OMEGA_EARTH_BEIDOU_RADPS, row[TOE_TOW] + BDT_MINUS_GPST_S
    plane = _motion_in_plane(row, tk, mu, out)
    node = row[OMEGA0] + row[OMEGA_DOT] * tk - omega_earth * toe_s
    if is_geostationary(satellite):
        _turn_plane(plane, node, row[OMEGA_DOT], out)
        _turn_geostationary(omega_earth, tk, out)
    else:
        _turn_plane(plane, node - omega_earth * tk, row[OMEGA_DOT] - omega_earth, out)


@kernel_in_place
def eccentric_anomaly(mean_anomaly_rad: float, eccentricity: float) -> float:
    """Solve Kepler's equation by Newton's method; converges for every eccentricity that the table lets in (below 0.5)."""
    e_k = mean_anomaly_rad
    for _ in range(30):
        step = (e_k - eccentricity * sin(e_k) - mean_anomaly_rad) / (1.0 - eccentricity * cos(e_k))
        e_k -= step
        if abs(step) < 1e-14:
            break
    return e_k


@kernel_in_place
def _motion_in_plane(row: Vector, tk: float, mu: float, out: Vector) -> Six:
    """Return the motion in the orbital plane (x, y, their rates, inclination, its rate); add the relativistic clock term to ``out``.

    IS-GPS-200N table 20-IV (position, velocity) and 20.3.3.3.3.1 (relativistic term -2 sqrt(mu) / c2 e sqrt(A) sin E).
    """
    e, a = row[ECCENTRICITY], row[SQRT_A] ** 2
    n = sqrt(mu / (a * a * a)) + row[DELTA_N]
    e_k = eccentric_anomaly(row[M0] + n * tk, e)
    sin_e, cos_e = sin(e_k), cos(e_k)
    e_rate = n / (1.0 - e * cos_e)
    phi = atan2(sqrt(1.0 - e * e) * sin_e, cos_e - e) + row[OMEGA]
    phi_rate = e_rate * sqrt(1.0 - e * e) / (1.0 - e * cos_e)
    s2, c2 = sin(2.0 * phi), cos(2.0 * phi)
    u = phi + row[CUS] * s2 + row[CUC] * c2
    r = a * (1.0 - e * cos_e) + row[CRS] * s2 + row[CRC] * c2
    u_rate = phi_rate * (1.0 + 2.0 * (row[CUS] * c2 - row[CUC] * s2))
    r_rate = a * e * sin_e * e_rate + 2.0 * phi_rate * (row[CRS] * c2 - row[CRC] * s2)
    x, y = r * cos(u), r * sin(u)
    vx, vy = r_rate * cos(u) - y * u_rate, r_rate * sin(u) + x * u_rate
    inclination = row[I0] + row[IDOT] * tk + row[CIS] * s2 + row[CIC] * c2
    inclination_rate = row[IDOT] + 2.0 * phi_rate * (row[CIS] * c2 - row[CIC] * s2)
    factor = -2.0 * sqrt(mu) * row[SQRT_A] * e / (_C * _C)
    out[STATE_CLOCK] += factor * sin_e
    out[STATE_CLOCK_RATE] += factor * cos_e * e_rate
    return x, y, vx, vy, inclination, inclination_rate


@kernel_in_place
def _turn_plane(plane: Six, node: float, node_rate: float, out: Vector) -> None:
    """Write position and velocity of a motion in a plane with this longitude of the ascending node (rad, rad/s)."""
    x, y, vx, vy, inclination, inclination_rate = plane
    so, co, si, ci = sin(node), cos(node), sin(inclination), cos(inclination)
    out[0] = x * co - y * ci * so
    out[1] = x * so + y * ci * co
    out[2] = y * si
    across_rate = vy * ci - y * si * inclination_rate
    out[3] = vx * co - across_rate * so - out[1] * node_rate
    out[4] = vx * so + across_rate * co + out[0] * node_rate
    out[5] = vy * si + y * ci * inclination_rate


@kernel_in_place
def _turn_geostationary(omega_earth: float, tk: float, out: Vector) -> None:
    """Take a BeiDou GEO state in place from its tilted inertial frame to ECEF: Rz(omega tk) Rx(-5 deg) (BDS-SIS-ICD-B1I-3.0, 5.2.4.12)."""
    s5, c5 = sin(_GEO_TILT_RAD), cos(_GEO_TILT_RAD)
    s, c = sin(omega_earth * tk), cos(omega_earth * tk)
    for first in (0, 3):
        x = out[first]
        y = c5 * out[first + 1] + s5 * out[first + 2]
        out[first + 2] = -s5 * out[first + 1] + c5 * out[first + 2]
        out[first], out[first + 1] = c * x + s * y, -s * x + c * y
    out[3] += omega_earth * out[1]
    out[4] -= omega_earth * out[0]


@kernel_in_place
def group_delay_m(row: Vector, signal: int) -> float:
    """Return how much (m) a code of this signal is longer than the broadcast clock says; model = range - c * clock + this.

    IS-GPS-200N 20.3.3.3.3.2 (clock of L1P and L2P free of ionosphere), Galileo OS SIS ICD 2.1 5.1.5, BDS-SIS-ICD-B1I-3.0 5.2.4.10 (clock
    of B3I), GLONASS ICD 5.1 4.4 (clock of L1; delta tau n is L2 minus L1). Biases between codes of one band are not broadcast in these
    messages and count as zero; L5 of GPS goes by the rule of L2. NaN without an ephemeris.
    """
    if row[KIND] == NO_EPHEMERIS:
        return np.nan
    system, band = int(row[SATELLITE]) // SATELLITES_PER_SYSTEM, signal // ATTRIBUTES
    if system == GLONASS:
        return _C * row[DELAY_1] if band == 2 or band == 6 else 0.0
    if system == GALILEO:
        return _galileo_delay_m(row, band)
    if system == BEIDOU:
        if band == 6:
            return 0.0
        return _C * (row[DELAY_1] if band <= 2 else row[DELAY_2])
    return _C * row[DELAY_1] * _square_over_l1(band)


@kernel_in_place
def _square_over_l1(band: int) -> float:
    """Return (f of L1 / f of band)^2 for the bands of GPS, Galileo and QZSS."""
    if band == 2:
        return (77.0 / 60.0) ** 2
    if band == 5:
        return (154.0 / 115.0) ** 2
    if band == 6:
        return (154.0 / 125.0) ** 2
    if band == 7:
        return (154.0 / 118.0) ** 2
    return (154.0 / 116.5) ** 2 if band == 8 else 1.0


@kernel_in_place
def _galileo_delay_m(row: Vector, band: int) -> float:
    """Galileo: DELAY_1 is BGD(E1, E5a), DELAY_2 BGD(E1, E5b); the F/NAV clock is of E1 and E5a, the I/NAV clock of E1 and E5b."""
    own = row[DELAY_1] if row[MESSAGE] == _FNAV else row[DELAY_2]
    pair = own
    if band == 5:
        pair = row[DELAY_1]
    elif band == 7:
        pair = row[DELAY_2]
    elif band == 8:
        pair = 0.5 * (row[DELAY_1] + row[DELAY_2])
    return _C * (own + (_square_over_l1(band) - 1.0) * pair)
