"""Epochs to RINEX observation files, 3.05 and 4.00 (mixed, time system GPS).

The header names every type that occurs, so the epochs are seen twice: ``Survey`` learns what there is, then ``ObservationWriter`` gives
the header and one text per epoch. Phases are written as they are (SYS / PHASE SHIFT: none). LLI: bit 0 slip, bit 1 half cycle not
resolved. A value that F14.3 cannot hold, and 0, which RINEX takes for none, stay blank.
"""

from dataclasses import dataclass, field
from math import isfinite
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.codecs.rinex_observation_rows import FIELD, KINDS, PHASE, SATELLITE_WIDTH, write_rows
from rtkmesh.codecs.rinex_write import Origin, calendar_fields, first_lines, header_line
from rtkmesh.gnss.ephemeris import GlonassBias, ReferenceStation
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.signals import GLONASS, MAX_SATELLITE, MAX_SIGNAL, NO_CHANNEL, SATELLITES_PER_SYSTEM, SYSTEMS, satellite_id, signal_code
from rtkmesh.gnss.time import GpsTime, gps_minus_utc_s

_TYPES_PER_LINE: Final = 13
_SLOTS_PER_LINE: Final = 8
_TIME_DIGITS: Final = 7
_UNKNOWN: Final = "unknown"
_BIAS_CODES: Final = ("C1C", "C1P", "C2C", "C2P")


@dataclass(frozen=True, slots=True)
class Equipment:
    """What a file says of the station. ``approximate_ecef_m`` is written where the station has no position of its own."""

    marker: str = ""
    station: ReferenceStation | None = None
    approximate_ecef_m: tuple[float, float, float] | None = None
    bias: GlonassBias | None = None


@dataclass(slots=True)
class Survey:
    """What the epochs of a file hold."""

    first: GpsTime | None = None
    last: GpsTime | None = None
    epochs: int = 0
    _present: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((len(SYSTEMS), MAX_SIGNAL, len(KINDS)), np.bool_))
    _channel: NDArray[np.int8] = field(default_factory=lambda: np.full(MAX_SATELLITE, NO_CHANNEL, np.int8))
    _steps: dict[int, int] = field(default_factory=dict[int, int])

    def add(self, epoch: Epoch) -> None:
        """Take in one epoch."""
        if self.last is not None and 0.0 < epoch.time - self.last < 3600.0:
            step_ms = round((epoch.time - self.last) * 1e3)
            self._steps[step_ms] = self._steps.get(step_ms, 0) + 1
        self.first = epoch.time if self.first is None else min(self.first, epoch.time)
        self.last = epoch.time
        self.epochs += 1
        systems = epoch.satellite // SATELLITES_PER_SYSTEM
        for kind, values in enumerate((epoch.pseudorange_m, epoch.phase_cyc, epoch.doppler_hz, epoch.cn0_dbhz)):
            there = np.isfinite(values)
            self._present[systems[there], epoch.signal[there], kind] = True
        known = epoch.channel != NO_CHANNEL
        self._channel[epoch.satellite[known]] = epoch.channel[known]

    @property
    def period_s(self) -> float | None:
        """The commonest step between epochs."""
        return max(self._steps, key=self._steps.__getitem__) / 1e3 if self._steps else None

    @property
    def types(self) -> dict[str, list[tuple[int, int]]]:
        """(signal, kind) of each type by system letter, in the order of the signals."""
        rows = {letter: [(int(s), int(k)) for s, k in np.argwhere(self._present[system])] for system, letter in enumerate(SYSTEMS)}
        return {letter: pairs for letter, pairs in rows.items() if pairs}

    @property
    def channels(self) -> dict[str, int]:
        """GLONASS channel by satellite id."""
        slots = range(GLONASS * SATELLITES_PER_SYSTEM, (GLONASS + 1) * SATELLITES_PER_SYSTEM)
        return {satellite_id(slot): int(self._channel[slot]) for slot in slots if self._channel[slot] != NO_CHANNEL}


