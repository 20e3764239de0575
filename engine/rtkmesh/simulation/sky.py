"""The sky: the same satellites for every scenario, seed and receiver, as exact broadcast ephemerides of any time.

Truth is what these ephemerides say without rounding; what a receiver is sent is rounded by its message's fields (decimetres at
most). The orbits are continuous over the changes of issue, except that GLONASS starts anew once a week (Saturday 03:00 UTC).
"""

from functools import lru_cache
from math import cos, pi, sin, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.gnss.constants import (
    BDT_MINUS_GPST_S,
    MU_BEIDOU_M3_S2,
    MU_GALILEO_M3_S2,
    MU_GLONASS_M3_S2,
    MU_GPS_M3_S2,
    OMEGA_EARTH_BEIDOU_RADPS,
    OMEGA_EARTH_GALILEO_RADPS,
    OMEGA_EARTH_GLONASS_RADPS,
    OMEGA_EARTH_GPS_RADPS,
    SECONDS_PER_WEEK,
)
from rtkmesh.gnss.ephemeris import Ephemeris, GlonassEphemeris, KeplerEphemeris, KlobucharParameters, NavigationMessage
from rtkmesh.gnss.signals import BEIDOU, GALILEO, GPS, NO_CHANNEL, SATELLITES_PER_SYSTEM
from rtkmesh.gnss.time import GpsTime, gps_minus_utc_s
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.models.glonass_orbit import propagate_state
from rtkmesh.simulation.elements import (
    GLONASS_INCLINATION_RAD,
    GLONASS_NODE_RATE_RADPS,
    GLONASS_PERIOD_S,
    GLONASS_SATELLITES,
    GLONASS_SEMI_MAJOR_M,
    KEPLER_SATELLITES,
    REFERENCE,
    CircularElements,
    KeplerElements,
)

Matrix = NDArray[np.float64]

SATELLITES: Final = np.array(sorted(e.satellite for e in (*KEPLER_SATELLITES, *GLONASS_SATELLITES)), np.int16)
_KEPLER: Final = {e.satellite: e for e in KEPLER_SATELLITES}
_GLONASS: Final = {e.satellite: index for index, e in enumerate(GLONASS_SATELLITES)}
CHANNELS: Final = np.array(
    [GLONASS_SATELLITES[_GLONASS[int(s)]].channel if int(s) in _GLONASS else NO_CHANNEL for s in SATELLITES], np.int8
)

# What GPS subframe 4 page 18 says, and the ionosphere of the simulation follows (a day of 2021, medium activity).
KLOBUCHAR: Final = KlobucharParameters(
    "G",
    (11.0 * 2.0**-30, 2.0 * 2.0**-27, -1.0 * 2.0**-24, -1.0 * 2.0**-24),
    (44.0 * 2.0**11, 3.0 * 2.0**14, -1.0 * 2.0**16, -3.0 * 2.0**16),
)

# (gravity m3/s2, earth rate rad/s, message, time between issues s, issues that toe is ahead, half-width of validity s, accuracy m)
_BROADCAST: Final = {
    GPS: (MU_GPS_M3_S2, OMEGA_EARTH_GPS_RADPS, NavigationMessage.LNAV, 7200.0, 1, 7200.0, 2.0),
    GALILEO: (MU_GALILEO_M3_S2, OMEGA_EARTH_GALILEO_RADPS, NavigationMessage.INAV, 1800.0, 0, 14400.0, 3.12),
    BEIDOU: (MU_BEIDOU_M3_S2, OMEGA_EARTH_BEIDOU_RADPS, NavigationMessage.D1, 3600.0, 0, 10800.0, 2.0),
}
_GLONASS_ISSUE_S: Final = 1800.0
_GLONASS_ANCHOR_S: Final = 529200.0  # time of week (Saturday 03:00 UTC) when the GLONASS orbits start anew


