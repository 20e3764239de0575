"""Which code of a satellite serves single-point positioning, and the columns that the adjustment works on."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel_in_place, scratch
from rtkmesh.gnss.constants import GPS_L1_HZ, SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.signals import ATTRIBUTES, BEIDOU, GLONASS, NO_CHANNEL, SATELLITES_PER_SYSTEM, carrier_hz
from rtkmesh.models.ephemeris_table import CHANNEL
from rtkmesh.models.orbit import group_delay_m

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

# Columns of the work table, one row per satellite. CODE (m) is freed of group delays (and of ionosphere if two bands were combined);
# IONOSPHERE is what multiplies the delay at L1; NOISE (m2) is the code's variance beside its elevation part; GAIN what the combination
# does to variances; RATE (m/s) the range rate by Doppler; GROUP the receiver clock. The rest belongs to the adjustment.
CODE, IONOSPHERE, NOISE, GAIN, RATE, GROUP, RESIDUAL, VARIANCE, WEIGHT, USED, RATE_RESIDUAL, RATE_USED = range(12)
WORK: Final = 12

# Receiver clock of a system: GPS, QZSS and SBAS share one (QZSS and SBAS are steered to GPST within some ns), the others have their own.
CLOCK_OF_SYSTEM: Final = np.array([0, 1, 2, 3, 0, 0, 4])
CLOCKS: Final = 5

_CHANNEL_BIAS_M2 = 4.0**2  # FDMA: a receiver's code delay differs from channel to channel by metres (seen: 2 to 5 m)
_CN0_M2 = 3160.0  # code variance (m2) = this * 10^(-C/N0 / 10): 1 m at 35 dB-Hz, 0.3 m at 45 dB-Hz
# Order of preference of attributes: open data and combined channels, whose group delays the clock's reference is nearest to, first.
_ATTRIBUTE_RANK = np.array([9, 8, 0, 7, 12, 12, 12, 12, 1, 12, 12, 3, 11, 11, 12, 5, 4, 12, 6, 12, 12, 12, 6, 2, 10, 9])


@kernel_in_place
def _band_rank(system: int, band: int) -> int:
    """Return the preference among bands: the band of the clock's simplest correction and of the ionosphere model first."""
    if system == BEIDOU and band <= 2:
        return 2 - band
    if system == GLONASS and band == 4:
        return 1
    return band


