"""RXM-SFRBX (u-blox F9 HPG 1.32 interface description, 3.17.11): whose navigation block it is, in which of its layouts."""

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
    QUIET,
    WORDS,
    Satellites,
    Words,
    take_block,
)
from rtkmesh.codecs.ubx_signals import GNSS_IDS, SATELLITE_OF, SIG_IDS
from rtkmesh.gnss.beidou import is_geostationary

# What is wrong with a message, besides what there may be with a block.
WRONG_LENGTH, UNKNOWN_SATELLITE = -100, -101

_OVERHEAD, _PAYLOAD, _HEADER = 8, 6, 8  # bytes of a frame besides its payload, before it, and of the payload before its words
_MAX_FREQ_ID: Final = 20
_NONE: Final = -1

# (gnssId, whether the satellite is geostationary) -> sigIds, message. Signals that are not here carry CNAV, SBAS-like data and the like;
# receivers before the F9 do not tell D2 apart by its signal.
_MESSAGES: Final = {
    (0, 0): ((0,), LNAV_MESSAGE),
    (2, 0): ((1, 5), INAV_MESSAGE),
    (3, 0): ((0, 2, 4), D1_MESSAGE),
    (3, 1): ((0, 1, 3, 10), D2_MESSAGE),
    (5, 0): ((0,), LNAV_MESSAGE),
    (6, 0): (tuple(range(SIG_IDS + 1)), GLONASS_MESSAGE),
}

# By message: words that are sent (with an I/NAV page at least), words that make the block, and the mask of their bits.
_WORDS: Final = ((10, 10, 30), (8, 8, 32), (10, 10, 30), (10, 10, 30), (4, 4, 32))
_SENT, _USED = (np.array([row[k] for row in _WORDS], np.int64) for k in (0, 1))
_MASKS = np.array([(1 << bits) - 1 for _, _, bits in _WORDS], np.int64)


def _message_table() -> NDArray[np.int64]:
    """Return messages by gnssId, whether the satellite is geostationary, and sigId (SIG_IDS stands for all that are not known)."""
    table = np.full((GNSS_IDS, 2, SIG_IDS + 1), _NONE, np.int64)
    for (gnss, geostationary), (sigs, message) in _MESSAGES.items():
        table[gnss, geostationary, list(sigs)] = message
    return table


_MESSAGE_OF = _message_table()


@kernel
def read_block(data: bytes, start: int, end: int, words: Words) -> tuple[int, int, int, int]:
    """Read the words of the block in the payload ``data[start:end]`` of one RXM-SFRBX.

    Returns satellite (or WRONG_LENGTH or UNKNOWN_SATELLITE), message (_NONE if it holds no ephemeris of ours), channel and frame of a
    GLONASS string.
    """
    if end - start < _HEADER or end - start < _HEADER + 4 * int(data[start + 4]):
        return WRONG_LENGTH, _NONE, 0, 0
    gnss, sig, freq, count = int(data[start]), int(data[start + 2]), int(data[start + 3]), int(data[start + 4])
    satellite = int(SATELLITE_OF[gnss, data[start + 1]]) if gnss < GNSS_IDS else 0
    if satellite == 0:
        return UNKNOWN_SATELLITE, _NONE, 0, 0
    message = int(_MESSAGE_OF[gnss, int(is_geostationary(satellite)), min(sig, SIG_IDS)])
    if message < 0 or count < _SENT[message] or (count > _SENT[message] and message != INAV_MESSAGE):
        return satellite, _NONE, 0, 0
    for k in range(WORDS):
        words[k] = 0
    for k in range(_USED[message]):
        at = start + _HEADER + 4 * k
        words[k] = (int(data[at]) | int(data[at + 1]) << 8 | int(data[at + 2]) << 16 | int(data[at + 3]) << 24) & _MASKS[message]
    if message != GLONASS_MESSAGE:
        return satellite, message, 0, 0
    frame, words[2], words[3] = words[3], words[2] >> 11 << 11, 0
    return satellite, message if freq <= _MAX_FREQ_ID else _NONE, freq - 7, frame


@kernel
def take_subframes(
    data: bytes, start: int, satellites: Satellites, clock: int, week: int, tow_s: float
) -> tuple[int, int, int, int, int]:  # fmt: skip
    """Take the RXM-SFRBX frames that stand one behind the other in ``data`` from ``start`` on, up to the first one that is not quiet.

    ``clock``, ``week`` and ``tow_s`` are NavigationDecoder.now. Returns the number of frames taken, the position behind them, and of the
    last one its satellite, its message and the index of the block that is to be looked at, or what is wrong (see ``check_block``; or
    WRONG_LENGTH or UNKNOWN_SATELLITE).
    """
    words, position, taken = np.empty(WORDS, np.int64), start, 0
    while position < len(data):
        at, taken = position, taken + 1
        position = len(data) + 1
        if at + _OVERHEAD <= len(data):
            position = at + _OVERHEAD + (int(data[at + 4]) | int(data[at + 5]) << 8)
        if position > len(data):
            return taken, len(data), 0, 0, WRONG_LENGTH
        satellite, message, channel, frame = read_block(data, at + _PAYLOAD, position - 2, words)
        if satellite < 0:
            return taken, position, 0, 0, satellite
        if message < 0:
            continue
        result = take_block(satellites, satellite, message, words, channel, frame, clock, week, tow_s)
        if result != QUIET:
            return taken, position, satellite, message, result
    return taken, position, 0, 0, QUIET
