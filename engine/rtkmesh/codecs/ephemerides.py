"""Whole sets of navigation blocks to ephemerides: pure functions of the blocks and of a time near their transmission.

A function returns None where the set contradicts itself or holds values that no satellite has.
"""

from datetime import UTC, datetime, timedelta
from math import hypot
from typing import Final

from rtkmesh.codecs.accuracy import GLONASS_FT_M, SISA_M, URA_M, accuracy_m
from rtkmesh.codecs.subframes import BEIDOU_TOE_UNIT_S, D1, D2_EPHEMERIS, GLONASS_STRING, INAV, LNAV
from rtkmesh.codecs.utc import leap_seconds_of
from rtkmesh.gnss.constants import BDT_MINUS_GPST_S, BDT_WEEK_OFFSET, GST_WEEK_OFFSET, SECONDS_PER_DAY, SECONDS_PER_WEEK
from rtkmesh.gnss.ephemeris import GlonassEphemeris, KeplerEphemeris, KlobucharParameters, NavigationMessage
from rtkmesh.gnss.signals import QZSS, SATELLITES_PER_SYSTEM, SYSTEMS
from rtkmesh.gnss.time import GpsTime, nearest_week, resolve_week

Values = dict[str, float]

MOSCOW_MINUS_UTC_S: Final = 10800.0  # GLONASS ICD 5.1, 3.3.3
# Half-widths of validity around toe.
GPS_FIT_S: Final = 7200.0  # IS-GPS-200N 20.3.3.4.3.1: 4 h in all
QZSS_FIT_S: Final = 7200.0
NAVIC_FIT_S: Final = 7200.0
GALILEO_FIT_S: Final = 14400.0  # Galileo OS SDD 1.3: at most 4 h old
BEIDOU_FIT_S: Final = 10800.0

_ORBIT: Final = (
    "sqrt_a", "eccentricity", "m0_rad", "delta_n_radps", "omega0_rad", "omega_rad", "omega_dot_radps", "i0_rad", "idot_radps",
    "cuc_rad", "cus_rad", "crc_m", "crs_m", "cic_rad", "cis_rad", "af0_s", "af1", "af2",
)  # fmt: skip


def lnav_ephemeris(satellite: int, blocks: dict[int, int], near: GpsTime) -> KeplerEphemeris | None:
    """Return the ephemeris of LNAV subframes 1 to 3 (IS-GPS-200N 20.3.3.3 and 20.3.3.4); the 10-bit week is resolved by ``near``."""
    clock, second, third = (LNAV[i].read(blocks[i]) for i in (1, 2, 3))
    iode, iodc = int(second["iode"]), int(clock["iodc"])
    if iode != int(third["iode"]) or iode != iodc & 0xFF:
        return None
    sent = GpsTime.normalized(resolve_week(int(clock["week"]), 10, near), clock["tow_s"])
    half_s = gps_fit_s(iodc) if second["fit"] else GPS_FIT_S
    fit_s = QZSS_FIT_S if satellite // SATELLITES_PER_SYSTEM == QZSS else half_s
    return kepler_ephemeris(
        satellite, NavigationMessage.LNAV, clock | second | third, sent, (iode, iodc), fit_s,
        accuracy_m=accuracy_m(URA_M, int(clock["ura"])), health=int(clock["health"]), delays_s=(clock["tgd_s"], 0.0),
    )  # fmt: skip


def gps_fit_s(iodc: int) -> float:
    """Return half of the curve fit interval where the fit flag is set (IS-GPS-200N table 20-XII)."""
    if 240 <= iodc <= 247:
        return 8 * 1800.0
    if 248 <= iodc <= 255 or iodc == 496:
        return 14 * 1800.0
    return 26 * 1800.0 if 497 <= iodc <= 503 or 1021 <= iodc <= 1023 else 6 * 1800.0