@kernel_in_place
def choose_codes(satellite: NDArray[np.int16], signal: NDArray[np.int16], pseudorange_m: Vector, cn0_dbhz: Vector,
                 allowed: NDArray[np.bool_], cn0_mask_dbhz: float, chosen: NDArray[np.int64]) -> int:  # fmt: skip
    """Write per satellite the rows of an epoch (sorted by satellite) with the best code and the best of another band; return their number.

    ``chosen`` (n, 2): the second is -1 where there is one band only. Satellites without any code, not ``allowed`` (by satellite
    number) or below the C/N0 mask are left out.
    """
    count, last = 0, -1
    for i in range(len(satellite)):
        low_cn0 = cn0_dbhz[i] < cn0_mask_dbhz
        if not np.isfinite(pseudorange_m[i]) or low_cn0 or not allowed[satellite[i]]:
            continue
        if satellite[i] != last:
            last = satellite[i]
            chosen[count, 0], chosen[count, 1] = i, -1
            count += 1
            continue
        _rank_in(int(satellite[i]) // SATELLITES_PER_SYSTEM, signal, i, chosen[count - 1])
    return count


@kernel_in_place
def _rank_in(system: int, signal: NDArray[np.int16], row: int, pair: NDArray[np.int64]) -> None:
    """Put one more row of the same satellite in its place among the two chosen."""
    first, second, own = int(pair[0]), int(pair[1]), int(signal[row])
    other_band = own // ATTRIBUTES != int(signal[first]) // ATTRIBUTES
    if _rank(system, own) < _rank(system, int(signal[first])):
        if other_band:
            pair[1] = first
        pair[0] = row
    elif other_band and (second < 0 or _rank(system, own) < _rank(system, int(signal[second]))):
        pair[1] = row


@kernel_in_place
def _rank(system: int, signal: int) -> int:
    return _band_rank(system, signal // ATTRIBUTES) * ATTRIBUTES + _ATTRIBUTE_RANK[signal % ATTRIBUTES]


@kernel_in_place
def fill_work(rows: Matrix, satellite: NDArray[np.int16], signal: NDArray[np.int16], channel: NDArray[np.int8], pseudorange_m: Vector,
              doppler_hz: Vector, cn0_dbhz: Vector, sigma_m: Vector, chosen: NDArray[np.int64], free_of_ionosphere: bool,
              work: Matrix) -> None:  # fmt: skip
    """Fill the work table (n, WORK) from an epoch's columns; ``rows`` are the chosen ephemerides.

    The GLONASS channel is the receiver's word, else the ephemeris's.
    """
    for i in range(rows.shape[0]):
        first, second = chosen[i, 0], chosen[i, 1]
        number, code, own = int(satellite[first]), int(signal[first]), int(channel[first])
        if own == NO_CHANNEL and np.isfinite(rows[i, CHANNEL]):
            own = int(rows[i, CHANNEL])
        band_hz = carrier_hz(number, code, own)
        work[i, GROUP] = CLOCK_OF_SYSTEM[number // SATELLITES_PER_SYSTEM]
        work[i, CODE] = pseudorange_m[first] - group_delay_m(rows[i], code)
        work[i, IONOSPHERE] = (GPS_L1_HZ / band_hz) ** 2 if band_hz > 0.0 else 1.0
        work[i, NOISE], work[i, GAIN] = _noise_m2(float(cn0_dbhz[first]), float(sigma_m[first])), 1.0
        if free_of_ionosphere and second >= 0:
            other = int(signal[second])
            other_m = float(pseudorange_m[second]) - group_delay_m(rows[i], other)
            noise_m2 = _noise_m2(float(cn0_dbhz[second]), float(sigma_m[second]))
            _combine(work[i], band_hz, other_m, carrier_hz(number, other, own), noise_m2)
        if number // SATELLITES_PER_SYSTEM == GLONASS:
            work[i, NOISE] += _CHANNEL_BIAS_M2
        work[i, RATE] = _range_rate_mps(satellite, signal, own, doppler_hz, int(first))


@kernel_in_place
def _noise_m2(cn0_dbhz: float, sigma_m: float) -> float:
    """Return the variance of a code by its C/N0 (40 dB-Hz where not known), at least the receiver's own word."""
    noise = _CN0_M2 * 10.0 ** (-0.1 * (cn0_dbhz if cn0_dbhz > 0.0 else 40.0))
    return max(noise, sigma_m * sigma_m) if sigma_m > 0.0 else noise


@kernel_in_place
def _combine(work: Vector, first_hz: float, second_m: float, second_hz: float, second_noise_m2: float) -> None:
    """Replace a code by its combination free of first-order ionosphere (IS-GPS-200N 20.3.3.3.3.3)."""
    if first_hz <= 0.0 or second_hz <= 0.0 or first_hz == second_hz:
        return
    a = first_hz**2 / (first_hz**2 - second_hz**2)
    work[CODE] = a * work[CODE] + (1.0 - a) * second_m
    work[NOISE] = a * a * work[NOISE] + (1.0 - a) ** 2 * second_noise_m2
    work[GAIN] = a * a + (1.0 - a) ** 2
    work[IONOSPHERE] = 0.0


@kernel_in_place
def _range_rate_mps(satellite: NDArray[np.int16], signal: NDArray[np.int16], channel: int, doppler_hz: Vector, first: int) -> float:
    """Return minus wavelength times Doppler of a row, or of the satellite's next row that has one; NaN without."""
    i = first
    while i > 0 and satellite[i - 1] == satellite[first] and not np.isfinite(doppler_hz[first]):
        i -= 1
    while i < len(satellite) and satellite[i] == satellite[first]:
        hz = carrier_hz(int(satellite[i]), int(signal[i]), channel)
        if np.isfinite(doppler_hz[i]) and hz > 0.0:
            return -doppler_hz[i] * SPEED_OF_LIGHT_MPS / hz
        i += 1
    return np.nan


@kernel_in_place
def clocks_by_system(work: Matrix, clocks_m: Vector, out: Vector) -> float:
    """Write the receiver clock (s) by system, NaN where no satellite was used; return that of the first system in use, GPS first."""
    has_clock = scratch(CLOCKS)
    has_clock[:] = 0.0
    for i in range(work.shape[0]):
        if work[i, USED] != 0.0:
            has_clock[int(work[i, GROUP])] = 1.0
    for k in range(len(out)):
        group = CLOCK_OF_SYSTEM[k]
        out[k] = clocks_m[group] / SPEED_OF_LIGHT_MPS if has_clock[group] != 0.0 else np.nan
    for group in (0, 2, 3, 1, 4):
        if has_clock[group] != 0.0:
            return clocks_m[group] / SPEED_OF_LIGHT_MPS
    return np.nan
