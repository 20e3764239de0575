"""Logs of Unicore N4 receivers, binary and ASCII, to a header and a tuple of fields (Unicore N4 commands manual R1.13, 7.1).

A layout is a string of one letter per field, as in ``struct``: B H I i f d, ``4s`` and the like for text. Both forms of a log have the same
fields in the same order; ASCII writes enumerations as words and masks in hexadecimal.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite, nan
from re import findall
from struct import Struct, error
from typing import Final

from rtkmesh.codecs.framing_unicore import UNICORE_HEADER
from rtkmesh.codecs.messages import Frame
from rtkmesh.gnss.constants import BDT_MINUS_GPST_S, BDT_WEEK_OFFSET, SECONDS_PER_WEEK
from rtkmesh.gnss.time import GpsTime

Value = float | int | str

_HEADER: Final = Struct("<3sBHHBBHIIBBH")
_ASCII_HEADER: Final = 10  # fields, the name included
_GPS, _BDS = 0, 1
_WORDS: Final = {"TRUE": 1, "FALSE": 0, "WGS84": 61}

SOLUTION_STATUS: Final = {"SOL_COMPUTED": 0, "INSUFFICIENT_OBS": 1, "NO_CONVERGENCE": 2, "COV_TRACE": 4}
POSITION_TYPE: Final = {
    "NONE": 0, "FIXEDPOS": 1, "FIXEDHEIGHT": 2, "DOPPLER_VELOCITY": 8, "SINGLE": 16, "PSRDIFF": 17, "SBAS": 18, "L1_FLOAT": 32,
    "IONOFREE_FLOAT": 33, "NARROW_FLOAT": 34, "L1_INT": 48, "WIDE_INT": 49, "NARROW_INT": 50, "INS": 52, "INS_PSRSP": 53,
    "INS_PSRDIFF": 54, "INS_RTKFLOAT": 55, "INS_RTKFIXED": 56, "PPP_CONVERGING": 68, "PPP": 69,
    # NovAtel's alone
    "WAAS": 18, "PROPAGATED": 19, "RTK_DIRECT_INS": 51, "INS_SBAS": 52, "OPERATIONAL": 70, "WARNING": 71, "OUT_OF_BOUNDS": 72,
    "INS_PPP_CONVERGING": 73, "INS_PPP": 74, "PPP_BASIC_CONVERGING": 77, "PPP_BASIC": 78, "INS_PPP_BASIC_CONVERGING": 79,
    "INS_PPP_BASIC": 80,
}  # fmt: skip
_ENUMERATIONS: Final[Mapping[str, int]] = {**_WORDS, **SOLUTION_STATUS, **POSITION_TYPE}
_OTHER_WORD: Final = 255  # a word that is not known


@dataclass(frozen=True, slots=True)
class Log:
    """One log: its name without the letter of its form, its time (None: not known) and its body, binary or split at commas."""

    name: str
    time: GpsTime | None
    body: bytes | list[str]


def open_log(frame: Frame) -> Log | None:
    """Return the log of a whole frame, None where its header is none."""
    return _binary(frame) if frame.data[0] == 0xAA else _ascii(frame)


def _binary(frame: Frame) -> Log:
    _, _, _, _, reference, _, week, tow_ms, _, _, _, _ = _HEADER.unpack_from(frame.data)
    return Log(frame.kind.removesuffix("B"), _time(reference, week, tow_ms), frame.data[UNICORE_HEADER:-4])


def _ascii(frame: Frame) -> Log | None:
    text = frame.data[1 : frame.data.rfind(b"*")].decode("ascii")
    head, found, body = text.partition(";")
    fields = head.split(",")
    if not found or len(fields) < _ASCII_HEADER or not (fields[4].isdecimal() and fields[5].isdecimal()):
        return None
    reference = {"GPS": _GPS, "BDS": _BDS}.get(fields[2], -1)
    known = reference >= 0 and fields[3] != "UNKNOWN" and len(fields[4]) < 6 and len(fields[5]) < 10
    return Log(fields[0].removesuffix("A"), _time(reference, int(fields[4]), int(fields[5])) if known else None, body.split(","))


def _time(reference: int, week: int, tow_ms: int) -> GpsTime | None:
    if week == 0 or tow_ms >= SECONDS_PER_WEEK * 1e3 or reference not in (_GPS, _BDS):
        return None
    if reference == _BDS:
        return GpsTime.normalized(week + BDT_WEEK_OFFSET, tow_ms / 1e3 - BDT_MINUS_GPST_S)
    return GpsTime(week, tow_ms / 1e3)


class Fields:
    """The fields of one kind of log."""

    def __init__(self, layout: str) -> None:
        self._codes: list[str] = findall(r"\d*s|[BHIifd]", layout)
        self._struct = Struct(f"<{layout}")

    def pack(self, *values: Value) -> bytes:
        """Return the binary body of these values."""
        coded = (value.encode() if isinstance(value, str) else value for value in values)
        return self._struct.pack(*coded)

    def read(self, log: Log) -> tuple[Value, ...] | None:
        """Return the values of all fields, None where some are missing or none of their kind. What is not finite is NaN."""
        try:
            values = self._struct.unpack_from(log.body) if isinstance(log.body, bytes) else self._words(log.body)
        except (error, ValueError):
            return None
        return tuple(_clean(value) for value in values)

    def _words(self, words: list[str]) -> list[Value | bytes]:
        if len(words) < len(self._codes):
            raise ValueError("too few fields")
        return [_value(word.strip(), code) for word, code in zip(words, self._codes, strict=False)]


def _value(word: str, code: str) -> Value:
    if code in ("f", "d"):
        return float(word)
    if code.endswith("s"):
        return word.strip('"')
    if word.lstrip("-").isdecimal() and len(word) < 12:
        return int(word)
    if word and all(character in "0123456789abcdef" for character in word) and len(word) <= 8:
        return int(word, 16)
    return _ENUMERATIONS.get(word, _OTHER_WORD)


def _clean(value: Value | bytes) -> Value:
    if isinstance(value, bytes):
        return "".join(character for character in value.split(b"\0")[0].decode("ascii", "replace") if character.isprintable())
    if isinstance(value, float) and not isfinite(value):
        return nan
    return value
