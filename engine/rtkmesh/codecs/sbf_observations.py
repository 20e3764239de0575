"""MeasEpoch and MeasExtra to the columns of an epoch (mosaic-X5 reference guide 4.14, 4.2.1).

A MeasEpoch has a sub-block for the first signal of each satellite (type 1) and behind it one for each further signal (type 2), whose
values are differences from the first one's.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.codecs.lock_slips import SLIP_STATE, lock_slip
from rtkmesh.codecs.observation_rows import ROW_MASK, SATELLITE_SHIFT, SIGNAL_MASK, SIGNAL_SHIFT, sort_keys
from rtkmesh.codecs.sbf_signals import (
    E6B,
    GALILEO_E6,
    GLONASS_FDMA,
    GPS_L1P,
    GPS_L2P,
    SATELLITE_OF,
    SIGNAL_NUMBERS,
    SIGNAL_OF,
    SYSTEM_OF,
)
from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP
from rtkmesh.gnss.signals import MAX_SATELLITE, NO_CHANNEL, SATELLITES_PER_SYSTEM, carrier_hz

# One signal as it is sent.
ROW: Final = np.dtype([
    ("pseudorange_m", np.float64), ("phase_cyc", np.float64), ("doppler_hz", np.float64), ("cn0_dbhz", np.float64),
    ("lock_s", np.float64), ("lock_limit_s", np.float64), ("satellite", np.int64), ("number", np.int64), ("signal", np.int64),
    ("channel", np.int64), ("half_cycle", np.int64), ("antenna", np.int64), ("receiver_channel", np.int64),
])  # fmt: skip
Row = np.void
Rows = NDArray[np.void]

HEAD: Final = 20  # bytes of the block before its sub-blocks
_TYPE1, _TYPE2, _EXTRA = 20, 12, 16  # bytes of the sub-blocks that are read
WRONG_LENGTH, SCRAMBLED = -1, -2

_SCRAMBLED_FLAG, _E6B_FLAG = 0x80, 0x40  # CommonFlags
_HALF_CYCLE_FLAG = 4  # ObsInfo
_LONG_SIGNAL = 31  # the number of the signal stands in ObsInfo, minus 32
_MAX_LOCK1_S, _MAX_LOCK2_S = 65534.0, 254.0  # lock times count no further
_NO_LOCK1, _NO_LOCK2, _NO_CN0, _NO_VARIANCE = 65535, 255, 255, 65535
_NO_DOPPLER = -(1 << 31)


@kernel
def u2(data: bytes, at: int) -> int:
    """Return the unsigned 16-bit number at a byte, little endian."""
    return int(np.int64(data[at]) | np.int64(data[at + 1]) << 8)  # a plain int of a byte stays a byte, and sums of them unsigned


@kernel
def u4(data: bytes, at: int) -> int:
    """Return the unsigned 32-bit number at a byte, little endian."""
    return u2(data, at) | u2(data, at + 2) << 16


@kernel
def signed(code: int, bits: int) -> int:
    """Return the two's complement number of so many bits."""
    return code - (1 << bits) if code >> (bits - 1) else code


@kernel
def name_signal(row: Row, kind: int, info: int, flags: int) -> None:
    """Write which signal of which antenna a sub-block is of. ``kind``, ``info``, ``flags``: Type, ObsInfo and CommonFlags."""
    number = kind & 31
    if number == _LONG_SIGNAL:
        number = 32 + (info >> 3)
    row["number"], row["antenna"] = number, kind >> 5
    row["half_cycle"] = info & _HALF_CYCLE_FLAG
    known = row["satellite"] > 0 and SYSTEM_OF[number] == row["satellite"] // SATELLITES_PER_SYSTEM
    row["signal"] = 0 if not known else E6B if number == GALILEO_E6 and flags & _E6B_FLAG else SIGNAL_OF[number]


@kernel
def write_phase(row: Row, msb: int, lsb: int) -> None:
    """Write the phase: its difference from the pseudorange in cycles; -128 and 0 mean none, as does a lock time that is not known."""
    row["phase_cyc"] = np.nan
    hz = carrier_hz(row["satellite"], row["signal"], row["channel"])
    if hz > 0.0 and (msb != -128 or lsb != 0) and not np.isnan(row["lock_s"]):
        row["phase_cyc"] = row["pseudorange_m"] * (hz / SPEED_OF_LIGHT_MPS) + msb * 65.536 + lsb * 0.001


