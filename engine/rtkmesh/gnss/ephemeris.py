"""Broadcast ephemerides and the other navigation data, as frozen values."""

from dataclasses import dataclass
from enum import IntEnum

from rtkmesh.gnss.time import GpsTime


class NavigationMessage(IntEnum):
    """Which message an ephemeris came in: it decides the clock's reference signal and the meaning of the group delays."""

    LNAV = 0
    INAV = 1
    FNAV = 2
    D1 = 3
    D2 = 4
    FDMA = 5
    CNAV = 6


@dataclass(frozen=True, slots=True)
class KeplerEphemeris:
    """Keplerian broadcast ephemeris of a GPS, Galileo, BeiDou or QZSS satellite (IS-GPS-200N table 20-III and kin).

    All times are GPST whatever the system's own scale; angles in radians, rates in rad/s, clock in s, s/s, s/s2.
    ``group_delay_s``: GPS/QZSS (TGD, 0); Galileo (BGD E5a/E1, BGD E5b/E1); BeiDou (TGD1, TGD2).
    ``iode``/``iodc``: issue of data (Galileo: IODnav in both; BeiDou: AODE and AODC). ``accuracy_m``: URA/SISA as one sigma.
    ``health``: 0 is healthy (the system's own bits). ``fit_s``: half-width of validity around ``toe``.
    """

    satellite: int
    message: NavigationMessage
    iode: int
    iodc: int
    toe: GpsTime
    toc: GpsTime
    transmitted: GpsTime
    health: int
    accuracy_m: float
    fit_s: float
    sqrt_a: float
    eccentricity: float
    m0_rad: float
    delta_n_radps: float
    omega0_rad: float
    omega_rad: float
    omega_dot_radps: float
    i0_rad: float
    idot_radps: float
    cuc_rad: float
    cus_rad: float
    crc_m: float
    crs_m: float
    cic_rad: float
    cis_rad: float
    af0_s: float
    af1: float
    af2: float
    group_delay_s: tuple[float, float]


@dataclass(frozen=True, slots=True)
class GlonassEphemeris:
    """GLONASS broadcast ephemeris (GLONASS ICD 5.1 table 4.5): PZ-90 state at ``toe``; times are GPST.

    ``tau_s`` is the clock *correction* sign of RINEX (clock bias is ``-TauN``): satellite clock = tau_s + gamma * dt.
    ``group_delay_s`` is delta tau n (L2 minus L1). ``iode`` is tb in units of 15 minutes.
    """

    satellite: int
    channel: int
    iode: int
    toe: GpsTime
    transmitted: GpsTime
    health: int
    accuracy_m: float
    age_days: int
    position_m: tuple[float, float, float]
    velocity_mps: tuple[float, float, float]
    acceleration_mps2: tuple[float, float, float]
    tau_s: float
    gamma: float
    group_delay_s: float


Ephemeris = KeplerEphemeris | GlonassEphemeris


@dataclass(frozen=True, slots=True)
class KlobucharParameters:
    """Klobuchar ionosphere coefficients (IS-GPS-200N 20.3.3.5.2.5); ``system`` is the RINEX letter that sent them."""

    system: str
    alpha: tuple[float, float, float, float]
    beta: tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class ReferenceStation:
    """What a stream says of its own antenna (RTCM 1005/1006/1007/1008/1033, RINEX header, configuration).

    ``position_ecef_m`` is the antenna reference point as transmitted plus nothing: ``antenna_height_m`` (1006) is the height of the
    ARP above the marker that the position may already contain. Empty strings and None where unknown.
    """

    station_id: int
    position_ecef_m: tuple[float, float, float] | None = None
    antenna_height_m: float = 0.0
    antenna: str = ""
    antenna_serial: str = ""
    receiver: str = ""
    source: str = ""


@dataclass(frozen=True, slots=True)
class GlonassBias:
    """GLONASS code-phase bias of a reference receiver (RTCM 1230), metres for 1C, 1P, 2C, 2P; NaN where not sent."""

    station_id: int
    aligned: bool
    bias_m: tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class ReceiverFix:
    """The receiver's own navigation solution (UBX NAV-PVT, NMEA GGA, SBF PVTGeodetic): for monitoring, never an input of the engine.

    ``fix``: 0 none, 1 dead reckoning, 2 2D, 3 3D, 4 DGPS, 5 RTK float, 6 RTK fixed. Height is ellipsoidal. The vertical part of the
    velocity is NaN where it is not known (NMEA).
    """

    time: GpsTime | None
    fix: int
    lat_rad: float
    lon_rad: float
    height_m: float
    horizontal_sigma_m: float
    vertical_sigma_m: float
    velocity_ned_mps: tuple[float, float, float] | None
    satellites: int
