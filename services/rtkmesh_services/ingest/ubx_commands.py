"""UBX configuration messages from text, as RTKLIB's command files write them: ``CFG-RATE 200 1 1``.

Arguments are the fields of the payload in their order (u-blox interface descriptions), decimal or 0x...; missing ones are 0, more of
them are bytes (further blocks of CFG-GNSS). CFG-VALSET, -VALGET and -VALDEL take keys by name (``CFG-RATE-MEAS``, with or without
``CFG-``) or as 0x numbers, and any number of them.
"""

import struct
from functools import cache
from typing import Final

from rtkmesh_services.errors import SourceError

_CLASS: Final = 0x06
# name -> (id, fields in struct's letters; x: reserved without an argument)
_MESSAGES: Final[dict[str, tuple[int, str]]] = {
    "PRT": (0x00, "BBHIIHHHH"),
    "MSG": (0x01, "BBBBBBBB"),
    "INF": (0x02, "BBBBBBBBBB"),
    "RST": (0x04, "HBB"),
    "DAT": (0x06, "ddfffffff"),
    "TP": (0x07, "IIbBHhhi"),
    "RATE": (0x08, "HHH"),
    "CFG": (0x09, "IIIB"),
    "FXN": (0x0E, "IIIIIIII"),
    "TM": (0x10, "III"),
    "RXM": (0x11, "BB"),
    "EKF": (0x12, "BBBBIHHBBH"),
    "ANT": (0x13, "HH"),
    "SBAS": (0x16, "BBBBI"),
    "NMEA": (0x17, "BBBB"),
    "TM2": (0x19, "BBHII"),
    "NAV2": (0x1A, "BBHBBBBiBBBBBBHHHHHBBHII"),
    "TMODE": (0x1D, "IiiiIII"),
    "ODO": (0x1E, "BBBBBBBBB"),
    "NAVX5": (0x23, "HHIBBBBBBBBBBHBBBBBBBBBBH"),
    "NAV5": (0x24, "HBBiIbBHHHHBBBBBBHBBBBBB"),
    "TPS": (0x31, "BBBBhhIIIIiI"),
    "RINV": (0x34, "BB"),
    "TMODE2": (0x3D, "BBHiiiIII"),
    "ITFM": (0x39, "II"),
    "PM2": (0x3B, "BBBBIIIIHH"),
    "GNSS": (0x3E, "BBBBBBBBI"),
    "LOGFILTER": (0x47, "BBHHHI"),
    "TXSLOT": (0x53, "BBBBIIIII"),
    "PWR": (0x57, "BBBBI"),
    "SMGR": (0x62, "BBHHBBHHHHI"),
    "TMODE3": (0x71, "BBHiiibbbBIIIxxxxxxxx"),
    "VALSET": (0x8A, "BBBB"),
    "VALGET": (0x8B, "BBH"),
    "VALDEL": (0x8C, "BBBB"),
}
_KEYED: Final = ("VALSET", "VALGET", "VALDEL")
_SIZES: Final = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8}  # of a key's bits 28 to 30: bytes of its value


def ubx_frame(text: str) -> bytes:
    """Return the frame of a message in text; SourceError says what is wrong with it."""
    name, *words = text.split()
    message = _MESSAGES.get(name.removeprefix("CFG-"))
    if message is None or not name.startswith("CFG-"):
        raise SourceError(f"{name}: no UBX message that can be written so; known are CFG- and {', '.join(_MESSAGES)}")
    number, layout = message
    fields = [letter for letter in layout if letter != "x"]
    payload = _packed(fields, words[: len(fields)]) + bytes(layout.count("x"))
    rest = words[len(fields) :]
    payload += _keyed(name, rest) if name.removeprefix("CFG-") in _KEYED else _packed(["B"] * len(rest), rest)
    return framed(_CLASS, number, payload)


def framed(class_: int, number: int, payload: bytes) -> bytes:
    """Return a whole UBX frame."""
    body = struct.pack("<BBH", class_, number, len(payload)) + payload
    a = b = 0
    for byte in body:
        a = (a + byte) & 255
        b = (b + a) & 255
    return b"\xb5\x62" + body + bytes((a, b))


def _packed(letters: list[str], words: list[str]) -> bytes:
    words = words + ["0"] * (len(letters) - len(words))
    return b"".join(_number(letter, word) for letter, word in zip(letters, words, strict=True))


def _number(letter: str, word: str) -> bytes:
    """Return a field's bytes; an unsigned field takes a negative number as its two's complement."""
    try:
        value = float(word) if letter in "df" else int(word, 0 if word.lower().startswith(("0x", "-0x")) else 10)
        size = struct.calcsize(letter)
        if isinstance(value, int) and letter.isupper() and -(1 << 8 * size - 1) <= value < 0:
            value += 1 << 8 * size
        return struct.pack(f"<{letter}", value)
    except (ValueError, OverflowError, struct.error):
        raise SourceError(f"{word!r} does not fit into a field of {struct.calcsize(letter)} bytes") from None


def _keyed(name: str, words: list[str]) -> bytes:
    if name != "CFG-VALSET":
        return b"".join(struct.pack("<I", key_of(word)[0]) for word in words)
    if not words or len(words) % 2:
        raise SourceError(f"{name}: wants version, layers, two zeros, then keys with a value each")
    parts: list[bytes] = []
    for word, value in zip(words[::2], words[1::2], strict=True):
        key, letter = key_of(word)
        parts += [struct.pack("<I", key), _number(letter, value)]
    return b"".join(parts)


def key_of(word: str) -> tuple[int, str]:
    """Return a key's number and the letter of its value's type; SourceError if it is none."""
    if word.lower().startswith("0x"):
        try:
            key = int(word, 16)
        except ValueError:
            key = 0
        letter = _letter_of_size(key)
        if not letter or key >> 32:
            raise SourceError(f"{word} is no configuration key")
        return key, letter
    name = "CFG_" + word.upper().replace("-", "_").removeprefix("CFG_")
    found = _database().get(name)
    if found is None:
        raise SourceError(f"{word}: there is no such configuration key")
    return found


def type_of_key(number: int) -> str:
    """Return the letter of a key's type: the known one's, else the unsigned one of its size; empty where it has none."""
    return _types().get(number) or _letter_of_size(number)


def _letter_of_size(number: int) -> str:
    return {1: "B", 2: "H", 4: "I", 8: "Q"}.get(_SIZES.get(number >> 28 & 7, 0), "")


@cache
def _types() -> dict[int, str]:
    return dict(_database().values())


@cache
def _database() -> dict[str, tuple[int, str]]:
    """Return the known keys: their numbers and the letters of their types."""
    from pyubx2 import UBX_CONFIG_DATABASE  # noqa: PLC0415  only who configures by names needs it

    letters = {"U": "BHIQ", "E": "BHIQ", "X": "BHIQ", "L": "BHIQ", "I": "bhiq", "R": "??fd"}
    order = {1: 0, 2: 1, 4: 2, 8: 3}
    return {name: (number, letters[kind[0]][order[int(kind[1:])]]) for name, (number, kind) in UBX_CONFIG_DATABASE.items()}
