"""Ephemeris logs of Unicore N4 receivers (Unicore N4 commands manual R1.13, GPSEPH, QZSSEPH, BDSEPH, GALEPH, GLOEPH).

Weeks are settled by the time of the log's header, which says when the receiver sent it. User range accuracies are variances.
"""

from collections.abc import Callable, Mapping
from math import hypot, isfinite, sqrt
from typing import Final

from rtkmesh.codecs.accuracy import GLONASS_FT_M, SISA_M, accuracy_m
from rtkmesh.codecs.ephemerides import BEIDOU_FIT_S, GALILEO_FIT_S, GPS_FIT_S, QZSS_FIT_S, kepler_ephemeris
from rtkmesh.codecs.messages import Message
from rtkmesh.codecs.unicore_logs import Fields, Log
from rtkmesh.gnss.beidou import message_on_b1i
from rtkmesh.gnss.constants import BDT_MINUS_GPST_S, SECONDS_PER_DAY, SECONDS_PER_WEEK
from rtkmesh.gnss.ephemeris import Ephemeris, GlonassEphemeris, NavigationMessage
from rtkmesh.gnss.signals import BEIDOU, GALILEO, GLONASS, GPS, NO_CHANNEL, QZSS, SATELLITES_PER_SYSTEM
from rtkmesh.gnss.time import GpsTime, nearest_week

ORBIT: Final = (
    "delta_n_radps", "m0_rad", "eccentricity", "omega_rad", "cuc_rad", "cus_rad", "crc_m", "crs_m", "cic_rad", "cis_rad", "i0_rad",
    "idot_radps", "omega0_rad", "omega_dot_radps",
)  # fmt: skip
CLOCK: Final = ("af0_s", "af1", "af2")
_FIRST: Final = ("prn", "sent_s", "health", "iode", "iode2", "week", "sent_week", "toe_s", "semi_major_m", *ORBIT, "iodc", "toc_s")
_LAST: Final = (*CLOCK, "anti_spoofing", "mean_motion_radps", "variance_m2")
_VECTORS: Final = ("position", "velocity", "acceleration")
_FIRST_LAYOUT, _LAST_LAYOUT = "IdIIIIIdd" + "d" * len(ORBIT) + "Id", "dddIdd"

GPS_NAMES: Final = (*_FIRST, "tgd_s", *_LAST)
BEIDOU_NAMES: Final = (*_FIRST, "tgd1_s", "tgd2_s", *_LAST)
GALILEO_NAMES: Final = (
    "prn", "fnav", "inav", "health_e1b", "health_e5a", "health_e5b", "invalid_e1b", "invalid_e5a", "invalid_e5b", "sisa", "reserved",
    "iode", "toe_s", "sqrt_a", *ORBIT, "fnav_toc_s", *(f"fnav_{name}" for name in CLOCK), "inav_toc_s",
    *(f"inav_{name}" for name in CLOCK), "bgd_e5a_s", "bgd_e5b_s",
)  # fmt: skip
GLONASS_NAMES: Final = (
    "slot", "frequency", "kind", "reserved", "week", "toe_ms", "leap_s", "day", "reserved1", "reserved2", "issue", "health",
    *(f"{kind}_{axis}" for kind in _VECTORS for axis in "xyz"), "tau_n_s", "delta_tau_n_s", "gamma", "tk_s", "p", "ft", "age_days", "flags",
)  # fmt: skip
GPS_FIELDS: Final = Fields(f"{_FIRST_LAYOUT}d{_LAST_LAYOUT}")
BEIDOU_FIELDS: Final = Fields(f"{_FIRST_LAYOUT}dd{_LAST_LAYOUT}")
GALILEO_FIELDS: Final = Fields("IIIBBBBBBBBIId" + "d" * len(ORBIT) + "IdddIddddd")
GLONASS_FIELDS: Final = Fields("HHBBHIIHBBII" + "d" * 12 + "IIIII")

GLONASS_SLOT_OFFSET, QZSS_PRN_OFFSET, CHANNEL_OFFSET = 37, 192, 7
_BAD_HEALTH: Final = 4  # GLONASS Bn: 4 and more are bad

Values = dict[str, float]
Build = Callable[[Values, GpsTime], list[Ephemeris | None]]
Reader = tuple[tuple[str, ...], Fields, Build]  # names of the fields, how they are read, what they become


def read_ephemeris(log: Log, readers: Mapping[str, Reader]) -> list[Message] | str:
    """Return what an ephemeris log says by the reader of its name, or why it is rejected."""
    names, fields, build = readers[log.name]
    values = fields.read(log)
    if values is None:
        return "length"
    if log.time is None:
        return "time"
    numbers: Values = {name: value for name, value in zip(names, values, strict=True) if not isinstance(value, str)}
    if not all(isfinite(number) for number in numbers.values()):
        return "value"
    found: list[Message] = [ephemeris for ephemeris in build(numbers, log.time) if ephemeris is not None]
    return found or "orbit"


def satellite_of(system: int, number: float, last: int) -> int:
    """Return a satellite's number, 0 where there is none."""
    return system * SATELLITES_PER_SYSTEM + int(number) if 1 <= number <= last else 0


def _gps(v: Values, sent: GpsTime) -> list[Ephemeris | None]:
    return _like_gps(satellite_of(GPS, v["prn"], 32), v, sent, GPS_FIT_S)


def _qzss(v: Values, sent: GpsTime) -> list[Ephemeris | None]:
    number = v["prn"] - QZSS_PRN_OFFSET if v["prn"] > QZSS_PRN_OFFSET else v["prn"]
    return _like_gps(satellite_of(QZSS, number, 10), v, sent, QZSS_FIT_S)


