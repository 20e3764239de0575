"""Observation types to signals, and the kernel that reads the fixed fields of observation lines.

RINEX 2 types say the band, not the tracked code. They become RINEX 3 signals so:

====== ========= ========= ===== ========= ===== ======
type   GPS       GLONASS   Gal.  BeiDou    QZSS  SBAS
====== ========= ========= ===== ========= ===== ======
C1     1C        1C        1X    2I        1C    1C
P1     1W        1P        -     -         -     -
C2     2X        2C        -     2I        2X    -
P2     2W        2P        -     -         -     -
C5     5X        -         5X    -         5X    5C
C3     -         3X        -     -         -     -
C6     -         -         6X    6I        6X    -
C7     -         -         7X    7I        -     -
C8     -         -         8X    -         -     -
====== ========= ========= ===== ========= ===== ======

L1, D1, S1 belong to C1 if the file has C1, else to P1; L2, D2, S2 to P2 if the file has P2, else to C2. A satellite that has the
other code only (a GLONASS satellite in a file with P2 for GPS) carries its phase there, decided once per satellite.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.gnss.signals import SATELLITES_PER_SYSTEM, signal_number

CODE, PHASE, DOPPLER, STRENGTH, NOT_READ = 0, 1, 2, 3, -1
_KINDS: Final = {"C": CODE, "P": CODE, "L": PHASE, "D": DOPPLER, "S": STRENGTH}
_FIELD: Final = 16  # F14.3, I1, I1

_V2_CODES: Final[dict[str, dict[str, str]]] = {
    "G": {"C1": "1C", "P1": "1W", "P2": "2W", "C2": "2X", "C5": "5X"},
    "R": {"C1": "1C", "P1": "1P", "P2": "2P", "C2": "2C", "C3": "3X"},
    "E": {"C1": "1X", "C5": "5X", "C6": "6X", "C7": "7X", "C8": "8X"},
    "C": {"C1": "2I", "C2": "2I", "C6": "6I", "C7": "7I"},
    "J": {"C1": "1C", "C2": "2X", "C5": "5X", "C6": "6X"},
    "S": {"C1": "1C", "C5": "5C"},
    "I": {"C5": "5A"},
}
_V2_PHASE_PREFERENCE: Final = {"1": ("C1", "P1"), "2": ("P2", "C2")}


@dataclass(frozen=True, slots=True)
class SystemLayout:
    """How the types of one system fall into rows. Per type: kind, slot (row of the satellite), scale; per slot: signal.

    ``alternatives``: per slot, the slot of the same band that carries the phase when this one has no pseudorange, or -1.
    """

    kinds: tuple[int, ...]
    slots: tuple[int, ...]
    scales: tuple[float, ...]
    signals: tuple[int, ...]
    alternatives: tuple[int, ...]


def observation_layout(
    version: float, system: str, observables: Mapping[str, tuple[str, ...]], factors: Mapping[tuple[str, str], float]
) -> SystemLayout:
    """Return the layout of a system's types; types that are no observation of a signal (X1, I, T2) are not read."""
    names = observables.get(system, ())
    codes = [_code_v2(system, name, names) if version < 3.0 else _code_v3(version, system, name) for name in names]
    signals = sorted({signal_number(code) for code in codes if code})
    return SystemLayout(
        tuple(_KINDS[name[0]] if code else NOT_READ for name, code in zip(names, codes, strict=True)),
        tuple(signals.index(signal_number(code)) if code else 0 for code in codes),
        tuple(1.0 / factors.get((system, name), factors.get((system, ""), 1.0)) for name in names),
        tuple(signals),
        _alternatives(system, signals) if version < 3.0 else (-1,) * len(signals),
    )


def _code_v3(version: float, system: str, name: str) -> str:
    """Return the signal of a RINEX 3 type, "" if it is none. B1I is 2I: 3.02 called it 1I, and 1X was B1 there."""
    if len(name) != 3 or name[0] not in "CLDS" or not name[1].isdecimal() or not "A" <= name[2] <= "Z":
        return ""
    if system == "C" and name[1] == "1" and (name[2] in "IQ" or (name[2] == "X" and version < 3.03)):
        return "2" + name[2]
    return name[1:]


