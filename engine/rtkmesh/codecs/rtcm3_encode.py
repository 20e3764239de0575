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
    FIRST_SATELLITE,
    GROUP_OF_SYSTEM,
    HEADER_BITS,
    INVALID_ROUGH_MS,
    LAST_EXTENDED_LOCK,
    LOCK_S,
    MASK_SATELLITES,
    MAX_CELLS,
    MILLISECOND_M,
    NO_EXTENDED,
    RATE_SCALE_MPS,
    SIGNAL_OF_BIT,
    WIDTHS,
    Widths,
)
from rtkmesh.codecs.rtcm3_station import bias_payload, descriptor_payload, position_payload
from rtkmesh.gnss.constants import BDT_MINUS_GPST_S, SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.ephemeris import Ephemeris, GlonassBias, ReferenceStation
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Epoch
from rtkmesh.gnss.signals import BEIDOU, GLONASS, MAX_SATELLITE, MAX_SIGNAL, SATELLITES_PER_SYSTEM, carrier_hz
from rtkmesh.gnss.time import GpsTime, gps_minus_utc_s

MAX_PAYLOAD: Final = 1023

_WIDEST_M: Final = 290.0  # pseudoranges of one satellite that fit around their middle
_WIDEST_MPS: Final = 2.0
_LEVEL_LIMIT_M: Final = 900.0  # phases are levelled again when they drift further than this from their pseudoranges


def frame(payload: bytes) -> bytes:
    """Return the frame of a payload: preamble, length, CRC-24Q (RTCM 10403.3, 4); ValueError if it is too long."""
    if len(payload) > MAX_PAYLOAD:
        raise ValueError(f"{len(payload)} bytes do not fit in an RTCM 3 frame")
    head = b"\xd3" + len(payload).to_bytes(2, "big") + payload
    return head + crc24q(head).to_bytes(3, "big")


def encode_ephemeris(ephemeris: Ephemeris) -> bytes:
    """Return the frame of a 1019, 1020, 1041, 1042, 1044, 1045 or 1046; ValueError if a value does not fit its field."""
    return frame(ephemeris_payload(ephemeris))


def encode_station_message(station: ReferenceStation, number: int) -> bytes:
    """Return the frame of a 1005, 1006, 1007, 1008 or 1033; ValueError for other numbers or without its position."""
    if number in (1005, 1006):
        return frame(position_payload(station, with_height=number == 1006))
    if number in (1007, 1008, 1033):
        return frame(descriptor_payload(station, number))
    raise ValueError(f"{number} is no station message")


def encode_station(station: ReferenceStation) -> list[bytes]:
    """Return the frames of 1006 (if the position is known) and 1033."""
    numbers = (1006, 1033) if station.position_ecef_m is not None else (1033,)
    return [encode_station_message(station, number) for number in numbers]


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
_LOCK_4: Final = LOCK_S[0, :16]
_LOCK_10: Final = LOCK_S[1, : LAST_EXTENDED_LOCK + 1]


