"""Unicore N4 receivers (UM980, UM982): observations of either antenna, ephemerides, their own positions and headings (N4 manual R1.13).

OBSVM or OBSVH and their compressed forms, GPSEPH, QZSSEPH, BDSEPH, GALEPH, GLOEPH, BESTNAV or BESTNAVH, UNIHEADING, VERSION; binary and
ASCII. All other logs are counted as ignored.
"""

from math import cos, isfinite, radians, sin
from typing import Final

from rtkmesh.codecs.log_decoder import COMPUTED, MAIN_ANTENNA, SECOND_ANTENNA, Found, LogDecoder, fix_of, heading_of, number, whole
from rtkmesh.codecs.messages import Frame, Protocol
from rtkmesh.codecs.unicore_ephemeris import READERS, read_ephemeris
from rtkmesh.codecs.unicore_logs import POSITION_TYPE, Fields, Log, Value, open_log
from rtkmesh.codecs.unicore_observations import UNICORE
from rtkmesh.gnss.receiver import ReceiverVersion

__all__ = ["BESTNAV", "MAIN_ANTENNA", "SECOND_ANTENNA", "UNIHEADING", "UnicoreDecoder"]

_NONE: Final = POSITION_TYPE["NONE"]
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


class UnicoreDecoder(LogDecoder):
    """Decodes the logs of one antenna of a receiver; ``antenna`` 2 is the second one of a UM982. It remembers lock times."""

    def __init__(self, antenna: int = MAIN_ANTENNA) -> None:
        super().__init__(Protocol.UNICORE)
        letter = "M" if antenna == MAIN_ANTENNA else "H"
        self._full, self._compressed = f"OBSV{letter}", f"OBSV{letter}CMP"
        self._position = "BESTNAV" if antenna == MAIN_ANTENNA else "BESTNAVH"

    def _open(self, frame: Frame) -> Log | None:
        return open_log(frame)

    def _read(self, log: Log) -> Found | None:
        if log.name in (self._full, self._compressed):
            return self._observations(log, UNICORE, compressed=log.name == self._compressed)
        if log.name in READERS:
            return read_ephemeris(log, READERS)
        if log.name == self._position:
            return _position(log)
        if log.name == "UNIHEADING":
            return _heading(log)
        return _version(log) if log.name == "VERSION" else None


def _heading(log: Log) -> Found:
    values = UNIHEADING.read(log)
    return "length" if values is None else [heading_of(log, values, values[10])]


def _position(log: Log) -> Found:
    values = BESTNAV.read(log)
    return "length" if values is None else [fix_of(log, values, _FIX_OF_TYPE, _velocity(values[21:28]))]


def _velocity(values: tuple[Value, ...]) -> tuple[float, float, float] | None:
    """Return north, east, down (m/s) of status, type, latency, age, horizontal speed, track over ground in degrees and upward speed."""
    status, kind, _, _, speed_mps, track_deg, up_mps = (number(value) for value in values)
    if (
        status != COMPUTED
        or kind == _NONE
        or not (0.0 <= speed_mps < _MAX_SPEED_MPS and abs(up_mps) < _MAX_SPEED_MPS and isfinite(track_deg))
    ):
        return None
    return speed_mps * cos(radians(track_deg)), speed_mps * sin(radians(track_deg)), -up_mps


def _version(log: Log) -> Found:
    values = VERSION.read(log)
    if values is None:
        return "length"
    model = log.body[0].strip('"') if not isinstance(log.body, bytes) else _MODELS.get(whole(values[0]), f"device {values[0]}")
    return [ReceiverVersion(model, str(values[1]), "", tuple(str(value) for value in values[2:]))]
