"""Measurements of RXM-RAWX to the columns of an epoch (u-blox F9 HPG 1.32 interface description, 3.17.7)."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.codecs.lock_slips import SLIP_STATE, lock_slip
from rtkmesh.codecs.observation_rows import ROW_MASK, SATELLITE_SHIFT, SIGNAL_MASK, SIGNAL_SHIFT, sort_keys
from rtkmesh.codecs.ubx_signals import GNSS_IDS, SATELLITE_OF, SIG_IDS, SIGNAL_OF, SV_IDS
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP
from rtkmesh.gnss.signals import NO_CHANNEL

# One measurement.
MEASUREMENT = np.dtype([
    ("pseudorange_m", "<f8"), ("phase_cyc", "<f8"), ("doppler_hz", "<f4"), ("gnss", "u1"), ("sv", "u1"), ("sig", "u1"), ("freq", "u1"),
    ("lock_ms", "<u2"), ("cn0_dbhz", "u1"), ("code_index", "u1"), ("phase_index", "u1"), ("doppler_index", "u1"), ("track", "u1"),
    ("reserved", "u1"),
])  # fmt: skip
Measurements = NDArray[np.void]
ROW_BYTES: Final = MEASUREMENT.itemsize
_GLONASS_ID: Final = 6
_PSEUDORANGE_VALID, _PHASE_VALID, _HALF_CYCLE_VALID = 1, 2, 4  # trkStat; 8: half cycle subtracted from the phase
_MAX_LOCK_MS = 64500  # locktime counts no further
_MAX_PSEUDORANGE_M, _MAX_PHASE_CYC, _MAX_DOPPLER_HZ = 1e9, 1e10, 1e6  # before the first fix the receiver's clock may be anything


def new_slip_state() -> NDArray[np.float64]:
    """Return what ``lock_slip`` remembers, by gnssId, svId and sigId: nothing yet."""
    return np.zeros((GNSS_IDS, SV_IDS, SIG_IDS, SLIP_STATE))


@kernel
def rawx_columns(
    rows: Measurements, version: int, time_s: float, state: NDArray[np.float64],
    ids: NDArray[np.int16], channel: NDArray[np.int8], flags: NDArray[np.uint8], columns: NDArray[np.float64],
) -> int:  # fmt: skip
    """Write the columns of an epoch, sorted by (satellite, signal); return the number of rows.

    ``rows`` are of MEASUREMENT, ``state`` is that of ``lock_slip`` by gnssId, svId, sigId. Measurements of a satellite or signal that is
    not known, or that is there already, are dropped. Out, as long as there are measurements: ``ids`` (satellite, signal), ``channel``,
    ``flags``, and ``columns``: pseudorange, phase, Doppler, C/N0, lock time, sigma of pseudorange, of phase.
    """
    keys, count = np.empty(len(rows), np.int64), 0
    for i in range(len(rows)):
        row = rows[i]
        gnss, sv, sig = int(row["gnss"]), int(row["sv"]), int(row["sig"]) if version > 0 else 0
        if gnss < GNSS_IDS and sig < SIG_IDS and SATELLITE_OF[gnss, sv] > 0 and SIGNAL_OF[gnss, sig] > 0:
            keys[count] = int(SATELLITE_OF[gnss, sv]) << SATELLITE_SHIFT | int(SIGNAL_OF[gnss, sig]) << SIGNAL_SHIFT | i
            count += 1
    count = sort_keys(keys[:count])
    for k in range(count):
        ids[0, k], ids[1, k] = keys[k] >> SATELLITE_SHIFT, keys[k] >> SIGNAL_SHIFT & SIGNAL_MASK
        row = rows[keys[k] & ROW_MASK]
        gnss, sv, sig, freq = int(row["gnss"]), int(row["sv"]), int(row["sig"]) if version > 0 else 0, int(row["freq"])
        channel[k] = freq - 7 if gnss == _GLONASS_ID and freq <= 20 else NO_CHANNEL
        lock_ms, track = int(row["lock_ms"]), int(row["track"])
        pseudorange_m, phase_cyc, doppler_hz = row["pseudorange_m"], row["phase_cyc"], float(row["doppler_hz"])
        code_valid = track & _PSEUDORANGE_VALID and 0.0 < pseudorange_m < _MAX_PSEUDORANGE_M
        phase_valid = track & _PHASE_VALID and abs(phase_cyc) < _MAX_PHASE_CYC
        slipped = lock_slip(state[gnss, sv, sig], lock_ms, _MAX_LOCK_MS, track >> 3 & 1, track & _PHASE_VALID != 0, time_s)
        flags[k] = ((SLIP if slipped else 0) | (0 if track & _HALF_CYCLE_VALID else HALF_CYCLE)) if phase_valid else 0
        code_index, phase_index = int(row["code_index"]) & 15, int(row["phase_index"]) & 15
        columns[0, k] = pseudorange_m if code_valid else np.nan
        columns[1, k] = phase_cyc if phase_valid else np.nan
        columns[2, k] = doppler_hz if abs(doppler_hz) < _MAX_DOPPLER_HZ else np.nan
        columns[3, k] = row["cn0_dbhz"]
        columns[4, k] = lock_ms / 1e3
        columns[5, k] = 0.01 * (1 << code_index)
        columns[6, k] = 0.004 * phase_index if 0 < phase_index < 15 else np.nan
    return count
