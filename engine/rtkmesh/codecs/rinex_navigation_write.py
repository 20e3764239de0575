"""Ephemerides to RINEX navigation files, 3.05 and 4.00 (RINEX 3.05 tables A5 to A13, RINEX 4.00 section 5.4).

Times go back to each system's own scale: BeiDou to BDT, GLONASS to UTC. Version 4 puts ``> EPH satellite message`` before each record and
has no place for ionosphere coefficients whose satellite and instant are not known, so these are written in version 3.05 alone.
"""

from collections.abc import Callable, Iterable
from typing import Final

from rtkmesh.codecs.accuracy import GLONASS_FT_M, NO_ACCURACY_M, accuracy_index
from rtkmesh.codecs.rinex_write import Origin, calendar_fields, first_lines, header_line
from rtkmesh.gnss.constants import BDT_MINUS_GPST_S, BDT_WEEK_OFFSET, SECONDS_PER_WEEK
from rtkmesh.gnss.ephemeris import Ephemeris, GlonassEphemeris, KeplerEphemeris, KlobucharParameters, NavigationMessage
from rtkmesh.gnss.signals import BEIDOU, GALILEO, GPS, NAVIC, QZSS, SATELLITES_PER_SYSTEM, satellite_id
from rtkmesh.gnss.time import GpsTime, gps_minus_utc_s

_PER_LINE: Final = 4
_SOURCES: Final = {NavigationMessage.INAV: 0b10_0000_0101, NavigationMessage.FNAV: 0b01_0000_0010}  # table A8: E1 and E5b; E5a
_NO_SISA: Final = -1.0
_USUAL_FIT_S: Final = 7200.0
_IONOSPHERE: Final = {"G": "GPS", "C": "BDS", "J": "QZS", "I": "IRN"}
_NO_STATUS: Final = 0.0  # GLONASS status flags: not known
_SYSTEMS: Final = (GPS, GALILEO, BEIDOU, QZSS, NAVIC)


def navigation_header(origin: Origin, ionosphere: Iterable[KlobucharParameters] = (), leap_seconds: int | None = None) -> str:
    """Return the header of a navigation file."""
    lines = [first_lines(origin, "NAVIGATION DATA")]
    if origin.version < 4.0:
        for parameters in ionosphere:
            for letter, terms in (("A", parameters.alpha), ("B", parameters.beta)):
                content = f"{_IONOSPHERE[parameters.system]}{letter} " + "".join(f"{term:12.4E}" for term in terms)
                lines.append(header_line(content, "IONOSPHERIC CORR"))
    if leap_seconds is not None:
        lines.append(header_line(f"{leap_seconds:6d}", "LEAP SECONDS"))
    return "".join((*lines, header_line("", "END OF HEADER")))


def navigation_record(ephemeris: Ephemeris, version: float) -> str:
    """Return the record of an ephemeris; ValueError if RINEX has none for its message (CNAV in 3.05)."""
    name = satellite_id(ephemeris.satellite)
    if isinstance(ephemeris, GlonassEphemeris):
        message, text = NavigationMessage.FDMA, _glonass(name, ephemeris)
    else:
        message, text = ephemeris.message, _kepler(name, ephemeris)
    return f"> EPH {name} {message.name}\n{text}" if version >= 4.0 else text


def _record(name: str, clock: GpsTime, values: list[float]) -> str:
    """Return the lines of a record: three numbers behind the date, then four a line."""
    year, month, day, hour, minute, second, _ = calendar_fields(clock, 0)
    lines = [f"{name} {year:4d} {month:02d} {day:02d} {hour:02d} {minute:02d} {second:02d}{_numbers(values[:3])}\n"]
    lines += [f"    {_numbers(values[first : first + _PER_LINE])}\n" for first in range(3, len(values), _PER_LINE)]
    return "".join(lines)


def _numbers(values: list[float]) -> str:
    return "".join(f"{value:19.12E}" for value in values)


