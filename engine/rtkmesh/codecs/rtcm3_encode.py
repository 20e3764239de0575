"""Values to RTCM 3 frames: MSM4 to MSM7, ephemerides, station and GLONASS bias messages. Layouts stand in the decoders' modules.

A phase must lie within 1.1 km of its rough range to be sent, a pseudorange within 292 m: ``PhaseLeveller`` brings the phases of any
receiver there by whole cycles, constant over an arc.
"""

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.codecs.checksums import crc24q
from rtkmesh.codecs.rtcm3_ephemeris import ephemeris_payload
from rtkmesh.codecs.rtcm3_epochs import DAY_MS, MOSCOW_MS, WEEK_MS
from rtkmesh.codecs.rtcm3_msm import (
    FIELD_BITS,
    FIELD_SCALES,
    FIRST_SATELLITE,
    GROUP_OF_SYSTEM,
    HEADER_BITS,
    INVALID_RATE_MPS,
    INVALID_ROUGH_MS,
    MASK_SATELLITES,
    MAX_CELLS,
    MILLISECOND_M,
    RATE_SCALE_MPS,
    SIGNAL_OF_BIT,
    lock_time_s,
)
from rtkmesh.codecs.rtcm3_station import bias_payload, descriptor_payload, position_payload
from rtkmesh.gnss.constants import BDT_MINUS_GPST_S, SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.ephemeris import Ephemeris, GlonassBias, ReferenceStation
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Epoch
from rtkmesh.gnss.signals import BEIDOU, GLONASS, MAX_SATELLITE, MAX_SIGNAL, SATELLITES_PER_SYSTEM, carrier_hz
from rtkmesh.gnss.time import GpsTime, gps_minus_utc_s

MAX_PAYLOAD: Final = 1023

_NO_CHANNEL_INFO: Final = 15  # DF419
_WIDEST_M: Final = 290.0  # pseudoranges of one satellite that fit around their middle
_WIDEST_MPS: Final = 2.0
_LEVEL_LIMIT_M: Final = 900.0  # phases are levelled again when they drift further than this from their pseudoranges


def frame(payload: bytes) -> bytes:
    """Return the frame of a payload: preamble, length, CRC-24Q (RTCM 10403.3, 4); ValueError if it is too long."""
    if len(payload) > MAX_PAYLOAD:
        raise ValueError(f"{len(payload)} bytes do not fit in an RTCM 3 frame")
    head = b"\xd3" + len(payload).to_bytes(2, "big") + payload
    return head + crc24q(np.frombuffer(head, np.uint8)).to_bytes(3, "big")


def encode_ephemeris(ephemeris: Ephemeris) -> bytes:
    """Return the frame of a 1019, 1020, 1042, 1044, 1045 or 1046; ValueError if a value does not fit its field."""
    return frame(ephemeris_payload(ephemeris))


def encode_station(station: ReferenceStation) -> list[bytes]:
    """Return the frames of 1006 (if the position is known) and 1033."""
    position = [frame(position_payload(station, with_height=True))] if station.position_ecef_m is not None else []
    return [*position, frame(descriptor_payload(station))]


def encode_glonass_bias(bias: GlonassBias) -> bytes:
    """Return the frame of a 1230."""
    return frame(bias_payload(bias))


def epoch_tag(system: int, time: GpsTime) -> int:
    """Return the 30-bit epoch time field of a system, rounded to milliseconds."""
    tow_ms = round(time.tow_s * 1e3) % WEEK_MS
    if system == BEIDOU:
        return (tow_ms + round(BDT_MINUS_GPST_S * 1e3)) % WEEK_MS
    if system != GLONASS:
        return tow_ms
    moscow_ms = (tow_ms + MOSCOW_MS - gps_minus_utc_s(time) * 1000) % WEEK_MS
    return moscow_ms // DAY_MS << 27 | moscow_ms % DAY_MS


def encode_epoch(epoch: Epoch, station_id: int, msm: int = 7) -> list[bytes]:
    """Return the MSM frames (type ``msm``, 4 to 7) of an epoch in one order of systems; the last one ends the epoch.

    The time is rounded to milliseconds. Signals and satellites that RTCM does not know are left out; values outside their fields are
    sent as invalid. An epoch without any row gives no frame.
    """
    if msm not in (4, 5, 6, 7):
        raise ValueError(f"MSM{msm} is not supported, only MSM4 to MSM7")
    chosen = [rows for rows in _messages(epoch) if len(rows)]
    return [frame(_msm_payload(epoch, rows, station_id, msm, more=rows is not chosen[-1])) for rows in chosen]


