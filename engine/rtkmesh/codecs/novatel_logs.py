"""Logs of NovAtel OEM4 to OEM7 receivers, binary and ASCII, to a header and a body (OEM7 commands and logs manual v15C, 1.4, 1.5).

Logs of a second antenna have ``_1`` behind their name, as in ASCII.
"""

from struct import Struct
from typing import Final

from rtkmesh.codecs.framing_novatel import SHORT_HEADER, SHORT_THIRD
from rtkmesh.codecs.messages import Frame
from rtkmesh.codecs.unicore_logs import Log
from rtkmesh.gnss.constants import SECONDS_PER_WEEK
from rtkmesh.gnss.time import GpsTime

HEADER: Final = Struct("<3sBHBBHHBBHIIHH")
SHORT: Final = Struct("<3sBHHI")
TIME_UNKNOWN: Final = 20
_ASCII_HEADER: Final = 10  # fields, the name included
_CRC: Final = 4
# Bits of the message type: the measurement source (1: second antenna), the form (0: binary), whether it answers a command.
SOURCE, _FORM, _RESPONSE = 0x1F, 0x60, 0x80


def open_novatel_log(frame: Frame) -> Log | None:
    """Return the log of a whole frame, None where it is an answer to a command or its header is none."""
    if frame.data[0] != 0xAA:
        return _ascii(frame)
    return _short(frame) if frame.data[2] == SHORT_THIRD else _long(frame)


def _long(frame: Frame) -> Log | None:
    _, length, _, kind, _, _, _, _, status, week, tow_ms, _, _, _ = HEADER.unpack_from(frame.data)
    if kind & (_FORM | _RESPONSE):
        return None
    time = None if status == TIME_UNKNOWN else _time(week, tow_ms / 1e3)
    return Log(_of_source(frame.kind.removesuffix("B"), kind & SOURCE), time, frame.data[length:-_CRC])


def _of_source(name: str, source: int) -> str:
    return f"{name}_{source}" if source else name


def _short(frame: Frame) -> Log:
    _, _, _, week, tow_ms = SHORT.unpack_from(frame.data)
    return Log(frame.kind.removesuffix("B"), _time(week, tow_ms / 1e3), frame.data[SHORT_HEADER:-_CRC])


def _ascii(frame: Frame) -> Log | None:
    text = frame.data[1 : frame.data.rfind(b"*")].decode("ascii")
    head, found, body = text.partition(";")
    fields = head.split(",")
    if not found or len(fields) < _ASCII_HEADER or not fields[5].isdecimal():
        return None
    name, _, source = fields[0].partition("_")
    name = name.removesuffix("A") + (f"_{source}" if source else "")
    known = fields[4] != "UNKNOWN" and len(fields[5]) < 6 and len(fields[6]) < 12 and fields[6].replace(".", "", 1).isdecimal()
    return Log(name, _time(int(fields[5]), float(fields[6])) if known else None, body.split(","))


def _time(week: int, tow_s: float) -> GpsTime | None:
    return None if week == 0 or tow_s >= SECONDS_PER_WEEK else GpsTime(week, tow_s)