def inav_ephemeris(satellite: int, blocks: dict[int, int], near: GpsTime | None) -> KeplerEphemeris | None:
    """Return the ephemeris of I/NAV words 1 to 5 (Galileo OS SIS ICD 2.1, 4.3.5); the 12-bit week holds until 2078 without ``near``.

    Health is put together as in RINEX: E1B data invalid (bit 0), E1B health (bits 1 to 2), E5b data invalid (6), E5b health (7 to 8).
    """
    words = {i: INAV[i].read(blocks[i]) for i in (1, 2, 3, 4, 5)}
    issue = int(words[1]["iodnav"])
    if any(int(words[i]["iodnav"]) != issue for i in (2, 3, 4)) or int(words[4]["satellite"]) != satellite % SATELLITES_PER_SYSTEM:
        return None
    last = words[5]
    sent = inav_time(last, near)
    health = int(last["invalid_e1b"]) | int(last["health_e1b"]) << 1 | int(last["invalid_e5b"]) << 6 | int(last["health_e5b"]) << 7
    return kepler_ephemeris(
        satellite, NavigationMessage.INAV, words[1] | words[2] | words[3] | words[4], sent, (issue, issue), GALILEO_FIT_S,
        accuracy_m=accuracy_m(SISA_M, int(words[3]["sisa"])), health=health, delays_s=(last["bgd_e5a_s"], last["bgd_e5b_s"]),
    )  # fmt: skip


def inav_time(word: Values, near: GpsTime | None) -> GpsTime:
    """Return the time of transmission that an I/NAV word 0 or 5 tells."""
    week = GST_WEEK_OFFSET + int(word["week"])
    return GpsTime.normalized(week if near is None else resolve_week(week % 4096, 12, near), word["tow_s"])


def d1_ephemeris(satellite: int, blocks: dict[int, int]) -> KeplerEphemeris | None:
    """Return the ephemeris of D1 subframes 1 to 3 of one frame (BDS-SIS-ICD-B1I-3.0, 5.2.4)."""
    first, second, third = (D1[i].read(blocks[i]) for i in (1, 2, 3))
    toe_s = (int(second["toe_high"]) << 15 | int(third["toe_low"])) * BEIDOU_TOE_UNIT_S
    return _beidou(satellite, NavigationMessage.D1, first | second | third | {"toe_s": toe_s, "sow_s": first["sow_s"]})


def d2_ephemeris(satellite: int, block: int) -> KeplerEphemeris | None:
    """Return the ephemeris of the ten joined D2 pages (BDS-SIS-ICD-B1I-3.0, 5.3.3)."""
    return _beidou(satellite, NavigationMessage.D2, D2_EPHEMERIS.read(block))


def beidou_time(values: Values) -> GpsTime:
    """Return the time of transmission (GPST) that D1 or D2 subframe 1 tells; the 13-bit week holds until 2163."""
    return GpsTime.normalized(BDT_WEEK_OFFSET + int(values["week"]), values["sow_s"] - BDT_MINUS_GPST_S)


def _beidou(satellite: int, message: NavigationMessage, values: Values) -> KeplerEphemeris | None:
    in_gpst = {name: values[name] - BDT_MINUS_GPST_S for name in ("toe_s", "toc_s")}
    return kepler_ephemeris(
        satellite, message, values | in_gpst, beidou_time(values), (int(values["aode"]), int(values["aodc"])), BEIDOU_FIT_S,
        accuracy_m=accuracy_m(URA_M, int(values["urai"])), health=int(values["health"]), delays_s=(values["tgd1_s"], values["tgd2_s"]),
    )  # fmt: skip


def kepler_ephemeris(
    satellite: int, message: NavigationMessage, values: Values, sent: GpsTime, issues: tuple[int, int], fit_s: float,
    *, accuracy_m: float, health: int, delays_s: tuple[float, float],
) -> KeplerEphemeris | None:  # fmt: skip
    """Return the ephemeris of the values of ``_ORBIT``, ``toe_s`` and ``toc_s`` (GPST), sent at a time; None where they are of no orbit."""
    if not (4000.0 < values["sqrt_a"] < 8000.0 and values["eccentricity"] < 0.5 and sent.week >= 0):
        return None
    if not (values["toe_s"] < SECONDS_PER_WEEK + 14.0 and values["toc_s"] < SECONDS_PER_WEEK + 14.0):
        return None
    return KeplerEphemeris(
        satellite=satellite, message=message, iode=issues[0], iodc=issues[1], toe=nearest_week(values["toe_s"], sent),
        toc=nearest_week(values["toc_s"], sent), transmitted=sent, health=health, accuracy_m=accuracy_m, fit_s=fit_s,
        group_delay_s=delays_s, **{name: values[name] for name in _ORBIT},
    )  # fmt: skip