def _code_v2(system: str, name: str, names: tuple[str, ...]) -> str:
    """Return the signal of a RINEX 2 type, "" if it is none."""
    codes = _V2_CODES[system]
    if len(name) != 2 or name[0] not in _KINDS:
        return ""
    if name[0] in "CP":
        return codes.get(name, "")
    candidates = _V2_PHASE_PREFERENCE.get(name[1], ("C" + name[1],))
    held = [code for code in candidates if code in names and code in codes] or [code for code in candidates if code in codes]
    return codes[held[0]] if held else ""


def _alternatives(system: str, signals: list[int]) -> tuple[int, ...]:
    codes, slots = _V2_CODES[system], [-1] * len(signals)
    for first, second in _V2_PHASE_PREFERENCE.values():
        if first in codes and second in codes:
            a, b = signal_number(codes[first]), signal_number(codes[second])
            if a in signals and b in signals:
                slots[signals.index(a)] = signals.index(b)
    return tuple(slots)


class LayoutTables(NamedTuple):
    """The layouts of all systems as arrays (system, type) or (system, slot); see ``SystemLayout``."""

    kind: NDArray[np.int8]
    slot: NDArray[np.int16]
    scale: NDArray[np.float64]
    signals: NDArray[np.int16]
    alternative: NDArray[np.int16]


def stack_layouts(layouts: Sequence[SystemLayout]) -> LayoutTables:
    """Return the layouts of the systems, in their order, as arrays."""
    types = max(1, *(len(layout.kinds) for layout in layouts))
    width = max(1, *(len(layout.signals) for layout in layouts))
    tables = LayoutTables(
        np.full((len(layouts), types), NOT_READ, np.int8), np.zeros((len(layouts), types), np.int16), np.ones((len(layouts), types)),
        np.zeros((len(layouts), width), np.int16), np.full((len(layouts), width), -1, np.int16),
    )  # fmt: skip
    for system, layout in enumerate(layouts):
        tables.kind[system, : len(layout.kinds)] = layout.kinds
        tables.slot[system, : len(layout.slots)] = layout.slots
        tables.scale[system, : len(layout.scales)] = layout.scales
        tables.signals[system, : len(layout.signals)] = layout.signals
        tables.alternative[system, : len(layout.alternatives)] = layout.alternatives
    return tables


@kernel
def _fixed_decimal(buffer: NDArray[np.uint8], start: int, stop: int) -> float:
    """Return the decimal number in ``buffer[start:stop]``, correctly rounded; NaN where it is blank, zero or no number.

    A number of F14.3 has at most 13 digits: its integer and the power of ten are exact, so one division rounds once.
    """
    mantissa, scale, digits, sign, point = 0, 1, 0, 1, False
    for i in range(start, stop):
        c = int(buffer[i])
        if 48 <= c <= 57:
            mantissa = mantissa * 10 + (c - 48)
            digits += 1
            if point:
                scale *= 10
        elif c == 46 and not point:
            point = True
        elif c == 45 and digits == 0:
            sign = -1
        elif c != 32 and c != 43:
            return np.nan
    if mantissa == 0:
        return np.nan
    return sign * (mantissa / scale)


@kernel
def _digit(buffer: NDArray[np.uint8], at: int, stop: int) -> int:
    """Return the digit at a column, 0 where it is blank or behind the end of the line."""
    if at >= stop or buffer[at] < 48 or buffer[at] > 57:
        return 0
    return int(buffer[at]) - 48


