"""RINEX navigation files 2.00 to 2.12 and 3.00 to 3.05, and the same records of 4.0x: text to ephemerides.

Sources: RINEX 2.11 tables A3 to A16, RINEX 3.05 tables A5 to A13, RINEX 4.00 section 5.4. All times become GPST: BeiDou + 14 s,
GLONASS (which RINEX writes in UTC) + leap seconds. Weeks are taken from the clock's date, so a record is right whatever its
week number counts from.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from math import isfinite
from typing import Final

from rtkmesh.codecs.accuracy import GLONASS_FT_M, NO_ACCURACY_M, accuracy_m
from rtkmesh.codecs.messages import DecodingCounters
from rtkmesh.codecs.rinex_header import as_bytes, header_lines, integer, number, numbers, version_and_type
from rtkmesh.errors import FormatError
from rtkmesh.gnss.beidou import message_on_b1i
from rtkmesh.gnss.constants import BDT_MINUS_GPST_S, SECONDS_PER_DAY, SECONDS_PER_WEEK
from rtkmesh.gnss.ephemeris import Ephemeris, GlonassEphemeris, KeplerEphemeris, KlobucharParameters, NavigationMessage
from rtkmesh.gnss.signals import NO_CHANNEL, satellite_number
from rtkmesh.gnss.time import GpsTime, nearest_week

_WIDTH: Final = 19  # D19.12
_LINES: Final = {"G": 8, "E": 8, "C": 8, "J": 8, "I": 8, "R": 4, "S": 4}
_V2_SYSTEM_OF_TYPE: Final = {"G": "R", "H": "S", "L": "E", "J": "J", "C": "C"}
_NAVIGATION_TYPES: Final = ("N", "G", "H", "L", "J", "P")
_V4_MESSAGES: Final = ("LNAV", "INAV", "FNAV", "INFN", "IFNV", "D1", "D2", "D1D2", "FDMA")
_GLONASS_ACCURACY_M: Final = 5.0  # where the record has no URA: F_T of a healthy satellite is 1 to 7 m (GLONASS ICD 5.1 table 4.4)


@dataclass(frozen=True, slots=True)
class NavigationFile:
    """What a navigation file holds, in its order; ``counters`` says what was not understood."""

    version: float
    ephemerides: list[Ephemeris] = field(default_factory=list[Ephemeris])
    klobuchar: list[KlobucharParameters] = field(default_factory=list[KlobucharParameters])
    leap_seconds: int | None = None
    counters: DecodingCounters = field(default_factory=DecodingCounters)


def read_navigation(text: str | bytes) -> NavigationFile:
    """Return the content of a RINEX navigation file; FormatError if the text is none."""
    data = as_bytes(text)
    lines, offset = header_lines(data)
    version, kind, system = version_and_type(lines[0][0])
    if version < 3.0:
        system = _V2_SYSTEM_OF_TYPE.get(kind, system if system in _LINES else "G")
    if kind not in _NAVIGATION_TYPES and "NAV" not in lines[0][0][20:40]:
        raise FormatError(f"file type {kind!r} is no navigation file")
    file = NavigationFile(version, klobuchar=_klobuchar(lines), leap_seconds=_leap_seconds(lines))
    records = data[offset:].decode("latin-1").splitlines()
    at = 0
    while at < len(records):
        at += _read_record(file, records, at, system)
    return file


def _read_record(file: NavigationFile, records: list[str], at: int, system: str) -> int:
    """Read the record that begins at line ``at`` into the file and return its number of lines."""
    first, skipped = records[at], 0
    if file.version >= 4.0:
        if not first.startswith("> EPH") or first[10:14].strip() not in _V4_MESSAGES:
            if first.startswith(">"):
                file.counters.ignored[f"rinex/{first[2:14].strip()}"] += 1
            return 1
        first, skipped = records[at + 1] if at + 1 < len(records) else "", 1
    name = _satellite_name(first, file.version, system)
    if not name:
        if first.strip():
            file.counters.rejected["rinex/stray line"] += 1
        return 1
    count = _lines_of(name, file.version)
    lines = records[at + skipped : at + skipped + count]
    whole = [k for k, line in enumerate(lines) if k > 0 and _satellite_name(line, file.version, system)]
    if len(lines) < count or whole:
        file.counters.rejected["rinex/truncated record"] += 1
        return skipped + (whole[0] if whole else len(lines))
    _decode(file, name, lines)
    return skipped + count


def _lines_of(name: str, version: float) -> int:
    return 5 if name[0] == "R" and version >= 3.05 else _LINES[name[0]]


def _satellite_name(line: str, version: float, system: str) -> str:
    """Return the satellite (``G05``) of a record's first line, "" if it is none."""
    if version >= 3.0:
        name = line[:3]
        return name if name[:1] in _LINES and name[1:].strip().isdecimal() else ""
    name = line[:2].strip() if line[:3].strip() else ""
    if name.isdecimal():
        return f"{system}{int(name):02d}"
    name = line[:3]  # RINEX 2.12 writes the system's letter in mixed files
    return name if name[:1] in _LINES and name[1:].strip().isdecimal() else ""


