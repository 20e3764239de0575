"""Satellites and signals as Unicore N4 receivers number them (Unicore N4 commands manual R1.13, OBSVM: channel tracking status)."""

from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.signals import BEIDOU, GALILEO, GLONASS, GPS, NAVIC, QZSS, SATELLITES_PER_SYSTEM, SBAS, satellite_number, signal_number

SYSTEMS, PRNS, SIGNAL_TYPES = 8, 256, 64
L2C_FLAG: Final = 32  # of a signal type here: that it is L2C(M), not L2P(Y); it means nothing for other signals

# Number of the system in the tracking status -> (system, first PRN, last PRN, PRN - number); QZSS is told by PRN or from 1 on.
SATELLITES: Final = (
    (0, GPS, 1, 32, 0), (1, GLONASS, 38, 64, 37), (2, SBAS, 120, 158, 100), (3, GALILEO, 1, 36, 0), (4, BEIDOU, 1, 63, 0),
    (5, QZSS, 193, 202, 192), (5, QZSS, 1, 10, 0), (6, NAVIC, 1, 14, 0),
)  # fmt: skip
# System -> {signal type: RINEX code}. L1S of QZSS comes as SBAS with the PRNs 183 to 191 and L1 C/A. B2b(I) is the data channel of B2b.
SIGNALS: Final = {
    0: {0: "1C", 3: "1L", 6: "5I", 9: "2W", 9 | L2C_FLAG: "2S", 11: "1S", 14: "5Q", 17: "2L"},
    1: {0: "1C", 5: "2C", 6: "3I", 7: "3Q"},
    2: {0: "1C", 6: "5I"},
    3: {1: "1B", 2: "1C", 12: "5Q", 17: "7Q", 18: "6B", 22: "6C"},
    4: {0: "2I", 4: "2Q", 5: "7Q", 6: "6Q", 8: "1P", 12: "5P", 13: "7D", 17: "7I", 21: "6I", 23: "1D", 28: "5D"},
    5: {0: "1C", 1: "1E", 3: "1L", 4: "1Z", 6: "5I", 9 | L2C_FLAG: "2S", 11: "1S", 14: "5Q", 17: "2L", 21: "6S", 27: "6E"},
    6: {6: "5A", 14: "5C"},
}  # fmt: skip
_L1S_SYSTEM, _L1S_PRN, _L1S = 2, (183, 191), "1Z"


def _satellite_table() -> NDArray[np.int16]:
    """Return satellite numbers by system and PRN, 0 where there is none."""
    table = np.zeros((SYSTEMS, PRNS), np.int16)
    for number, system, first, last, offset in SATELLITES:
        for prn in range(first, last + 1):
            table[number, prn] = system * SATELLITES_PER_SYSTEM + prn - offset
    for prn in range(_L1S_PRN[0], _L1S_PRN[1] + 1):
        table[_L1S_SYSTEM, prn] = satellite_number("J01") + prn - _L1S_PRN[0]
    return table


def signal_table(signals: Mapping[int, Mapping[int, str]]) -> NDArray[np.int16]:
    """Return signal numbers by system and signal type, 0 where there is none."""
    table = np.zeros((SYSTEMS, SIGNAL_TYPES), np.int16)
    for number, codes in signals.items():
        for kind, code in codes.items():
            table[number, kind] = signal_number(code)
            if kind < L2C_FLAG and kind | L2C_FLAG not in codes:
                table[number, kind | L2C_FLAG] = signal_number(code)
    return table


SATELLITE_OF = _satellite_table()
SIGNAL_OF = signal_table(SIGNALS)
L1S_SIGNAL: Final = signal_number(_L1S)