def absolute_s(time: GpsTime) -> float:
    """Return the seconds from REFERENCE to a time."""
    return time - REFERENCE


def broadcast(satellite: int, time: GpsTime) -> Ephemeris:
    """Return the unrounded ephemeris that a satellite broadcasts at a time; ``transmitted`` is the start of its issue."""
    if satellite in _GLONASS:
        return _glonass_ephemeris(_GLONASS[satellite], _glonass_issue(time))
    return _kepler_ephemeris(_KEPLER[satellite], time)


def issues(time: GpsTime) -> tuple[int, int, int, int]:
    """Return what identifies all ephemerides broadcast at a time: the running issue of each system."""
    gps, galileo, beidou = (_kepler_issue(system, time) for system in (GPS, GALILEO, BEIDOU))
    return gps, galileo, beidou, _glonass_issue(time)


class Sky:
    """The exact ephemerides of all SATELLITES as rows for the orbit kernels, kept until the next issue of any."""

    def __init__(self) -> None:
        self._issues: tuple[int, int, int, int] | None = None
        self._rows = np.zeros((0, 0))

    def rows(self, time: GpsTime) -> Matrix:
        """Return one row (n, ROW) per satellite of SATELLITES."""
        now = issues(time)
        if now != self._issues:
            table = EphemerisTable()
            for satellite in SATELLITES.tolist():
                table.add(broadcast(satellite, time))
            self._issues, self._rows = now, table.select(SATELLITES, time)
        return self._rows


def glonass_generation(time: GpsTime) -> int:
    """Return the number of the week-long span over which the GLONASS orbits are continuous."""
    return _generation(_glonass_issue(time))


