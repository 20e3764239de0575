"""Satellites and signals as Septentrio numbers them (mosaic-X5 reference guide 4.14, 4.1.9 and 4.1.10)."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.signals import BEIDOU, GALILEO, GLONASS, GPS, NAVIC, QZSS, SATELLITES_PER_SYSTEM, SBAS, signal_number

# First and last SVID, system, SVID minus number (SBAS: number is PRN - 100). SVID 62 is a GLONASS satellite whose slot is not known.
_SATELLITES: Final = (
    (1, 37, GPS, 0), (38, 61, GLONASS, 37), (63, 68, GLONASS, 38), (71, 106, GALILEO, 70), (120, 140, SBAS, 100), (141, 180, BEIDOU, 140),
    (181, 187, QZSS, 180), (191, 197, NAVIC, 190), (198, 215, SBAS, 157), (216, 222, NAVIC, 208), (223, 245, BEIDOU, 182),
)  # fmt: skip
_SIGNALS: Final = {
    0: (GPS, "1C"), 1: (GPS, "1W"), 2: (GPS, "2W"), 3: (GPS, "2L"), 4: (GPS, "5Q"), 5: (GPS, "1L"), 6: (QZSS, "1C"), 7: (QZSS, "2L"),
    8: (GLONASS, "1C"), 9: (GLONASS, "1P"), 10: (GLONASS, "2P"), 11: (GLONASS, "2C"), 12: (GLONASS, "3Q"), 13: (BEIDOU, "1P"),
    14: (BEIDOU, "5P"), 15: (NAVIC, "5A"), 17: (GALILEO, "1C"), 19: (GALILEO, "6C"), 20: (GALILEO, "5Q"), 21: (GALILEO, "7Q"),
    22: (GALILEO, "8Q"), 24: (SBAS, "1C"), 25: (SBAS, "5I"), 26: (QZSS, "5Q"), 27: (QZSS, "6L"), 28: (BEIDOU, "2I"), 29: (BEIDOU, "7I"),
    30: (BEIDOU, "6I"), 32: (QZSS, "1L"), 33: (QZSS, "1Z"), 34: (BEIDOU, "7D"), 38: (QZSS, "1E"), 39: (QZSS, "5P"),
}  # fmt: skip
SVIDS, SIGNAL_NUMBERS = 256, 64
GPS_L1P, GPS_L2P = 1, 2  # their C/N0 has no offset of 10 dB-Hz
GLONASS_FDMA: Final = (8, 11)  # first and last signal whose ObsInfo holds the frequency number
GALILEO_E6: Final = 19


def _satellite_table() -> NDArray[np.int16]:
    """Return satellite numbers by SVID, 0 where there is none."""
    table = np.zeros(SVIDS, np.int16)
    for first, last, system, offset in _SATELLITES:
        for svid in range(first, last + 1):
            table[svid] = system * SATELLITES_PER_SYSTEM + svid - offset
    return table


def _signal_table() -> NDArray[np.int16]:
    """Return signal numbers by Septentrio's number of the signal, 0 where there is none."""
    table = np.zeros(SIGNAL_NUMBERS, np.int16)
    for number, (_, code) in _SIGNALS.items():
        table[number] = signal_number(code)
    return table


def _system_table() -> NDArray[np.int16]:
    """Return the system of each of Septentrio's signals, -1 where there is none."""
    table = np.full(SIGNAL_NUMBERS, -1, np.int16)
    for number, (system, _) in _SIGNALS.items():
        table[number] = system
    return table


SATELLITE_OF = _satellite_table()
SIGNAL_OF = _signal_table()
SYSTEM_OF = _system_table()
E6B: Final = signal_number("6B")


def svid_of(satellite: int) -> int:
    """Return the SVID of a satellite; ValueError if it has none."""
    found = np.flatnonzero(satellite == SATELLITE_OF)
    if satellite <= 0 or not len(found):
        raise ValueError(f"satellite {satellite} has no SVID")
    return int(found[0])


def septentrio_signal(satellite: int, signal: int) -> int | None:
    """Return Septentrio's number of a satellite's signal, None if it has none."""
    number = GALILEO_E6 if signal == E6B else -1
    for candidate in np.flatnonzero(signal == SIGNAL_OF).tolist():
        number = candidate if SYSTEM_OF[candidate] == satellite // SATELLITES_PER_SYSTEM else number
    return number if number >= 0 and SYSTEM_OF[number] == satellite // SATELLITES_PER_SYSTEM else None
