"""RINEX observation files 2.00 to 2.12, 3.00 to 3.05 and 4.0x: text to epochs.

Sources: RINEX 2.11 (Gurtner, Estey 2007) and RINEX 3.05 (IGS/RTCM 2020). Missing observations (blank or zero) are NaN.
Phases are taken as they stand: RINEX 3 says that SYS / PHASE SHIFT is already applied. LLI bit 0 is SLIP, bit 1 HALF_CYCLE (also
in RINEX 2, as every receiver of today writes it; WAVELENGTH FACT, for codeless squaring receivers, is not followed).
A signal strength digit stands in for C/N0 only where there is no S observation.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.codecs.messages import DecodingCounters
from rtkmesh.codecs.rinex_header import as_bytes, header_lines, integer, number, version_and_type
from rtkmesh.codecs.rinex_rows import fill_rows, observation_layout, stack_layouts
from rtkmesh.errors import FormatError
from rtkmesh.gnss.constants import BDT_MINUS_GPST_S
from rtkmesh.gnss.ephemeris import ReferenceStation
from rtkmesh.gnss.epoch import SLIP, Epoch
from rtkmesh.gnss.frames import enu_from_ecef_at
from rtkmesh.gnss.signals import GLONASS, MAX_SATELLITE, NO_CHANNEL, SATELLITES_PER_SYSTEM, SYSTEMS, satellite_number
from rtkmesh.gnss.time import GpsTime

_TIME_SYSTEM_OF: Final = {"R": "GLO", "E": "GAL", "C": "BDT", "J": "QZS", "I": "IRN"}
_POWER_FAILURE, _FIRST_EVENT, _SLIP_RECORDS = 1, 2, 6  # epoch flags (RINEX 3.05 table A3)
_SATELLITES_PER_LINE: Final = 12  # of a RINEX 2 epoch line
_V2_FIELDS_PER_LINE: Final = 5
_MAX_SATELLITES: Final = 400  # no receiver has so many: a larger count is damage


@dataclass(frozen=True, slots=True)
class ObservationHeader:
    """What the header says. ``observables`` are the type names per system letter as written; ``position_ecef_m`` is the marker's.

    ``antenna_delta_hen_m``: height, east, north of the antenna reference point above the marker. None and "" where not said.
    """

    version: float
    system: str
    time_system: str
    observables: dict[str, tuple[str, ...]]
    scale_factors: dict[tuple[str, str], float]
    glonass_channels: dict[int, int]
    marker: str = ""
    receiver: str = ""
    antenna: str = ""
    antenna_serial: str = ""
    position_ecef_m: tuple[float, float, float] | None = None
    antenna_delta_hen_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    interval_s: float | None = None

    def station(self) -> ReferenceStation:
        """Return the antenna reference point and the equipment."""
        return ReferenceStation(
            0, self._reference_point(), self.antenna_delta_hen_m[0], self.antenna, self.antenna_serial, self.receiver, "rinex"
        )

    def _reference_point(self) -> tuple[float, float, float] | None:
        if self.position_ecef_m is None or self.antenna_delta_hen_m == (0.0, 0.0, 0.0):
            return self.position_ecef_m
        height, east, north = self.antenna_delta_hen_m
        marker = np.array(self.position_ecef_m)
        x, y, z = (marker + enu_from_ecef_at(marker).T @ np.array([east, north, height])).tolist()
        return x, y, z


class ObservationReader:
    """The epochs of one RINEX observation file, in the order of the file.

    ``header`` follows the header lines that events in the file bring; ``position`` is the number of bytes read so far;
    ``counters`` says what was read, skipped (``ignored``: event records) and refused (``rejected``). FormatError if
    the text is no RINEX observation file.
    """

    def __init__(self, text: str | bytes) -> None:
        self._text = as_bytes(text)
        lines, offset = header_lines(self._text)
        self.header = _parse_header(lines, None)
        self.counters = DecodingCounters()
        self.position = offset
        self._buffer = np.frombuffer(self._text, np.uint8)
        stops = np.flatnonzero(self._buffer[offset:] == ord("\n")) + offset
        if len(self._text) > offset and self._text[-1:] != b"\n":
            stops = np.append(stops, len(self._text))
        self._starts = np.concatenate((np.array([offset], stops.dtype), stops[:-1] + 1)) if len(stops) else stops
        self._stops = stops - (self._buffer[stops - 1] == ord("\r"))
        self._carrier = np.zeros((MAX_SATELLITE, 10), np.int8)
        self._days: dict[bytes, GpsTime] = {}
        self._satellites: dict[bytes, int] = {}
        self._seen: tuple[list[bytes], NDArray[np.int16], NDArray[np.int64], list[str]] = [], *self._sorted([])
        self._use_layout()

    def __iter__(self) -> Iterator[Epoch]:
        line = 0
        version_2 = self.header.version < 3.0
        while line < len(self._starts):
            line, epoch = self._read_v2(line) if version_2 else self._read_v3(line)
            self.position = int(self._starts[line]) if line < len(self._starts) else len(self._text)
            if epoch is not None:
                self.counters.epochs += 1
                self.counters.decoded["rinex/epoch"] += 1
                yield epoch

    def _use_layout(self) -> None:
        header = self.header
        layouts = [observation_layout(header.version, system, header.observables, header.scale_factors) for system in SYSTEMS]
        self._tables = stack_layouts(layouts)
        self._v2_lines = -(-len(header.observables.get(header.system, ())) // _V2_FIELDS_PER_LINE)
        self._channel = np.full(MAX_SATELLITE, NO_CHANNEL, np.int8)
        for satellite, channel in header.glonass_channels.items():
            self._channel[satellite] = channel

    def _line(self, index: int) -> bytes:
        return self._text[self._starts[index] : self._stops[index]]

    def _refuse(self, reason: str) -> None:
        self.counters.rejected[f"rinex/{reason}"] += 1

    def _read_v3(self, line: int) -> tuple[int, Epoch | None]:
        """Return the next line to read and the epoch that begins at ``line``, if one does."""
        text = self._line(line)
        if not text.startswith(b">"):
            if text.strip():
                self._refuse("stray line")
            return line + 1, None
        flag, count = integer(text[31:32].decode("latin-1")), integer(text[32:35].decode("latin-1"), -1)
        if not 0 <= count <= _MAX_SATELLITES:
            self._refuse("epoch line")
            return line + 1, None
        behind = line + 1 + count
        if behind > len(self._starts):
            self._refuse("truncated epoch")
            return line + 1, None
        if flag >= _FIRST_EVENT:
            self._event(flag, line + 1, behind)
            return behind, None
        time = self._time(text[2:29], text[2:6])
        if time is None:
            self._refuse("epoch line")
            return line + 1, None
        names = [self._text[start : start + 3] for start in self._starts[line + 1 : behind].tolist()]
        return behind, self._epoch(time, flag, names, range(line + 1, behind), 3, 0)

    def _read_v2(self, line: int) -> tuple[int, Epoch | None]:
        """Return the next line to read and the epoch that begins at ``line``, if one does."""
        text = self._line(line)
        flag, count = integer(text[26:29].decode("latin-1"), -1), integer(text[29:32].decode("latin-1"), -1)
        if not 0 <= flag <= _SLIP_RECORDS or not 0 <= count <= _MAX_SATELLITES:
            if text.strip():
                self._refuse("epoch line")
            return line + 1, None
        if _FIRST_EVENT <= flag < _SLIP_RECORDS:
            behind = min(line + 1 + count, len(self._starts))
            self._event(flag, line + 1, behind)
            return behind, None
        first = line + max(1, -(-count // _SATELLITES_PER_LINE))
        behind = first + count * self._v2_lines
        time = self._time(text[:26], text[1:3])
        if time is None or behind > len(self._starts):
            self._refuse("epoch line" if time is None else "truncated epoch")
            return line + 1, None
        if flag == _SLIP_RECORDS:
            self._event(flag, first, behind)
            return behind, None
        names = [name for index in range(line, first) for name in _names_v2(self._line(index))][:count]
        return behind, self._epoch(time, flag, names, range(first, behind, max(1, self._v2_lines)), 0, _V2_FIELDS_PER_LINE)

    def _time(self, text: bytes, year: bytes) -> GpsTime | None:
        """Return GPST of the date in an epoch line (its last 17 characters are the time of day), None where it is none."""
        try:
            day = self._days.get(text[:-17]) or self._day(text[:-17], int(year))
            seconds = int(text[-17:-14]) * 3600 + int(text[-14:-11]) * 60 + float(text[-11:])
        except ValueError:
            return None
        return day + seconds if 0.0 <= seconds < 86402.0 else None

    def _day(self, text: bytes, year: int) -> GpsTime:
        if year < 100:
            year += 2000 if year < 80 else 1900
        _, month, day_of_month = text.split()
        midnight = datetime(year, int(month), int(day_of_month), tzinfo=UTC)
        if not 1980 <= year < 2100:
            raise ValueError(f"{year} is no year of GNSS")
        day = _gpst(midnight, self.header.time_system)
        if len(self._days) < 1000:
            self._days[text] = day
        return day

    def _epoch(self, time: GpsTime, flag: int, names: list[bytes], lines: range, skip: int, per_line: int) -> Epoch | None:
        """Return the epoch of these satellites, each beginning at its line; of a satellite that is there twice the first counts."""
        if names != self._seen[0]:  # most epochs have the satellites of the one before
            self._seen = names, *self._sorted(names)
        _, satellites, order, refused = self._seen
        for reason in refused:
            self._refuse(reason)
        first_line = lines.start + lines.step * order
        size = len(satellites) * self._tables.signals.shape[1]
        row_satellite, row_signal = np.empty(size, np.int16), np.empty(size, np.int16)
        row_flags, values = np.empty(size, np.uint8), np.empty((4, size))
        count = fill_rows(
            self._buffer, self._starts, self._stops, satellites, first_line, skip, per_line, *self._tables,
            self._carrier, row_satellite, row_signal, row_flags, values,
        )  # fmt: skip
        if flag == _POWER_FAILURE:
            row_flags[:count] |= SLIP
        unknown = np.full((3, count), np.nan)
        row_satellite = row_satellite[:count]
        return Epoch(
            time, row_satellite, row_signal[:count], self._channel[row_satellite], row_flags[:count],
            values[0, :count], values[1, :count], values[2, :count], values[3, :count], unknown[0], unknown[1], unknown[2],
        )  # fmt: skip

    def _sorted(self, names: list[bytes]) -> tuple[NDArray[np.int16], NDArray[np.int64], list[str]]:
        """Return the satellites of these names in rising order, which name is whose, and why others are refused."""
        place_of: dict[int, int] = {}
        refused: list[str] = []
        for place, name in enumerate(names):
            satellite = self._satellite(name)
            if satellite and satellite not in place_of:
                place_of[satellite] = place
            else:
                refused.append("satellite twice" if satellite else "satellite id")
        satellites = sorted(place_of)
        return np.array(satellites, np.int16), np.array([place_of[satellite] for satellite in satellites], np.int64), refused

    def _satellite(self, name: bytes) -> int:
        """Return the number of a satellite name (a blank system is the file's), 0 if it is none."""
        known = self._satellites.get(name)
        if known is None:
            text = name.decode("latin-1")
            if text[:1] == " ":
                text = (self.header.system if self.header.system in SYSTEMS else "G") + text[1:]
            try:
                known = satellite_number(text)
            except ValueError:
                known = 0
            if len(self._satellites) < MAX_SATELLITE * 4:
                self._satellites[name] = known
        return known

    def _event(self, flag: int, first: int, behind: int) -> None:
        """Take over the header lines that an event brings; count the event."""
        self.counters.ignored[f"rinex/event {flag}"] += 1
        if flag == _SLIP_RECORDS:  # slips that the receiver has repaired
            return
        lines = [self._line(index).decode("latin-1") for index in range(first, behind)]
        changes = [(text[:60], text[60:].strip()) for text in lines]
        try:
            self.header = _parse_header(changes, self.header)
        except FormatError:
            self._refuse("event header")
        self._use_layout()


def _names_v2(line: bytes) -> list[bytes]:
    return [line[column : column + 3] for column in range(32, 32 + 3 * _SATELLITES_PER_LINE, 3)]


def _gpst(midnight: datetime, time_system: str) -> GpsTime:
    if time_system == "GLO":  # GLONASS time in RINEX is UTC without the three hours
        return GpsTime.from_utc(midnight)
    day = GpsTime.from_calendar(midnight.year, midnight.month, midnight.day)
    return day + -BDT_MINUS_GPST_S if time_system == "BDT" else day


def _parse_header(lines: list[tuple[str, str]], before: ObservationHeader | None) -> ObservationHeader:
    """Return the header of these lines, on top of the header before an event."""
    header = before or _empty_header(lines)
    changes: dict[str, Any] = {}
    for content, label in lines:
        if (field := _FIELDS.get(label)) is not None:
            changes |= field(content)
        elif label == "TIME OF FIRST OBS" and content[48:51].strip():
            changes["time_system"] = content[48:51].strip()
    if observables := _observables(lines, header):
        changes["observables"] = header.observables | observables
    changes["scale_factors"] = header.scale_factors | _scale_factors(lines)
    changes["glonass_channels"] = header.glonass_channels | _glonass_channels(lines)
    header = replace(header, **changes)
    if not header.observables:
        raise FormatError("the header names no observation types")
    return header


def _empty_header(lines: list[tuple[str, str]]) -> ObservationHeader:
    version, kind, system = version_and_type(lines[0][0])
    if kind != "O":
        raise FormatError(f"file type {kind!r} is no observation file")
    return ObservationHeader(version, system, _TIME_SYSTEM_OF.get(system, "GPS"), {}, {}, {})


def _position(content: str) -> dict[str, Any]:
    x, y, z = (number(content[column : column + 14]) for column in (0, 14, 28))
    return {"position_ecef_m": (x, y, z) if (x, y, z) != (0.0, 0.0, 0.0) else None}


_FIELDS: Final[dict[str, Callable[[str], dict[str, Any]]]] = {
    "MARKER NAME": lambda content: {"marker": content.strip()},
    "REC # / TYPE / VERS": lambda content: {"receiver": content[20:40].strip()},
    "ANT # / TYPE": lambda content: {"antenna_serial": content[:20].strip(), "antenna": content[20:40].rstrip()},
    "APPROX POSITION XYZ": _position,
    "ANTENNA: DELTA H/E/N": lambda content: {"antenna_delta_hen_m": (number(content[:14]), number(content[14:28]), number(content[28:42]))},
    "INTERVAL": lambda content: {"interval_s": number(content[:10]) or None},
}


def _observables(lines: list[tuple[str, str]], header: ObservationHeader) -> dict[str, tuple[str, ...]]:
    """Return the observation types per system; in RINEX 2 one list holds for all systems of the file."""
    if header.version < 3.0:
        names = [name for content, label in lines if label == "# / TYPES OF OBSERV" for name in content[6:].split()]
        return dict.fromkeys({*SYSTEMS, header.system}, tuple(names)) if names else {}
    types: dict[str, list[str]] = {}
    system = ""
    for content, label in lines:
        if label == "SYS / # / OBS TYPES":
            if content[:1].strip():
                system = content[:1]
                types[system] = []
            if system:
                types[system] += content[7:].split()
    return {system: tuple(names) for system, names in types.items()}


def _scale_factors(lines: list[tuple[str, str]]) -> dict[tuple[str, str], float]:
    """Return the factors that stored observations are to be divided by; type "" stands for all types of a system."""
    factors: dict[tuple[str, str], float] = {}
    system, factor = "", 1.0
    for content, label in lines:
        if label == "SYS / SCALE FACTOR":
            if content[:1].strip():
                system, factor = content[0], number(content[2:6], 1.0) or 1.0
            for name in content[10:].split() or [""]:
                factors[system, name] = factor
    return factors


def _glonass_channels(lines: list[tuple[str, str]]) -> dict[int, int]:
    channels: dict[int, int] = {}
    for content, label in lines:
        if label == "GLONASS SLOT / FRQ #":
            for column in range(4, 60, 7):
                slot, channel = integer(content[column + 1 : column + 3]), integer(content[column + 4 : column + 6], NO_CHANNEL)
                if 0 < slot < SATELLITES_PER_SYSTEM and -7 <= channel <= 13:
                    channels[GLONASS * SATELLITES_PER_SYSTEM + slot] = channel
    return channels
