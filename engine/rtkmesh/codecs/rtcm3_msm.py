"""RTCM 3 multiple signal messages (RTCM 10403.3, section 3.5.16): tables and the decoder of types 4 to 7.

A message is ``header, satellite data, signal data``; signal data go field by field, each for all cells, so that one cell
is gathered from several places of the payload.
"""

from math import nan
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, scratch_indices
from rtkmesh.codecs.bits import load_words, word_bits
from rtkmesh.codecs.observation_rows import Rows
from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.epoch import HALF_CYCLE
from rtkmesh.gnss.signals import (
    BEIDOU,
    GALILEO,
    GLONASS,
    GPS,
    NAVIC,
    NO_CHANNEL,
    QZSS,
    SATELLITES_PER_SYSTEM,
    SBAS,
    carrier_hz,
    signal_number,
)

MAX_CELLS: Final = 64  # a message holds at most this many (satellite, signal) pairs (10403.3, 3.5.16.1)
MILLISECOND_M: Final = SPEED_OF_LIGHT_MPS * 1e-3
HEADER_BITS: Final = 169  # up to and with the signal mask DF395
INVALID_ROUGH_MS: Final = 255  # DF397
MSM_PRIORITY, LEGACY_PRIORITY = 0, 1
NO_DAY: Final = 7  # DF416: day of week not known

# Message number without its last digit -> system, and the same the other way round.
SYSTEM_OF_GROUP: Final = {107: GPS, 108: GLONASS, 109: GALILEO, 110: SBAS, 111: QZSS, 112: BEIDOU, 113: NAVIC}
GROUP_OF_SYSTEM: Final = {system: group for group, system in SYSTEM_OF_GROUP.items()}

# Satellite mask DF394: RINEX number of mask bit 1 minus 1, and how many bits have a meaning (tables 3.5-101 and following).
FIRST_SATELLITE: Final = (0, 0, 0, 0, 0, 19, 0)
MASK_SATELLITES: Final = (63, 27, 52, 63, 10, 39, 14)

_SIGNALS: Final = {
    GPS: "2:1C 3:1P 4:1W 8:2C 9:2P 10:2W 15:2S 16:2L 17:2X 22:5I 23:5Q 24:5X 30:1S 31:1L 32:1X",
    GLONASS: "2:1C 3:1P 8:2C 9:2P",
    GALILEO: "2:1C 3:1A 4:1B 5:1X 6:1Z 8:6C 9:6A 10:6B 11:6X 12:6Z 14:7I 15:7Q 16:7X 18:8I 19:8Q 20:8X 22:5I 23:5Q 24:5X",
    BEIDOU: "2:2I 3:2Q 4:2X 8:6I 9:6Q 10:6X 14:7I 15:7Q 16:7X 22:5D 23:5P 24:5X 25:7D 30:1D 31:1P 32:1X",
    QZSS: "2:1C 9:6S 10:6L 11:6X 15:2S 16:2L 17:2X 22:5I 23:5Q 24:5X 30:1S 31:1L 32:1X",
    SBAS: "2:1C 22:5I 23:5Q 24:5X",
    NAVIC: "8:9A 22:5A",
}  # DF395 bit:RINEX code (tables 3.5-91 and following)


def _signal_table() -> NDArray[np.int64]:
    table = np.full((7, 33), -1, np.int64)
    for system, text in _SIGNALS.items():
        for entry in text.split():
            bit, code = entry.split(":")
            table[system, int(bit)] = signal_number(code)
    return table


SIGNAL_OF_BIT: Final = _signal_table()  # [system, DF395 bit 1..32] -> signal number, -1 reserved


class Widths(NamedTuple):
    """Bits of the fields of a message type, in their order; 0 where the type has not got a field. Resolutions with them."""

    satellite: NDArray[np.int64]  # DF397 whole ms, extended information, DF398 1/1024 ms, DF399 m/s
    signal: NDArray[np.int64]  # fine pseudorange, fine phase range, lock time, half cycle, C/N0, fine rate
    scales: NDArray[np.float64]  # of fine pseudorange (ms), fine phase range (ms), C/N0 (dB-Hz)


def _widths(satellite: list[int], signal: list[int], scales: list[float]) -> Widths:
    return Widths(np.array(satellite, np.int64), np.array(signal, np.int64), np.array(scales))


WIDTHS: Final = {
    4: _widths([8, 0, 10, 0], [15, 22, 4, 1, 6, 0], [2.0**-24, 2.0**-29, 1.0]),
    5: _widths([8, 4, 10, 14], [15, 22, 4, 1, 6, 15], [2.0**-24, 2.0**-29, 1.0]),
    6: _widths([8, 0, 10, 0], [20, 24, 10, 1, 10, 0], [2.0**-29, 2.0**-31, 2.0**-4]),
    7: _widths([8, 4, 10, 14], [20, 24, 10, 1, 10, 15], [2.0**-29, 2.0**-31, 2.0**-4]),
}  # by type (tables 3.5-80 to 3.5-90)


