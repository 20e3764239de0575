"""RTCM 3 multiple signal messages (RTCM 10403.3, section 3.5.16): tables and the decoder of types 4 to 7.

A message is ``header, satellite data, signal data``; signal data go field by field, each for all cells, so that one cell
is gathered from several places of the payload.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.codecs.bits import unsigned_bits
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
_SIGNAL_ROWS: Final = tuple(SIGNAL_OF_BIT)
RATE_SCALE_MPS: Final = 1e-4  # DF404
INVALID_RATE_MPS: Final = -8192  # DF399
NO_EXTENDED: Final = 15  # DF419: channel not known

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
def _set_bits(payload: NDArray[np.uint8], position: int, length: int, numbers: NDArray[np.int64]) -> int:
    """Write the numbers (from 0) of the set bits of a mask to ``numbers`` and return how many there are."""
    count = 0
    for i in range(length):
        if payload[(position + i) >> 3] & (0x80 >> ((position + i) & 7)):
            numbers[count] = i
            count += 1
    return count


@kernel
def _read_columns(payload: NDArray[np.uint8], position: int, widths: NDArray[np.int64], raw: NDArray[np.int64]) -> int:
    """Read fields that follow one another, each for all columns of ``raw``, as unsigned numbers; return the position behind."""
    for field in range(len(widths)):
        for i in range(raw.shape[1]):
            raw[field, i] = unsigned_bits(payload, position, widths[field])
            position += widths[field]
    return position


@kernel
def _total(widths: NDArray[np.int64]) -> int:
    total = 0
    for width in widths:
        total += width
    return total


@kernel
def _signed(code: int, width: int, scale: float) -> float:
    """Return a two's complement field times ``scale``; NaN for its most negative value, which means 'invalid', and without field."""
    if width == 0 or code == 1 << (width - 1):
        return np.nan
    return (code - (1 << width) if code >> (width - 1) else code) * scale


@kernel
def _convert(
    satellite: NDArray[np.int64], signal: NDArray[np.int64], widths: NDArray[np.int64], scales: NDArray[np.float64], wavelength_m: float,
    out: NDArray[np.float64],
) -> None:  # fmt: skip
    """Turn the raw fields of a satellite and of one of its cells into a column of ``Observations.values``."""
    rough_ms = np.nan if satellite[0] == INVALID_ROUGH_MS else satellite[0] + satellite[2] / 1024.0
    out[0] = (rough_ms + _signed(signal[0], widths[0], scales[0])) * MILLISECOND_M
    out[1] = (rough_ms + _signed(signal[1], widths[1], scales[1])) * MILLISECOND_M / wavelength_m
    out[2] = -(_signed(satellite[3], 14, 1.0) + _signed(signal[5], widths[5], RATE_SCALE_MPS)) / wavelength_m
    out[3] = signal[4] * scales[2] if signal[4] else np.nan
    out[4] = lock_time_s(signal[2], widths[2] == 10)


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
    payload: NDArray[np.uint8], system: int, signals: NDArray[np.int16], channels: NDArray[np.int8], satellite_widths: NDArray[np.int64],
    widths: NDArray[np.int64], scales: NDArray[np.float64], cells: NDArray[np.int16], values: NDArray[np.float64], tally: NDArray[np.int64],
) -> int:  # fmt: skip
    """Decode the cells of one MSM payload and return a status.

    ``signals`` is the system's row of SIGNAL_OF_BIT, ``channels`` the GLONASS channels by slot (read and learned), then come the type's
    WIDTHS. Out: ``cells`` (4, 64), ``values`` (5, 64) as in Observations and ``tally``: rows written (a cell without any valid value
    gives none), cells of unknown signal or satellite, cells without phase for want of a GLONASS channel.
    """
    masks = np.empty((3, 64), np.int64)
    if 8 * len(payload) < HEADER_BITS:
        return TOO_SHORT
    n_sat, n_sig = _set_bits(payload, 73, 64, masks[0]), _set_bits(payload, 137, 32, masks[1])
    if n_sat * n_sig > MAX_CELLS:
        return TOO_MANY_CELLS
    position = HEADER_BITS + n_sat * n_sig
    if 8 * len(payload) < position:
        return TOO_SHORT
    n_cell = _set_bits(payload, HEADER_BITS, n_sat * n_sig, masks[2])
    if 8 * len(payload) < position + n_sat * _total(satellite_widths) + n_cell * _total(widths):
        return TOO_SHORT
    raw_satellite, raw = np.empty((4, n_sat), np.int64), np.empty((6, n_cell), np.int64)
    position = _read_columns(payload, position, satellite_widths, raw_satellite)
    _read_columns(payload, position, widths, raw)
    row, unknown, phaseless = 0, 0, 0
    for cell in range(n_cell):
        i, number = masks[2, cell] // n_sig, masks[0, masks[2, cell] // n_sig] + 1
        signal = int(signals[masks[1, masks[2, cell] % n_sig] + 1])
        if number > MASK_SATELLITES[system] or signal < 0:
            unknown += 1
            continue
        number += FIRST_SATELLITE[system]
        satellite = system * SATELLITES_PER_SYSTEM + number
        channel = _channel(system, number, raw_satellite[1, i] if satellite_widths[1] else NO_EXTENDED, channels)
        carrier = carrier_hz(satellite, signal, channel)
        phaseless += 1 if carrier == 0.0 else 0
        wavelength_m = SPEED_OF_LIGHT_MPS / carrier if carrier > 0.0 else np.nan
        _convert(raw_satellite[:, i], raw[:, cell], widths, scales, wavelength_m, values[:, row])
        cells[0, row], cells[1, row], cells[2, row], cells[3, row] = satellite, signal, channel, HALF_CYCLE if raw[3, cell] else 0
        if not (np.isnan(values[0, row]) and np.isnan(values[1, row]) and np.isnan(values[2, row])):
            row += 1
    tally[0], tally[1], tally[2] = row, unknown, phaseless
    return OK


def decode_msm(payload: bytes, number: int, channels: NDArray[np.int8]) -> MsmResult:
    """Decode the payload of MSM4 to MSM7 message ``number``; GLONASS ``channels`` (int8 by slot, 64) are read and learned."""
    system, level = SYSTEM_OF_GROUP[number // 10], number % 10
    cells, values, tally = np.empty((4, MAX_CELLS), np.int16), np.empty((5, MAX_CELLS)), np.empty(3, np.int64)
    view = np.frombuffer(payload, np.uint8)
    status = decode_cells(view, system, _SIGNAL_ROWS[system], channels, *WIDTHS[level], cells, values, tally)
    if status != OK:
        return MsmResult(None, REASONS[status], 0, 0)
    head = int.from_bytes(payload[:8], "big")
    rows, unknown_cells, unknown_channels = tally.tolist()
    more, tag, station_id = bool((head >> 9) & 1), (head >> 10) & 0x3FFFFFFF, (head >> 40) & 0xFFF
    observations = Observations(system, station_id, tag, more, MSM_PRIORITY, cells[:, :rows], values[:, :rows])
    return MsmResult(observations, "", unknown_cells, unknown_channels)
