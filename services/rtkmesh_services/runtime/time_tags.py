"""When the bytes of a log arrived: RTKLIB's ``.tag`` (2.4.3 and demo5) and our recorder's ``.times``.

A ``.tag`` has a header of 64 bytes (its last 4: milliseconds of the host since its start), the start in GPS time counted from 1970
(whole seconds as u32, fraction as f64), then records of milliseconds since the start (u32) and bytes of the log that had been
written by then (u32, or u64 for large logs). Little-endian, as on every host that RTKLIB runs on today. A ``.times`` has a line per
frame: sequence, UTC ns, monotonic ns, bytes.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import accumulate, pairwise
from typing import Final

from rtkmesh.gnss.time import GpsTime

TITLE: Final = b"TIMETAG RTKLIB"
_HEADER: Final = struct.Struct("<60sIId")
_RECORDS: Final = (struct.Struct("<II"), struct.Struct("<IQ"))
_UNIX_ORIGIN: Final = datetime(1970, 1, 1, tzinfo=UTC)
_LARGEST_SMALL: Final = 0xFFFFFFFF


@dataclass(frozen=True, slots=True)
class TimeTags:
    """Bytes up to ``offsets[k]`` had arrived ``instants_s[k]`` after ``start``; both never fall."""

    start: GpsTime
    instants_s: Sequence[float]
    offsets: Sequence[int]

    def time(self, index: int) -> GpsTime:
        """Return the instant of a record in GPS time, by the clock of the host that recorded."""
        return self.start + self.instants_s[index]


def parse_tag(data: bytes, log_bytes: int) -> TimeTags | None:
    """Return what a ``.tag`` of a log of so many bytes says, None if it is none; a record that was cut short is left out."""
    if not data.startswith(TITLE) or len(data) < _HEADER.size:
        return None
    _, _, seconds, fraction = _HEADER.unpack_from(data)
    if not 0.0 <= fraction < 1.0:
        return None
    start = _from_gpst(seconds) + fraction
    for record in _RECORDS:
        count = (len(data) - _HEADER.size) // record.size
        rows = list(record.iter_unpack(data[_HEADER.size : _HEADER.size + count * record.size]))
        if _rises([row[0] for row in rows]) and _rises([row[1] for row in rows]) and (not rows or rows[-1][1] <= log_bytes):
            return TimeTags(start, [row[0] * 1e-3 for row in rows], [row[1] for row in rows])
    return None


def parse_times(text: bytes) -> TimeTags | None:
    """Return what a ``.times`` says, None if it is none; a line that was cut short is left out."""
    rows: list[list[int]] = []
    for line in text[: text.rfind(b"\n") + 1].splitlines():
        fields = line.split()
        if len(fields) != 4 or not all(field.lstrip(b"-").isdigit() and len(field) < 21 for field in fields):
            return None
        rows.append([int(field) for field in fields])
    if not rows:
        return None
    first = rows[0]
    offsets = list(accumulate(row[3] for row in rows))
    instants_s = [(row[2] - first[2]) * 1e-9 for row in rows]
    if not (_rises(instants_s) and _rises(offsets) and abs(first[1]) < 1 << 62):
        return None
    return TimeTags(GpsTime.from_utc(_UNIX_ORIGIN + timedelta(microseconds=first[1] // 1000)), instants_s, offsets)


class TagWriter:
    """The bytes of a ``.tag``: a header, then a record after each write to the log."""

    def __init__(self, utc_ns: int, mono_ns: int, *, large: bool = False) -> None:
        self._mono_ns, self._record = mono_ns, _RECORDS[large]
        gpst = GpsTime.from_utc(_UNIX_ORIGIN + timedelta(microseconds=utc_ns // 1000)).to_calendar() - _UNIX_ORIGIN
        seconds = gpst.days * 86400 + gpst.seconds
        self.header = _HEADER.pack(TITLE + b" rtkmesh", mono_ns // 1_000_000 & 0xFFFFFFFF, seconds, gpst.microseconds * 1e-6)

    def record(self, mono_ns: int, log_bytes: int) -> bytes:
        """Return the record after a write; nothing where the log has outgrown its records."""
        if self._record is _RECORDS[0] and log_bytes > _LARGEST_SMALL:
            return b""
        return self._record.pack(max(0, mono_ns - self._mono_ns) // 1_000_000 & 0xFFFFFFFF, log_bytes)


def _from_gpst(seconds: int) -> GpsTime:
    date = _UNIX_ORIGIN + timedelta(seconds=seconds)
    return GpsTime.from_calendar(date.year, date.month, date.day, date.hour, date.minute, date.second)


def _rises(values: Sequence[float]) -> bool:
    return all(a <= b for a, b in pairwise(values))