def glonass_ephemeris(satellite: int, channel: int, strings: dict[int, int], near: GpsTime) -> GlonassEphemeris | None:
    """Return the ephemeris of strings 1 to 4 of one frame (GLONASS ICD 5.1, 4.4), dated to the day nearest to ``near``.

    Health: bit 0 is the most significant bit of Bn, bit 1 is ln; the clock's sign is turned to that of RINEX.
    """
    first, second, third, fourth = (GLONASS_STRING[i].read(strings[i]) for i in (1, 2, 3, 4))
    tb_s = second["tb_s"]
    if not 0.0 < tb_s < SECONDS_PER_DAY or int(fourth["slot"]) not in (0, satellite % SATELLITES_PER_SYSTEM):
        return None
    values = first | second | third
    position, velocity, acceleration = (
        (values[f"{kind}_x_{unit}"], values[f"{kind}_y_{unit}"], values[f"{kind}_z_{unit}"])
        for kind, unit in (("position", "m"), ("velocity", "mps"), ("acceleration", "mps2"))
    )
    if not 25.1e6 < hypot(*position) < 25.9e6:  # nearly circular, 25 508 km (GLONASS ICD 5.1, 1.2): coordinates of two sets show
        return None
    return GlonassEphemeris(
        satellite=satellite, channel=channel, iode=int(tb_s / 900.0), toe=moscow_time(tb_s, near),
        transmitted=moscow_time(_frame_start_s(first), near), health=int(second["health"]) >> 2 | int(third["ln"]) << 1,
        accuracy_m=accuracy_m(GLONASS_FT_M, int(fourth["ft"])), age_days=int(fourth["age_days"]), position_m=position,
        velocity_mps=velocity, acceleration_mps2=acceleration, tau_s=-fourth["tau_n_s"] + 0.0, gamma=third["gamma"],
        group_delay_s=fourth["delta_tau_n_s"],
    )  # fmt: skip


def _frame_start_s(first: Values) -> float:
    return first["tk_hours"] * 3600.0 + first["tk_minutes"] * 60.0 + first["tk_half_minutes"] * 30.0


def moscow_time(time_of_day_s: float, near: GpsTime) -> GpsTime:
    """Return the instant nearest to ``near`` with this Moscow time of day."""
    leap_s = leap_seconds_of(near)
    found = _nearest_day(time_of_day_s - MOSCOW_MINUS_UTC_S + leap_s, near)
    own_leap_s = leap_seconds_of(found)
    return found if own_leap_s == leap_s else _nearest_day(time_of_day_s - MOSCOW_MINUS_UTC_S + own_leap_s, near)


def _nearest_day(time_of_day_s: float, near: GpsTime) -> GpsTime:
    midnight_s = near.tow_s // SECONDS_PER_DAY * SECONDS_PER_DAY
    found = GpsTime.normalized(near.week, midnight_s + time_of_day_s % SECONDS_PER_DAY)
    return found + SECONDS_PER_DAY * round((near - found) / SECONDS_PER_DAY)


def glonass_time(first: int, fourth: int, fifth: int) -> GpsTime | None:
    """Return the start of the frame of strings 1, 4 and 5: four-year period from 1996, day in it, time of day (GLONASS ICD 5.1, 4.4)."""
    n4 = int(GLONASS_STRING[5].read(fifth)["n4"])
    day = int(GLONASS_STRING[4].read(fourth)["nt_days"])
    if n4 < 1 or not 1 <= day <= 1461:
        return None
    frame_s = _frame_start_s(GLONASS_STRING[1].read(first))
    moscow = datetime(1996 + 4 * (n4 - 1), 1, 1, tzinfo=UTC) + timedelta(days=day - 1, seconds=frame_s)
    return GpsTime.from_utc(moscow - timedelta(seconds=MOSCOW_MINUS_UTC_S))


def klobuchar(system: int, values: Values) -> KlobucharParameters:
    """Return the ionosphere coefficients of LNAV subframe 4 page 18 or of BeiDou subframe 1."""
    alpha, beta = ((values[f"{name}0"], values[f"{name}1"], values[f"{name}2"], values[f"{name}3"]) for name in ("alpha", "beta"))
    return KlobucharParameters(SYSTEMS[system], alpha, beta)