@kernel
def _fill_satellite(
    buffer: NDArray[np.uint8], starts: NDArray[np.int64], stops: NDArray[np.int64], line: int, skip: int, per_line: int,
    kind: NDArray[np.int8], slot: NDArray[np.int16], scale: NDArray[np.float64], base: int,
    row_flags: NDArray[np.uint8], values: NDArray[np.float64],
) -> None:  # fmt: skip
    """Read all fields of one satellite into rows ``base + slot``."""
    column = 0
    for k in range(len(kind)):
        if per_line > 0 and k > 0 and k % per_line == 0:
            line, column = line + 1, 0
        start, stop = starts[line] + skip + column * 16, stops[line]
        column += 1
        if kind[k] < 0 or start >= stop:
            continue
        value = _fixed_decimal(buffer, start, min(start + 14, stop))
        if np.isnan(value):
            continue
        row = base + slot[k]
        values[kind[k], row] = value * scale[k] if scale[k] != 1.0 else value
        if kind[k] == 1:
            row_flags[row] |= _digit(buffer, start + 14, stop) & 3
        strength = _digit(buffer, start + 15, stop)
        if kind[k] < 2 and strength > 0 and np.isnan(values[3, row]):
            values[3, row] = -strength


@kernel
def _carry_phase(satellite: int, alternative: NDArray[np.int16], base: int, carrier: NDArray[np.int8],
                 signals: NDArray[np.int16], row_flags: NDArray[np.uint8], values: NDArray[np.float64]) -> None:  # fmt: skip
    """Move phase, Doppler and C/N0 to the other code of the band for satellites that have only that one."""
    for s in range(len(alternative)):
        if alternative[s] < 0:
            continue
        band, row, other = signals[s] // 26, base + s, base + alternative[s]
        if carrier[satellite, band] == 0 and not np.isnan(values[1, row]):
            if not np.isnan(values[0, row]):
                carrier[satellite, band] = 1
            elif not np.isnan(values[0, other]):
                carrier[satellite, band] = 2
        if carrier[satellite, band] == 2:
            for c in range(1, 4):
                if not np.isnan(values[c, row]):
                    values[c, other], values[c, row] = values[c, row], np.nan
            row_flags[other], row_flags[row] = row_flags[row], 0


@kernel
def fill_rows(
    buffer: NDArray[np.uint8], starts: NDArray[np.int64], stops: NDArray[np.int64], satellites: NDArray[np.int16],
    first_line: NDArray[np.int64], skip: int, per_line: int, kind: NDArray[np.int8], slot: NDArray[np.int16],
    scale: NDArray[np.float64], signals: NDArray[np.int16], alternative: NDArray[np.int16], carrier: NDArray[np.int8],
    row_satellite: NDArray[np.int16], row_signal: NDArray[np.int16], row_flags: NDArray[np.uint8], values: NDArray[np.float64],
) -> int:  # fmt: skip
    """Read one epoch's observation lines into rows and return how many there are.

    ``satellites`` rise; satellite i begins at line ``first_line[i]``, column ``skip``, with ``per_line`` fields a line (0: all).
    ``kind``, ``slot``, ``scale`` (system, type), ``signals`` and ``alternative`` (system, slot) are the layouts. ``carrier``
    (satellite, band) remembers which code carries the phase. Rows without code, phase and Doppler are left out. ``values`` rows:
    pseudorange (m), phase (cycles), Doppler (Hz), C/N0 (dB-Hz).
    """
    count = 0
    width = signals.shape[1]
    for i in range(len(satellites)):
        satellite = satellites[i]
        system = satellite // SATELLITES_PER_SYSTEM
        for s in range(count, count + width):
            row_flags[s] = 0
            for c in range(4):
                values[c, s] = np.nan
        _fill_satellite(
            buffer, starts, stops, first_line[i], skip, per_line, kind[system], slot[system], scale[system], count, row_flags, values
        )
        _carry_phase(satellite, alternative[system], count, carrier, signals[system], row_flags, values)
        base = count
        for s in range(width):
            row = base + s
            if np.isnan(values[0, row]) and np.isnan(values[1, row]) and np.isnan(values[2, row]):
                continue
            for c in range(4):
                values[c, count] = values[c, row]
            if values[3, count] < 0.0:  # a digit 1 to 9 stands for 6 dB-Hz each (RINEX 3.05 table 8)
                values[3, count] = -6.0 * values[3, count] + 2.5
            row_flags[count], row_satellite[count], row_signal[count] = row_flags[row], satellite, signals[system, s]
            count += 1
    return count