@kernel
def cn0_of(code: int, number: int) -> float:
    """Return C/N0 (dB-Hz)."""
    if code == _NO_CN0:
        return np.nan
    return code * 0.25 + (0.0 if number in (GPS_L1P, GPS_L2P) else 10.0)


@kernel
def read_first(data: bytes, at: int, flags: int, row: Row) -> None:
    """Read a sub-block of type 1."""
    info, lock = int(data[at + 18]), u2(data, at + 16)
    row["receiver_channel"], row["satellite"], row["channel"] = int(data[at]), int(SATELLITE_OF[data[at + 2]]), NO_CHANNEL
    name_signal(row, int(data[at + 1]), info, flags)
    if GLONASS_FDMA[0] <= row["number"] <= GLONASS_FDMA[1]:
        row["channel"] = (info >> 3) - 8
    code = (int(data[at + 3]) & 15) << 32 | u4(data, at + 4)
    row["pseudorange_m"] = code * 0.001 if code else np.nan
    doppler = signed(u4(data, at + 8), 32)
    row["doppler_hz"] = doppler * 0.0001 if doppler != _NO_DOPPLER else np.nan
    row["cn0_dbhz"] = cn0_of(int(data[at + 15]), row["number"])
    row["lock_s"], row["lock_limit_s"] = float(lock) if lock != _NO_LOCK1 else np.nan, _MAX_LOCK1_S
    write_phase(row, signed(int(data[at + 14]), 8), u2(data, at + 12))


@kernel
def read_further(data: bytes, at: int, flags: int, first: Row, row: Row) -> None:
    """Read a sub-block of type 2 behind the ``first`` signal of its satellite."""
    info, lock, high = int(data[at + 5]), int(data[at + 1]), int(data[at + 3])
    row["receiver_channel"], row["satellite"], row["channel"] = first["receiver_channel"], first["satellite"], first["channel"]
    name_signal(row, int(data[at]), info, flags)
    code_msb, code_lsb, doppler_msb, doppler_lsb = signed(high & 7, 3), u2(data, at + 6), signed(high >> 3, 5), u2(data, at + 10)
    sent = code_msb != -4 or code_lsb != 0
    row["pseudorange_m"] = first["pseudorange_m"] + code_msb * 65.536 + code_lsb * 0.001 if sent else np.nan
    row["doppler_hz"] = np.nan
    hz = carrier_hz(row["satellite"], row["signal"], row["channel"])
    first_hz = carrier_hz(first["satellite"], first["signal"], first["channel"])
    if first_hz > 0.0 and hz > 0.0 and (doppler_msb != -16 or doppler_lsb != 0):
        row["doppler_hz"] = first["doppler_hz"] * (hz / first_hz) + doppler_msb * 6.5536 + doppler_lsb * 0.0001
    row["cn0_dbhz"] = cn0_of(int(data[at + 2]), row["number"])
    row["lock_s"], row["lock_limit_s"] = float(lock) if lock != _NO_LOCK2 else np.nan, _MAX_LOCK2_S
    write_phase(row, signed(int(data[at + 4]), 8), u2(data, at + 8))


@kernel
def read_signals(data: bytes, end: int, rows: Rows) -> int:
    """Read all signals of the MeasEpoch block ``data[:end]``; return their number, or WRONG_LENGTH or SCRAMBLED.

    ``rows`` has room for as many as the block's length allows.
    """
    count, at, flags = 0, HEAD, int(data[17])
    first_bytes, further_bytes = int(np.int64(data[15])), int(np.int64(data[16]))
    if flags & _SCRAMBLED_FLAG:
        return SCRAMBLED
    for _ in range(data[14]):
        if first_bytes < _TYPE1 or at + first_bytes > end:
            return WRONG_LENGTH
        further, first = int(data[at + 19]), rows[count]
        read_first(data, at, flags, first)
        at, count = at + first_bytes, count + 1
        if further and (further_bytes < _TYPE2 or at + further * further_bytes > end):
            return WRONG_LENGTH
        for _ in range(further):
            read_further(data, at, flags, first, rows[count])
            at, count = at + further_bytes, count + 1
    return count


