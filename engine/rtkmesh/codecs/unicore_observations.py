"""Measurements of OBSVM, OBSVH and their compressed forms to the columns of an epoch (Unicore N4 commands manual R1.13, 7.3).

NovAtel's RANGE and RANGECMP are of the same kind: a ``Form`` tells what differs.
``Measurements`` are what all forms have in common, in the units of an epoch; the receiver's carrier phase has the sign of an accumulated
Doppler range: minus that of RINEX.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.codecs.lock_slips import SLIP_STATE, lock_slip
from rtkmesh.codecs.observation_rows import ROW_MASK, SATELLITE_SHIFT, SIGNAL_MASK, SIGNAL_SHIFT, sort_keys
from rtkmesh.codecs.unicore_signals import L1S_SIGNAL, L2C_FLAG, PRNS, SATELLITE_OF, SIGNAL_OF, SIGNAL_TYPES, SYSTEMS
from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Epoch
from rtkmesh.gnss.signals import GLONASS, NO_CHANNEL, SATELLITES_PER_SYSTEM, carrier_hz
from rtkmesh.gnss.time import GpsTime

FULL = np.dtype([
    ("frequency", "<u2"), ("prn", "<u2"), ("pseudorange_m", "<f8"), ("range_cyc", "<f8"), ("pseudorange_sigma", "<u2"),
    ("phase_sigma", "<u2"), ("doppler_hz", "<f4"), ("cn0", "<u2"), ("reserved", "<u2"), ("lock_s", "<f4"), ("status", "<u4"),
])  # fmt: skip
COMPRESSED_BYTES: Final = 24
# Standard deviations of compressed pseudoranges by their index (m).
PSEUDORANGE_SIGMAS_M = np.array(
    (0.05, 0.075, 0.113, 0.169, 0.253, 0.38, 0.57, 0.854, 1.281, 2.375, 4.75, 9.5, 19.0, 38.0, 76.0, 152.0), np.float64
)
ROLL_CYC: Final = 8388608.0  # compressed carrier phases repeat after this many cycles, or after twice as many
DOPPLER_UNIT_HZ, RANGE_UNIT_M, PHASE_UNIT_CYC, SIGMA_STEP_CYC = 1 / 256, 1 / 128, 1 / 256, 1 / 512
LOCK_UNIT_S, LEAST_CN0_DBHZ = 1 / 32, 20.0
MAX_COMPRESSED_LOCK_S: Final = ((1 << 21) - 1) * LOCK_UNIT_S
MAX_LOCK_S: Final = 1e6

PHASE_LOCKED, PARITY_KNOWN, CODE_LOCKED, HALF_ADDED = 1 << 10, 1 << 11, 1 << 12, 1 << 28  # bits of the tracking status
_MAX_PSEUDORANGE_M, _MAX_PHASE_CYC, _MAX_DOPPLER_HZ = 1e9, 1e10, 1e6
_MAX_FREQUENCY: Final = 13  # GLONASS channel + 7
_MAX_CN0_DBHZ, _MAX_SIGMA = 100.0, 1e6


class Units(NamedTuple):
    """Units of C/N0 (dB-Hz) and of the standard deviations of pseudorange (m) and phase (cycles)."""

    cn0_dbhz: float
    pseudorange_sigma_m: float
    phase_sigma_cyc: float


class Form(NamedTuple):
    """What differs between makers: the rows of full measurements, their units, the signals by system and signal type.

    ``tells_parity``: the tracking status says whether the half cycle is known, and whether it was added.
    """

    rows: np.dtype[np.void]
    units: Units
    signals: NDArray[np.int16]
    tells_parity: bool


UNICORE: Final = Form(FULL, Units(0.01, 0.01, 1e-4), SIGNAL_OF, tells_parity=False)


class Measurements(NamedTuple):
    """One row per signal: ``numbers`` (frequency, PRN, tracking status) and ``values`` (columns of VALUES)."""

    numbers: NDArray[np.int64]
    values: NDArray[np.float64]


VALUES: Final = 7  # pseudorange m, accumulated Doppler range cyc, Doppler Hz, C/N0 dB-Hz, lock s, sigma of pseudorange m, of phase cyc


def new_slip_state() -> NDArray[np.float64]:
    """Return what ``lock_slip`` remembers, by system, PRN and signal type: nothing yet."""
    return np.zeros((SYSTEMS, PRNS, SIGNAL_TYPES, SLIP_STATE))


def rows_of(body: bytes | list[str], form: Form) -> NDArray[np.void] | None:
    """Return the rows of a log of full measurements, None where they are not whole."""
    layout = form.rows
    if isinstance(body, bytes):
        count = int.from_bytes(body[:4], "little")
        return np.frombuffer(body, layout, count, 4) if len(body) >= 4 + count * layout.itemsize and len(body) >= 4 else None
    names = layout.names or ()
    try:
        count = int(body[0])
        words = body[1 : 1 + count * len(names)]
        rows = np.zeros(max(count, 0) if len(words) == count * len(names) else -1, layout)
        with np.errstate(over="ignore", invalid="ignore"):
            for k, name in enumerate(names):
                column = words[k :: len(names)]
                rows[name] = [int(word, 16) for word in column] if name == "status" else [float(word) for word in column]
    except (ValueError, OverflowError):
        return None
    return rows


def full_measurements(body: bytes | list[str], form: Form) -> Measurements | None:
    """Return the measurements of a log of full ones, None where they are not whole."""
    rows = rows_of(body, form)
    if rows is None:
        return None
    numbers, values = np.empty((len(rows), 3), np.int64), np.empty((len(rows), VALUES))
    for k, name in enumerate(("frequency", "prn", "status")):
        numbers[:, k] = rows[name]
    for k, (name, unit) in enumerate((
        ("pseudorange_m", 1.0), ("range_cyc", 1.0), ("doppler_hz", 1.0), ("cn0", form.units.cn0_dbhz), ("lock_s", 1.0),
        ("pseudorange_sigma", form.units.pseudorange_sigma_m), ("phase_sigma", form.units.phase_sigma_cyc),
    )):  # fmt: skip
        with np.errstate(invalid="ignore"):  # what is no number stays none
            np.multiply(rows[name], unit, out=values[:, k])
    return Measurements(numbers, values)


def compressed_measurements(body: bytes | list[str], form: Form) -> Measurements | None:
    """Return the measurements of a log of compressed ones (in ASCII each is 48 hexadecimal digits), None where they are not whole."""
    if not isinstance(body, bytes):
        try:
            body = int(body[0]).to_bytes(4, "little") + bytes.fromhex("".join(body[1:]))
        except (ValueError, OverflowError):
            return None
    count = int.from_bytes(body[:4], "little")
    if len(body) < 4 + count * COMPRESSED_BYTES or len(body) < 4:
        return None
    numbers, values = np.empty((count, 3), np.int64), np.empty((count, VALUES))
    read_compressed(np.frombuffer(body, np.uint8, count * COMPRESSED_BYTES, 4), form.signals, numbers, values)
    return Measurements(numbers, values)


@kernel
def _bits(data: NDArray[np.uint8], start: int, first: int, count: int) -> int:
    """Return ``count`` bits of a row at byte ``start``, the lowest one first."""
    value = 0
    for bit in range(first, first + count):
        value |= (int(data[start + (bit >> 3)]) >> (bit & 7) & 1) << (bit - first)
    return value


@kernel
def _signed_bits(data: NDArray[np.uint8], start: int, first: int, count: int) -> int:
    value = _bits(data, start, first, count)
    return value - (1 << count) if value >> (count - 1) else value


@kernel
def read_compressed(data: NDArray[np.uint8], signals: NDArray[np.int16], numbers: NDArray[np.int64], values: NDArray[np.float64]) -> None:
    """Read rows of 24 bytes. The carrier phase gets the rolls back with which it is nearest to the pseudorange."""
    for i in range(len(numbers)):
        at = i * COMPRESSED_BYTES
        numbers[i, 0], numbers[i, 1], numbers[i, 2] = _bits(data, at, 170, 6), _bits(data, at, 136, 8), _bits(data, at, 0, 32)
        values[i, 0] = _bits(data, at, 60, 36) * RANGE_UNIT_M
        values[i, 1] = _unrolled_cyc(numbers[i], signals, _signed_bits(data, at, 96, 32) * PHASE_UNIT_CYC, values[i, 0])
        values[i, 2] = _signed_bits(data, at, 32, 28) * DOPPLER_UNIT_HZ
        values[i, 3] = _bits(data, at, 165, 5) + LEAST_CN0_DBHZ
        values[i, 4] = _bits(data, at, 144, 21) * LOCK_UNIT_S
        values[i, 5] = PSEUDORANGE_SIGMAS_M[_bits(data, at, 128, 4)]
        values[i, 6] = (_bits(data, at, 132, 4) + 1) * SIGMA_STEP_CYC


@kernel
def _unrolled_cyc(numbers: NDArray[np.int64], signals: NDArray[np.int16], rolled_cyc: float, pseudorange_m: float) -> float:
    satellite, signal, _ = identify(numbers, signals)
    if satellite == 0 or signal == 0:
        return rolled_cyc
    expected_cyc = pseudorange_m * carrier_hz(satellite, signal, channel_of(numbers, satellite)) / SPEED_OF_LIGHT_MPS
    return rolled_cyc - np.rint((rolled_cyc + expected_cyc) / ROLL_CYC) * ROLL_CYC


@kernel
def identify(numbers: NDArray[np.int64], signals: NDArray[np.int16]) -> tuple[int, int, int]:
    """Return satellite, signal (0 where there is none) and signal type of a row's numbers; ``signals`` are those of a form."""
    status, prn = int(numbers[2]), int(numbers[1])
    system, kind = status >> 16 & 7, status >> 21 & 31 | (L2C_FLAG if status >> 26 & 1 else 0)
    satellite = int(SATELLITE_OF[system, prn]) if prn < PRNS else 0
    signal = int(signals[system, kind])
    if system == 2 and satellite // SATELLITES_PER_SYSTEM == 4:
        signal = L1S_SIGNAL if kind & 31 == 0 else 0
    return satellite, signal, kind