def _by_type(index: int) -> NDArray[Any]:
    """Return one part of WIDTHS as an array by type."""
    parts = {level: widths[index] for level, widths in WIDTHS.items()}
    table = np.zeros((8, len(parts[7])), parts[7].dtype)
    for level, part in parts.items():
        table[level] = part
    return table


SATELLITE_WIDTHS, CELL_WIDTHS, SCALES = (_by_type(index) for index in range(3))
SATELLITE_BITS, CELL_BITS = SATELLITE_WIDTHS.sum(axis=1), CELL_WIDTHS.sum(axis=1)
RATE_SCALE_MPS: Final = 1e-4  # DF404
NO_EXTENDED: Final = 15  # DF419: channel not known
LAST_EXTENDED_LOCK: Final = 704  # DF407

OK, TOO_SHORT, TOO_MANY_CELLS = 0, 1, 2
REASONS: Final = ("", "too short", "more than 64 cells")


class Part(NamedTuple):
    """One observation message: ``tag`` is the raw epoch time field of its system, ``rows`` how many rows it wrote.

    ``more`` says that further messages of the same epoch follow. ``priority`` orders messages that hold the same signal.
    """

    system: int
    station_id: int
    tag: int
    more: bool
    priority: int
    rows: int


def lock_time_s(indicator: int, *, extended: bool) -> float:
    """Return the minimum lock time (s) of DF402 or, extended, of DF407 (table 3.5-75); NaN for reserved values."""
    if not extended:
        return 0.0 if indicator == 0 else float(1 << (indicator + 4)) * 1e-3
    if indicator < 64:
        return indicator * 1e-3
    if indicator > LAST_EXTENDED_LOCK:
        return nan
    k = indicator // 32 - 1
    return float((indicator - 32 * k) << k) * 1e-3


def _lock_table() -> NDArray[np.float64]:
    """Return lock times by [whether the field is the extended one][indicator]."""
    table = np.full((2, 1 << 10), np.nan)
    table[0, :16] = [lock_time_s(indicator, extended=False) for indicator in range(16)]
    table[1] = [lock_time_s(indicator, extended=True) for indicator in range(1 << 10)]
    return table


LOCK_S: Final = _lock_table()


@kernel
def _signed(code: int, width: int, scale: float) -> float:
    """Return a two's complement field times ``scale``; NaN for its most negative value, which means 'invalid', and without field."""
    if width == 0 or code == 1 << (width - 1):
        return np.nan
    return (code - (1 << width) if code >> (width - 1) else code) * scale


@kernel
def _satellite_fields(words: NDArray[np.int64], at: int, n_sat: int, widths: NDArray[np.int64], i: int) -> tuple[float, float, int]:
    """Return rough range (ms), rough rate (m/s) and extended information of satellite ``i``; each field comes for all satellites."""
    whole_ms = word_bits(words, at + widths[0] * i, widths[0])
    at += widths[0] * n_sat
    extended = word_bits(words, at + widths[1] * i, widths[1]) if widths[1] else NO_EXTENDED
    at += widths[1] * n_sat
    rough_ms = np.nan if whole_ms == INVALID_ROUGH_MS else whole_ms + word_bits(words, at + widths[2] * i, widths[2]) / 1024.0
    at += widths[2] * n_sat
    rough_mps = _signed(word_bits(words, at + widths[3] * i, widths[3]), widths[3], 1.0) if widths[3] else 0.0
    return rough_ms, rough_mps, extended


@kernel
def _find_cells(
    words: NDArray[np.int64], bits: int, satellite_bits: int, cell_bits: int, masks: NDArray[np.int64]
) -> tuple[int, int, int, int]:
    """Read the masks of satellites, signals and cells to the rows of ``masks``; return a status and how many of each there are.

    ``bits`` is the payload's length, ``satellite_bits`` and ``cell_bits`` are those of the data of one satellite and one cell.
    """
    if bits < HEADER_BITS:
        return TOO_SHORT, 0, 0, 0
    counts, at, length = np.empty(3, np.int64), 73, 64  # DF394; then DF395 and DF396
    for mask in range(3):
        counts[mask] = 0
        for i in range(length):
            if words[(at + i) >> 5] >> (31 - (at + i & 31)) & 1:
                masks[mask, counts[mask]] = i
                counts[mask] += 1
        at, length = at + length, 32
        if mask == 1:
            length = counts[0] * counts[1]
            if length > MAX_CELLS:
                return TOO_MANY_CELLS, 0, 0, 0
            if bits < HEADER_BITS + length:
                return TOO_SHORT, 0, 0, 0
    n_sat, n_sig, n_cell = counts[0], counts[1], counts[2]
    if bits < HEADER_BITS + n_sat * n_sig + n_sat * satellite_bits + n_cell * cell_bits:
        return TOO_SHORT, 0, 0, 0
    return OK, n_sat, n_sig, n_cell