@kernel
def slipped_since(state: NDArray[np.float64], lock_s: float, limit_s: float, valid: bool, time_s: float) -> bool:
    """Return whether the phase slipped since this signal's last valid phase (see ``lock_slip``); without a lock time nobody can tell.

    Lock times are whole seconds, rounded down, and count only to ``limit_s``, which is less for signals that come second.
    """
    if np.isnan(lock_s):
        return False
    limit_ms = (limit_s + 1.0) * 1e3
    state[1] = min(state[1], limit_ms)
    return lock_slip(state, (lock_s + 1.0) * 1e3 if lock_s > 0.0 else 0.0, limit_ms, 0, valid, time_s)


def new_slip_state() -> NDArray[np.float64]:
    """Return what ``slipped_since`` remembers, by satellite and Septentrio's signal: nothing yet."""
    return np.zeros((MAX_SATELLITE, SIGNAL_NUMBERS, SLIP_STATE))


@kernel
def epoch_columns(
    rows: Rows, antenna: int, time_s: float, state: NDArray[np.float64], ids: NDArray[np.int16], sources: NDArray[np.int64],
    channel: NDArray[np.int8], flags: NDArray[np.uint8], columns: NDArray[np.float64],
) -> tuple[int, int]:  # fmt: skip
    """Write the columns of an epoch of one antenna, sorted by (satellite, signal); return the number of rows, and that of unknown signals.

    ``state`` is that of ``slipped_since`` by satellite and signal. Out: ``ids`` (satellite, signal), ``sources`` (receiver channel and
    number of the signal, by which MeasExtra calls them), ``channel``, ``flags``, and ``columns``: pseudorange, phase, Doppler, C/N0,
    lock time, sigma of pseudorange, of phase (both not known here).
    """
    keys, count, unknown = np.empty(len(rows), np.int64), 0, 0
    for i in range(len(rows)):
        row = rows[i]
        if row["antenna"] != antenna:
            continue
        if row["signal"] > 0:
            keys[count] = int(row["satellite"]) << SATELLITE_SHIFT | int(row["signal"]) << SIGNAL_SHIFT | i
            count += 1
        else:
            unknown += 1
    count = sort_keys(keys[:count])
    for k in range(count):
        row = rows[keys[k] & ROW_MASK]
        ids[0, k], ids[1, k] = keys[k] >> SATELLITE_SHIFT, keys[k] >> SIGNAL_SHIFT & SIGNAL_MASK
        sources[0, k], sources[1, k], channel[k] = row["receiver_channel"], row["number"], row["channel"]
        valid = not np.isnan(row["phase_cyc"])
        slipped = slipped_since(state[row["satellite"], row["number"]], float(row["lock_s"]), float(row["lock_limit_s"]), valid, time_s)
        flags[k] = ((SLIP if slipped else 0) | (HALF_CYCLE if row["half_cycle"] else 0)) if valid else 0
        columns[0, k], columns[1, k], columns[2, k] = row["pseudorange_m"], row["phase_cyc"], row["doppler_hz"]
        columns[3, k], columns[4, k] = row["cn0_dbhz"], row["lock_s"]
        columns[5, k] = columns[6, k] = np.nan
    return count, unknown


@kernel
def add_extra(
    data: bytes, end: int, antenna: int, sources: NDArray[np.int64], cn0_dbhz: NDArray[np.float64], code_sigma_m: NDArray[np.float64],
    phase_sigma_cyc: NDArray[np.float64],
) -> bool:  # fmt: skip
    """Add what the MeasExtra block ``data[:end]`` says to the columns of its epoch; return whether its length is right.

    ``sources``: receiver channel and number of the signal of each row. Blocks of revision 3 have the number's high part and the fine part
    of C/N0.
    """
    size, at = int(np.int64(data[15])), HEAD
    if size < _EXTRA - 2 or HEAD + int(data[14]) * size > end:
        return False
    for _ in range(data[14]):
        kind, misc = int(data[at + 1]), int(data[at + 15]) if size >= _EXTRA else 0
        number = kind & 31
        if number == _LONG_SIGNAL:
            number = 32 + (misc >> 3)
        for k in range(sources.shape[1]):
            if kind >> 5 == antenna and sources[0, k] == data[at] and sources[1, k] == number:
                code, phase = u2(data, at + 6), u2(data, at + 8)
                code_sigma_m[k] = np.sqrt(max(code, 1) * 1e-4) if code != _NO_VARIANCE else np.nan
                phase_sigma_cyc[k] = np.sqrt(max(phase, 1) * 1e-6) if phase != _NO_VARIANCE else np.nan
                cn0_dbhz[k] += (misc & 7) * 0.03125
        at += size
    return True
