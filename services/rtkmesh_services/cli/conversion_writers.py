"""The formats of ``rtkmesh convert``: each takes messages and makes one file, or two for RINEX."""

import csv
import io
from collections.abc import Callable
from dataclasses import fields
from datetime import UTC, datetime
from math import isnan
from pathlib import Path
from typing import Any, Final

import msgspec

from rtkmesh import __version__
from rtkmesh.codecs.messages import Message
from rtkmesh.codecs.rinex_navigation_write import navigation_header, navigation_record
from rtkmesh.codecs.rinex_observation_write import Equipment, ObservationWriter, Survey
from rtkmesh.codecs.rinex_write import Origin
from rtkmesh.codecs.rtcm3_base import BaseEncoder, BaseOptions
from rtkmesh.gnss.ephemeris import (
    Ephemeris,
    GlonassBias,
    GlonassEphemeris,
    KeplerEphemeris,
    KlobucharParameters,
    NavigationMessage,
    ReceiverFix,
    ReferenceStation,
)
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Epoch
from rtkmesh.gnss.frames import ecef_from_geodetic
from rtkmesh.gnss.signals import satellite_id, signal_code
from rtkmesh.gnss.time import GpsTime, gps_minus_utc_s
from rtkmesh_services.cli.spool import Spool
from rtkmesh_services.cli.written_files import WrittenFile

Watch = Callable[[float], None]
Vector = tuple[float, float, float]

_VALUES: Final = ("pseudorange_m", "phase_cyc", "doppler_hz", "cn0_dbhz", "lock_s", "pseudorange_sigma_m", "phase_sigma_cyc")
_COLUMNS: Final = ("week", "tow_s", "satellite", "signal", *_VALUES, "slip", "half_cycle")


class StreamWriter:
    """A file that grows with every message. ``encode`` gives the bytes of a message, ``end`` those behind the last one."""

    def __init__(self, path: Path, encode: Callable[[Message], bytes], end: Callable[[], bytes] = bytes, head: bytes = b"") -> None:
        self._file, self._encode, self._end = WrittenFile(path), encode, end
        self._file.write(head)
        self._head = len(head)

    def take(self, message: Message) -> None:
        """Write a message."""
        if data := self._encode(message):
            self._file.write(data)

    def finish(self, watch: Watch) -> list[tuple[Path, int]]:
        """Write the end; without any content there is no file."""
        self._file.write(self._end())
        if self._file.size == self._head:
            self.abandon()
            return []
        with self._file:
            watch(1.0)
        return [(self._file.path, self._file.size)]

    def abandon(self) -> None:
        """Leave no file."""
        self._file.drop()


class RinexWriter:
    """An observation file and a navigation file. Epochs wait in a temporary file until it is known which types there are."""

    def __init__(self, observations: Path, navigation: Path, version: float, marker: str, comments: tuple[str, ...]) -> None:
        self._paths = observations, navigation
        self._origin = Origin(version, f"rtkmesh {__version__}", datetime.now(UTC), comments)
        self._marker = marker
        self._spool, self._survey = Spool[Epoch](), Survey()
        self._records: list[Ephemeris] = []
        self._ionosphere: dict[str, KlobucharParameters] = {}
        self._station: ReferenceStation | None = None
        self._bias: GlonassBias | None = None
        self._approximate: Vector | None = None

    def take(self, message: Message) -> None:
        """Keep a message."""
        if isinstance(message, Epoch):
            self._survey.add(message)
            self._spool.append(message)
        elif isinstance(message, KeplerEphemeris | GlonassEphemeris):
            self._records.append(message)
        elif isinstance(message, KlobucharParameters):
            self._ionosphere[message.system] = message
        elif isinstance(message, ReferenceStation):
            self._station = message
        elif isinstance(message, GlonassBias):
            self._bias = message
        elif isinstance(message, ReceiverFix) and self._approximate is None and message.fix >= 3:
            self._approximate = _ecef_of(message)

    def finish(self, watch: Watch) -> list[tuple[Path, int]]:
        """Write both files, as far as there is something for them."""
        written: list[tuple[Path, int]] = []
        if len(self._spool):
            written.append(self._write_observations(watch))
        if self._records:
            written.append(self._write_navigation())
        self.abandon()
        return written

    def abandon(self) -> None:
        """Give the temporary file back."""
        self._spool.close()

    def _write_observations(self, watch: Watch) -> tuple[Path, int]:
        writer = ObservationWriter(self._survey, self._origin, Equipment(self._marker, self._station, self._approximate, self._bias))
        with WrittenFile(self._paths[0]) as file:
            file.write(writer.header().encode("ascii", "replace"))
            for number, epoch in enumerate(self._spool.forward()):
                file.write(writer.epoch(epoch))
                if number % 64 == 0:
                    watch(number / len(self._spool))
        return file.path, file.size

    def _write_navigation(self) -> tuple[Path, int]:
        leap_s = gps_minus_utc_s(self._records[-1].toe)
        with WrittenFile(self._paths[1]) as file:
            file.write(navigation_header(self._origin, self._ionosphere.values(), leap_s).encode("ascii", "replace"))
            for ephemeris in self._records:
                file.write(navigation_record(ephemeris, self._origin.version).encode("ascii"))
        return file.path, file.size