@kernel
def channel_of(numbers: NDArray[np.int64], satellite: int) -> int:
    """Return the GLONASS channel of a row, NO_CHANNEL for others."""
    glonass = satellite // SATELLITES_PER_SYSTEM == GLONASS and numbers[0] <= _MAX_FREQUENCY
    return int(numbers[0]) - 7 if glonass else NO_CHANNEL


@kernel
def observation_columns(
    numbers: NDArray[np.int64], values: NDArray[np.float64], time_s: float, max_lock_s: float, signals: NDArray[np.int16],
    tells_parity: bool, state: NDArray[np.float64], ids: NDArray[np.int16], channel: NDArray[np.int8], flags: NDArray[np.uint8],
    columns: NDArray[np.float64],
) -> int:  # fmt: skip
    """Write the columns of an epoch, sorted by (satellite, signal); return the number of rows.

    ``signals`` and ``tells_parity`` are those of a form, ``state`` is that of ``lock_slip``. Measurements of a satellite or signal that is
    not known, or that is there already, are dropped. Out, as long as there are measurements: ``ids`` (satellite, signal), ``channel``,
    ``flags``, and ``columns`` in the order of an epoch.
    """
    keys, count = np.empty(len(numbers), np.int64), 0
    for i in range(len(numbers)):
        satellite, signal, _ = identify(numbers[i], signals)
        if satellite > 0 and signal > 0:
            keys[count] = satellite << SATELLITE_SHIFT | signal << SIGNAL_SHIFT | i
            count += 1
    count = sort_keys(keys[:count])
    for k in range(count):
        ids[0, k], ids[1, k] = keys[k] >> SATELLITE_SHIFT, keys[k] >> SIGNAL_SHIFT & SIGNAL_MASK
        i = keys[k] & ROW_MASK
        status, (_, _, kind) = int(numbers[i, 2]), identify(numbers[i], signals)
        channel[k] = channel_of(numbers[i], int(ids[0, k]))
        lock_s = values[i, 4] if 0.0 <= values[i, 4] < MAX_LOCK_S else 0.0
        code_valid = status & CODE_LOCKED != 0 and 0.0 < values[i, 0] < _MAX_PSEUDORANGE_M
        phase_valid = status & PHASE_LOCKED != 0 and 0.0 < abs(values[i, 1]) < _MAX_PHASE_CYC
        half_added = 1 if tells_parity and status & HALF_ADDED else 0
        of_signal = state[status >> 16 & 7, numbers[i, 1], kind]
        slipped = lock_slip(of_signal, np.rint(lock_s * 1e3), max_lock_s * 1e3, half_added, phase_valid, time_s)
        flags[k] = SLIP if slipped and phase_valid else 0
        if tells_parity and phase_valid and status & PARITY_KNOWN == 0:
            flags[k] |= HALF_CYCLE
        columns[0, k] = values[i, 0] if code_valid else np.nan
        columns[1, k] = -values[i, 1] if phase_valid else np.nan
        columns[2, k] = values[i, 2] if phase_valid and abs(values[i, 2]) < _MAX_DOPPLER_HZ else np.nan
        columns[3, k] = values[i, 3] if 0.0 <= values[i, 3] < _MAX_CN0_DBHZ else np.nan
        columns[4, k] = lock_s
        columns[5, k] = values[i, 5] if 0.0 < values[i, 5] < _MAX_SIGMA else np.nan
        columns[6, k] = values[i, 6] if 0.0 < values[i, 6] < _MAX_SIGMA else np.nan
    return count


def epoch_of(measurements: Measurements, time: GpsTime, max_lock_s: float, form: Form, state: NDArray[np.float64]) -> Epoch:
    """Return the epoch of measurements; what is not known of them is dropped."""
    total = len(measurements.numbers)
    ids, channel, flags, columns = np.empty((2, total), np.int16), np.empty(total, np.int8), np.empty(total, np.uint8), np.empty((7, total))
    now_s = time.week * 604800.0 + time.tow_s
    count = observation_columns(
        measurements.numbers, measurements.values, now_s, max_lock_s, form.signals, form.tells_parity, state, ids, channel, flags, columns
    )
    ids, channel, flags, v = ids[:, :count], channel[:count], flags[:count], columns[:, :count]
    return Epoch(time, ids[0], ids[1], channel, flags, v[0], v[1], v[2], v[3], v[4], v[5], v[6])