def _msm_payload(epoch: Epoch, rows: NDArray[np.intp], station_id: int, msm: int, *, more: bool) -> bytes:
    system = int(epoch.satellite[rows[0]]) // SATELLITES_PER_SYSTEM
    satellites, satellite_index = np.unique(epoch.satellite[rows], return_inverse=True)
    bits, signal_index = np.unique(_BIT_OF_SIGNAL[system, epoch.signal[rows]], return_inverse=True)
    order = np.lexsort((signal_index, satellite_index))  # bits of a system are not in the order of RINEX codes
    rows, satellite_index, signal_index = rows[order], satellite_index[order], signal_index[order]
    widths, (satellite_fields, signal_fields) = WIDTHS[msm], _fields(epoch.take(rows), satellite_index, WIDTHS[msm])
    numbers = satellites % SATELLITES_PER_SYSTEM - FIRST_SATELLITE[system]
    cells = len(satellites) * len(bits)
    header = (10 * GROUP_OF_SYSTEM[system] + msm) << 157 | station_id << 145 | epoch_tag(system, epoch.time) << 115 | int(more) << 114
    header |= sum(1 << (96 - number) for number in numbers.tolist()) | sum(1 << (32 - bit) for bit in bits.tolist())
    header = header << cells | sum(1 << (cells - 1 - cell) for cell in (satellite_index * len(bits) + signal_index).tolist())
    position = HEADER_BITS + cells
    total = position + len(satellites) * int(widths.satellite.sum()) + len(rows) * int(widths.signal.sum())
    buffer = np.zeros((total + 7) // 8, np.uint8)
    head = (header << -position % 8).to_bytes((position + 7) // 8, "big")
    buffer[: len(head)] = np.frombuffer(head, np.uint8)
    position = write_columns(buffer, position, widths.satellite, satellite_fields)
    write_columns(buffer, position, widths.signal, signal_fields)
    return buffer.tobytes()


def _fields(epoch: Epoch, satellite_index: NDArray[np.intp], widths: Widths) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the satellite fields (4, satellites) and signal fields (6, cells) as numbers of their resolution steps.

    The rough range is the middle of a satellite's pseudoranges (phase ranges, if there are none), so that all its fine values fit.
    """
    carrier = _carriers_hz(epoch)
    wavelength_m = np.where(carrier > 0.0, SPEED_OF_LIGHT_MPS / np.where(carrier > 0.0, carrier, 1.0), np.nan)
    known = (_finite(epoch.pseudorange_m), _finite(epoch.phase_cyc * wavelength_m), _finite(-epoch.doppler_hz * wavelength_m))
    range_m, phase_m, rate_mps = known
    first = np.flatnonzero(np.diff(satellite_index, prepend=-1))
    middle_m = _middle(range_m, first, _WIDEST_M)
    middle_m = np.where(np.isnan(middle_m), _middle(phase_m, first, _WIDEST_M), middle_m)
    rough = np.rint(middle_m / MILLISECOND_M * 1024.0)
    rough = np.where((rough >= 0.0) & (rough < INVALID_ROUGH_MS * 1024), rough, np.nan)
    rough_rate = np.rint(_middle(rate_mps, first, _WIDEST_MPS))
    rough_steps = np.where(np.isnan(rough), INVALID_ROUGH_MS * 1024, rough).astype(np.int64)
    channel = np.where((epoch.channel >= -7) & (epoch.channel <= 6), epoch.channel.astype(np.int64) + 7, NO_EXTENDED)[first]
    extended = np.where(epoch.satellite[first] // SATELLITES_PER_SYSTEM == GLONASS, channel, 0)
    fine_ms, fine_rate = rough[satellite_index] / 1024.0, rough_rate[satellite_index]
    satellites = np.stack((rough_steps >> 10, extended, rough_steps & 1023, _steps(rough_rate, 14)))
    signals = np.stack((
        _steps((range_m / MILLISECOND_M - fine_ms) / widths.scales[0], int(widths.signal[0])),
        _steps((phase_m / MILLISECOND_M - fine_ms) / widths.scales[1], int(widths.signal[1])),
        _lock_indicators(epoch, widths),
        (epoch.flags & HALF_CYCLE != 0).astype(np.int64),
        np.clip(np.rint(_finite(epoch.cn0_dbhz, 0.0) / widths.scales[2]), 0, (1 << int(widths.signal[4])) - 1).astype(np.int64),
        _steps((rate_mps - fine_rate) / RATE_SCALE_MPS, 15),
    ))  # fmt: skip
    return satellites, signals


def _finite(values: NDArray[np.float64], otherwise: float = np.nan) -> NDArray[np.float64]:
    return np.where(np.isfinite(values), values, otherwise)


def _middle(values: NDArray[np.float64], first: NDArray[np.intp], widest: float) -> NDArray[np.float64]:
    """Return the middle of each group's values (groups begin at ``first``), its lowest if they lie further apart than ``widest``."""
    low, high = np.fmin.reduceat(values, first), np.fmax.reduceat(values, first)
    return np.where(high - low <= widest, (low + high) / 2.0, low)


def _steps(values: NDArray[np.float64], width: int) -> NDArray[np.int64]:
    """Return numbers of resolution steps rounded for a signed field: its most negative value where they are NaN or do not fit."""
    limit = float(1 << (width - 1))
    steps = np.rint(values)
    return np.where(np.abs(steps) < limit, steps, -limit).astype(np.int64)


def _lock_indicators(epoch: Epoch, widths: Widths) -> NDArray[np.int64]:
    """Return DF402 or DF407: the longest time that is not longer than the lock; 0 where it is not known."""
    table = _LOCK_4 if widths.signal[2] == 4 else _LOCK_10
    return np.searchsorted(table, _finite(epoch.lock_s, 0.0) + 1e-9, side="right").astype(np.int64) - 1


def _carriers_hz(epoch: Epoch) -> NDArray[np.float64]:
    return carriers_hz(epoch.satellite.astype(np.int64), epoch.signal.astype(np.int64), epoch.channel.astype(np.int64))


@kernel
def carriers_hz(satellite: NDArray[np.int64], signal: NDArray[np.int64], channel: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the carrier frequency (Hz) of each row, 0.0 where it is not known."""
    out = np.empty(len(satellite))
    for i in range(len(satellite)):
        out[i] = carrier_hz(satellite[i], signal[i], channel[i])
    return out


@kernel
def write_columns(buffer: NDArray[np.uint8], position: int, widths: NDArray[np.int64], raw: NDArray[np.int64]) -> int:
    """Write fields that follow one another, each for all columns of ``raw``, into a zeroed buffer; return the position behind.

    Of each number the lowest bits are written (two's complement); the widths are at most 56.
    """
    for field in range(len(widths)):
        width = widths[field]
        for i in range(raw.shape[1]):
            last = position + width - 1
            bits = (raw[field, i] & ((1 << width) - 1)) << (7 - (last & 7))
            for k in range(last >> 3, (position >> 3) - 1, -1):
                buffer[k] |= np.uint8(bits & 0xFF)
                bits >>= 8
            position += width
    return position


class PhaseLeveller:
    """Shifts phases by whole cycles, constant over an arc, so that they come close enough to their pseudoranges to be sent."""

    def __init__(self) -> None:
        self._shift_cyc = np.full((MAX_SATELLITE, MAX_SIGNAL), np.nan)

    def level(self, epoch: Epoch) -> Epoch:
        """Return the epoch with shifted phases; where the shift had to change, lock time is 0 and SLIP is set."""
        index = epoch.satellite.astype(np.intp), epoch.signal.astype(np.intp)
        carrier = _carriers_hz(epoch)
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
