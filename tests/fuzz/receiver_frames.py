"""Frames of Septentrio's, Unicore's and NovAtel's own protocols: bodies of our encoders, and how a body becomes a frame.

SBF: a body is the block's number and revision, then what stands behind its length. Unicore: the number of the log, bytes 8 to 23 of its
header (time), then the payload; NovAtel the same with bytes 6, 7 and 10 to 27; their ASCII logs: the text between ``#`` and ``*``.
"""

import re
from collections.abc import Callable, Iterable
from typing import Any, Final

from rtkmesh.codecs import novatel_encode, sbf_encode, unicore_encode
from rtkmesh.codecs.checksums import crc16, crc32
from rtkmesh.codecs.messages import Message
from rtkmesh.gnss.ephemeris import GlonassEphemeris, KeplerEphemeris, ReceiverFix, ReferenceStation
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.time import GpsTime

_EPOCHS: Final = 4
SBF_HEADS: Final = tuple(
    number.to_bytes(2, "little") for number in (4007, 4013, 4017, 4023, 4027, 4000, 4109, 5891, 5894, 5907, 5914, 5938)
)
UNICORE_HEADS: Final = tuple(number.to_bytes(2, "little") for number in (12, 13, 138, 139, 106, 107, 108, 109, 2118, 972, 2124, 8))

NOVATEL_HEADS: Final = tuple(
    number.to_bytes(2, "little") for number in (43, 140, 41, 7, 723, 1122, 1309, 1310, 1696, 1331, 1336, 8, 42, 971, 1335, 37, 508)
)
_NOVATEL_HEAD: Final = 22  # bytes of a body before the payload


def seal_sbf(body: bytes) -> bytes:
    """Return the block of a body, padded to a multiple of four bytes, with a number that blocks have."""
    number = int.from_bytes(body[:2], "little")
    body = (number & 0xE000 | 4000 + (number - 4000) % 2144 & 0x1FFF).to_bytes(2, "little") + body[2:]
    rest = body[2:] + bytes(-len(body[2:]) % 4)
    covered = body[:2] + (len(rest) + 8).to_bytes(2, "little") + rest
    return b"$@" + crc16(covered).to_bytes(2, "little") + covered


def seal_unicore(body: bytes) -> bytes:
    """Return the binary log of a body."""
    body = body.ljust(18, b"\x00")
    log = b"\xaa\x44\xb5\x60" + body[:2] + (len(body) - 18).to_bytes(2, "little") + body[2:]
    return log + crc32(log).to_bytes(4, "little")


def seal_novatel(body: bytes) -> bytes:
    """Return the binary log of a body."""
    body = body.ljust(_NOVATEL_HEAD, b"\x00")
    length = (len(body) - _NOVATEL_HEAD).to_bytes(2, "little")
    log = b"\xaa\x44\x12\x1c" + body[:4] + length + body[4:]
    return log + crc32(log).to_bytes(4, "little")


def seal_ascii(text: bytes) -> bytes:
    """Return the ASCII log of a text: what cannot stand in one becomes a comma, what has no name gets one."""
    text = re.sub(rb"[^ -~]|[#*]", b",", text)
    text = text if re.match(rb"[A-Z0-9_]{1,23},", text) else b"OBSVMA," + text
    return b"#%b*%08x\r\n" % (text, crc32(text))


def sbf_pool(messages: list[Message], start: GpsTime) -> list[bytes]:
    """Return the bodies of blocks that say what these messages say."""
    blocks = _each(messages, Epoch, lambda epoch: [sbf_encode.encode_meas_epoch(epoch), sbf_encode.encode_meas_extra(epoch)], _EPOCHS)
    blocks += _each(messages, (KeplerEphemeris, GlonassEphemeris), lambda e: [sbf_encode.encode_ephemeris(e, start)])
    blocks += _each(messages, (KeplerEphemeris, GlonassEphemeris), lambda e: sbf_encode.encode_navigation(e, start))
    blocks += _each(messages, ReceiverFix, lambda fix: [sbf_encode.encode_pvt(fix)], _EPOCHS)
    station = ReferenceStation(7, (3.8e6, 8.9e5, 5.0e6), 1.5, "TRM115000.00    NONE", "123", "RX")
    return [block[4:6] + block[8:] for block in [*blocks, sbf_encode.encode_setup(station, start)]]


def unicore_pool(messages: list[Message], start: GpsTime) -> list[bytes]:
    """Return the bodies of binary logs that say what these messages say."""
    u = unicore_encode
    logs = _each(messages, Epoch, lambda epoch: [u.encode_observations(epoch), u.encode_compressed(epoch)], _EPOCHS)
    logs += _each(messages, (KeplerEphemeris, GlonassEphemeris), lambda e: [u.encode_ephemeris(e, start)])
    logs += _each(messages, ReceiverFix, lambda fix: [u.encode_position(fix)], _EPOCHS)
    return [log[4:6] + log[8:-4] for log in logs]


def novatel_pool(messages: list[Message], start: GpsTime) -> list[bytes]:
    """Return the bodies of binary logs that say what these messages say."""
    n = novatel_encode
    logs = _each(messages, Epoch, lambda epoch: [n.encode_observations(epoch), n.encode_compressed(epoch)], _EPOCHS)
    logs += _each(messages, (KeplerEphemeris, GlonassEphemeris), lambda e: [n.encode_ephemeris(e, start)])
    logs += _each(messages, KeplerEphemeris, lambda e: [n.encode_raw_ephemeris(e, start)])
    logs += _each(messages, KeplerEphemeris, lambda e: [n.encode_galileo(e, start)])
    logs += _each(messages, ReceiverFix, lambda fix: [n.encode_position(fix)], _EPOCHS)
    return [log[4:8] + log[10:-4] for log in logs]


def ascii_pool(messages: list[Message], start: GpsTime) -> list[bytes]:
    """Return the texts of ASCII logs that say what these messages say."""
    u = unicore_encode
    logs = _each(messages, Epoch, lambda epoch: [u.encode_observations_ascii(epoch), u.encode_compressed_ascii(epoch)], 2)
    logs += _each(messages, (KeplerEphemeris, GlonassEphemeris), lambda e: [u.encode_ephemeris_ascii(e, start)])
    return [log[1 : log.rindex(b"*")] for log in logs]


def _each(messages: list[Message], kind: Any, encode: Callable[[Any], Iterable[bytes]], most: int = 40) -> list[bytes]:
    """Return what an encoder makes of the first messages of a kind; of those that it has no form for, nothing."""
    made: list[bytes] = []
    for message in [message for message in messages if isinstance(message, kind)][:most]:
        try:
            made += encode(message)
        except ValueError:
            continue
    return made