def _like_gps(satellite: int, v: Values, sent: GpsTime, fit_s: float) -> list[Ephemeris | None]:
    health = int(v["health"]) & 63
    return [_kepler(satellite, NavigationMessage.LNAV, v, sent, (v["iode"], v["iodc"]), fit_s, health, (v["tgd_s"], 0.0))]


def _beidou(v: Values, sent: GpsTime) -> list[Ephemeris | None]:
    """Times of week are BDT."""
    satellite = satellite_of(BEIDOU, v["prn"], 63)
    v = {**v, "toe_s": v["toe_s"] - BDT_MINUS_GPST_S, "toc_s": v["toc_s"] - BDT_MINUS_GPST_S}
    delays_s = v["tgd1_s"], v["tgd2_s"]
    return [_kepler(satellite, message_on_b1i(satellite), v, sent, (v["iode"], v["iodc"]), BEIDOU_FIT_S, int(v["health"]), delays_s)]


def _kepler(
    satellite: int, message: NavigationMessage, v: Values, sent: GpsTime, issues: tuple[float, float], fit_s: float, health: int,
    delays_s: tuple[float, float],
) -> Ephemeris | None:  # fmt: skip
    if satellite == 0 or v["semi_major_m"] < 0.0 or v["variance_m2"] < 0.0 or v["toe_s"] < 0.0 or v["toc_s"] < 0.0:
        return None
    v = {**v, "sqrt_a": sqrt(v["semi_major_m"])}
    return kepler_ephemeris(
        satellite, message, v, sent, (int(issues[0]), int(issues[1])), fit_s, accuracy_m=sqrt(v["variance_m2"]), health=health,
        delays_s=delays_s,
    )  # fmt: skip


def galileo(v: Values, sent: GpsTime) -> list[Ephemeris | None]:
    """Return I/NAV and F/NAV, whichever was received; they share orbit and issue. Health bits stand as in RINEX 3.05 table A8."""
    e1b, e5b = int(v["health_e1b"]) & 3, int(v["health_e5b"]) & 3
    inav = (int(v["invalid_e1b"]) & 1) | e1b << 1 | (int(v["invalid_e5b"]) & 1) << 6 | e5b << 7
    fnav = (int(v["invalid_e5a"]) & 1) << 3 | (int(v["health_e5a"]) & 3) << 4
    return [
        _galileo_message("inav", NavigationMessage.INAV, v, sent, inav, (v["bgd_e5a_s"], v["bgd_e5b_s"])),
        _galileo_message("fnav", NavigationMessage.FNAV, v, sent, fnav, (v["bgd_e5a_s"], 0.0)),
    ]


def _galileo_message(
    name: str, message: NavigationMessage, v: Values, sent: GpsTime, health: int, delays_s: tuple[float, float]
) -> Ephemeris | None:
    satellite, issue = satellite_of(GALILEO, v["prn"], 36), int(v["iode"])
    if satellite == 0 or not int(v[name]) & 1:
        return None
    v = {**v, "toc_s": v[f"{name}_toc_s"], **{part: v[f"{name}_{part}"] for part in CLOCK}}
    return kepler_ephemeris(
        satellite, message, v, sent, (issue, issue), GALILEO_FIT_S, accuracy_m=accuracy_m(SISA_M, int(v["sisa"])), health=health,
        delays_s=delays_s,
    )  # fmt: skip


def _glonass(v: Values, sent: GpsTime) -> list[Ephemeris | None]:
    satellite = satellite_of(GLONASS, v["slot"] - GLONASS_SLOT_OFFSET, 27)
    position, velocity, acceleration = ((v[f"{kind}_x"], v[f"{kind}_y"], v[f"{kind}_z"]) for kind in _VECTORS)
    toe_s = round(v["toe_ms"] / 1e3)
    if satellite == 0 or v["week"] == 0 or toe_s >= SECONDS_PER_WEEK or not 25.1e6 < hypot(*position) < 25.9e6:
        return [None]
    toe = nearest_week(float(toe_s), sent)
    return [GlonassEphemeris(
        satellite=satellite, channel=int(v["frequency"]) - CHANNEL_OFFSET if v["frequency"] <= 20 else NO_CHANNEL,
        iode=int(v["issue"]) & 127, toe=toe, transmitted=_frame_start(v, toe), health=int(v["health"] >= _BAD_HEALTH),
        accuracy_m=accuracy_m(GLONASS_FT_M, int(v["ft"])), age_days=int(v["age_days"]), position_m=position, velocity_mps=velocity,
        acceleration_mps2=acceleration, tau_s=-v["tau_n_s"] + 0.0, gamma=v["gamma"], group_delay_s=v["delta_tau_n_s"],
    )]  # fmt: skip


def _frame_start(v: Values, toe: GpsTime) -> GpsTime:
    """Return the start of the frame, a Moscow time of day (``leap_s`` is Moscow minus GPS time), nearest to toe."""
    late_s = v["tk_s"] - v["leap_s"] - toe.tow_s
    return toe + (late_s - SECONDS_PER_DAY * round(late_s / SECONDS_PER_DAY))


READERS: Final[dict[str, Reader]] = {
    "GPSEPH": (GPS_NAMES, GPS_FIELDS, _gps),
    "QZSSEPH": (GPS_NAMES, GPS_FIELDS, _qzss),
    "BDSEPH": (BEIDOU_NAMES, BEIDOU_FIELDS, _beidou),
    "GALEPH": (GALILEO_NAMES, GALILEO_FIELDS, galileo),
    "GLOEPH": (GLONASS_NAMES, GLONASS_FIELDS, _glonass),
}
