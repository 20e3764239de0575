"""Raw navigation blocks of SBF: whose block of which message it is, and its words (mosaic-X5 reference guide 4.14, 4.2.2)."""

from math import floor
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.codecs.navigation_words import (
    D1_MESSAGE,
    D2_MESSAGE,
    GLONASS_MESSAGE,
    INAV_MESSAGE,
    LNAV_MESSAGE,
    WORDS,
    Words,
)
from rtkmesh.codecs.sbf_observations import u4
from rtkmesh.codecs.sbf_signals import SATELLITE_OF
from rtkmesh.codecs.utc import leap_seconds_of
from rtkmesh.gnss.beidou import is_geostationary
from rtkmesh.gnss.constants import SECONDS_PER_WEEK
from rtkmesh.gnss.signals import BEIDOU, GALILEO, GLONASS, GPS, QZSS, SATELLITES_PER_SYSTEM
from rtkmesh.gnss.time import GpsTime

GPS_RAW_CA, GALILEO_RAW_INAV, GLONASS_RAW_CA, BEIDOU_RAW, QZSS_RAW_CA = "4017", "4023", "4026", "4047", "4066"

# Block -> system, message (of satellites that are not geostationary), 32-bit words of NAVBits.
_BLOCKS: Final = {
    GPS_RAW_CA: (GPS, LNAV_MESSAGE, 10),
    QZSS_RAW_CA: (QZSS, LNAV_MESSAGE, 10),
    GALILEO_RAW_INAV: (GALILEO, INAV_MESSAGE, 8),
    GLONASS_RAW_CA: (GLONASS, GLONASS_MESSAGE, 3),
    BEIDOU_RAW: (BEIDOU, D1_MESSAGE, 10),
}
NUMBERS: Final = frozenset(_BLOCKS)
_BITS: Final = 20  # offset of NAVBits in a block
_SVID, _CRC_PASSED, _CHANNEL = 14, 15, 18
_GLONASS_FRAME_S: Final = 30.0
_UNKNOWN_SLOT: Final = 62
_EVEN_BITS: Final = 114  # of an I/NAV page; the odd part follows at once


@kernel
def _bits_at(sent: Words, first: int, length: int) -> int:
    """Return ``length`` (1 to 32) bits from bit ``first`` of words of 32 bits."""
    at = first >> 5
    pair = sent[at] << 32 | (sent[at + 1] if at + 1 < len(sent) else 0)
    return (pair >> (64 - (first & 31) - length)) & ((1 << length) - 1)


@kernel
def page_words(sent: Words, words: Words) -> None:
    """Write an I/NAV page with each part at the beginning of four words, as ``check_block`` takes it."""
    for k in range(4):
        words[k] = _bits_at(sent, 32 * k, 32 if k < 3 else _EVEN_BITS - 96) << (0 if k < 3 else 128 - _EVEN_BITS)
        words[4 + k] = _bits_at(sent, _EVEN_BITS + 32 * k, 32 if k < 3 else 24) << (0 if k < 3 else 8)


@kernel
def navigation_words(data: bytes, count: int, message: int, words: Words) -> None:
    """Write the words of the block whose NAVBits have ``count`` words of 32 bits.

    LNAV comes in words of 30 bits, two unused bits before each; the bits of BeiDou, Galileo and GLONASS come without gaps.
    """
    sent = np.zeros(11, np.int64)
    for k in range(count):
        sent[k] = u4(data, _BITS + 4 * k)
    for k in range(WORDS):
        words[k] = 0
    if message == INAV_MESSAGE:
        page_words(sent, words)
    elif message == GLONASS_MESSAGE:
        for k in range(3):
            words[k] = sent[k] if k < 2 else sent[k] >> 11 << 11
    else:
        for k in range(WORDS):
            words[k] = sent[k] & 0x3FFFFFFF if message == LNAV_MESSAGE else _bits_at(sent, 30 * k, 30)


def read_block(data: bytes, kind: str, time: GpsTime | None) -> tuple[int, int, NDArray[np.int64], int, int] | str | None:
    """Return satellite, message, words, GLONASS channel and frame number of a raw navigation block (see ``keep_block``).

    The reason of its refusal, or None if the receiver found its checksum wrong or does not know the satellite's slot.
    """
    system, message, count = _BLOCKS[kind]
    if len(data) < _BITS + 4 * count:
        return "length"
    svid = data[_SVID]
    satellite = int(SATELLITE_OF[svid])
    if not data[_CRC_PASSED] or (svid == _UNKNOWN_SLOT and system == GLONASS):
        return None
    if satellite == 0 or satellite // SATELLITES_PER_SYSTEM != system:
        return "satellite"
    if is_geostationary(satellite):
        message = D2_MESSAGE
    words = np.empty(WORDS, np.int64)
    navigation_words(data, count, message, words)
    if system != GLONASS:
        return satellite, message, words, 0, 0
    return satellite, message, words, data[_CHANNEL] - 8, 0 if time is None else _glonass_frame(time)


def _glonass_frame(time: GpsTime) -> int:
    """Return the number of the GLONASS frame that is sent at a time: superframe and frame in it as u-blox counts them.

    Strings 1 to 5, which matter, end 2 to 10 s after the frame's beginning; frames of 30 s begin with the minutes of UTC.
    """
    running = floor((time.week * SECONDS_PER_WEEK + time.tow_s - leap_seconds_of(time)) / _GLONASS_FRAME_S)
    return (running // 5 % 0x10000) << 16 | (running % 5 + 1)
