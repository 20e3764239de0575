"""Satellites and signals: RINEX ids outside, small integers inside.

A satellite is ``system * 64 + number`` with the systems in the order ``GRECJSI`` (RINEX 3.05 table 1; SBAS number is PRN
minus 100, QZSS is PRN minus 192). A signal is ``band * 26 + attribute`` of its RINEX 3 code, e.g. ``1C`` -> 1 * 26 + 2. Both
are order preserving: sorting by (satellite, signal) is sorting by system, number, band, attribute.
"""

from collections.abc import Iterable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel_in_place

SYSTEMS: Final = "GRECJSI"
GPS, GLONASS, GALILEO, BEIDOU, QZSS, SBAS, NAVIC = range(7)
SATELLITES_PER_SYSTEM: Final = 64
MAX_SATELLITE: Final = len(SYSTEMS) * SATELLITES_PER_SYSTEM
ATTRIBUTES: Final = 26
MAX_SIGNAL: Final = 10 * ATTRIBUTES
SIGNALS_PER_SATELLITE: Final = 512  # more than there are signal numbers: satellite * this + signal is a key of both
KEYS_PER_SATELLITE: Final = SIGNALS_PER_SATELLITE**2  # a pair's key: (satellite * 512 + rover signal) * 512 + base signal
NO_CHANNEL: Final = 127  # GLONASS frequency channel not known (or not GLONASS)


def satellite_number(satellite_id: str) -> int:
    """Return the number of a RINEX satellite id such as ``G05``; ValueError if it is none."""
    system, number = SYSTEMS.find(satellite_id[:1]), satellite_id[1:].strip()
    if len(satellite_id) < 2 or system < 0 or not number.isdecimal() or not 0 < int(number) < SATELLITES_PER_SYSTEM:
        raise ValueError(f"{satellite_id!r} is no RINEX satellite id")
    return system * SATELLITES_PER_SYSTEM + int(number)


def satellite_id(satellite: int) -> str:
    """Return the RINEX id of a satellite number."""
    return f"{SYSTEMS[satellite // SATELLITES_PER_SYSTEM]}{satellite % SATELLITES_PER_SYSTEM:02d}"


def allowed_satellites(systems: Iterable[str], excluded: Iterable[str] = ()) -> NDArray[np.bool_]:
    """Return by satellite number whether it is of these systems (RINEX letters) and not one of the excluded (RINEX ids)."""
    allowed = np.zeros(MAX_SATELLITE, np.bool_)
    for letter in systems:
        first = SYSTEMS.index(letter) * SATELLITES_PER_SYSTEM
        allowed[first : first + SATELLITES_PER_SYSTEM] = True
    for name in excluded:
        allowed[satellite_number(name)] = False
    return allowed


def signal_number(code: str) -> int:
    """Return the number of a RINEX 3 code such as ``1C`` (band and attribute); ValueError if it is none."""
    if len(code) != 2 or not code[0].isdecimal() or not "A" <= code[1] <= "Z":
        raise ValueError(f"{code!r} is no RINEX signal code")
    return int(code[0]) * ATTRIBUTES + ord(code[1]) - ord("A")


def signal_code(signal: int) -> str:
    """Return the RINEX 3 code of a signal number."""
    return f"{signal // ATTRIBUTES}{chr(ord('A') + signal % ATTRIBUTES)}"


@kernel_in_place
def system_of(satellite: int) -> int:
    """Return the system (GPS, GLONASS, ...) of a satellite number."""
    return satellite // SATELLITES_PER_SYSTEM


@kernel_in_place
def band_of(signal: int) -> int:
    """Return the RINEX band (1 to 9) of a signal number."""
    return signal // ATTRIBUTES


@kernel_in_place
def carrier_hz(satellite: int, signal: int, channel: int) -> float:
    """Return the carrier frequency (Hz), or 0.0 where it is not known.

    RINEX 3.05 tables 4 to 10. ``channel`` is the GLONASS frequency number (-7 to +6), used only for FDMA signals.
    """
    system, band = satellite // SATELLITES_PER_SYSTEM, signal // ATTRIBUTES
    if system == GLONASS:
        if band == 1 or band == 2:
            if channel < -7 or channel > 13:
                return 0.0
            return 1602.0e6 + channel * 0.5625e6 if band == 1 else 1246.0e6 + channel * 0.4375e6
        if band == 4:
            return 1600.995e6
        if band == 6:
            return 1248.06e6
        return 1202.025e6 if band == 3 else 0.0
    if system == BEIDOU and band == 2:
        return 1561.098e6
    if system == BEIDOU and band == 6:
        return 1268.52e6
    if band == 1:
        return 1575.42e6
    if band == 2:
        return 1227.60e6
    if band == 5:
        return 1176.45e6
    if band == 6:
        return 1278.75e6
    if band == 7:
        return 1207.14e6
    if band == 8:
        return 1191.795e6
    return 2492.028e6 if band == 9 else 0.0
