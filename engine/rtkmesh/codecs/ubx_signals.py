"""Satellites and signals as u-blox numbers them (u-blox F9 HPG 1.32 interface description, 1.5)."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.signals import BEIDOU, GALILEO, GLONASS, GPS, NAVIC, QZSS, SATELLITES_PER_SYSTEM, SBAS, signal_number

# gnssId -> (system, first svId, last svId, svId - number); (gnssId, sigId) -> RINEX code
_SATELLITES: Final = {
    0: (GPS, 1, 32, 0), 1: (SBAS, 120, 158, 100), 2: (GALILEO, 1, 36, 0), 3: (BEIDOU, 1, 63, 0), 5: (QZSS, 1, 10, 0),
    6: (GLONASS, 1, 32, 0), 7: (NAVIC, 1, 14, 0),
}  # fmt: skip
_SIGNALS: Final = {
    (0, 0): "1C", (0, 3): "2L", (0, 4): "2S", (0, 6): "5I", (0, 7): "5Q",
    (1, 0): "1C",
    (2, 0): "1C", (2, 1): "1B", (2, 3): "5I", (2, 4): "5Q", (2, 5): "7I", (2, 6): "7Q", (2, 8): "6B", (2, 9): "6C", (2, 10): "6A",
    (3, 0): "2I", (3, 1): "2I", (3, 2): "7I", (3, 3): "7I", (3, 4): "6I", (3, 10): "6I",
    (3, 5): "1P", (3, 6): "1D", (3, 7): "5P", (3, 8): "5D",
    (5, 0): "1C", (5, 1): "1Z", (5, 4): "2S", (5, 5): "2L", (5, 8): "5I", (5, 9): "5Q", (5, 12): "1E",
    (6, 0): "1C", (6, 2): "2C",
    (7, 0): "5A",
}  # fmt: skip
GNSS_IDS, SV_IDS, SIG_IDS = 8, 256, 16


def _satellite_table() -> NDArray[np.int16]:
    """Return satellite numbers by gnssId and svId, 0 where there is none."""
    table = np.zeros((GNSS_IDS, SV_IDS), np.int16)
    for gnss, (system, first, last, offset) in _SATELLITES.items():
        for sv in range(first, last + 1):
            table[gnss, sv] = system * SATELLITES_PER_SYSTEM + sv - offset
    return table


def _signal_table() -> NDArray[np.int16]:
    """Return signal numbers by gnssId and sigId, 0 where there is none."""
    table = np.zeros((GNSS_IDS, SIG_IDS), np.int16)
    for (gnss, sig), code in _SIGNALS.items():
        table[gnss, sig] = signal_number(code)
    return table


SATELLITE_OF = _satellite_table()
SIGNAL_OF = _signal_table()
