"""RTCM 3 legacy observation messages 1002, 1004 (GPS) and 1010, 1012 (GLONASS): RTCM 10403.3, 3.5.1 and 3.5.7.

1001, 1003, 1009 and 1011 lack the modulus of the pseudorange, so they give none and are not decoded. The phase is sent as its difference
from the L1 pseudorange, rolled by 1500 cycles when it leaves its field; the decoder undoes that.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.codecs.bits import load_words, word_bits
from rtkmesh.codecs.observation_rows import Rows
from rtkmesh.codecs.rtcm3_msm import LEGACY_PRIORITY, MILLISECOND_M, NO_DAY, Part
from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.signals import GLONASS, GPS, MAX_SATELLITE, NO_CHANNEL, SATELLITES_PER_SYSTEM, SBAS, carrier_hz, signal_number

NUMBERS: Final = (1002, 1004, 1010, 1012)
WITHOUT_MODULUS: Final = (1001, 1003, 1009, 1011)

_ROLL_CYC: Final = 1500.0  # DF012, DF018, DF042, DF048
_INVALID_PHASE: Final = -(1 << 19)
_INVALID_DIFFERENCE: Final = -(1 << 13)
_PHASE_SCALE_M: Final = 0.0005
_CODE_SCALE_M: Final = 0.02
_CN0_SCALE_DBHZ: Final = 0.25


def _signals(first: str, second: str) -> list[int]:
    return [signal_number(code) for code in (first + " " + second).split()]


# [system][L1 code 0, 1, L2 code 0..3] (DF010, DF016, DF039, DF046); GPS L2 code 0 is 'C/A or L2C', codes 2 and 3 are P(Y) semi-codeless.
_SIGNALS: Final = np.array([_signals("1C 1P", "2X 2P 2D 2W"), _signals("1C 1P", "2C 2P 2P 2P")], dtype=np.int16)


# Fields of a satellite: number, L1 code, channel, pseudorange, phase difference, lock, modulus, C/N0; L2: code, pseudorange and phase
# differences, lock, C/N0. 0 where the message has not got the field.
_GPS_L1, _GLONASS_L1, _L2, _NO_L2 = [6, 1, 0, 24, 20, 7, 8, 8], [6, 1, 5, 25, 20, 7, 7, 8], [2, 14, 20, 7, 8], [0] * 5
# The same by [system][whether L2 is sent].
_WIDTHS: Final = np.array([[_GPS_L1 + _NO_L2, _GPS_L1 + _L2], [_GLONASS_L1 + _NO_L2, _GLONASS_L1 + _L2]], np.int64)


@kernel
def lock_time_s(indicator: int) -> float:
    """Return the minimum lock time (s) of DF013, DF019, DF043, DF049 (table 3.4-2)."""
    if indicator == 127:
        return 937.0
    k = indicator // 24
    return float((indicator << k) - 24 * ((k - 1) * (1 << k) + 1))


@kernel
def satellite_of(number: int, glonass: int) -> int:
    """Return the satellite of DF038 or DF009 (where 40 to 58 are SBAS PRN 120 to 138), -1 if it is none."""
    if glonass:
        return GLONASS * SATELLITES_PER_SYSTEM + number if 1 <= number <= 24 else -1
    if 40 <= number <= 58:
        return SBAS * SATELLITES_PER_SYSTEM + number - 20
    return GPS * SATELLITES_PER_SYSTEM + number if 1 <= number <= 32 else -1


@kernel
def _unrolled_cyc(gap_cyc: float, last_cyc: NDArray[np.float64], satellite: int, band: int) -> float:
    """Return phase minus pseudorange made continuous with its last value, which it replaces."""
    last = last_cyc[satellite, band - 1]
    if not np.isnan(last):
        gap_cyc -= np.rint((gap_cyc - last) / _ROLL_CYC) * _ROLL_CYC
    last_cyc[satellite, band - 1] = gap_cyc
    return gap_cyc


@kernel
def _signed(code: int, width: int) -> int:
    return code - (1 << width) if code >> (width - 1) else code


@kernel
def _put_row(
    cells: NDArray[np.int16], values: NDArray[np.float64], row: int, satellite: int, signal: int, channel: int,
    code_m: float, l1_code_m: float, phase: int, lock: int, cn0: int, last_cyc: NDArray[np.float64],
) -> None:  # fmt: skip
    """Write one row; ``phase`` is the difference of the phase range from the L1 pseudorange in steps of 0.5 mm."""
    cycles_per_m = carrier_hz(satellite, signal, channel) / SPEED_OF_LIGHT_MPS
    cells[row, 0], cells[row, 1], cells[row, 2], cells[row, 3], cells[row, 4] = satellite, signal, channel, 0, LEGACY_PRIORITY
    values[row, 0] = code_m
    values[row, 1] = np.nan
    if phase != _INVALID_PHASE:
        gap_cyc = _unrolled_cyc(phase * _PHASE_SCALE_M * cycles_per_m, last_cyc, satellite, signal // 26)
        values[row, 1] = l1_code_m * cycles_per_m + gap_cyc
    values[row, 2] = np.nan
    values[row, 3] = cn0 * _CN0_SCALE_DBHZ if cn0 else np.nan
    values[row, 4] = lock_time_s(lock)


@kernel
def decode_rows(
    payload: bytes, glonass: int, second: int, channels: NDArray[np.int8], last_cyc: NDArray[np.float64],
    cells: NDArray[np.int16], values: NDArray[np.float64], row: int,
) -> tuple[int, int]:  # fmt: skip
    """Decode 1002/1004/1010/1012 into rows of ``cells`` and ``values`` (see observation_rows) from ``row`` on.

    ``second`` is 1 if the message has L2. Learns the GLONASS ``channels`` by slot; ``last_cyc`` (satellite, band) is the memory for undoing
    rolls. Returns the number of rows, -1 if the payload is too short, and its first 64 bits without the message number.
    """
    head, modulus_m = (61, 2.0 * MILLISECOND_M) if glonass else (64, MILLISECOND_M)
    widths, signals = _WIDTHS[glonass, second], _SIGNALS[glonass]
    if 8 * len(payload) < head:
        return -1, 0
    words = load_words(payload)
    count = word_bits(words, head - 9, 5)
    if 8 * len(payload) < head + count * widths.sum():
        return -1, 0
    first, at, f = row, head, np.empty(13, np.int64)
    for _ in range(count):
        for k in range(13):
            f[k] = word_bits(words, at, widths[k])
            at += widths[k]
        satellite = satellite_of(f[0], glonass)
        channel = f[2] - 7 if glonass else NO_CHANNEL
        if satellite < 0 or (glonass and channel > 13):
            continue
        phase, code_m = _signed(f[4], 20), f[3] * _CODE_SCALE_M + f[6] * modulus_m
        if glonass and phase != _INVALID_PHASE:  # without phases some receivers leave the channel at zero
            channels[f[0]] = channel
        _put_row(cells, values, row, satellite, int(signals[f[1]]), channel, code_m, code_m, phase, f[5], f[7], last_cyc)
        row += 1
        difference, phase = _signed(f[9], 14), _signed(f[10], 20)
        if second and not (difference == _INVALID_DIFFERENCE and phase == _INVALID_PHASE):
            l2_m = np.nan if difference == _INVALID_DIFFERENCE else code_m + difference * _CODE_SCALE_M
            _put_row(cells, values, row, satellite, int(signals[2 + f[8]]), channel, l2_m, code_m, phase, f[11], f[12], last_cyc)
            row += 1
    return row - first, (words[0] & 0xFFFFF) << 32 | words[1]


class LegacyDecoder:
    """Decoder of 1002, 1004, 1010 and 1012: remembers each signal's roll of 1500 cycles."""

    def __init__(self, channels: NDArray[np.int8]) -> None:
        self._channels = channels
        self._last_cyc = np.full((MAX_SATELLITE, 2), np.nan)

    def decode(self, payload: bytes, number: int, rows: Rows) -> Part | None:
        """Decode a message into ``rows``, behind those in use; return what it is, None if it is too short for what it announces."""
        glonass, first = number in (1010, 1012), rows.reserve()
        second = int(number in (1004, 1012))
        count, head = decode_rows(payload, int(glonass), second, self._channels, self._last_cyc, rows.cells, rows.values, first)
        if count < 0:
            return None
        tag_bits = 27 if glonass else 30
        tag = (head >> (40 - tag_bits)) & ((1 << tag_bits) - 1) | (NO_DAY << 27 if glonass else 0)
        more = bool((head >> (39 - tag_bits)) & 1)
        return Part(GLONASS if glonass else GPS, head >> 40 & 0xFFF, tag, more, LEGACY_PRIORITY, count)