def _kepler(name: str, e: KeplerEphemeris) -> str:
    system = e.satellite // SATELLITES_PER_SYSTEM
    if system not in _SYSTEMS or e.message is NavigationMessage.CNAV:
        raise ValueError(f"no RINEX record for {name} {e.message.name}")
    shift_s = BDT_MINUS_GPST_S if system == BEIDOU else 0.0
    toe, toc, sent = e.toe + shift_s, e.toc + shift_s, e.transmitted + shift_s
    orbit = [
        e.af0_s, e.af1, e.af2, float(e.iode), e.crs_m, e.delta_n_radps, e.m0_rad, e.cuc_rad, e.eccentricity, e.cus_rad, e.sqrt_a, toe.tow_s,
        e.cic_rad, e.omega0_rad, e.cis_rad, e.i0_rad, e.crc_m, e.omega_rad, e.omega_dot_radps, e.idot_radps,
    ]  # fmt: skip
    week = toe.week - (BDT_WEEK_OFFSET if system == BEIDOU else 0)
    sent_s = (sent.week - toe.week) * SECONDS_PER_WEEK + sent.tow_s
    return _record(name, toc, orbit + _LAST[system](e, float(week), sent_s))


def _gps_end(e: KeplerEphemeris, week: float, sent_s: float) -> list[float]:
    fit_h = 2.0 * e.fit_s / 3600.0
    return [0.0, week, 0.0, e.accuracy_m, float(e.health), e.group_delay_s[0], float(e.iodc), sent_s, fit_h]


def _qzss_end(e: KeplerEphemeris, week: float, sent_s: float) -> list[float]:
    fit_flag = float(e.fit_s > _USUAL_FIT_S)
    return [2.0, week, 0.0, e.accuracy_m, float(e.health), e.group_delay_s[0], float(e.iodc), sent_s, fit_flag]


def _galileo_end(e: KeplerEphemeris, week: float, sent_s: float) -> list[float]:
    accuracy_m = _NO_SISA if e.accuracy_m >= NO_ACCURACY_M else e.accuracy_m
    return [float(_SOURCES.get(e.message, 0)), week, 0.0, accuracy_m, float(e.health), *e.group_delay_s, sent_s]


def _beidou_end(e: KeplerEphemeris, week: float, sent_s: float) -> list[float]:
    return [0.0, week, 0.0, e.accuracy_m, float(e.health), *e.group_delay_s, sent_s, float(e.iodc)]


def _navic_end(e: KeplerEphemeris, week: float, sent_s: float) -> list[float]:
    return [0.0, week, 0.0, e.accuracy_m, float(e.health), e.group_delay_s[0], 0.0, sent_s]


_LAST: Final[dict[int, Callable[[KeplerEphemeris, float, float], list[float]]]] = {
    GPS: _gps_end,
    GALILEO: _galileo_end,
    BEIDOU: _beidou_end,
    QZSS: _qzss_end,
    NAVIC: _navic_end,
}


def _glonass(name: str, e: GlonassEphemeris) -> str:
    """Times are UTC; five lines as since 3.05 (status flags, delay L2 - L1, F_T, health flags)."""
    leap_s = float(gps_minus_utc_s(e.toe))
    clock, sent = e.toe + -leap_s, e.transmitted + -leap_s
    (x, y, z), (vx, vy, vz), (ax, ay, az) = (
        [value / 1e3 for value in axis] for axis in (e.position_m, e.velocity_mps, e.acceleration_mps2)
    )
    index = float(accuracy_index(GLONASS_FT_M, e.accuracy_m))
    return _record(name, clock, [
        e.tau_s, e.gamma, sent.tow_s, x, vx, ax, float(e.health), y, vy, ay, float(e.channel), z, vz, az, float(e.age_days), _NO_STATUS,
        e.group_delay_s, index, 0.0,
    ])  # fmt: skip
