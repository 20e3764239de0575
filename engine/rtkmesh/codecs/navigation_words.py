"""The newest navigation blocks of all satellites as words in one array, and the kernels that put them there.

Most blocks of a stream repeat what is known. The kernels check a block (preamble, CRC, check bits), keep its words, and say which block
``NavigationDecoder`` has to look at because an ephemeris, a time or an ionosphere may come of it.
"""

from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.codecs.bits import Layout
from rtkmesh.codecs.checksums import crc24q_step
from rtkmesh.codecs.subframes import BEIDOU_PREAMBLE, GLONASS_CHECK_MASKS, GLONASS_STRING, INAV, LNAV_PREAMBLE
from rtkmesh.gnss.constants import SECONDS_PER_WEEK
from rtkmesh.gnss.signals import GPS, QZSS, SATELLITES_PER_SYSTEM

LNAV_MESSAGE, INAV_MESSAGE, D1_MESSAGE, D2_MESSAGE, GLONASS_MESSAGE = range(5)
NO_CLOCK, OWN_CLOCK, GIVEN_CLOCK = range(3)  # no time is known; it comes from the blocks themselves; it was given

BLOCKS: Final = 11  # of a satellite: blocks that are numbered from 1, and one that is not kept (0)
WORDS: Final = 10  # of a block: LNAV and BeiDou 10 of 30 bits (a page of D2 5), I/NAV 4 and GLONASS 3 of 32 bits
IONOSPHERE_SUBFRAME: Final = 4

# The blocks of one satellite.
SATELLITE: Final = np.dtype([
    ("held", np.int64),  # bit i: block i came
    ("settled", np.int64),  # 1: these blocks have been tried, and their ephemeris, if any, is published
    ("channel", np.int64),
    ("tried_channel", np.int64),  # of GLONASS strings that were tried last
    ("toe_s", np.float64),  # what they gave: its toe since the beginning of GPS time, 0 if nothing
    ("stamps", np.int64, BLOCKS),  # when, or in which frame, a block was sent, and 1; 0: not known
    ("received_week", np.int64, BLOCKS),  # when a GLONASS string came, and 1; 0: not known
    ("received_tow_s", np.float64, BLOCKS),
    ("words", np.int64, (BLOCKS, WORDS)),
])  # fmt: skip
Satellites = NDArray[np.void]  # of SATELLITE, by satellite
Words = NDArray[np.int64]

_SAME_DAY_S: Final = 11 * 3600.0  # beyond 12 h the day is another one

# What comes of a block: its index if somebody must look at it, or one of these.
QUIET, BAD_PREAMBLE, BAD_CHECKSUM, ALERT, OUT_OF_RANGE = -1, -2, -3, -4, -5


class Refusal(Enum):
    """Why a block was not used (data faults are values)."""

    PREAMBLE = "preamble"
    CHECKSUM = "checksum"
    ALERT_PAGE = "alert page"
    RANGE = "range"


REFUSALS: Final = {
    BAD_PREAMBLE: Refusal.PREAMBLE,
    BAD_CHECKSUM: Refusal.CHECKSUM,
    ALERT: Refusal.ALERT_PAGE,
    OUT_OF_RANGE: Refusal.RANGE,
}