def _decode(file: NavigationFile, name: str, lines: list[str]) -> None:
    build = _BUILDERS.get(name[0])
    if build is None:
        file.counters.ignored[f"rinex/{name[0]}"] += 1
        return
    clock, values = _clock_time(lines[0], file.version), _values(lines, file.version)
    if clock is None:
        file.counters.rejected["rinex/date"] += 1
        return
    try:
        ephemeris = build(satellite_number(name), clock, values) if all(map(isfinite, values)) else None
    except (ValueError, OverflowError):  # satellite 0, a date that no calendar has
        ephemeris = None
    if ephemeris is None:
        file.counters.rejected["rinex/value"] += 1
        return
    file.counters.decoded[f"rinex/{name[0]}"] += 1
    file.ephemerides.append(ephemeris)


def _values(lines: list[str], version: float) -> list[float]:
    """Return the numbers of a record: 3 of the first line, 4 of each other; missing ones are 0."""
    start = 4 if version >= 3.0 else 3
    values: list[float] = []
    for k, line in enumerate(lines):
        first = start + _WIDTH if k == 0 else start
        content = line[: start + 4 * _WIDTH].ljust(start + 4 * _WIDTH).replace("D", "E")  # Fortran's exponent, as Python reads it at once
        values += numbers(content, _WIDTH, first)
    return values


def _clock_time(line: str, version: float) -> datetime | None:
    """Return the date of a record in the time of its own system (as UTC datetime), None if it is none."""
    text = line[4:23] if version >= 3.0 else line[3:22]
    try:
        year, month, day, hour, minute, second = text.split() if version >= 3.0 else (text[k : k + 3] for k in range(0, 18, 3))
        seconds = float(text[14:]) if version < 3.0 else float(second)
        years = int(year)
        if version < 3.0:
            years += 2000 if years < 80 else 1900
        whole = int(seconds)
        return datetime(years, int(month), int(day), int(hour), int(minute), min(whole, 59), round((seconds - whole) * 1e6), tzinfo=UTC)
    except ValueError:
        return None


def _gpst(date: datetime) -> GpsTime:
    return GpsTime.from_calendar(date.year, date.month, date.day, date.hour, date.minute, date.second + date.microsecond * 1e-6)


def _kepler(
    satellite: int, v: list[float], message: NavigationMessage, toc: GpsTime, *, shift_s: float = 0.0,
    issues: tuple[float, float], accuracy_m: float, fit_s: float,
) -> KeplerEphemeris:  # fmt: skip
    """Return the ephemeris of the numbers that all Keplerian records share; ``shift_s``: GPST minus the system's time."""
    sent_s = v[27] if abs(v[27]) < 2.0 * SECONDS_PER_WEEK else v[11]  # 0.9999E9: not known
    return KeplerEphemeris(
        satellite=satellite, message=message, iode=int(issues[0]), iodc=int(issues[1]),
        toe=nearest_week(v[11] + shift_s, toc), toc=toc, transmitted=nearest_week(sent_s + shift_s, toc),
        health=int(v[24]), accuracy_m=accuracy_m, fit_s=fit_s, sqrt_a=v[10], eccentricity=v[8], m0_rad=v[6], delta_n_radps=v[5],
        omega0_rad=v[13], omega_rad=v[17], omega_dot_radps=v[18], i0_rad=v[15], idot_radps=v[19], cuc_rad=v[7], cus_rad=v[9],
        crc_m=v[16], crs_m=v[4], cic_rad=v[12], cis_rad=v[14], af0_s=v[0], af1=v[1], af2=v[2], group_delay_s=(v[25], v[26]),
    )  # fmt: skip


def _gps(satellite: int, date: datetime, v: list[float]) -> Ephemeris:
    """IS-GPS-200N 20.3.3.4.3.1: the fit interval is 4 h unless more is said (hours; 1 was a flag in old files)."""
    half = max(v[28], 4.0) * 1800.0 if v[28] < 200.0 else 7200.0
    ephemeris = _kepler(satellite, v, NavigationMessage.LNAV, _gpst(date), issues=(v[3], v[26]), accuracy_m=v[23], fit_s=half)
    return _with_delays(ephemeris, (v[25], 0.0))


def _qzss(satellite: int, date: datetime, v: list[float]) -> Ephemeris:
    """IS-QZSS-PNT 5.4.3.1: curve fit interval 2 h, issued ahead; valid as long as GPS's."""
    ephemeris = _kepler(satellite, v, NavigationMessage.LNAV, _gpst(date), issues=(v[3], v[26]), accuracy_m=v[23], fit_s=7200.0)
    return _with_delays(ephemeris, (v[25], 0.0))


