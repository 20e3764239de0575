"""Values to NMEA 0183 sentences (version 4.11): GGA, RMC, GST, GSA, GSV, VTG, ZDA, HDT, THS. Each comes with its checksum and line end.

Angles are degrees, as the sentences have them; values that are not known (NaN, None) are empty fields.
"""

from collections.abc import Iterable, Sequence
from datetime import datetime, timedelta
from math import isfinite, nan
from typing import Final, NamedTuple

from rtkmesh.gnss.ellipse import ErrorEllipse
from rtkmesh.gnss.sentences import sentence
from rtkmesh.gnss.signals import BEIDOU, GALILEO, GLONASS, GPS, NAVIC, QZSS, SATELLITES_PER_SYSTEM, SBAS

KNOTS_PER_MPS: Final = 3600.0 / 1852.0
KMH_PER_MPS: Final = 3.6
GSV_SATELLITES: Final = 4  # in one sentence
GSA_SATELLITES: Final = 12

# system -> talker, system id (GSA), number of satellite 0 (4.11, table of GNSS ids)
_SYSTEMS: Final = {
    GPS: ("GP", 1, 0), SBAS: ("GP", 1, 13), GLONASS: ("GL", 2, 64), GALILEO: ("GA", 3, 0), BEIDOU: ("GB", 4, 0), QZSS: ("GQ", 5, 192),
    NAVIC: ("GI", 6, 0),
}  # fmt: skip


class Position(NamedTuple):
    """A position: degrees, height above the ellipsoid (m), and the geoid's height above it (m)."""

    lat_deg: float
    lon_deg: float
    height_m: float = 0.0
    geoid_m: float = 0.0


class SatelliteInView(NamedTuple):
    """A satellite for GSV; C/N0 is NaN where it is not tracked."""

    satellite: int
    elevation_deg: float
    azimuth_deg: float
    cn0_dbhz: float = nan


def gga(
    utc: datetime, place: Position | None, quality: int, satellites: int, *, hdop: float = nan, age_s: float = nan,
    station_id: int | None = None, talker: str = "GN",
) -> str:  # fmt: skip
    """Return GGA. ``quality``: 0 none, 1 single, 2 differential, 4 integers fixed, 5 float, 6 dead reckoning."""
    position, altitude = _position_fields(place)
    station = "" if station_id is None else f"{station_id:04d}"
    quality = quality if place is not None else 0
    status = f"{quality},{satellites:02d},{_number(hdop, 1)}"
    return sentence(f"{talker}GGA,{_clock(utc)},{position},{status},{altitude},{_number(age_s, 1)},{station}")


def rmc(
    utc: datetime, place: Position | None, *, speed_mps: float = nan, course_deg: float = nan, mode: str = "A", talker: str = "GN"
) -> str:
    """Return RMC. ``mode``: A autonomous, D differential, F float, R integers fixed, E dead reckoning; N is written without a position."""
    position, _ = _position_fields(place)
    valid, mode = ("A", mode) if place is not None else ("V", "N")
    speed, course = _number(speed_mps * KNOTS_PER_MPS, 3), _number(_turn(course_deg), 2)
    return sentence(f"{talker}RMC,{_clock(utc)},{valid},{position},{speed},{course},{_hundredths(utc):%d%m%y},,,{mode},V")


def gst(
    utc: datetime, ellipse: ErrorEllipse, sigma_lat_m: float, sigma_lon_m: float, sigma_height_m: float, *, rms_m: float = nan,
    talker: str = "GN",
) -> str:  # fmt: skip
    """Return GST; ``rms_m`` is that of the ranges' residuals."""
    axes = f"{_number(ellipse.major_m, 3)},{_number(ellipse.minor_m, 3)},{_number(ellipse.direction_deg, 1)}"
    sigmas = ",".join(_number(sigma, 3) for sigma in (sigma_lat_m, sigma_lon_m, sigma_height_m))
    return sentence(f"{talker}GST,{_clock(utc)},{_number(rms_m, 3)},{axes},{sigmas}")


def gsa(satellites: Iterable[int], fix: int, pdop: float, hdop: float, vdop: float) -> list[str]:
    """Return one GSA per system (two where it has more than twelve satellites). ``fix``: 1 none, 2 in the plane, 3 in space."""
    sentences: list[str] = []
    dops = ",".join(_number(dop, 2) for dop in (pdop, hdop, vdop))
    for _, number, names in _by_system(satellites):
        for first in range(0, len(names), GSA_SATELLITES):
            some = [f"{name:02d}" for name in names[first : first + GSA_SATELLITES]]
            fields = ",".join([*some, *[""] * (GSA_SATELLITES - len(some))])
            sentences.append(sentence(f"GNGSA,A,{fix},{fields},{dops},{number}"))
    return sentences