def _kepler_issue(system: int, time: GpsTime) -> int:
    """Return the number of the issue that is broadcast at a time, counted from 1980 (BeiDou: by BDT)."""
    shift_s = BDT_MINUS_GPST_S if system == BEIDOU else 0.0
    return int((time.week * SECONDS_PER_WEEK + time.tow_s + shift_s) // _BROADCAST[system][3])


def _kepler_ephemeris(e: KeplerElements, time: GpsTime) -> KeplerEphemeris:
    """Return the issue of a time: the mean elements moved to its toe (IS-GPS-200N table 20-IV, read backwards)."""
    system = e.satellite // SATELLITES_PER_SYSTEM
    mu, omega_earth, message, spacing_s, ahead, fit_s, accuracy_m = _BROADCAST[system]
    issue = _kepler_issue(system, time)
    shift_s = BDT_MINUS_GPST_S if system == BEIDOU else 0.0
    sent = GpsTime.normalized(0, issue * spacing_s - shift_s)
    toe = sent + ahead * spacing_s
    dt = absolute_s(toe)
    node = e.node_rad + (e.node_rate_radps - omega_earth) * dt + omega_earth * (toe + shift_s).tow_s
    mean_anomaly = e.mean_anomaly_rad + (sqrt(mu / e.semi_major_m**3) + e.delta_n_radps) * dt
    issue_of_data = {GPS: issue % 240, GALILEO: issue % 1024, BEIDOU: 1}[system]
    cuc, cus, crc, crs, cic, cis = e.harmonics
    return KeplerEphemeris(
        satellite=e.satellite, message=message, iode=issue_of_data, iodc=issue_of_data, toe=toe, toc=toe, transmitted=sent, health=0,
        accuracy_m=accuracy_m, fit_s=fit_s, sqrt_a=sqrt(e.semi_major_m), eccentricity=e.eccentricity, m0_rad=_angle(mean_anomaly),
        delta_n_radps=e.delta_n_radps, omega0_rad=_angle(node), omega_rad=_angle(e.perigee_rad), omega_dot_radps=e.node_rate_radps,
        i0_rad=e.inclination_rad, idot_radps=0.0, cuc_rad=cuc, cus_rad=cus, crc_m=crc, crs_m=crs, cic_rad=cic, cis_rad=cis,
        af0_s=e.clock_s + e.clock_rate * dt, af1=e.clock_rate, af2=0.0, group_delay_s=e.group_delay_s,
    )  # fmt: skip


def _angle(angle_rad: float) -> float:
    """Return the angle in [-pi, pi)."""
    return (angle_rad + pi) % (2.0 * pi) - pi


def _glonass_issue(time: GpsTime) -> int:
    """Return the number of the half hour of UTC, counted from 1980; its tb is in its middle."""
    return int((time.week * SECONDS_PER_WEEK + time.tow_s - gps_minus_utc_s(time)) // _GLONASS_ISSUE_S)


def _generation(issue: int) -> int:
    return int((issue * _GLONASS_ISSUE_S - _GLONASS_ANCHOR_S) // SECONDS_PER_WEEK)


def _glonass_ephemeris(index: int, issue: int) -> GlonassEphemeris:
    e = GLONASS_SATELLITES[index]
    toe = _glonass_toe(issue)
    state = _glonass_states(issue)[index]
    x, y, z, vx, vy, vz = state.tolist()
    moscow_s = ((issue + 0.5) * _GLONASS_ISSUE_S + 10800.0) % 86400.0
    return GlonassEphemeris(
        satellite=e.satellite, channel=e.channel, iode=int(moscow_s // 900.0), toe=toe, transmitted=toe + -_GLONASS_ISSUE_S / 2.0, health=0,
        accuracy_m=2.5, age_days=0, position_m=(x, y, z), velocity_mps=(vx, vy, vz), acceleration_mps2=(0.0, 0.0, 0.0),
        tau_s=e.clock_s + e.clock_rate * absolute_s(toe), gamma=e.clock_rate, group_delay_s=e.group_delay_s,
    )  # fmt: skip


def _glonass_toe(issue: int) -> GpsTime:
    utc_s = (issue + 0.5) * _GLONASS_ISSUE_S
    near = GpsTime.normalized(0, utc_s)
    return near + gps_minus_utc_s(near)


@lru_cache(maxsize=4)
def _glonass_states(issue: int) -> Matrix:
    """Return the states (24, 6) at the middle of an issue, integrated from the start of its generation."""
    first = int(np.ceil((_generation(issue) * SECONDS_PER_WEEK + _GLONASS_ANCHOR_S) / _GLONASS_ISSUE_S))
    start = _glonass_toe(first)
    states = np.array([_circular_state(e, absolute_s(start)) for e in GLONASS_SATELLITES])
    _advance(states, (issue - first) * _GLONASS_ISSUE_S)
    return states


def _circular_state(e: CircularElements, dt: float) -> Matrix:
    """Return position and velocity (6) in the rotating frame of a circular orbit, ``dt`` seconds from REFERENCE."""
    a, i = GLONASS_SEMI_MAJOR_M, GLONASS_INCLINATION_RAD
    u = e.latitude_argument_rad + 2.0 * pi / GLONASS_PERIOD_S * dt
    node = e.node_rad + (GLONASS_NODE_RATE_RADPS - OMEGA_EARTH_GLONASS_RADPS) * dt
    speed = sqrt(MU_GLONASS_M3_S2 / a)
    along = np.array((cos(node), sin(node), 0.0))
    across = np.array((-sin(node) * cos(i), cos(node) * cos(i), sin(i)))
    position = a * (cos(u) * along + sin(u) * across)
    velocity = speed * (cos(u) * across - sin(u) * along)
    velocity -= OMEGA_EARTH_GLONASS_RADPS * np.array((-position[1], position[0], 0.0))
    return np.concatenate((position, velocity))


@kernel
def _advance(states: Matrix, seconds: float) -> None:
    """Integrate all states (n, 6) in place with the equations that receivers use."""
    acceleration = np.zeros(3)
    for i in range(states.shape[0]):
        propagate_state(states[i], acceleration, seconds)