def _galileo(satellite: int, date: datetime, v: list[float]) -> Ephemeris:
    """Data sources (RINEX 3.05 table A8): bit 8 says clock of E5a,E1 = F/NAV, bit 9 clock of E5b,E1 = I/NAV."""
    sources = int(v[20])
    clock_fnav, clock_inav = sources >> 8 & 1, sources >> 9 & 1
    fnav = bool(clock_fnav) if clock_fnav != clock_inav else sources & 0b111 == 0b010
    message = NavigationMessage.FNAV if fnav else NavigationMessage.INAV
    sisa_m = v[23] if v[23] >= 0.0 else NO_ACCURACY_M
    return _kepler(satellite, v, message, _gpst(date), issues=(v[3], v[3]), accuracy_m=sisa_m, fit_s=14400.0)


def _navic(satellite: int, date: datetime, v: list[float]) -> Ephemeris:
    ephemeris = _kepler(satellite, v, NavigationMessage.LNAV, _gpst(date), issues=(v[3], v[3]), accuracy_m=v[23], fit_s=7200.0)
    return _with_delays(ephemeris, (v[25], 0.0))


def _beidou(satellite: int, date: datetime, v: list[float]) -> Ephemeris:
    shift_s, message = -BDT_MINUS_GPST_S, message_on_b1i(satellite)
    return _kepler(satellite, v, message, _gpst(date) + shift_s, shift_s=shift_s, issues=(v[3], v[28]), accuracy_m=v[23], fit_s=10800.0)


def _with_delays(ephemeris: KeplerEphemeris, group_delay_s: tuple[float, float]) -> KeplerEphemeris:
    return replace(ephemeris, group_delay_s=group_delay_s)


def _glonass(satellite: int, date: datetime, v: list[float]) -> Ephemeris:
    """The record's time is tb in UTC (a multiple of 15 minutes); message frame time is of the day (RINEX 2) or of the week."""
    quarter = 900.0
    clock = _gpst(date)  # UTC, counted like GPST
    tb = GpsTime.normalized(clock.week, float(int((clock.tow_s + quarter / 2.0) // quarter)) * quarter)
    leap_s = GpsTime.from_utc(date) - clock
    midnight_s = tb.tow_s - tb.tow_s % SECONDS_PER_DAY
    sent_s = midnight_s + v[2] % SECONDS_PER_DAY
    sent_s -= SECONDS_PER_DAY * round((sent_s - tb.tow_s) / SECONDS_PER_DAY)
    extended = len(v) >= 19  # RINEX 3.05 has a fifth line: status, delay L2 - L1, index F_T, health
    channel = int(v[10])
    if channel > 128:  # some receivers write the channel as an unsigned byte
        channel -= 256
    return GlonassEphemeris(
        satellite=satellite, channel=channel if -7 <= channel <= 13 else NO_CHANNEL,
        iode=int((tb.tow_s + 10800.0) % SECONDS_PER_DAY // quarter),
        toe=tb + leap_s, transmitted=GpsTime.normalized(tb.week, sent_s) + leap_s, health=int(v[6]),
        accuracy_m=accuracy_m(GLONASS_FT_M, int(v[17])) if extended and 0.0 <= v[17] < 16.0 else _GLONASS_ACCURACY_M, age_days=int(v[14]),
        position_m=(v[3] * 1e3, v[7] * 1e3, v[11] * 1e3), velocity_mps=(v[4] * 1e3, v[8] * 1e3, v[12] * 1e3),
        acceleration_mps2=(v[5] * 1e3, v[9] * 1e3, v[13] * 1e3), tau_s=v[0], gamma=v[1],
        group_delay_s=v[16] if extended and abs(v[16]) < 1e-6 else 0.0,
    )  # fmt: skip


_BUILDERS: Final[dict[str, Callable[[int, datetime, list[float]], Ephemeris]]] = {
    "G": _gps,
    "R": _glonass,
    "E": _galileo,
    "C": _beidou,
    "J": _qzss,
    "I": _navic,
}


def _klobuchar(lines: list[tuple[str, str]]) -> list[KlobucharParameters]:
    """Return the complete alpha/beta pairs of the header, one per system, the last of each."""
    terms: dict[str, tuple[float, float, float, float]] = {}
    for content, label in lines:
        if label in ("ION ALPHA", "ION BETA"):
            terms["G" + label[4]] = _four(content, 2)
        elif label == "IONOSPHERIC CORR" and content[:4] in _KLOBUCHAR_LABELS:
            terms[_KLOBUCHAR_LABELS[content[:4]] + content[3]] = _four(content, 5)
    return [
        KlobucharParameters(system, terms[system + "A"], terms[system + "B"])
        for system in "GCJI"
        if system + "A" in terms and system + "B" in terms
    ]


_KLOBUCHAR_LABELS: Final = {
    label + term: letter for label, letter in (("GPS", "G"), ("BDS", "C"), ("QZS", "J"), ("IRN", "I")) for term in "AB"
}


def _four(content: str, start: int) -> tuple[float, float, float, float]:
    a, b, c, d = (number(content[start + 12 * k : start + 12 * (k + 1)]) for k in range(4))
    return a, b, c, d


def _leap_seconds(lines: list[tuple[str, str]]) -> int | None:
    for content, label in lines:
        if label == "LEAP SECONDS" and content[:6].strip():
            return integer(content[:6])
    return None
