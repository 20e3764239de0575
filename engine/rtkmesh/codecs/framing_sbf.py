"""Candidates for blocks of Septentrio receivers (SBF; mosaic-X5 reference guide 4.14, 4.1.1).

``$@``, CRC-16 of all that follows it, number (13 bits) and revision, length of the block (a multiple of 4), then its contents.
"""

from typing import Final

import numpy as np

from rtkmesh._jit import kernel
from rtkmesh.codecs.candidates import BAD_CHECKSUM, NEEDS_MORE, NO_FRAME
from rtkmesh.codecs.checksums import crc16_range

SBF_SECOND: Final = 0x40
SBF_MAX_LENGTH: Final = 32768  # three antennas with all signals of 255 satellites have less; bounds the wait for a false header
_SHORTEST: Final = 8
_NUMBERS: Final = (4000, 6143)  # of blocks


@kernel
def sbf_candidate(data: bytes, start: int, end: int) -> int:
    """Return the length of the SBF block at ``start`` (its first byte is ``$``), or why there is none."""
    if start + 2 > end:
        return NEEDS_MORE
    if data[start + 1] != SBF_SECOND:
        return NO_FRAME
    if start + _SHORTEST > end:
        return NEEDS_MORE
    number, length = sbf_number(data, start), int(np.int64(data[start + 6]) | np.int64(data[start + 7]) << 8)
    if number < _NUMBERS[0] or number > _NUMBERS[1] or length < _SHORTEST or length % 4 or length > SBF_MAX_LENGTH:
        return NO_FRAME
    stop = start + length
    if stop > end:
        return NEEDS_MORE
    sent = int(data[start + 2]) | int(data[start + 3]) << 8
    return stop - start if crc16_range(data, start + 4, stop) == sent else BAD_CHECKSUM


@kernel
def sbf_number(data: bytes, start: int) -> int:
    """Return the number of a block without its revision."""
    return int((np.int64(data[start + 4]) | np.int64(data[start + 5]) << 8) & 0x1FFF)
