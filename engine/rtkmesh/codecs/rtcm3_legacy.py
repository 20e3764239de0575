"""RTCM 3 legacy observation messages 1002, 1004 (GPS) and 1010, 1012 (GLONASS): RTCM 10403.3, 3.5.1 and 3.5.7.

1001, 1003, 1009 and 1011 lack the modulus of the pseudorange, so they give none and are not decoded. The phase is sent as its difference
from the L1 pseudorange, rolled by 1500 cycles when it leaves its field; the decoder undoes that.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.codecs.bits import unsigned_bits
from rtkmesh.codecs.rtcm3_msm import LEGACY_PRIORITY, MILLISECOND_M, NO_DAY, Observations
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
_MAX_ROWS: Final = 64  # 5 bits of satellites, two signals each


def _signals(first: str, second: str) -> list[int]:
    return [signal_number(code) for code in (first + " " + second).split()]


# [system][L1 code 0, 1, L2 code 0..3] (DF010, DF016, DF039, DF046); GPS L2 code 0 is 'C/A or L2C', codes 2 and 3 are P(Y) semi-codeless.
_SIGNALS: Final = np.array([_signals("1C 1P", "2X 2P 2D 2W"), _signals("1C 1P", "2C 2P 2P 2P")], dtype=np.int16)


# Fields of a satellite: number, L1 code, channel, pseudorange, phase difference, lock, modulus, C/N0; L2: code, pseudorange and phase
# differences, lock, C/N0. 0 where the message has not got the field.
_GPS_L1, _GLONASS_L1, _L2, _NO_L2 = [6, 1, 0, 24, 20, 7, 8, 8], [6, 1, 5, 25, 20, 7, 7, 8], [2, 14, 20, 7, 8], [0] * 5
_WIDTHS: Final = {
    1002: np.array(_GPS_L1 + _NO_L2, np.int64),
    1004: np.array(_GPS_L1 + _L2, np.int64),
    1010: np.array(_GLONASS_L1 + _NO_L2, np.int64),
    1012: np.array(_GLONASS_L1 + _L2, np.int64),
}


@kernel
def lock_time_s(indicator: int) -> float:
    """Return the minimum lock time (s) of DF013, DF019, DF043, DF049 (table 3.4-2)."""
    if indicator == 127:
        return 937.0
    k = indicator // 24
    return float((indicator << k) - 24 * ((k - 1) * (1 << k) + 1))


@kernel
def satellite_of(number: int, glonass: bool) -> int:
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
    cells[0, row], cells[1, row], cells[2, row], cells[3, row] = satellite, signal, channel, 0
    values[0, row] = code_m
    values[1, row] = np.nan
    if phase != _INVALID_PHASE:
        gap_cyc = _unrolled_cyc(phase * _PHASE_SCALE_M * cycles_per_m, last_cyc, satellite, signal // 26)
        values[1, row] = l1_code_m * cycles_per_m + gap_cyc
    values[2, row] = np.nan
    values[3, row] = cn0 * _CN0_SCALE_DBHZ if cn0 else np.nan
    values[4, row] = lock_time_s(lock)


@kernel
def decode_rows(
    payload: NDArray[np.uint8], glonass: bool, widths: NDArray[np.int64], signals: NDArray[np.int16], channels: NDArray[np.int8],
    last_cyc: NDArray[np.float64], cells: NDArray[np.int16], values: NDArray[np.float64],
) -> int:  # fmt: skip
    """Decode 1002/1004/1010/1012 into ``cells`` (4, 64) and ``values`` (5, 64); return the rows, -1 if the payload is too short.

    ``widths`` are those of _WIDTHS. Learns the GLONASS ``channels`` by slot; ``last_cyc`` (satellite, band) is the memory for undoing
    rolls.
    """
    head, modulus_m = (61, 2.0 * MILLISECOND_M) if glonass else (64, MILLISECOND_M)
    size = 0
    for width in widths:
        size += width
    if 8 * len(payload) < head:
        return -1
    count = unsigned_bits(payload, head - 9, 5)
    if 8 * len(payload) < head + count * size:
        return -1
    rows, at, f = 0, head, np.empty(13, np.int64)
    for _ in range(count):
        for k in range(13):
            f[k] = unsigned_bits(payload, at, widths[k])
            at += widths[k]
        satellite = satellite_of(f[0], glonass)
        channel = f[2] - 7 if glonass else NO_CHANNEL
        if satellite < 0 or (glonass and channel > 13):
            continue
        phase, code_m = _signed(f[4], 20), f[3] * _CODE_SCALE_M + f[6] * modulus_m
        if glonass and phase != _INVALID_PHASE:  # without phases some receivers leave the channel at zero
            channels[f[0]] = channel
        _put_row(cells, values, rows, satellite, int(signals[f[1]]), channel, code_m, code_m, phase, f[5], f[7], last_cyc)
        rows += 1
        difference, phase = _signed(f[9], 14), _signed(f[10], 20)
        if widths[8] and not (difference == _INVALID_DIFFERENCE and phase == _INVALID_PHASE):
            l2_m = np.nan if difference == _INVALID_DIFFERENCE else code_m + difference * _CODE_SCALE_M
            _put_row(cells, values, rows, satellite, int(signals[2 + f[8]]), channel, l2_m, code_m, phase, f[11], f[12], last_cyc)
            rows += 1
    return rows


class LegacyDecoder:
    """Decoder of 1002, 1004, 1010 and 1012: remembers each signal's roll of 1500 cycles."""

    def __init__(self, channels: NDArray[np.int8]) -> None:
        self._channels = channels
        self._last_cyc = np.full((MAX_SATELLITE, 2), np.nan)

    def decode(self, payload: bytes, number: int) -> Observations | None:
        """Return the observations of a message, None if it is too short for what it announces."""
        glonass = number in (1010, 1012)
        cells, values = np.empty((4, _MAX_ROWS), np.int16), np.empty((5, _MAX_ROWS))
        view = np.frombuffer(payload, np.uint8)
        rows = decode_rows(view, glonass, _WIDTHS[number], _SIGNALS[int(glonass)], self._channels, self._last_cyc, cells, values)
        if rows < 0:
            return None
        head, tag_bits = int.from_bytes(payload[:8], "big"), 27 if glonass else 30
        return Observations(
            GLONASS if glonass else GPS,
            station_id=(head >> 40) & 0xFFF,
            tag=(head >> (40 - tag_bits)) & ((1 << tag_bits) - 1) | (NO_DAY << 27 if glonass else 0),
            more=bool((head >> (39 - tag_bits)) & 1),
            priority=LEGACY_PRIORITY,
            cells=cells[:, :rows],
            values=values[:, :rows],
        )
