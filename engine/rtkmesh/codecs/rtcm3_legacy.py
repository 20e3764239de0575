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

_ROLL_CYC: Final = 1500.0  # DF012, DF018, DF042, DF048
_INVALID_PHASE: Final = -(1 << 19)
_INVALID_DIFFERENCE: Final = -(1 << 13)
_PHASE_SCALE_M: Final = 0.0005
_CODE_SCALE_M: Final = 0.02
_CN0_SCALE_DBHZ: Final = 0.25


def _signals(first: str, second: str) -> list[int]:
    return [signal_number(code) for code in (first + " " + second).split()]


# [system][L1 code 0, 1, L2 code 0..3] (DF010, DF016, DF039, DF046); GPS L2 code 0 is 'C/A or L2C', codes 2 and 3 are P(Y) semi-codeless.
_SIGNALS: Final = np.array([_signals("1C 1P", "2X 2P 2D 2W"), _signals("1C 1P", "2C 2P 2P 2P")], np.int64)


# Fields of a satellite: number, L1 code, channel, pseudorange, phase difference, lock, modulus, C/N0; L2: code, pseudorange and phase
# differences, lock, C/N0. 0 where the message has not got the field.
_GPS_L1, _GLONASS_L1, _L2, _NO_L2 = [6, 1, 0, 24, 20, 7, 8, 8], [6, 1, 5, 25, 20, 7, 7, 8], [2, 14, 20, 7, 8], [0] * 5
# The same by [system][whether L2 is sent].
_WIDTHS: Final = np.array([[_GPS_L1 + _NO_L2, _GPS_L1 + _L2], [_GLONASS_L1 + _NO_L2, _GLONASS_L1 + _L2]], np.int64)
_BITS: Final = _WIDTHS.sum(axis=2)
# By band: the fields of code, phase difference, lock and C/N0.
_PLACES: Final = np.array([[1, 4, 5, 7], [8, 10, 11, 12]], np.int64)


def _satellite_table() -> NDArray[np.int64]:
    """Return satellites by [system][DF009 or DF038], -1 where there is none; DF009 of 40 to 58 is SBAS PRN 120 to 138."""
    table = np.full((2, 64), -1, np.int64)
    table[0, 1:33] = GPS * SATELLITES_PER_SYSTEM + np.arange(1, 33)
    table[0, 40:59] = SBAS * SATELLITES_PER_SYSTEM + np.arange(20, 39)
    table[1, 1:25] = GLONASS * SATELLITES_PER_SYSTEM + np.arange(1, 25)
    return table


_SATELLITE_OF: Final = _satellite_table()


def lock_time_s(indicator: int) -> float:
    """Return the minimum lock time (s) of DF013, DF019, DF043, DF049 (table 3.4-2)."""
    if indicator == 127:
        return 937.0
    k = indicator // 24
    return float((indicator << k) - 24 * ((k - 1) * (1 << k) + 1))


_LOCK_S: Final = np.array([lock_time_s(indicator) for indicator in range(128)])


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
    count = words[1] >> (7 if glonass else 4) & 31  # nine bits before the end of the head
    if 8 * len(payload) < head + count * _BITS[glonass, second]:
        return -1, 0
    first, at, f = row, head, np.empty(13, np.int64)
    for _ in range(count):
        for k in range(13):
            f[k] = word_bits(words, at, widths[k])
            at += widths[k]
        satellite, channel = int(_SATELLITE_OF[glonass, f[0]]), f[2] - 7 if glonass else NO_CHANNEL
        if satellite < 0 or (glonass and channel > 13):
            continue
        l1_m = f[3] * _CODE_SCALE_M + f[6] * modulus_m
        for band in range(1 + second):
            code_m, at_code, at_phase, at_lock, at_cn0 = l1_m, _PLACES[band, 0], _PLACES[band, 1], _PLACES[band, 2], _PLACES[band, 3]
            phase = _signed(
                int(f[at_phase]), int(widths[at_phase])
            )  # difference of the phase range from the L1 pseudorange in steps of 0.5 mm
            if band == 1:
                difference = _signed(f[9], widths[9])
                if difference == _INVALID_DIFFERENCE and phase == _INVALID_PHASE:
                    continue
                code_m = np.nan if difference == _INVALID_DIFFERENCE else l1_m + difference * _CODE_SCALE_M
            elif glonass and phase != _INVALID_PHASE:  # without phases some receivers leave the channel at zero
                channels[f[0]] = channel
            signal = int(signals[2 * band + f[at_code]])
            cycles_per_m = carrier_hz(satellite, signal, channel) / SPEED_OF_LIGHT_MPS
            cells[row, 0], cells[row, 1], cells[row, 2], cells[row, 3], cells[row, 4] = satellite, signal, channel, 0, LEGACY_PRIORITY
            values[row, 0], values[row, 1], values[row, 2] = code_m, np.nan, np.nan
            if phase != _INVALID_PHASE:
                gap_cyc = _unrolled_cyc(phase * _PHASE_SCALE_M * cycles_per_m, last_cyc, satellite, signal // 26)
                values[row, 1] = l1_m * cycles_per_m + gap_cyc
            values[row, 3] = f[at_cn0] * _CN0_SCALE_DBHZ if f[at_cn0] else np.nan
            values[row, 4] = _LOCK_S[f[at_lock]]
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