def _messages(epoch: Epoch) -> list[NDArray[np.intp]]:
    """Return the rows of each message: by system in the order of message numbers, at most 64 cells."""
    systems = epoch.satellite // SATELLITES_PER_SYSTEM
    bits = _BIT_OF_SIGNAL[systems, epoch.signal]
    number = epoch.satellite % SATELLITES_PER_SYSTEM - _FIRST[systems]
    sendable = (bits > 0) & (number >= 1) & (number <= _LAST[systems])
    messages: list[NDArray[np.intp]] = []
    for system in sorted(GROUP_OF_SYSTEM, key=lambda system: GROUP_OF_SYSTEM[system]):
        messages += _split(np.flatnonzero(sendable & (systems == system)), epoch)
    return messages


def _split(rows: NDArray[np.intp], epoch: Epoch) -> list[NDArray[np.intp]]:
    """Cut the rows of one system between satellites so that satellites times signals is at most 64 in each part."""
    satellites, position = np.unique(epoch.satellite[rows], return_inverse=True)
    signals = len(np.unique(epoch.signal[rows]))
    if len(satellites) * signals <= MAX_CELLS:
        return [rows]
    per_message = max(MAX_CELLS // signals, 1)
    return [rows[position // per_message == part] for part in range(-(-len(satellites) // per_message))]


def _bit_table() -> NDArray[np.int64]:
    table = np.zeros((len(SIGNAL_OF_BIT), MAX_SIGNAL), np.int64)
    for system, row in enumerate(SIGNAL_OF_BIT):
        for bit, signal in enumerate(row):
            if signal >= 0:
                table[system, signal] = bit
    return table


_BIT_OF_SIGNAL: Final = _bit_table()
_FIRST: Final = np.array(FIRST_SATELLITE)
_LAST: Final = np.array(MASK_SATELLITES)
_LOCK_4: Final = np.array([lock_time_s(i, False) for i in range(16)])
_LOCK_10: Final = np.array([lock_time_s(i, True) for i in range(705)])


def _msm_payload(epoch: Epoch, rows: NDArray[np.intp], station_id: int, msm: int, *, more: bool) -> bytes:
    system = int(epoch.satellite[rows[0]]) // SATELLITES_PER_SYSTEM
    satellites, satellite_index = np.unique(epoch.satellite[rows], return_inverse=True)
    bits, signal_index = np.unique(_BIT_OF_SIGNAL[system, epoch.signal[rows]], return_inverse=True)
    order = np.lexsort((signal_index, satellite_index))  # bits of a system are not in the order of RINEX codes
    rows, satellite_index, signal_index = rows[order], satellite_index[order], signal_index[order]
    head = (10 * GROUP_OF_SYSTEM[system] + msm) << 52 | station_id << 40 | epoch_tag(system, epoch.time) << 10 | int(more) << 9
    widths = FIELD_BITS[msm - 4]
    extra = 36 if msm in (5, 7) else 18
    total = HEADER_BITS + len(satellites) * len(bits) + len(satellites) * extra + len(rows) * int(widths.sum())
    buffer = np.zeros((total + 7) // 8, np.uint8)
    buffer[:8] = np.frombuffer(head.to_bytes(8, "big"), np.uint8)
    locks = _LOCK_4 if widths[2] == 4 else _LOCK_10
    lock_s = np.where((epoch.flags[rows] & SLIP != 0) & ~(epoch.lock_s[rows] > 0.0), 0.0, epoch.lock_s[rows])
    lock = np.searchsorted(locks, np.nan_to_num(lock_s) + 1e-9, side="right") - 1
    columns = np.stack((epoch.pseudorange_m[rows], epoch.phase_cyc[rows], epoch.doppler_hz[rows], epoch.cn0_dbhz[rows]))
    write_cells(
        buffer, satellites % SATELLITES_PER_SYSTEM - FIRST_SATELLITE[system], bits, satellite_index, signal_index, epoch.satellite[rows],
        epoch.signal[rows], epoch.channel[rows], epoch.flags[rows] & HALF_CYCLE != 0, lock,
        columns, widths, FIELD_SCALES[msm - 4],
    )  # fmt: skip
    return buffer.tobytes()


@kernel
def put_bits(buffer: NDArray[np.uint8], position: int, length: int, value: int) -> None:
    """Write the lowest ``length`` (1 to 56) bits of ``value`` at bit ``position`` of a zeroed buffer."""
    last = position + length - 1
    bits = (value & ((1 << length) - 1)) << (7 - (last & 7))
    for i in range(last >> 3, (position >> 3) - 1, -1):
        buffer[i] |= np.uint8(bits & 0xFF)
        bits >>= 8


@kernel
def _put_fine(buffer: NDArray[np.uint8], position: int, length: int, value: float) -> None:
    """Write a number of resolution steps as a signed field, its most negative value if it is NaN or does not fit."""
    limit = 1 << (length - 1)
    if not abs(value) < limit - 0.5:  # NaN as well
        put_bits(buffer, position, length, -limit)
    else:
        put_bits(buffer, position, length, int(np.rint(value)))


@kernel
def _middle(values: NDArray[np.float64], index: NDArray[np.int64], which: int, widest: float) -> float:
    """Return the middle of the finite values with ``index == which``, the first of them if they lie further apart than ``widest``."""
    low, high, first = np.inf, -np.inf, np.nan
    for j in range(len(index)):
        if index[j] == which and np.isfinite(values[j]):
            first = values[j] if np.isnan(first) else first
            low, high = min(low, values[j]), max(high, values[j])
    return (low + high) / 2.0 if high - low <= widest else first


@kernel
def _rough(
    ranges_m: NDArray[np.float64], phase_ranges_m: NDArray[np.float64], rates_mps: NDArray[np.float64], index: NDArray[np.int64],
    out: NDArray[np.float64],
) -> None:  # fmt: skip
    """Write to ``out`` (2, satellites) the rough range (ms) and rate (m/s) of each satellite; NaN where nothing is known or fits."""
    for i in range(out.shape[1]):
        middle_m = _middle(ranges_m, index, i, _WIDEST_M)
        if np.isnan(middle_m):
            middle_m = _middle(phase_ranges_m, index, i, _WIDEST_M)
        rough_ms = np.rint(middle_m / MILLISECOND_M * 1024.0) / 1024.0
        out[0, i] = rough_ms if 0.0 <= rough_ms < INVALID_ROUGH_MS else np.nan
        rate_mps = np.rint(_middle(rates_mps, index, i, _WIDEST_MPS))
        out[1, i] = rate_mps if abs(rate_mps) < -INVALID_RATE_MPS else np.nan


@kernel
def _write_satellites(
    buffer: NDArray[np.uint8], position: int, rough: NDArray[np.float64], extended: NDArray[np.int64], with_rate: bool
) -> int:
    """Write the satellite data at bit ``position``; return the position behind."""
    count = rough.shape[1]
    fraction = position + (12 if with_rate else 8) * count
    for i in range(count):
        steps = INVALID_ROUGH_MS * 1024 if np.isnan(rough[0, i]) else int(rough[0, i] * 1024.0)
        put_bits(buffer, position + 8 * i, 8, steps >> 10)
        put_bits(buffer, fraction + 10 * i, 10, steps & 1023)
        if with_rate:
            put_bits(buffer, position + 8 * count + 4 * i, 4, extended[i])
            rate = INVALID_RATE_MPS if np.isnan(rough[1, i]) else int(rough[1, i])
            put_bits(buffer, fraction + 10 * count + 14 * i, 14, rate)
    return fraction + (24 if with_rate else 10) * count


@kernel
def write_cells(
    buffer: NDArray[np.uint8], numbers: NDArray[np.int16], bits: NDArray[np.int64], satellite_index: NDArray[np.int64],
    signal_index: NDArray[np.int64], satellites: NDArray[np.int16], signals: NDArray[np.int16], channels: NDArray[np.int8],
    half_cycle: NDArray[np.bool_], lock: NDArray[np.int64], values: NDArray[np.float64], widths: NDArray[np.int64],
    scales: NDArray[np.float64],
) -> None:  # fmt: skip
    """Write masks, satellite data and signal data of one MSM behind its header into a zeroed buffer.

    ``numbers`` and ``bits`` are the set bits of DF394 and DF395; cells are sorted by (satellite, bit), ``satellite_index`` and
    ``signal_index`` say where each belongs; ``values`` rows: pseudorange (m), phase (cycles), Doppler (Hz), C/N0 (dB-Hz).
    """
    n_sat, n_sig, n_cell = len(numbers), len(bits), len(satellites)
    phase_ranges_m, rates_mps = np.empty(n_cell), np.empty(n_cell)
    extended, rough = np.zeros(n_sat, np.int64), np.empty((2, n_sat))
    for i in range(n_cell):
        carrier = carrier_hz(satellites[i], signals[i], channels[i])
        wavelength_m = SPEED_OF_LIGHT_MPS / carrier if carrier > 0.0 else np.nan
        phase_ranges_m[i], rates_mps[i] = values[1, i] * wavelength_m, -values[2, i] * wavelength_m
        if satellites[i] // SATELLITES_PER_SYSTEM == GLONASS:
            extended[satellite_index[i]] = channels[i] + 7 if -7 <= channels[i] <= 6 else _NO_CHANNEL_INFO
    _rough(values[0], phase_ranges_m, rates_mps, satellite_index, rough)
    for i in range(n_sat):
        put_bits(buffer, 73 + numbers[i] - 1, 1, 1)
    for i in range(n_sig):
        put_bits(buffer, 137 + bits[i] - 1, 1, 1)
    for i in range(n_cell):
        put_bits(buffer, HEADER_BITS + satellite_index[i] * n_sig + signal_index[i], 1, 1)
    at = _write_satellites(buffer, HEADER_BITS + n_sat * n_sig, rough, extended, widths[5] > 0)
    for i in range(n_cell):
        rough_ms, p = rough[0, satellite_index[i]], at
        _put_fine(buffer, p + i * widths[0], widths[0], (values[0, i] / MILLISECOND_M - rough_ms) / scales[0])
        p += n_cell * widths[0]
        _put_fine(buffer, p + i * widths[1], widths[1], (phase_ranges_m[i] / MILLISECOND_M - rough_ms) / scales[1])
        p += n_cell * widths[1]
        put_bits(buffer, p + i * widths[2], widths[2], lock[i])
        p += n_cell * widths[2]
        put_bits(buffer, p + i, 1, half_cycle[i])
        p += n_cell
        cn0 = np.rint(values[3, i] / scales[2]) if values[3, i] > 0.0 else 0.0
        put_bits(buffer, p + i * widths[4], widths[4], int(min(cn0, (1 << widths[4]) - 1)))
        p += n_cell * widths[4]
        if widths[5]:
            _put_fine(buffer, p + i * widths[5], widths[5], (rates_mps[i] - rough[1, satellite_index[i]]) / RATE_SCALE_MPS)


class PhaseLeveller:
    """Shifts phases by whole cycles, constant over an arc, so that they come close enough to their pseudoranges to be sent."""

    def __init__(self) -> None:
        self._shift_cyc = np.full((MAX_SATELLITE, MAX_SIGNAL), np.nan)

    def level(self, epoch: Epoch) -> Epoch:
        """Return the epoch with shifted phases; where the shift had to change, lock time is 0 and SLIP is set."""
        index = epoch.satellite.astype(np.intp), epoch.signal.astype(np.intp)
        carrier = np.array([carrier_hz(s, g, c) for s, g, c in zip(epoch.satellite, epoch.signal, epoch.channel, strict=True)])
        with np.errstate(divide="ignore", invalid="ignore"):
            gap_cyc = epoch.phase_cyc - epoch.pseudorange_m * carrier / SPEED_OF_LIGHT_MPS
            before = self._shift_cyc[index]
            drifted = np.isfinite(gap_cyc) & ~(np.abs(gap_cyc - before) < _LEVEL_LIMIT_M * carrier / SPEED_OF_LIGHT_MPS)
        new_arc = drifted | ((epoch.flags & SLIP) != 0) & np.isfinite(gap_cyc)
        shift = np.where(new_arc, np.rint(gap_cyc), before)
        self._shift_cyc[index] = shift
        changed = new_arc & np.isfinite(before) & (shift != before)
        return replace(
            epoch,
            phase_cyc=np.where(np.isnan(shift), epoch.phase_cyc, epoch.phase_cyc - shift),
            lock_s=np.where(changed, 0.0, epoch.lock_s),
            flags=np.where(changed, epoch.flags | SLIP, epoch.flags).astype(np.uint8),
        )