def words_of(block: int, bits: int, word_bits: int) -> list[int]:
    """Return a block of ``bits`` bits as words of ``word_bits``; the last one is filled up with zeros."""
    count = -(-bits // word_bits)
    block <<= count * word_bits - bits
    return [block >> word_bits * (count - 1 - k) & (1 << word_bits) - 1 for k in range(count)]


def block_of(words: list[int], bits: int, word_bits: int) -> int:
    """Return the block of ``bits`` bits that begins with these words of ``word_bits``."""
    block, count = 0, -(-bits // word_bits)
    for word in words[:count]:
        block = block << word_bits | word
    return block >> count * word_bits - bits


def _mask_of(layout: Layout, *names: str) -> int:
    """Return the mask of the bits of a block that hold the named fields."""
    parts = [part for field in layout.fields if field.name in names for part in field.parts]
    return sum((1 << length) - 1 << layout.bits - first - length for first, length in parts)


def _contents() -> NDArray[np.int64]:
    """Return the masks of the words, by message and block, whose change means new data.

    The first two words of LNAV are the same in meaning whenever they are sent; so are preamble, time and the parity of words 1 and 2 of
    BeiDou, the time in word 5 of I/NAV, and that in string 1 of GLONASS with the check bits.
    """
    contents = np.zeros((5, BLOCKS, WORDS), np.int64)
    contents[LNAV_MESSAGE] = words_of((1 << 240) - 1, 300, 30)
    contents[INAV_MESSAGE, :, :4] = 0xFFFFFFFF
    contents[INAV_MESSAGE, 5, :4] = words_of((1 << 128) - 1 ^ _mask_of(INAV[5], "tow_s"), 128, 32)
    contents[D1_MESSAGE] = words_of(((1 << 258) - 1) & ~(0xFF << 240), 300, 30)
    contents[D2_MESSAGE, :, :5] = contents[D1_MESSAGE, :, :5]
    contents[GLONASS_MESSAGE, :, :3] = 0xFFFFFFFF
    hidden = _mask_of(GLONASS_STRING[1], "tk_hours", "tk_minutes", "tk_half_minutes") | 0xFF
    contents[GLONASS_MESSAGE, 1, :3] = words_of((1 << 85) - 1 ^ hidden, 85, 32)
    return contents


def _meanings() -> NDArray[np.int64]:
    """Return the masks of the words of GLONASS strings, by string, that make the ephemeris, but for its time of transmission."""
    unused = ("string", "p", "p1", "p2", "p3", "p4", "type", "nt_days", "tk_hours", "tk_minutes", "tk_half_minutes")
    meanings = np.zeros((BLOCKS, WORDS), np.int64)
    for index in (1, 2, 3, 4):
        layout = GLONASS_STRING[index]
        used = [f.name for f in layout.fields if f.name not in unused]
        meanings[index, :3] = words_of(_mask_of(layout, *used), layout.bits, 32)
    return meanings


_CONTENTS = _contents()
GLONASS_MEANINGS = _meanings()
_CHECK_MASKS = np.array([words_of(mask << 8, 85, 32) for mask in GLONASS_CHECK_MASKS], np.int64)
_EVERY_DATA_BIT = np.array(words_of(((1 << 77) - 1) << 8, 85, 32), np.int64)


def new_satellites(count: int) -> Satellites:
    """Return the memory of satellites 0 to ``count`` - 1, of which nothing came yet."""
    return np.zeros(count, SATELLITE)


@kernel
def keep_block(satellites: Satellites, satellite: int, message: int, index: int, words: Words, stamp: int) -> bool:
    """Keep a block as the newest one of its index; return whether it is the first one of its satellite."""
    state = satellites[satellite]
    first, changed = state["held"] == 0, state["held"] >> index & 1 == 0
    kept = state["words"]
    for k in range(WORDS):
        changed = changed or (kept[index, k] ^ words[k]) & _CONTENTS[message, index, k] != 0
        kept[index, k] = words[k]
    if changed:
        state["settled"] = 0
    state["held"] |= 1 << index
    state["stamps"][index] = stamp + 1
    return first


@kernel
def set_is_whole(satellites: Satellites, satellite: int, message: int, clock: int) -> bool:
    """Return whether the blocks of a satellite may make an ephemeris, and are not settled.

    LNAV and GLONASS need a time; BeiDou's blocks must have been sent one after the other, GLONASS' in one frame, or at least in frames
    that are known.
    """
    state = satellites[satellite]
    count, step_s = 3, 0
    if message == INAV_MESSAGE:
        count = 5
    elif message == D1_MESSAGE:
        step_s = 6
    elif message == D2_MESSAGE:
        count, step_s = 10, 3
    elif message == GLONASS_MESSAGE:
        count = 4
    if state["settled"] or (clock == NO_CLOCK and message in (LNAV_MESSAGE, GLONASS_MESSAGE)):
        return False
    stamps, same, known = state["stamps"], True, True
    for i in range(1, count + 1):
        if state["held"] >> i & 1 == 0:
            return False
        if step_s and (stamps[i] - stamps[1] - step_s * (i - 1)) % int(SECONDS_PER_WEEK) != 0:
            return False
        same, known = same and stamps[i] == stamps[1] and stamps[i] > 0, known and stamps[i] > 1
    return message != GLONASS_MESSAGE or same or known


@kernel
def take_lnav(satellites: Satellites, satellite: int, words: Words, clock: int) -> int:
    """Take one GPS or QZSS LNAV subframe (ten words of 30 bits, parity included)."""
    if words[0] >> 22 != LNAV_PREAMBLE:
        return BAD_PREAMBLE
    index = words[1] >> 8 & 7
    if index == IONOSPHERE_SUBFRAME:
        # Data id and page id (IS-GPS-200N 20.3.3.5.1, IS-QZSS-PNT 5.5.2).
        system, page = satellite // SATELLITES_PER_SYSTEM, words[2] >> 22
        if not ((system == GPS and page == 1 << 6 | 56) or (system == QZSS and page == 3 << 6 | 56)):
            return QUIET
        satellites[satellite]["words"][index, :] = words
        return IONOSPHERE_SUBFRAME
    if index < 1 or index > 3:
        return QUIET
    first = keep_block(satellites, satellite, LNAV_MESSAGE, index, words, 0)
    return index if first or set_is_whole(satellites, satellite, LNAV_MESSAGE, clock) else QUIET


@kernel
def inav_crc(words: Words) -> int:
    """Return the CRC-24Q of an I/NAV page: 114 bits of the even part and 82 of the odd part (Galileo OS SIS ICD 2.1 5.1.9.4)."""
    crc = 0
    for first, last in ((0, 3), (4, 6)):
        for k in range(first, last + 1):
            for shift in range(24, 8 if k == last else -8, -8):
                crc = crc24q_step(crc, words[k] >> shift & 255, 8)
        crc = crc24q_step(crc, words[last] >> 14 & 3, 2)
    return crc


@kernel
def take_inav(satellites: Satellites, satellite: int, words: Words, clock: int) -> int:
    """Take one Galileo I/NAV page, even and odd part, as u-blox lays them out (eight words, see ``INAV_PAGE``; they are used up)."""
    if words[0] >> 31 or not words[4] >> 31:
        return BAD_PREAMBLE
    if words[0] >> 30 & 1 or words[4] >> 30 & 1:
        return ALERT
    index = words[0] >> 24 & 63
    if index > 5:
        return QUIET
    if inav_crc(words) != (words[6] & 0x3FFF) << 10 | words[7] >> 22:
        return BAD_CHECKSUM
    for k in range(3):
        words[k] = (words[k] << 2 | words[k + 1] >> 30) & 0xFFFFFFFF
    words[3] = (words[3] >> 14 & 0xFFFF) << 16 | words[4] >> 14 & 0xFFFF
    if index == 0:
        if clock == GIVEN_CLOCK or words[0] >> 24 & 3 != 2:  # no time in it
            return QUIET
        satellites[satellite]["words"][index, :] = words
        return index
    first = keep_block(satellites, satellite, INAV_MESSAGE, index, words, 0)
    news = first or (index == 5 and clock != GIVEN_CLOCK)
    return index if news or set_is_whole(satellites, satellite, INAV_MESSAGE, clock) else QUIET


@kernel
def _sow_s(words: Words) -> int:
    """Return the seconds of week of a BeiDou subframe."""
    return (words[0] >> 4 & 0xFF) << 12 | words[1] >> 18


@kernel
def take_d1(satellites: Satellites, satellite: int, words: Words, clock: int) -> int:
    """Take one BeiDou D1 subframe (ten words of 30 bits, parity included)."""
    if words[0] >> 19 != BEIDOU_PREAMBLE:
        return BAD_PREAMBLE
    index = words[0] >> 12 & 7
    if index < 1 or index > 3:
        return QUIET
    first = keep_block(satellites, satellite, D1_MESSAGE, index, words, _sow_s(words))
    news = first or (index == 1 and not satellites[satellite]["settled"])
    return index if news or set_is_whole(satellites, satellite, D1_MESSAGE, clock) else QUIET


@kernel
def take_d2(satellites: Satellites, satellite: int, words: Words, clock: int) -> int:
    """Take one BeiDou D2 subframe (ten words of 30 bits, parity included), of which the first half is kept."""
    if words[0] >> 19 != BEIDOU_PREAMBLE:
        return BAD_PREAMBLE
    if words[0] >> 12 & 7 != 1:
        return QUIET
    index = words[1] >> 14 & 15
    if index < 1 or index > 10:
        return OUT_OF_RANGE
    first = keep_block(satellites, satellite, D2_MESSAGE, index, words, _sow_s(words))
    return index if first or set_is_whole(satellites, satellite, D2_MESSAGE, clock) else QUIET


@kernel
def _is_odd(value: int) -> int:
    """Return the parity of 32 bits."""
    for shift in (16, 8, 4, 2, 1):
        value ^= value >> shift
    return value & 1


@kernel
def glonass_checks(words: Words) -> int:
    """Return the check bits 8 to 1 of a string (GLONASS ICD 5.1, 4.7, table 4.13)."""
    check, total = 0, 0
    for k in range(7):
        bit = 0
        for i in range(3):
            bit ^= _is_odd(words[i] & _CHECK_MASKS[k, i])
        check |= bit << k
        total ^= bit
    for i in range(3):
        total ^= _is_odd(words[i] & _EVERY_DATA_BIT[i])
    return check | total << 7


@kernel
def gives_the_same(state: np.void, index: int, words: Words, channel: int, clock: int, now_s: float) -> bool:
    """Return whether a string that comes to the settled blocks of a GLONASS satellite leaves them settled.

    Some bits of strings change in every frame and mean nothing here. The ephemeris is the one of the last trial if the others are the
    same, and if the day of its toe, which is that nearest to the present time, cannot be another one yet.
    """
    if not state["settled"] or clock != GIVEN_CLOCK or state["toe_s"] <= 0.0 or channel != state["tried_channel"]:
        return False
    for k in range(3):
        if (state["words"][index, k] ^ words[k]) & GLONASS_MEANINGS[index, k]:
            return False
    return abs(now_s - state["toe_s"]) < _SAME_DAY_S


@kernel
def take_glonass(
    satellites: Satellites, satellite: int, words: Words, channel: int, frame: int, clock: int, week: int, tow_s: float
) -> int:
    """Take one GLONASS string (85 bits, check bits included, the rest zero); ``frame`` is equal for the strings of one frame, or 0.

    ``week`` and ``tow_s`` are the time now, if it was given.
    """
    index = words[0] >> 27 & 15
    if index < 1 or index > 5:
        return QUIET
    if glonass_checks(words) != words[2] >> 11 & 255:
        return BAD_CHECKSUM
    state = satellites[satellite]
    settled = gives_the_same(state, index, words, channel, clock, week * SECONDS_PER_WEEK + tow_s)
    first = keep_block(satellites, satellite, GLONASS_MESSAGE, index, words, frame)
    if settled:
        state["settled"] = 1
    state["channel"] = channel
    state["received_week"][index], state["received_tow_s"][index] = week + 1 if clock == GIVEN_CLOCK else 0, tow_s
    if index == 1 and frame == 0:  # a new frame begins: what is left of others must not complete it
        state["stamps"][2:] = 0
    if first:
        return index
    news = index == 5 and clock != GIVEN_CLOCK and not state["settled"]
    return index if news or set_is_whole(satellites, satellite, GLONASS_MESSAGE, clock) else QUIET
