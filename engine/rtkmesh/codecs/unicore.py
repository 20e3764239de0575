"""Unicore N4 receivers (UM980, UM982): observations of either antenna, ephemerides, their own positions and headings (N4 manual R1.13).

OBSVM or OBSVH and their compressed forms, GPSEPH, QZSSEPH, BDSEPH, GALEPH, GLOEPH, BESTNAV or BESTNAVH, UNIHEADING, VERSION; binary and
ASCII. All other logs are counted as ignored.
"""

from math import cos, hypot, isfinite, nan, radians, sin
from typing import Final

import numpy as np

from rtkmesh.codecs.messages import DecodingCounters, Frame, Message, Protocol
from rtkmesh.codecs.unicore_ephemeris import READERS, read_ephemeris
from rtkmesh.codecs.unicore_logs import POSITION_TYPE, SOLUTION_STATUS, Fields, Log, Value, open_log
from rtkmesh.codecs.unicore_observations import (
    COMPRESSED_BYTES,
    FULL,
    FULL_FIELDS,
    MAX_COMPRESSED_LOCK_S,
    MAX_LOCK_S,
    VALUES,
    Measurements,
    epoch_of,
    full_measurements,
    new_slip_state,
    read_compressed,
)
from rtkmesh.gnss.ephemeris import ReceiverFix
from rtkmesh.gnss.receiver import CarrierSolution, ReceiverHeading, ReceiverVersion

MAIN_ANTENNA, SECOND_ANTENNA = 1, 2

_COMPUTED: Final = SOLUTION_STATUS["SOL_COMPUTED"]
_NONE: Final = POSITION_TYPE["NONE"]
_FIXED: Final = frozenset(POSITION_TYPE[name] for name in ("L1_INT", "WIDE_INT", "NARROW_INT", "INS_RTKFIXED"))
_FLOAT: Final = frozenset(POSITION_TYPE[name] for name in ("L1_FLOAT", "IONOFREE_FLOAT", "NARROW_FLOAT", "INS_RTKFLOAT"))
# Position type to ReceiverFix.fix; types that are not here are no fix.
_FIX_OF_TYPE: Final = {
    1: 3, 16: 3, 17: 4, 18: 4, 32: 5, 33: 5, 34: 5, 48: 6, 49: 6, 50: 6, 52: 1, 53: 3, 54: 4, 55: 5, 56: 6, 68: 4, 69: 4,
}  # fmt: skip

# Fields by name where they are used; the layouts are those of the binary logs.
UNIHEADING: Final = Fields("IIffffff4sBBBBBBBB")
BESTNAV: Final = Fields("IIdddfIfff4sffBBBBBBBBIIffdddff")
VERSION: Final = Fields("I33s129s66s33s43s")
_MODELS: Final = {17: "UM982", 18: "UM980", 19: "UM960", 21: "UM980A", 26: "UM981", 31: "UM981S", 53: "UBD9A0"}
_MAX_SPEED_MPS: Final = 1e4
_LATITUDE_DEG, _LONGITUDE_DEG, _HEIGHT_M = 90.0, 360.0, 1e6

Found = list[Message] | str


class UnicoreDecoder:
    """Decodes the logs of one antenna of a receiver; ``antenna`` 2 is the second one of a UM982. It remembers lock times."""

    def __init__(self, antenna: int = MAIN_ANTENNA) -> None:
        self.counters = DecodingCounters()
        self._slip_state = new_slip_state()
        letter = "M" if antenna == MAIN_ANTENNA else "H"
        self._full, self._compressed = f"OBSV{letter}", f"OBSV{letter}CMP"
        self._position = "BESTNAV" if antenna == MAIN_ANTENNA else "BESTNAVH"

    def decode(self, frame: Frame) -> list[Message]:
        """Return the messages of one log."""
        label = f"unicore/{frame.kind}"
        log = open_log(frame)
        if log is None:  # a reply to a command
            self.counters.ignore(Protocol.UNICORE, frame.kind)
            return []
        found = self._read(log)
        if found is None:
            self.counters.ignore(Protocol.UNICORE, frame.kind)
            return []
        if isinstance(found, str):
            self.counters.rejected[f"{label} {found}"] += 1
            return []
        self.counters.decoded[label] += 1
        return found

    def _read(self, log: Log) -> Found | None:
        """Return what a log says, why it is rejected, or None where it is of no use here."""
        if log.name in (self._full, self._compressed):
            return self._observations(log)
        if log.name in READERS:
            found = read_ephemeris(log)
            return found if isinstance(found, str) else [*found]
        if log.name == self._position:
            return _position(log)
        if log.name == "UNIHEADING":
            return _heading(log)
        return _version(log) if log.name == "VERSION" else None

    def _observations(self, log: Log) -> Found:
        compressed = log.name == self._compressed
        measurements = compressed_measurements(log.body) if compressed else measurements_of(log.body)
        if measurements is None:
            return "length"
        if log.time is None:
            return "time"
        epoch = epoch_of(measurements, log.time, MAX_COMPRESSED_LOCK_S if compressed else MAX_LOCK_S, self._slip_state)
        if len(epoch) < len(measurements.numbers):
            self.counters.rejected[f"unicore/{log.name} unknown signal"] += len(measurements.numbers) - len(epoch)
        self.counters.epochs += 1
        return [epoch]