class ObservationWriter:
    """Writes the epochs that a survey has seen."""

    def __init__(self, survey: Survey, origin: Origin, equipment: Equipment) -> None:
        self._survey, self._origin, self._equipment = survey, origin, equipment
        self._field = np.full((len(SYSTEMS), MAX_SIGNAL, len(KINDS)), -1, np.int64)
        self._types = survey.types
        for letter, pairs in self._types.items():
            for place, (signal, kind) in enumerate(pairs):
                self._field[SYSTEMS.index(letter), signal, kind] = place
        self._width = SATELLITE_WIDTH + FIELD * max(map(len, self._types.values()), default=0) + 1

    def header(self) -> str:
        """Return the header."""
        version4 = self._origin.version >= 4.0
        return "".join((
            first_lines(self._origin, "OBSERVATION DATA"), self._station_lines(), self._type_lines(),
            header_line("DBHZ", "SIGNAL STRENGTH UNIT"), self._time_lines(), "" if version4 else self._shift_lines(), self._glonass_lines(),
            self._leap_line(), header_line("", "END OF HEADER"),
        ))  # fmt: skip

    def epoch(self, epoch: Epoch) -> bytes:
        """Return the lines of an epoch; nothing if none of its values can be written."""
        satellites = len(np.unique(epoch.satellite))
        out = np.full(satellites * self._width, ord(" "), np.uint8)
        values = np.array((epoch.pseudorange_m, epoch.phase_cyc, epoch.doppler_hz, epoch.cn0_dbhz))
        length, count = write_rows(epoch.satellite, epoch.signal, epoch.flags, values, self._field, out)
        if not count:
            return b""
        year, month, day, hour, minute, second, rest = calendar_fields(epoch.time, _TIME_DIGITS)
        head = f"> {year:4d} {month:02d} {day:02d} {hour:02d} {minute:02d} {second:2d}.{rest:07d}  0{count:3d}\n"
        return head.encode("ascii") + out[:length].tobytes()

    def _station_lines(self) -> str:
        equipment, station = self._equipment, self._equipment.station or ReferenceStation(0)
        x, y, z = station.position_ecef_m or equipment.approximate_ecef_m or (0.0, 0.0, 0.0)
        # The position is that of the antenna reference point, so that point is the marker: the height of 1006 is not added again.
        return "".join((
            header_line(equipment.marker or _UNKNOWN, "MARKER NAME"), header_line("", "MARKER NUMBER"),
            header_line("GEODETIC" if station.position_ecef_m else "UNKNOWN", "MARKER TYPE"), header_line("", "OBSERVER / AGENCY"),
            header_line(f"{'':20}{station.receiver:<20.20}", "REC # / TYPE / VERS"),
            header_line(f"{station.antenna_serial:<20.20}{station.antenna:<20.20}", "ANT # / TYPE"),
            header_line(f"{x:14.4f}{y:14.4f}{z:14.4f}", "APPROX POSITION XYZ"),
            header_line(f"{0.0:14.4f}{0.0:14.4f}{0.0:14.4f}", "ANTENNA: DELTA H/E/N"),
        ))  # fmt: skip

    def _type_lines(self) -> str:
        lines: list[str] = []
        for letter, pairs in self._types.items():
            names = [KINDS[kind] + signal_code(signal) for signal, kind in pairs]
            for first in range(0, len(names), _TYPES_PER_LINE):
                head = f"{letter}  {len(names):3d}" if first == 0 else " " * 6
                lines.append(
                    header_line(head + "".join(f" {name}" for name in names[first : first + _TYPES_PER_LINE]), "SYS / # / OBS TYPES")
                )
        return "".join(lines)

    def _time_lines(self) -> str:
        survey, lines = self._survey, list[str]()
        if survey.period_s is not None:
            lines.append(header_line(f"{survey.period_s:10.3f}", "INTERVAL"))
        for time, label in ((survey.first, "TIME OF FIRST OBS"), (survey.last, "TIME OF LAST OBS")):
            if time is not None:
                year, month, day, hour, minute, second, rest = calendar_fields(time, _TIME_DIGITS)
                date = f"{year:6d}{month:6d}{day:6d}{hour:6d}{minute:6d}{second:5d}.{rest:07d}"
                lines.append(header_line(f"{date}     GPS", label))
        return "".join(lines)

    def _shift_lines(self) -> str:
        """Every phase is as its pseudorange's carrier has it: no shift (a blank correction means 0)."""
        phases = ((letter, signal) for letter, pairs in self._types.items() for signal, kind in pairs if kind == PHASE)
        return "".join(header_line(f"{letter} L{signal_code(signal)}", "SYS / PHASE SHIFT") for letter, signal in phases)

    def _glonass_lines(self) -> str:
        if "R" not in self._types:
            return ""
        channels = list(self._survey.channels.items())
        lines: list[str] = []
        for first in range(0, max(len(channels), 1), _SLOTS_PER_LINE):
            head = f"{len(channels):3d} " if first == 0 else " " * 4
            slots = "".join(f"{name} {channel:2d} " for name, channel in channels[first : first + _SLOTS_PER_LINE])
            lines.append(header_line(head + slots, "GLONASS SLOT / FRQ #"))
        bias = self._equipment.bias
        known = bias is not None and any(map(isfinite, bias.bias_m))
        values = bias.bias_m if bias is not None and known else (0.0,) * 4
        content = "".join(f" {code} {value if isfinite(value) else 0.0:8.3f}" for code, value in zip(_BIAS_CODES, values, strict=True))
        return "".join(lines) + header_line(content if known else "", "GLONASS COD/PHS/BIS")

    def _leap_line(self) -> str:
        return "" if self._survey.first is None else header_line(f"{gps_minus_utc_s(self._survey.first):6d}", "LEAP SECONDS")