@kernel
def _write_cell(
    words: NDArray[np.int64], begin: NDArray[np.int64], level: int, cell: int, rough: tuple[float, float, int], wavelength_m: float,
    values: NDArray[np.float64],
) -> int:  # fmt: skip
    """Write the values of a cell (a row, see observation_rows) and return its flags. ``begin`` is where each field of the cells begins,
    ``rough`` what is said of its satellite; without a wavelength (NaN) there is no phase and no rate.
    """
    widths, scales = CELL_WIDTHS[level], SCALES[level]
    code = _signed(word_bits(words, begin[0] + widths[0] * cell, widths[0]), widths[0], scales[0])
    phase = _signed(word_bits(words, begin[1] + widths[1] * cell, widths[1]), widths[1], scales[1])
    rate = _signed(word_bits(words, begin[5] + widths[5] * cell, widths[5]), widths[5], RATE_SCALE_MPS)
    cn0 = word_bits(words, begin[4] + widths[4] * cell, widths[4])
    values[0] = (rough[0] + code) * MILLISECOND_M
    values[1] = (rough[0] + phase) * MILLISECOND_M / wavelength_m
    values[2] = -(rough[1] + rate) / wavelength_m
    values[3] = cn0 * scales[2] if cn0 else np.nan
    values[4] = LOCK_S[1 if widths[2] == 10 else 0, word_bits(words, begin[2] + widths[2] * cell, widths[2])]
    return HALF_CYCLE if word_bits(words, begin[3] + cell, widths[3]) else 0


@kernel
def decode_cells(
    payload: bytes, system: int, level: int, channels: NDArray[np.int8], cells: NDArray[np.int16], values: NDArray[np.float64], row: int
) -> tuple[int, int, int, int, int]:  # fmt: skip
    """Decode one MSM payload of type ``level`` into rows of ``cells`` and ``values`` (see observation_rows) from ``row`` on.

    ``channels`` are the GLONASS channels by slot (read and learned). Returns a status, the rows written (a cell without any valid value
    gives none), the cells of unknown signal or satellite, those without phase for want of a GLONASS channel, and the head of the payload
    (its first 64 bits without the message number: station, epoch time, more to come, the rest).
    """
    words, masks, begin = load_words(payload), np.empty((3, MAX_CELLS), np.int64), scratch_indices(len(CELL_WIDTHS[level]))
    status, n_sat, n_sig, n_cell = _find_cells(words, 8 * len(payload), SATELLITE_BITS[level], CELL_BITS[level], masks)
    if status != OK:
        return status, 0, 0, 0, 0
    at_satellites = HEADER_BITS + n_sat * n_sig
    begin[0] = at_satellites + n_sat * SATELLITE_BITS[level]
    for k in range(1, len(begin)):
        begin[k] = begin[k - 1] + n_cell * CELL_WIDTHS[level, k - 1]
    first, last, unknown, phaseless, rough = row, -1, 0, 0, (0.0, 0.0, NO_EXTENDED)
    for cell in range(n_cell):
        i = masks[2, cell] // n_sig
        number, signal = masks[0, i] + 1, int(SIGNAL_OF_BIT[system, masks[1, masks[2, cell] - i * n_sig] + 1])
        if number > MASK_SATELLITES[system] or signal < 0:
            unknown += 1
            continue
        number += FIRST_SATELLITE[system]
        if i != last:
            rough, last = _satellite_fields(words, at_satellites, n_sat, SATELLITE_WIDTHS[level], i), i
        satellite, channel = system * SATELLITES_PER_SYSTEM + number, NO_CHANNEL
        if system == GLONASS:
            if rough[2] <= 13:  # DF419
                channels[number] = rough[2] - 7
            channel = int(channels[number])
        carrier = carrier_hz(satellite, signal, channel)
        phaseless += 1 if carrier == 0.0 else 0
        wavelength_m = SPEED_OF_LIGHT_MPS / carrier if carrier > 0.0 else np.nan
        cells[row, 0], cells[row, 1], cells[row, 2], cells[row, 4] = satellite, signal, channel, MSM_PRIORITY
        cells[row, 3] = _write_cell(words, begin, level, cell, rough, wavelength_m, values[row])
        if not (np.isnan(values[row, 0]) and np.isnan(values[row, 1]) and np.isnan(values[row, 2])):
            row += 1
    return OK, row - first, unknown, phaseless, (words[0] & 0xFFFFF) << 32 | words[1]


def decode_msm(payload: bytes, number: int, channels: NDArray[np.int8], rows: Rows) -> tuple[Part | None, str, int, int]:
    """Decode the payload of MSM4 to MSM7 message ``number`` into ``rows``, behind those in use.

    GLONASS ``channels`` (int8 by slot, 64) are read and learned. Returns the message or the reason of its rejection, and how many of its
    cells were of unknown satellites or signals, and how many without phase for want of a channel.
    """
    system, first = SYSTEM_OF_GROUP[number // 10], rows.reserve()
    status, count, unknown_cells, unknown_channels, head = decode_cells(
        payload, system, number % 10, channels, rows.cells, rows.values, first
    )  # fmt: skip
    if status != OK:
        return None, REASONS[status], 0, 0
    part = Part(system, head >> 40, head >> 10 & 0x3FFFFFFF, bool(head >> 9 & 1), MSM_PRIORITY, count)
    return part, "", unknown_cells, unknown_channels
