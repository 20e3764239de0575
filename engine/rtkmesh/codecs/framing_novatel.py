"""Candidates for binary logs of NovAtel OEM4 to OEM7 receivers (OEM7 commands and logs reference manual v15C, 1.5).

AA 44 12: a header of 28 bytes (it says how long it is), payload, CRC-32. AA 44 13: a short header of 12 bytes. Their ASCII logs are those
of ``framing_unicore``.
"""

from typing import Final

from rtkmesh._jit import kernel
from rtkmesh.codecs.candidates import NEEDS_MORE, NO_FRAME
from rtkmesh.codecs.framing_unicore import checked_log

LONG_THIRD, SHORT_THIRD = 0x12, 0x13  # third byte, which tells the form of the header
LONG_HEADER: Final = 28
SHORT_HEADER: Final = 12
NOVATEL_MAX_PAYLOAD: Final = 24576  # RANGE of 558 measurements; bounds the wait for a false header
_CRC: Final = 4

# Numbers of logs (OEM7 v15C, 3); those that are not here are counted by their number.
NOVATEL_LOGS: Final = {
    7: "GPSEPHEM", 8: "IONUTC", 37: "VERSION", 41: "RAWEPHEM", 42: "BESTPOS", 43: "RANGE", 47: "PSRPOS", 93: "RXSTATUS", 99: "BESTVEL",
    101: "TIME", 128: "CLOCKMODEL", 140: "RANGECMP", 141: "RTKPOS", 241: "BESTXYZ", 287: "RAWWAASFRAME", 508: "INSPVAS",
    723: "GLOEPHEMERIS", 963: "HWMONITOR", 971: "HEADING", 973: "RAWSBASFRAME", 1122: "GALEPHEMERIS", 1127: "GALIONO", 1273: "RANGECMP2",
    1309: "GALINAVEPHEMERIS", 1310: "GALFNAVEPHEMERIS", 1331: "QZSSRAWEPHEM", 1335: "HEADING2", 1336: "QZSSEPHEMERIS", 1347: "QZSSIONUTC",
    1696: "BDSEPHEMERIS", 2050: "RANGECMP4", 2123: "NAVICEPHEMERIS",
}  # fmt: skip


@kernel
def novatel_candidate(data: bytes, start: int, end: int) -> int:
    """Return the length of the binary log at ``start`` (its first byte is AA), or why there is none."""
    if start + 3 > end:
        return NEEDS_MORE if start + 2 > end or data[start + 1] == 0x44 else NO_FRAME
    if data[start + 1] != 0x44 or not (data[start + 2] == LONG_THIRD or data[start + 2] == SHORT_THIRD):
        return NO_FRAME
    if start + 10 > end:
        return NEEDS_MORE
    if data[start + 2] == SHORT_THIRD:
        return checked_log(data, start, start + SHORT_HEADER + int(data[start + 3]) + _CRC, end)
    header, payload = int(data[start + 3]), int(data[start + 8]) | int(data[start + 9]) << 8
    if header < LONG_HEADER or payload > NOVATEL_MAX_PAYLOAD:
        return NO_FRAME
    return checked_log(data, start, start + header + payload + _CRC, end)