def rtcm3_writer(path: Path, options: BaseOptions) -> StreamWriter:
    """Return a writer of the stream of a base station."""
    encoder = BaseEncoder(options)
    return StreamWriter(path, lambda message: b"".join(encoder.take(message)), lambda: b"".join(encoder.flush()))


def json_writer(path: Path) -> StreamWriter:
    """Return a writer of one JSON object per message and line."""
    return StreamWriter(path, lambda message: msgspec.json.encode(message_fields(message)) + b"\n")


def csv_writer(path: Path) -> StreamWriter:
    """Return a writer of one line per observation; other messages are left out."""
    return StreamWriter(path, _csv_lines, head=(",".join(_COLUMNS) + "\n").encode())


def message_fields(message: Message) -> dict[str, Any]:
    """Return a message as JSON has it: its kind, names for satellites and signals, [week, seconds] for times, null for unknown."""
    if isinstance(message, Epoch):
        return {"message": "epoch", "week": message.time.week, "tow_s": message.time.tow_s, "observations": _observations(message)}
    content = {field.name: _plain(getattr(message, field.name)) for field in fields(message)}
    if isinstance(message, KeplerEphemeris | GlonassEphemeris):
        content["satellite"] = satellite_id(message.satellite)
    return {
        "message": _KINDS.get(type(message), "receiver_report"),
        **({"navigation": content.pop("message")} if "message" in content else {}),
        **content,
    }


_KINDS: Final[dict[type, str]] = {
    KeplerEphemeris: "ephemeris",
    GlonassEphemeris: "glonass_ephemeris",
    KlobucharParameters: "ionosphere",
    ReferenceStation: "station",
    GlonassBias: "glonass_bias",
    ReceiverFix: "receiver_fix",
}


def _plain(value: Any) -> Any:
    if isinstance(value, GpsTime):
        return [value.week, value.tow_s]
    return value.name if isinstance(value, NavigationMessage) else value


def _observations(epoch: Epoch) -> list[dict[str, Any]]:
    return [dict(zip(_COLUMNS[2:], row, strict=True)) for row in _rows(epoch)]


def _rows(epoch: Epoch) -> list[tuple[Any, ...]]:
    """Return (satellite, signal, values, slip, half cycle) of each observation."""
    flags = epoch.flags.tolist()
    columns = (getattr(epoch, name).tolist() for name in _VALUES)
    names = map(satellite_id, epoch.satellite.tolist()), map(signal_code, epoch.signal.tolist())
    return list(zip(*names, *columns, (bool(f & SLIP) for f in flags), (bool(f & HALF_CYCLE) for f in flags), strict=True))


def _csv_lines(message: Message) -> bytes:
    if not isinstance(message, Epoch):
        return b""
    text, time = io.StringIO(), (message.time.week, message.time.tow_s)
    lines = csv.writer(text, lineterminator="\n")
    lines.writerows((*time, *(_cell(value) for value in row)) for row in _rows(message))
    return text.getvalue().encode()


def _cell(value: Any) -> Any:
    if isinstance(value, bool):
        return int(value)
    return "" if isinstance(value, float) and isnan(value) else value


def _ecef_of(fix: ReceiverFix) -> Vector:
    x, y, z = ecef_from_geodetic(fix.lat_rad, fix.lon_rad, fix.height_m).tolist()
    return x, y, z
