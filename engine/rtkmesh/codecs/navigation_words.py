"""The newest navigation blocks of all satellites as words in one array, and the kernels that put them there.

Most blocks of a stream repeat what is known. The kernels check a block (preamble, CRC, check bits), keep its words, and say which block
``NavigationDecoder`` has to look at because an ephemeris, a time or an ionosphere may come of it.
"""

from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place
from rtkmesh.codecs.bits import Layout
from rtkmesh.codecs.checksums import CRC24Q
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


def _meanings(contents: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return masks like those of contents: of GLONASS strings only what makes the ephemeris, but for its time of transmission."""
    unused = ("string", "p", "p1", "p2", "p3", "p4", "type", "nt_days", "tk_hours", "tk_minutes", "tk_half_minutes")
    meanings = contents.copy()
    meanings[GLONASS_MESSAGE] = 0
    for index in (1, 2, 3, 4):
        layout = GLONASS_STRING[index]
        used = [f.name for f in layout.fields if f.name not in unused]
        meanings[GLONASS_MESSAGE, index, :3] = words_of(_mask_of(layout, *used), layout.bits, 32)
    return meanings


_CONTENTS = _contents()
MEANINGS = _meanings(_CONTENTS)
_CHECK_MASKS = np.array([words_of(mask << 8, 85, 32) for mask in (*GLONASS_CHECK_MASKS, (1 << 77) - 1)], np.int64)
_FOLDS = np.array([16, 8, 4, 2, 1])  # of 32 bits to their parity


def new_satellites(count: int) -> Satellites:
    """Return the memory of satellites 0 to ``count`` - 1, of which nothing came yet."""
    return np.zeros(count, SATELLITE)


@kernel
def set_is_whole(satellites: Satellites, satellite: int, message: int, clock: int) -> bool:
    """Return whether the blocks of a satellite may make an ephemeris, and are not settled.

    LNAV and GLONASS need a time; BeiDou's blocks must have been sent one after the other, GLONASS' in one frame, or at least in frames
    that are known.
    """
    state = satellites[satellite]
    count, step_s, needs_time = 3, 0, message == LNAV_MESSAGE
    if message == INAV_MESSAGE:
        count = 5
    elif message == D1_MESSAGE:
        step_s = 6
    elif message == D2_MESSAGE:
        count, step_s = 10, 3
    elif message == GLONASS_MESSAGE:
        count, needs_time = 4, True
    if state["settled"] or (needs_time and clock == NO_CLOCK):
        return False
    stamps, same, known = state["stamps"], True, True
    for i in range(1, count + 1):
        if state["held"] >> i & 1 == 0:
            return False
        if step_s and (stamps[i] - stamps[1] - step_s * (i - 1)) % int(SECONDS_PER_WEEK) != 0:
            return False
        same, known = same and stamps[i] == stamps[1] and stamps[i] > 0, known and stamps[i] > 1
    return message != GLONASS_MESSAGE or same or known


@kernel_in_place
def check_block(satellite: int, message: int, words: Words, clock: int) -> int:
    """Check the block in ``words``; return its index if it is of use, QUIET if it is of none, or what is wrong with it.

    The words are ten of an LNAV or BeiDou subframe, three of a GLONASS string, or eight of an I/NAV page as u-blox lays it out (see
    ``INAV_PAGE``): of that the first four are afterwards the data of its word.
    """
    if message == INAV_MESSAGE:
        return _check_page(words, clock)
    if message == GLONASS_MESSAGE:
        return _check_string(words)
    if message == LNAV_MESSAGE:
        return _check_subframe(satellite // SATELLITES_PER_SYSTEM, words)
    return _check_beidou(message, words)


@kernel_in_place
def _check_page(words: Words, clock: int) -> int:
    """Check an I/NAV page, and leave the data of its word."""
    if words[0] >> 31 or not words[4] >> 31:
        return BAD_PREAMBLE
    if words[0] >> 30 & 1 or words[4] >> 30 & 1:
        return ALERT
    index = words[0] >> 24 & 63
    if index > 5:
        return QUIET
    if _crc_of_page(words) != (words[6] & 0x3FFF) << 10 | words[7] >> 22:
        return BAD_CHECKSUM
    for k in range(3):
        words[k] = (words[k] << 2 | words[k + 1] >> 30) & 0xFFFFFFFF
    words[3] = (words[3] >> 14 & 0xFFFF) << 16 | words[4] >> 14 & 0xFFFF
    return index if index > 0 or (words[0] >> 24 & 3 == 2 and clock != GIVEN_CLOCK) else QUIET  # word 0 may hold a time


@kernel_in_place
def _crc_of_page(words: Words) -> int:
    """Return the checksum of 114 bits of the even part and 82 of the odd part (Galileo OS SIS ICD 2.1 5.1.9.4)."""
    crc = 0
    for k in range(7):
        last = k == 3 or k == 6
        for shift in range(24, 8 if last else -8, -8):
            crc = ((crc << 8) & 0xFFFFFF) ^ int(CRC24Q[0, (crc >> 16) ^ (words[k] >> shift & 255)])
        if last:
            crc = ((crc << 2) & 0xFFFFFF) ^ int(CRC24Q[0, (crc >> 22) ^ (words[k] >> 14 & 3)])
    return crc


@kernel_in_place
def _check_string(words: Words) -> int:
    """Check a GLONASS string: its check bits are parities of masked data bits, the last of all of them and of the others (ICD 5.1, 4.7)."""
    index, check, total = words[0] >> 27 & 15, 0, 0
    if index < 1 or index > 5:
        return QUIET
    for k in range(8):
        odd = total if k == 7 else 0
        for i in range(3):
            odd ^= words[i] & _CHECK_MASKS[k, i]
        for shift in _FOLDS:
            odd ^= odd >> shift
        check |= (odd & 1) << k
        total ^= odd & 1
    return index if check == words[2] >> 11 & 255 else BAD_CHECKSUM


@kernel_in_place
def _check_subframe(system: int, words: Words) -> int:
    """Check an LNAV subframe; of the fourth that page is of use which holds the ionosphere, by its data id and page id
    (IS-GPS-200N 20.3.3.5.1, IS-QZSS-PNT 5.5.2).
    """
    if words[0] >> 22 != LNAV_PREAMBLE:
        return BAD_PREAMBLE
    index, page = words[1] >> 8 & 7, words[2] >> 22
    is_ionosphere = (system == GPS and page == 1 << 6 | 56) or (system == QZSS and page == 3 << 6 | 56)
    return index if 1 <= index <= 3 or (index == IONOSPHERE_SUBFRAME and is_ionosphere) else QUIET


@kernel_in_place
def _check_beidou(message: int, words: Words) -> int:
    """Check a subframe of BeiDou; of D2 the pages of the first are of use."""
    if words[0] >> 19 != BEIDOU_PREAMBLE:
        return BAD_PREAMBLE
    index, page = words[0] >> 12 & 7, words[1] >> 14 & 15
    if message == D1_MESSAGE or index != 1:
        return index if message == D1_MESSAGE and 1 <= index <= 3 else QUIET
    return page if 1 <= page <= 10 else OUT_OF_RANGE


@kernel
def keep_block(
    satellites: Satellites, satellite: int, message: int, index: int, words: Words, channel: int, frame: int,
    clock: int, week: int, tow_s: float,
) -> bool:  # fmt: skip
    """Keep a block as the newest one of its index; return whether it must be looked at, whatever the others of its set are.

    Of a GLONASS string come ``channel`` and ``frame``, a number that is equal for the strings of one frame, or 0. ``clock``, ``week`` and
    ``tow_s`` are NavigationDecoder.now.

    What settled blocks gave holds until a block with other contents comes. Some bits of GLONASS strings change in every frame and mean
    nothing here: with a given time the ephemeris is the one of the last trial if the others are the same, and if the day of its toe, which
    is that nearest to the present time, cannot be another one yet.
    """
    state, is_glonass = satellites[satellite], message == GLONASS_MESSAGE
    first, changed, turned, kept = state["held"] == 0, state["held"] >> index & 1 == 0, False, state["words"]
    for k in range(WORDS):
        difference = kept[index, k] ^ words[k]
        changed = changed or difference & _CONTENTS[message, index, k] != 0
        turned = turned or difference & MEANINGS[message, index, k] != 0
        kept[index, k] = words[k]
    if index == 0 or (message == LNAV_MESSAGE and index == IONOSPHERE_SUBFRAME):  # not part of a set
        return True
    if is_glonass and clock == GIVEN_CLOCK and not turned and state["toe_s"] > 0.0:
        from_toe_s = week * SECONDS_PER_WEEK + tow_s - state["toe_s"]
        changed = changed and (channel != state["tried_channel"] or abs(from_toe_s) >= _SAME_DAY_S)
    if changed:
        state["settled"] = 0
    state["held"] |= 1 << index
    if is_glonass:
        state["channel"], state["stamps"][index], state["received_tow_s"][index] = channel, frame + 1, tow_s
        state["received_week"][index] = week + 1 if clock == GIVEN_CLOCK else 0
        if index == 1 and frame == 0:  # a new frame begins: what is left of others must not complete it
            for k in range(2, BLOCKS):
                state["stamps"][k] = 0
    elif D1_MESSAGE <= message <= D2_MESSAGE:
        state["stamps"][index] = ((words[0] >> 4 & 0xFF) << 12 | words[1] >> 18) + 1  # seconds of week
    # A time that was not given, or the ionosphere of D1, may come of a block alone.
    of_time = clock != GIVEN_CLOCK and index == 5 and (message == INAV_MESSAGE or (is_glonass and not state["settled"]))
    return first or of_time or (message == D1_MESSAGE and index == 1 and not state["settled"])


@kernel
def take_block(
    satellites: Satellites, satellite: int, message: int, words: Words, channel: int, frame: int, clock: int, week: int, tow_s: float
) -> int:  # fmt: skip
    """Check and keep the block in ``words`` (see ``check_block`` and ``keep_block``).

    Returns its index if it must be looked at, QUIET if not, or what is wrong with it.
    """
    result = check_block(satellite, message, words, clock)
    if result < 0:
        return result
    news = keep_block(satellites, satellite, message, result, words, channel, frame, clock, week, tow_s)
    return result if news or set_is_whole(satellites, satellite, message, clock) else QUIET
