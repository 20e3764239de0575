"""Candidates for frames of Unicore N4 receivers, and of ASCII logs of NovAtel's form (Unicore N4 commands manual R1.13, 7.1).

Binary: AA 44 B5, a header of 24 bytes, payload, CRC-32 (NovAtel's: ``framing_novatel``). ASCII: ``#NAME,header;body*crc32`` and the
replies to commands, ``#NAME,...*hh`` with an exclusive or of all characters, the ``#`` included.
"""

from typing import Final

from rtkmesh._jit import kernel
from rtkmesh.codecs.candidates import BAD_CHECKSUM, NEEDS_MORE, NO_FRAME, hex_value
from rtkmesh.codecs.checksums import crc32_range

UNICORE_THIRD: Final = 0xB5  # third byte
UNICORE_HEADER: Final = 24
UNICORE_OVERHEAD: Final = UNICORE_HEADER + 4
UNICORE_MAX_PAYLOAD: Final = 16384  # 409 measurements of OBSVM; bounds the wait for a false header
ASCII_LOG_MAX_LENGTH: Final = 32768  # 400 measurements of OBSVMA
_MAX_NAME: Final = 24
_COMMA, _STAR, _HASH, _CR, _LF, _UNDERSCORE = 44, 42, 35, 13, 10, 95

# Numbers of logs (R1.13, 7.3 to 7.5); those that are not here are counted by their number.
UNICORE_LOGS: Final = {
    4: "BDSION", 8: "GPSION", 9: "GALION", 12: "OBSVM", 13: "OBSVH", 21: "BD3ION", 37: "VERSION", 102: "RECTIME", 106: "GPSEPH",
    107: "GLOEPH", 108: "BDSEPH", 109: "GALEPH", 110: "QZSSEPH", 112: "IRNSSEPH", 138: "OBSVMCMP", 139: "OBSVHCMP", 142: "ADRNAV",
    218: "HWSTATUS", 220: "AGC", 240: "BESTNAVXYZ", 284: "OBSVBASE", 509: "RTKSTATUS", 511: "JAMSTATUS", 521: "HEADINGSTATUS",
    954: "STADOP", 972: "UNIHEADING", 1021: "PVTSLN", 1331: "UNIHEADING2", 2118: "BESTNAV", 2119: "BESTNAVH", 2124: "SATSINFO",
    2125: "RTCMSTATUS", 2999: "BD3EPH", 11276: "AGRIC",
}  # fmt: skip


@kernel
def unicore_candidate(data: bytes, start: int, end: int) -> int:
    """Return the length of the binary log at ``start`` (its first byte is AA), or why there is none."""
    if start + 3 > end:
        known = start + 2 > end or data[start + 1] == 0x44
        return NEEDS_MORE if known else NO_FRAME
    if data[start + 1] != 0x44 or data[start + 2] != UNICORE_THIRD:
        return NO_FRAME
    if start + 8 > end:
        return NEEDS_MORE
    payload = int(data[start + 6]) | int(data[start + 7]) << 8
    if payload > UNICORE_MAX_PAYLOAD:
        return NO_FRAME
    return checked_log(data, start, start + payload + UNICORE_OVERHEAD, end)


@kernel
def checked_log(data: bytes, start: int, stop: int, end: int) -> int:
    """Return the length of a binary log from ``start`` to ``stop`` by the CRC-32 of its last four bytes, or why it is none."""
    if stop > end:
        return NEEDS_MORE
    sent = int(data[stop - 4]) | int(data[stop - 3]) << 8 | int(data[stop - 2]) << 16 | int(data[stop - 1]) << 24
    return stop - start if crc32_range(data, start, stop - 4) == sent else BAD_CHECKSUM


@kernel
def ascii_log_candidate(data: bytes, start: int, end: int) -> int:
    """Return the length of the ASCII log at ``start`` (its first byte is ``#``), or why there is none.

    A name of upper case letters and digits (NovAtel's second antenna: ``RANGEA_1``), printable ASCII up to ``*``, eight digits of a CRC-32
    or two of an exclusive or, CR LF (a lone LF is accepted).
    """
    position, in_name = start + 1, True
    while True:
        if position >= start + ASCII_LOG_MAX_LENGTH:
            return NO_FRAME
        if position >= end:
            return NEEDS_MORE
        character = int(data[position])
        if character == _STAR:
            break
        if character < 32 or character > 126 or character == _HASH:
            return NO_FRAME
        if in_name:
            if character == _COMMA and position > start + 1:
                in_name = False
            elif not (65 <= character <= 90 or 48 <= character <= 57 or character == _UNDERSCORE) or position > start + _MAX_NAME:
                return NO_FRAME
        position += 1
    return NO_FRAME if in_name else _ascii_log_end(data, start, position, end)


@kernel
def _ascii_log_end(data: bytes, start: int, star: int, end: int) -> int:
    """Return the length of an ASCII log by what stands behind its ``*``, or why it is none."""
    stop = star + 1
    while stop < end and stop < star + 9 and hex_value(data, stop, 1) >= 0:
        stop += 1
    digits = stop - star - 1
    if digits != 2 and digits != 8:
        return NEEDS_MORE if stop >= end else NO_FRAME
    if stop < end and data[stop] == _CR:
        stop += 1
    if stop >= end:
        return NEEDS_MORE
    if data[stop] != _LF:
        return NO_FRAME
    check = 0
    if digits == 8:
        check = crc32_range(data, start + 1, star)
    else:
        for position in range(start, star):
            check ^= int(data[position])
    return stop + 1 - start if check == hex_value(data, star + 1, digits) else BAD_CHECKSUM


@kernel
def is_novatel_log(data: bytes, start: int) -> bool:
    """Return whether a whole ASCII log has NovAtel's header (``#NAME,port,sequence,...``) instead of N4's (``#NAME,idle,GPS,...``).

    Older Unicore boards write that form too.
    """
    position, commas = start, 0
    while commas < 2 and data[position] != _STAR:
        commas += data[position] == _COMMA
        position += 1
    return commas == 2 and 48 <= data[position] <= 57