def gsv(satellites: Sequence[SatelliteInView], signal_id: int = 0) -> list[str]:
    """Return the GSV sentences of all systems; ``signal_id`` 0 stands for all signals."""
    of = {_name(one.satellite): one for one in satellites}
    sentences: list[str] = []
    for talker, number, names in _by_system(one.satellite for one in satellites):
        count = -(-len(names) // GSV_SATELLITES)
        for k in range(count):
            some = (of[number, name] for name in names[k * GSV_SATELLITES : (k + 1) * GSV_SATELLITES])
            fields = ",".join(_view(one) for one in some)
            sentences.append(sentence(f"{talker}GSV,{count},{k + 1},{len(names):02d},{fields},{signal_id:X}"))
    return sentences


def vtg(speed_mps: float, course_deg: float, *, mode: str = "A", talker: str = "GN") -> str:
    """Return VTG: course over ground (true), speed in knots and in km/h."""
    knots, kmh = _number(speed_mps * KNOTS_PER_MPS, 3), _number(speed_mps * KMH_PER_MPS, 3)
    return sentence(f"{talker}VTG,{_number(_turn(course_deg), 2)},T,,M,{knots},N,{kmh},K,{mode}")


def zda(utc: datetime, *, talker: str = "GN") -> str:
    """Return ZDA: date and time, local zone 0."""
    return sentence(f"{talker}ZDA,{_clock(utc)},{_hundredths(utc):%d,%m,%Y},00,00")


def hdt(heading_deg: float, *, talker: str = "GN") -> str:
    """Return HDT: true heading."""
    return sentence(f"{talker}HDT,{_number(_turn(heading_deg), 3)},T")


def ths(heading_deg: float, *, mode: str = "A", talker: str = "GN") -> str:
    """Return THS: true heading and status (A autonomous, E estimated, S simulated; V is written where it is not known)."""
    return sentence(f"{talker}THS,{_number(_turn(heading_deg), 3)},{mode if isfinite(heading_deg) else 'V'}")


def _by_system(satellites: Iterable[int]) -> list[tuple[str, int, list[int]]]:
    """Return (talker, system id, NMEA numbers in rising order) of each system there is."""
    talkers: dict[int, str] = {}
    names: dict[int, list[int]] = {}
    for satellite in satellites:
        talker, number, _ = _SYSTEMS[satellite // SATELLITES_PER_SYSTEM]
        talkers[number] = talker
        names.setdefault(number, []).append(_name(satellite)[1])
    return [(talkers[number], number, sorted(names[number])) for number in sorted(names)]


def _name(satellite: int) -> tuple[int, int]:
    """Return system id and NMEA number of a satellite."""
    _, number, offset = _SYSTEMS[satellite // SATELLITES_PER_SYSTEM]
    return number, satellite % SATELLITES_PER_SYSTEM + offset


def _view(one: SatelliteInView) -> str:
    cn0 = f"{min(round(one.cn0_dbhz), 99):02d}" if isfinite(one.cn0_dbhz) else ""
    if not isfinite(one.elevation_deg + one.azimuth_deg):
        return f"{_name(one.satellite)[1]:02d},,,{cn0}"
    return f"{_name(one.satellite)[1]:02d},{round(one.elevation_deg):02d},{round(one.azimuth_deg) % 360:03d},{cn0}"


def _position_fields(place: Position | None) -> tuple[str, str]:
    """Return the fields of a position and of heights; both empty without one."""
    if place is None:
        return ",,,", ",M,,M"
    lon_deg = place.lon_deg if abs(place.lon_deg) <= 180.0 else (place.lon_deg + 180.0) % 360.0 - 180.0
    north, east = "N" if place.lat_deg >= 0.0 else "S", "E" if lon_deg >= 0.0 else "W"
    altitude = f"{place.height_m - place.geoid_m:.3f},M,{place.geoid_m:.3f},M"
    return f"{_angle(abs(place.lat_deg), 2)},{north},{_angle(abs(lon_deg), 3)},{east}", altitude


def _angle(angle_deg: float, digits: int) -> str:
    """Return degrees and minutes, ``dddmm.mmmmmmm``; 60 minutes never stand there."""
    minutes_e7 = round(angle_deg * 60e7)
    return f"{minutes_e7 // 600_000_000:0{digits}d}{minutes_e7 % 600_000_000 / 1e7:010.7f}"


def _hundredths(utc: datetime) -> datetime:
    """Return the time rounded to hundredths of a second."""
    return utc + timedelta(microseconds=(utc.microsecond + 5000) // 10000 * 10000 - utc.microsecond)


def _clock(utc: datetime) -> str:
    rounded = _hundredths(utc)
    return f"{rounded:%H%M%S}.{rounded.microsecond // 10000:02d}"


def _turn(angle_deg: float) -> float:
    return angle_deg % 360.0 if isfinite(angle_deg) else angle_deg


def _number(value: float, decimals: int) -> str:
    return f"{value:.{decimals}f}" if isfinite(value) else ""