def measurements_of(body: bytes | list[str]) -> Measurements | None:
    """Return the measurements of an OBSVM or OBSVH, None where they are not whole."""
    if isinstance(body, bytes):
        count = int.from_bytes(body[:4], "little")
        if len(body) < 4 + count * FULL.itemsize or len(body) < 4:
            return None
        return full_measurements(np.frombuffer(body, FULL, count, 4))
    try:
        count = int(body[0])
        words = body[1 : 1 + count * FULL_FIELDS]
        rows = np.zeros(max(count, 0) if len(words) == count * FULL_FIELDS else -1, FULL)
        for k, name in enumerate(FULL.names or ()):
            column = words[k::FULL_FIELDS]
            rows[name] = [int(word, 16) for word in column] if name == "status" else [float(word) for word in column]
    except (ValueError, OverflowError):
        return None
    return full_measurements(rows)


def compressed_measurements(body: bytes | list[str]) -> Measurements | None:
    """Return the measurements of an OBSVMCMP or OBSVHCMP (in ASCII each is 48 hexadecimal digits), None where they are not whole."""
    if not isinstance(body, bytes):
        try:
            body = int(body[0]).to_bytes(4, "little") + bytes.fromhex("".join(body[1:]))
        except (ValueError, OverflowError):
            return None
    count = int.from_bytes(body[:4], "little")
    if len(body) < 4 + count * COMPRESSED_BYTES or len(body) < 4:
        return None
    numbers, values = np.empty((count, 3), np.int64), np.empty((count, VALUES))
    read_compressed(np.frombuffer(body, np.uint8, count * COMPRESSED_BYTES, 4), numbers, values)
    return Measurements(numbers, values)


def _number(value: Value) -> float:
    return nan if isinstance(value, str) else float(value)


def _heading(log: Log) -> Found:
    values = UNIHEADING.read(log)
    if values is None:
        return "length"
    status, kind = values[:2]
    length_m, heading_deg, pitch_deg, _, heading_sigma_deg, pitch_sigma_deg = (_number(value) for value in values[2:8])
    solution = CarrierSolution.FIXED if kind in _FIXED else CarrierSolution.FLOAT if kind in _FLOAT else CarrierSolution.NONE
    valid = status == _COMPUTED and solution is not CarrierSolution.NONE and 0.0 <= heading_deg <= 360.0
    if not valid:
        return [ReceiverHeading(log.time, "UNIHEADING", CarrierSolution.NONE, satellites=_whole(values[10]), station=str(values[8]))]
    return [ReceiverHeading(
        log.time, "UNIHEADING", solution, heading_rad=radians(heading_deg % 360.0), heading_sigma_rad=_sigma(radians(heading_sigma_deg)),
        pitch_rad=radians(pitch_deg) if abs(pitch_deg) <= 90.0 else nan, pitch_sigma_rad=_sigma(radians(pitch_sigma_deg)),
        length_m=length_m if length_m > 0.0 else nan, satellites=_whole(values[10]), station=str(values[8]),
    )]  # fmt: skip


def _sigma(value: float) -> float:
    return value if value > 0.0 else nan


def _whole(value: Value) -> int:
    return 0 if isinstance(value, str) or not isfinite(value) else int(value)


def _position(log: Log) -> Found:
    values = BESTNAV.read(log)
    if values is None:
        return "length"
    lat_deg, lon_deg, sea_height_m, undulation_m = (_number(value) for value in values[2:6])
    lat_sigma_m, lon_sigma_m, height_sigma_m = (_number(value) for value in values[7:10])
    fix = _FIX_OF_TYPE.get(_whole(values[1]), 0) if values[0] == _COMPUTED else 0
    height_m, satellites = sea_height_m + undulation_m, _whole(values[14])
    inside = abs(lat_deg) <= _LATITUDE_DEG and abs(lon_deg) <= _LONGITUDE_DEG and abs(height_m) < _HEIGHT_M
    if fix == 0 or not inside:
        return [ReceiverFix(log.time, 0, nan, nan, nan, nan, nan, None, satellites)]
    return [ReceiverFix(
        log.time, fix, radians(lat_deg), radians(lon_deg), height_m, hypot(lat_sigma_m, lon_sigma_m), height_sigma_m,
        _velocity(values[21:28]), satellites,
    )]  # fmt: skip


def _velocity(values: tuple[Value, ...]) -> tuple[float, float, float] | None:
    """Return north, east, down (m/s) of status, type, latency, age, horizontal speed, track over ground in degrees and upward speed."""
    status, kind, _, _, speed_mps, track_deg, up_mps = (_number(value) for value in values)
    if (
        status != _COMPUTED
        or kind == _NONE
        or not (0.0 <= speed_mps < _MAX_SPEED_MPS and abs(up_mps) < _MAX_SPEED_MPS and isfinite(track_deg))
    ):
        return None
    return speed_mps * cos(radians(track_deg)), speed_mps * sin(radians(track_deg)), -up_mps


def _version(log: Log) -> Found:
    values = VERSION.read(log)
    if values is None:
        return "length"
    model = log.body[0].strip('"') if not isinstance(log.body, bytes) else _MODELS.get(_whole(values[0]), f"device {values[0]}")
    return [ReceiverVersion(model, str(values[1]), "", tuple(str(value) for value in values[2:]))]
