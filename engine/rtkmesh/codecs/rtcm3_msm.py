"""RTCM 3 multiple signal messages (RTCM 10403.3, section 3.5.16): tables and the decoder of types 4 to 7.

A message is ``header, satellite data, signal data``; signal data go field by field, each for all cells, so that one cell
is gathered from several places of the payload.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.codecs.bits import signed_bits, unsigned_bits
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


def _signal_table() -> NDArray[np.int16]:
    table = np.full((7, 33), -1, dtype=np.int16)
    for system, text in _SIGNALS.items():
        for entry in text.split():
            bit, code = entry.split(":")
            table[system, int(bit)] = signal_number(code)
    return table


SIGNAL_OF_BIT: Final = _signal_table()  # [system, DF395 bit 1..32] -> signal number, -1 reserved

# Widths of the signal fields by type (rows 4..7): fine pseudorange, fine phase range, lock time, half cycle, C/N0, fine rate.
FIELD_BITS: Final = np.array([[15, 22, 4, 1, 6, 0], [15, 22, 4, 1, 6, 15], [20, 24, 10, 1, 10, 0], [20, 24, 10, 1, 10, 15]], dtype=np.int64)
# Resolutions by type: fine pseudorange (ms), fine phase range (ms), C/N0 (dB-Hz).
FIELD_SCALES: Final = np.array(
    [[2.0**-24, 2.0**-29, 1.0], [2.0**-24, 2.0**-29, 1.0], [2.0**-29, 2.0**-31, 2.0**-4], [2.0**-29, 2.0**-31, 2.0**-4]]
)
_FIELDS: Final = {level: (FIELD_BITS[level - 4], FIELD_SCALES[level - 4]) for level in (4, 5, 6, 7)}
_SIGNAL_ROWS: Final = tuple(SIGNAL_OF_BIT)
RATE_SCALE_MPS: Final = 1e-4  # DF404
INVALID_RATE_MPS: Final = -8192  # DF399

OK, TOO_SHORT, TOO_MANY_CELLS = 0, 1, 2
REASONS: Final = ("", "too short", "more than 64 cells")


class Observations(NamedTuple):
    """The observations of one message: ``tag`` is the raw epoch time field of its system, columns are as in ``Epoch``.

    ``more`` says that further messages of the same epoch follow. ``priority`` orders messages that hold the same signal.
    """

    system: int
    station_id: int
    tag: int
    more: bool
    priority: int
    cells: NDArray[np.int16]  # rows satellite, signal, channel, flags
    values: NDArray[np.float64]  # rows pseudorange_m, phase_cyc, doppler_hz, cn0_dbhz, lock_s


class MsmResult(NamedTuple):
    """A decoded message or the reason of its rejection, and how many of its cells could not be used (in full)."""

    observations: Observations | None
    reason: str
    unknown_cells: int
    unknown_channels: int


@kernel
def lock_time_s(indicator: int, extended: bool) -> float:
    """Return the minimum lock time (s) of DF402 or, extended, of DF407 (table 3.5-75); NaN for reserved values."""
    if not extended:
        return 0.0 if indicator == 0 else float(1 << (indicator + 4)) * 1e-3
    if indicator < 64:
        return indicator * 1e-3
    if indicator > 704:
        return np.nan
    k = indicator // 32 - 1
    return float((indicator - 32 * k) << k) * 1e-3


@kernel
def _cell_count(payload: NDArray[np.uint8], satellites: int, signals: int) -> int:
    count = 0
    for i in range(satellites * signals):
        count += unsigned_bits(payload, HEADER_BITS + i, 1)
    return count


@kernel
def _mask(payload: NDArray[np.uint8], position: int, length: int, bits: NDArray[np.int64]) -> int:
    """Write the numbers (from 1) of the set bits to ``bits`` and return how many there are."""
    count = 0
    for i in range(length):
        if payload[(position + i) >> 3] & (0x80 >> ((position + i) & 7)):
            bits[count] = i + 1
            count += 1
    return count


@kernel
def _satellite_data(
    payload: NDArray[np.uint8], position: int, count: int, with_rate: bool, rough: NDArray[np.float64], extended: NDArray[np.int64]
) -> int:
    """Read rough ranges (ms, row 0) and rates (m/s, row 1) and the extended information; return the position behind."""
    fraction = position + (12 if with_rate else 8) * count
    rate = fraction + 10 * count
    for i in range(count):
        whole = unsigned_bits(payload, position + 8 * i, 8)
        rough[0, i] = np.nan if whole == INVALID_ROUGH_MS else whole + unsigned_bits(payload, fraction + 10 * i, 10) / 1024.0
        rough[1, i] = np.nan
        extended[i] = 15
        if with_rate:
            extended[i] = unsigned_bits(payload, position + 8 * count + 4 * i, 4)
            coarse = signed_bits(payload, rate + 14 * i, 14)
            rough[1, i] = np.nan if coarse == INVALID_RATE_MPS else float(coarse)
    return rate + (14 * count if with_rate else 0)


@kernel
def _fine(payload: NDArray[np.uint8], position: int, length: int, scale: float) -> float:
    """Return a signed field times ``scale``; NaN for its most negative value, which means 'invalid'."""
    value = signed_bits(payload, position, length)
    return np.nan if value == -(1 << (length - 1)) else value * scale


@kernel
def _read_cell(
    payload: NDArray[np.uint8], position: int, cells: int, index: int, bits: NDArray[np.int64], scales: NDArray[np.float64],
    rough_ms: float, rough_rate_mps: float, wavelength_m: float, out: NDArray[np.float64], column: int,
) -> int:  # fmt: skip
    """Read cell ``index`` of the signal data at ``position`` into ``out[:, column]``; return its half-cycle bit."""
    at = position
    out[0, column] = (rough_ms + _fine(payload, at + bits[0] * index, bits[0], scales[0])) * MILLISECOND_M
    at += bits[0] * cells
    out[1, column] = (rough_ms + _fine(payload, at + bits[1] * index, bits[1], scales[1])) * MILLISECOND_M / wavelength_m
    at += bits[1] * cells
    out[4, column] = lock_time_s(unsigned_bits(payload, at + bits[2] * index, bits[2]), bits[2] == 10)
    at += bits[2] * cells
    half_cycle = unsigned_bits(payload, at + index, 1)
    at += cells
    cn0 = unsigned_bits(payload, at + bits[4] * index, bits[4])
    out[3, column] = cn0 * scales[2] if cn0 else np.nan
    out[2, column] = np.nan
    if bits[5]:
        at += bits[4] * cells
        out[2, column] = -(rough_rate_mps + _fine(payload, at + bits[5] * index, bits[5], RATE_SCALE_MPS)) / wavelength_m
    return half_cycle


@kernel
def _channel(system: int, number: int, extended: int, channels: NDArray[np.int8]) -> int:
    """Return the GLONASS frequency channel, learning it from DF419 into ``channels``; NO_CHANNEL where unknown."""
    if system != GLONASS:
        return NO_CHANNEL
    if extended <= 13:
        channels[number] = extended - 7
    return int(channels[number])


@kernel
def decode_cells(
    payload: NDArray[np.uint8], system: int, level: int, signals: NDArray[np.int16], channels: NDArray[np.int8], bits: NDArray[np.int64],
    scales: NDArray[np.float64], cells: NDArray[np.int16], values: NDArray[np.float64], tally: NDArray[np.int64],
) -> int:  # fmt: skip
    """Decode the cells of one MSM payload and return a status.

    ``signals`` is the system's row of SIGNAL_OF_BIT, ``channels`` the GLONASS channels by slot (read and learned), ``bits`` and
    ``scales`` the type's rows of FIELD_BITS and FIELD_SCALES. Out: ``cells`` (4, 64), ``values`` (5, 64) as in Observations and
    ``tally``: rows written (a cell without any valid value gives none), cells of unknown signal or satellite, cells without phase for
    want of a GLONASS channel.
    """
    satellite_bits, signal_bits = np.empty(64, np.int64), np.empty(32, np.int64)
    if 8 * len(payload) < HEADER_BITS:
        return TOO_SHORT
    n_sat = _mask(payload, 73, 64, satellite_bits)
    n_sig = _mask(payload, 137, 32, signal_bits)
    if n_sat * n_sig > MAX_CELLS:
        return TOO_MANY_CELLS
    position = HEADER_BITS + n_sat * n_sig
    if 8 * len(payload) < position:
        return TOO_SHORT
    n_cell = _cell_count(payload, n_sat, n_sig)
    with_rate = level == 5 or level == 7
    if 8 * len(payload) < position + n_sat * (36 if with_rate else 18) + n_cell * np.sum(bits):
        return TOO_SHORT
    rough, extended = np.empty((2, 64)), np.empty(64, np.int64)
    position = _satellite_data(payload, position, n_sat, with_rate, rough, extended)
    tally[:] = 0
    index, row = 0, 0
    for i in range(n_sat):
        number = satellite_bits[i] + FIRST_SATELLITE[system]
        known = satellite_bits[i] <= MASK_SATELLITES[system]
        channel = _channel(system, number, extended[i], channels) if known else NO_CHANNEL
        for j in range(n_sig):
            if not unsigned_bits(payload, HEADER_BITS + i * n_sig + j, 1):
                continue
            signal = int(signals[signal_bits[j]])
            index += 1
            if not known or signal < 0:
                tally[1] += 1
                continue
            satellite = system * SATELLITES_PER_SYSTEM + number
            carrier = carrier_hz(satellite, signal, channel)
            if carrier == 0.0:
                tally[2] += 1
            wavelength_m = SPEED_OF_LIGHT_MPS / carrier if carrier > 0.0 else np.nan
            half = _read_cell(payload, position, n_cell, index - 1, bits, scales, rough[0, i], rough[1, i], wavelength_m, values, row)
            cells[0, row], cells[1, row], cells[2, row] = satellite, signal, channel
            cells[3, row] = HALF_CYCLE if half else 0
            row += 1 if np.isfinite(values[0, row]) or np.isfinite(values[1, row]) or np.isfinite(values[2, row]) else 0
    tally[0] = row
    return OK


def decode_msm(payload: NDArray[np.uint8], number: int, channels: NDArray[np.int8]) -> MsmResult:
    """Decode the payload of MSM4 to MSM7 message ``number``; GLONASS ``channels`` (int8 by slot, 64) are read and learned."""
    system, level = SYSTEM_OF_GROUP[number // 10], number % 10
    cells, values, tally = np.empty((4, MAX_CELLS), np.int16), np.empty((5, MAX_CELLS)), np.empty(3, np.int64)
    bits, scales = _FIELDS[level]
    status = decode_cells(payload, system, level, _SIGNAL_ROWS[system], channels, bits, scales, cells, values, tally)
    if status != OK:
        return MsmResult(None, REASONS[status], 0, 0)
    head = int.from_bytes(payload[:8].tobytes(), "big")
    rows, unknown_cells, unknown_channels = tally.tolist()
    more, tag, station_id = bool((head >> 9) & 1), (head >> 10) & 0x3FFFFFFF, (head >> 40) & 0xFFF
    observations = Observations(system, station_id, tag, more, MSM_PRIORITY, cells[:, :rows], values[:, :rows])
    return MsmResult(observations, "", unknown_cells, unknown_channels)
