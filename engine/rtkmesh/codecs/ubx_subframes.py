"""RXM-SFRBX (u-blox F9 HPG 1.32 interface description, 3.17.11): whose navigation block it is, in which of its layouts."""

from typing import Final

import numpy as np

from rtkmesh._jit import kernel
from rtkmesh.codecs.navigation_words import (
    D1_MESSAGE,
    D2_MESSAGE,
    GLONASS_MESSAGE,
    INAV_MESSAGE,
    LNAV_MESSAGE,
    QUIET,
    WORDS,
    Satellites,
    Words,
    take_d1,
    take_d2,
    take_glonass,
    take_inav,
    take_lnav,
)
from rtkmesh.codecs.ubx_signals import GNSS_IDS, SATELLITE_OF
from rtkmesh.gnss.signals import SATELLITES_PER_SYSTEM

# What is wrong with a message, besides what the blocks' kernels say.
WRONG_LENGTH, UNKNOWN_SATELLITE = -100, -101

_OVERHEAD, _PAYLOAD, _HEADER = 8, 6, 8  # bytes of a frame besides its payload, before it, and of the payload before its words
_GPS_ID, _GALILEO_ID, _BEIDOU_ID, _QZSS_ID, _GLONASS_ID = 0, 2, 3, 5, 6
_MAX_FREQ_ID: Final = 20


@kernel
def _read_words(data: bytes, position: int, count: int, bits: int, words: Words) -> None:
    """Read the lowest ``bits`` bits of ``count`` little-endian words."""
    for k in range(count):
        at = position + 4 * k
        word = int(data[at]) | int(data[at + 1]) << 8 | int(data[at + 2]) << 16 | int(data[at + 3]) << 24
        words[k] = word & (1 << bits) - 1


@kernel
def _message_of(gnss: int, number: int, sig: int, freq: int, count: int) -> int:
    """Return the message that ``count`` words of satellite ``number`` on this signal hold, -1 if it holds no ephemeris of ours."""
    if gnss in (_GPS_ID, _QZSS_ID) and sig == 0 and count == 10:  # other signals carry CNAV or SBAS-like data
        return LNAV_MESSAGE
    if gnss == _GALILEO_ID and sig in (1, 5) and count >= 8:
        return INAV_MESSAGE
    if gnss == _BEIDOU_ID and count == 10:
        if number <= 5 or number >= 59:  # geostationary; receivers before the F9 do not tell D2 apart by its signal
            return D2_MESSAGE if sig in (0, 1, 3, 10) else -1
        return D1_MESSAGE if sig in (0, 2, 4) else -1
    return GLONASS_MESSAGE if gnss == _GLONASS_ID and count == 4 and freq <= _MAX_FREQ_ID else -1


@kernel
def take_subframe(
    data: bytes, start: int, end: int, words: Words, satellites: Satellites, clock: int, week: int, tow_s: float
) -> tuple[int, int, int]:
    """Take the payload ``data[start:end]`` of one RXM-SFRBX; return its satellite, message and what comes of it."""
    if end - start < _HEADER or end - start < _HEADER + 4 * int(data[start + 4]):
        return 0, 0, WRONG_LENGTH
    gnss, sv, sig, freq, count = int(data[start]), int(data[start + 1]), int(data[start + 2]), int(data[start + 3]), int(data[start + 4])
    satellite = int(SATELLITE_OF[gnss, sv]) if gnss < GNSS_IDS else 0
    if satellite == 0:
        return 0, 0, UNKNOWN_SATELLITE
    message, at = _message_of(gnss, satellite % SATELLITES_PER_SYSTEM, sig, freq, count), start + _HEADER
    result = QUIET
    if message == GLONASS_MESSAGE:
        _read_words(data, at, 4, 32, words)
        frame, words[2] = words[3], words[2] >> 11 << 11
        result = take_glonass(satellites, satellite, words, freq - 7, frame, clock, week, tow_s)
    elif message == INAV_MESSAGE:
        _read_words(data, at, 8, 32, words)
        result = take_inav(satellites, satellite, words, clock)
    elif message >= 0:
        _read_words(data, at, 10, 30, words)
        if message == LNAV_MESSAGE:
            result = take_lnav(satellites, satellite, words, clock)
        elif message == D1_MESSAGE:
            result = take_d1(satellites, satellite, words, clock)
        else:
            result = take_d2(satellites, satellite, words, clock)
    return satellite, message, result


@kernel
def take_subframes(
    data: bytes, start: int, satellites: Satellites, clock: int, week: int, tow_s: float
) -> tuple[int, int, int, int, int]:  # fmt: skip
    """Take the RXM-SFRBX frames that stand one behind the other in ``data`` from ``start`` on, up to the first one that is not quiet.

    ``clock``, ``week`` and ``tow_s`` are NavigationDecoder.now. Returns the number of frames taken, the position behind them, and of the
    last one its satellite, its message and what comes of it (``NavigationDecoder.outcome``, or WRONG_LENGTH or UNKNOWN_SATELLITE).
    """
    words, position, taken = np.zeros(WORDS, np.int64), start, 0
    while position < len(data):
        stop = len(data) + 1
        if position + _OVERHEAD <= len(data):
            stop = position + _OVERHEAD + (int(data[position + 4]) | int(data[position + 5]) << 8)
        taken += 1
        if stop > len(data):
            return taken, len(data), 0, 0, WRONG_LENGTH
        satellite, message, result = take_subframe(data, position + _PAYLOAD, stop - 2, words, satellites, clock, week, tow_s)
        position = stop
        if result != QUIET:
            return taken, position, satellite, message, result
    return taken, position, 0, 0, QUIET
