"""Single differences: what rover and base observed, minus the models of each at its own time.

The models are undifferenced (``rtkmesh.models.geometry``), so a base epoch of another time needs nothing special.
"""

from math import isfinite
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place, scratch, scratch_indices, scratch_table
from rtkmesh.gnss.constants import GPS_L1_HZ, SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Signals
from rtkmesh.gnss.signals import GLONASS, NO_CHANNEL, band_of, carrier_hz, system_of
from rtkmesh.models.antenna import antenna_correction_m, carrier_place, pattern_of
from rtkmesh.models.ephemeris_table import KIND, NO_EPHEMERIS, ROW
from rtkmesh.models.geometry import AZIMUTH, E_X, ELEVATION, GEOMETRY, IONOSPHERE_L1_M, RANGE, TROPOSPHERE_M, receiver_geometry
from rtkmesh.models.orbit import LONGEST_RANGE_M, SHORTEST_RANGE_M, STATE, STATE_CLOCK, STATE_OK, satellite_states
from rtkmesh.models.single import Located, is_misplaced
from rtkmesh.rtk.matching import Pairs, runs
from rtkmesh.rtk.noise import UNALIGNED_CODE_M, cn0_factor, elevation_variance

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

# Columns of a single difference. CODE and PHASE (m): observed minus modelled, rover minus base, NaN where not to be used; ROVER_PHASE and
# BASE_PHASE (m) the same of one receiver (time differences find slips in them); variances (m2); IONOSPHERE is (f1 / f)^2; CN0 the lower
# of the two. CHANNEL that of GLONASS on G1 and G2, 0 for others. MODEL_L1 (m): the model's ionosphere on L1, rover minus base. GAIN_DB is
# the rover's C/N0 less the base's, NaN where one is not known.
(
    CODE, PHASE, ROVER_PHASE, BASE_PHASE, CODE_VARIANCE, PHASE_VARIANCE, WAVELENGTH, IONOSPHERE, CN0, ELEVATION_RAD, CHANNEL, MODEL_L1,
    GAIN_DB,
) = range(13)  # fmt: skip
DIFFERENCE: Final = 13

# Columns of what a receiver says of a signal; the sigmas (m, cycles) are NaN if it does not say them.
WORD_CN0, WORD_CODE_SIGMA, WORD_PHASE_SIGMA = range(3)
WORDS: Final = 3

# Places in the vector of noise parameters.
PHASE_A, PHASE_B, CODE_RATIO, COMMON_VARIANCE = range(4)

# Sigma (m) that GLONASS codes get over long baselines (what their residuals say of it leaves a seventh at least): between receivers of two
# makes they are biased by channel, for as long as these run, and who looks for integers for an hour averages that as if it were noise. An
# ionosphere would take it for its own. Simulated stations 48 km apart had integers that were wrong for half an hour by them.
GLONASS_CODE_M: Final = 10.0
_MOST_CYCLES = 1e12  # a phase that a receiver has counted for months; more is damage
_C = SPEED_OF_LIGHT_MPS


@kernel_in_place
def wavelengths(
    satellite: NDArray[np.int16], signal: NDArray[np.int16], channel: NDArray[np.int8], row: Indices, known: NDArray[np.int8],
    wavelength_m: Vector, channels: Vector,
) -> None:  # fmt: skip
    """Write the wavelength (m) of each pair, NaN where the carrier is not known, and its GLONASS channel, 0 where it has none.

    ``row`` are rows of ``signal`` and ``channel``; ``known`` is the channel per satellite number, for rows without one.
    """
    for k in range(len(satellite)):
        number, own = int(satellite[k]), int(channel[row[k]])
        if own == NO_CHANNEL:
            own = int(known[number])
        f = carrier_hz(number, int(signal[row[k]]), own)
        wavelength_m[k] = _C / f if f > 0.0 else np.nan
        by_channel = system_of(number) == GLONASS and band_of(int(signal[row[k]])) <= 2
        channels[k] = own if by_channel and own != NO_CHANNEL else 0.0


@kernel_in_place
def observe_receiver(
    signals: Signals, row: Indices, satellite_index: Indices, wavelength_m: Vector, position_ecef_m: Vector, klobuchar: Vector,
    states: Matrix, geometry: Matrix, out: Matrix,
) -> None:  # fmt: skip
    """Write the geometry per satellite of one receiver, and code and phase minus model (m, n x 2) per pair."""
    receiver_geometry(states, signals.week, signals.tow_s, position_ecef_m, klobuchar, geometry)
    undifferenced(row, satellite_index, wavelength_m, signals.pseudorange_m, signals.phase_cyc, signals.flags, states, geometry, out)


@kernel_in_place
def undifferenced(
    rows: Indices, satellite_index: Indices, wavelength_m: Vector, pseudorange_m: Vector, phase_cyc: Vector, flags: NDArray[np.uint8],
    states: Matrix, geometry: Matrix, out: Matrix,
) -> None:  # fmt: skip
    """Write code and phase (m) minus model of one receiver per pair (n x 2); NaN where not observed or not to be modelled."""
    for k in range(len(rows)):
        row, s = rows[k], satellite_index[k]
        out[k, 0], out[k, 1] = np.nan, np.nan
        if states[s, STATE_OK] == 0.0:
            continue
        model, delay = without_ionosphere_m(states, geometry, s), ionosphere_m(geometry, s, wavelength_m[k])
        if not isfinite(delay):
            continue
        if SHORTEST_RANGE_M < pseudorange_m[row] < LONGEST_RANGE_M:
            out[k, 0] = pseudorange_m[row] - model - delay
        if flags[row] & HALF_CYCLE == 0 and abs(phase_cyc[row]) < _MOST_CYCLES:
            out[k, 1] = phase_cyc[row] * wavelength_m[k] - model + delay


@kernel_in_place
def without_ionosphere_m(states: Matrix, geometry: Matrix, s: int) -> float:
    """Return what a signal of satellite ``s`` should measure (m), but for the ionosphere and the receiver's clock."""
    return geometry[s, RANGE] - _C * states[s, STATE_CLOCK] + geometry[s, TROPOSPHERE_M]


@kernel_in_place
def ionosphere_m(geometry: Matrix, s: int, wavelength_m: float) -> float:
    """Return the model's delay of a code on this wavelength (m) by the ionosphere; phases are early by it."""
    scale = wavelength_m * GPS_L1_HZ / _C
    return geometry[s, IONOSPHERE_L1_M] * scale * scale


@kernel_in_place
def correct_antenna(signals: Signals, rows: Indices, satellite_index: Indices, pattern: Vector, geometry: Matrix, out: Matrix) -> None:
    """Take what the antenna of one receiver adds from its code and phase minus model (m, n x 2)."""
    for k in range(len(rows)):
        s, row = satellite_index[k], rows[k]
        if not isfinite(geometry[s, ELEVATION]):
            continue
        place = carrier_place(pattern, system_of(int(signals.satellite[row])), band_of(int(signals.signal[row])))
        delay_m = antenna_correction_m(pattern, place, geometry[s, AZIMUTH], geometry[s, ELEVATION])
        out[k, 0] -= delay_m
        out[k, 1] -= delay_m


@kernel_in_place
def single_differences(
    satellite_index: Indices,
    likeness: Indices,
    wavelength_m: Vector,
    channels: Vector,
    rover: Matrix,
    base: Matrix,
    rover_words: Matrix,
    base_words: Matrix,
    geometry: Matrix,
    base_geometry: Matrix,
    mask_rad: float,
    noise: Vector,
    out: Matrix,
) -> None:
    """Write the single differences (n x DIFFERENCE) of the pairs.

    ``rover`` and ``base`` (n x 2) are of ``undifferenced``; the words are of ``receiver_words``; ``geometry`` is the rover's, per
    satellite, as ``base_geometry`` is the base's; ``noise`` is the vector of parameters.
    """
    for k in range(len(satellite_index)):
        elevation = float(geometry[satellite_index[k], ELEVATION])
        if not isfinite(elevation):
            elevation = -1.0
        rover_cn0_dbhz, base_cn0_dbhz = rover_words[k, WORD_CN0], base_words[k, WORD_CN0]
        cn0 = min(rover_cn0_dbhz, base_cn0_dbhz) if base_cn0_dbhz > 0.0 else rover_cn0_dbhz
        scale = wavelength_m[k] * GPS_L1_HZ / _C
        out[k, WAVELENGTH], out[k, IONOSPHERE] = wavelength_m[k], scale * scale
        out[k, ROVER_PHASE], out[k, BASE_PHASE] = rover[k, 1], base[k, 1]
        out[k, CN0], out[k, ELEVATION_RAD], out[k, CHANNEL] = cn0, elevation, channels[k]
        out[k, GAIN_DB] = rover_cn0_dbhz - base_cn0_dbhz if rover_cn0_dbhz > 0.0 and base_cn0_dbhz > 0.0 else np.nan
        out[k, MODEL_L1] = geometry[satellite_index[k], IONOSPHERE_L1_M] - base_geometry[satellite_index[k], IONOSPHERE_L1_M]
        usable = elevation >= mask_rad
        out[k, CODE] = rover[k, 0] - base[k, 0] if usable else np.nan
        out[k, PHASE] = rover[k, 1] - base[k, 1] if usable else np.nan
        factor = elevation_variance(noise[PHASE_A], noise[PHASE_B], elevation)
        factor *= cn0_factor(rover_cn0_dbhz) + cn0_factor(base_cn0_dbhz)
        code, phase = factor * noise[CODE_RATIO] ** 2, factor
        for words in (rover_words, base_words):
            if words[k, WORD_CODE_SIGMA] > 0.0:
                code += words[k, WORD_CODE_SIGMA] ** 2
            if words[k, WORD_PHASE_SIGMA] > 0.0:
                phase += (words[k, WORD_PHASE_SIGMA] * wavelength_m[k]) ** 2
        if likeness[k] == 2:
            code += UNALIGNED_CODE_M**2
        common = noise[COMMON_VARIANCE] / max(np.sin(elevation), 0.2) ** 2
        out[k, CODE_VARIANCE] = code + common
        out[k, PHASE_VARIANCE] = phase + common


@kernel_in_place
def receiver_words(
    signals: Signals, row: Indices, receiver: int, words: Matrix, lock_s: Matrix, flagged: NDArray[np.bool_], half_cycle: NDArray[np.bool_]
) -> None:
    """Write what one receiver (0: rover, 1: base) says of its signals: C/N0 and sigmas, lock times, slips and open half cycles."""
    for k in range(len(row)):
        i = row[k]
        words[k, WORD_CN0], words[k, WORD_CODE_SIGMA] = signals.cn0_dbhz[i], signals.pseudorange_sigma_m[i]
        words[k, WORD_PHASE_SIGMA] = signals.phase_sigma_cyc[i]
        lock_s[k, receiver] = signals.lock_s[i]
        flagged[k, receiver] = signals.flags[i] & SLIP != 0
        half_cycle[k] = (receiver == 1 and half_cycle[k]) or signals.flags[i] & HALF_CYCLE != 0


class Differences(NamedTuple):
    """The single differences of one pair of epochs; all columns go with ``pairs``.

    ``table`` is of ``single_differences``; directions are unit vectors receiver to satellite; ``flagged`` (n x 2) says that the rover or
    the base reports a slip; ``half_cycle`` that either has its half cycles open; ``lock_s`` (n x 2) are rover's and base's; ``base_s`` is
    the time of the base epoch (on the filter's clock).
    """

    pairs: Pairs
    table: Matrix
    rover_direction: Matrix
    base_direction: Matrix
    azimuth_rad: Vector
    flagged: NDArray[np.bool_]
    half_cycle: NDArray[np.bool_]
    lock_s: Matrix
    base_s: Vector


class Conditions(NamedTuple):
    """What of an epoch decides variances and use: noise parameters, elevation mask, time of the base epoch (on the filter's clock).

    ``antennas`` are of ``join_patterns``, empty where they are not both known.
    """

    noise: Vector
    mask_rad: float
    base_s: float
    antennas: Vector


@kernel
def observe(
    rover: Signals, base: Signals, pairs: Pairs, located: Located, channel: NDArray[np.int8], klobuchar: Vector, rover_ecef_m: Vector,
    base_ecef_m: Vector, conditions: Conditions,
) -> Differences:  # fmt: skip
    """Form the single differences of matched epochs, modelled at these positions.

    Both receivers are modelled with the same issue of each ephemeris: those that ``located``, the rover's single-point solution, used.
    """
    n = len(pairs.satellite)
    first, index = scratch_indices(n), scratch_indices(n)
    count = runs(pairs.satellite, first, index)
    rows, states, base_states, codes_m = scratch_table(count, ROW), scratch_table(count, STATE), scratch_table(count, STATE), scratch(count)
    take_satellites(located, pairs.satellite, first, rows, states)
    for i in range(count):
        codes_m[i] = base.pseudorange_m[pairs.base[first[i]]]
    satellite_states(rows, base.week, base.tow_s, codes_m, base_states)
    wavelength_m, channels = scratch(n), scratch(n)
    wavelengths(pairs.satellite, rover.signal, rover.channel, pairs.rover, channel, wavelength_m, channels)
    geometry, out, words = scratch_table(count, GEOMETRY), scratch_table(n, 2), scratch_table(n, WORDS)
    base_geometry, base_out, base_words = scratch_table(count, GEOMETRY), scratch_table(n, 2), scratch_table(n, WORDS)
    lock_s, flagged, half_cycle = np.empty((n, 2)), np.empty((n, 2), np.bool_), np.empty(n, np.bool_)
    observe_receiver(rover, pairs.rover, index, wavelength_m, rover_ecef_m, klobuchar, states, geometry, out)
    observe_receiver(base, pairs.base, index, wavelength_m, base_ecef_m, klobuchar, base_states, base_geometry, base_out)
    if len(conditions.antennas) > 0:
        correct_antenna(rover, pairs.rover, index, pattern_of(conditions.antennas, 0), geometry, out)
        correct_antenna(base, pairs.base, index, pattern_of(conditions.antennas, 1), base_geometry, base_out)
    receiver_words(rover, pairs.rover, 0, words, lock_s, flagged, half_cycle)
    receiver_words(base, pairs.base, 1, base_words, lock_s, flagged, half_cycle)
    table = np.empty((n, DIFFERENCE))
    single_differences(
        index, pairs.likeness, wavelength_m, channels, out, base_out, words, base_words, geometry, base_geometry, conditions.mask_rad,
        conditions.noise, table,
    )  # fmt: skip
    direction, columns = np.empty((2, n, 3)), np.empty((2, n))
    azimuth_rad, base_s = columns[0], columns[1]
    for k in range(n):
        s = index[k]
        for i in range(3):
            direction[0, k, i], direction[1, k, i] = geometry[s, E_X + i], base_geometry[s, E_X + i]
        azimuth_rad[k], base_s[k] = geometry[s, AZIMUTH], conditions.base_s
    return Differences(pairs, table, direction[0], direction[1], azimuth_rad, flagged, half_cycle, lock_s, base_s)


@kernel_in_place
def take_satellites(located: Located, satellite: NDArray[np.int16], first: Indices, rows: Matrix, states: Matrix) -> None:
    """Write ephemeris rows and states of the satellites (sorted) that ``first`` says the places of; NaN and not OK where the single point
    had no code of one, or knows that it is elsewhere.
    """
    j = 0
    for i in range(len(rows)):
        number = satellite[first[i]]
        while j < len(located.satellites) and located.satellites[j] < number:
            j += 1
        if j < len(located.satellites) and located.satellites[j] == number and not is_misplaced(located, j):
            for k in range(ROW):
                rows[i, k] = located.rows[j, k]
            for k in range(STATE):
                states[i, k] = located.states[j, k]
            continue
        rows[i, :], states[i, :] = np.nan, np.nan
        rows[i, KIND], states[i, STATE_OK] = NO_EPHEMERIS, 0.0


def combine(first: Differences, second: Differences) -> Differences:
    """Return the differences of both, sorted by satellite; they must not share a system."""
    a, b = first.pairs, second.pairs
    satellite = np.concatenate((a.satellite, b.satellite))
    order = np.argsort(satellite, kind="stable")

    def both(x: NDArray[Any], y: NDArray[Any]) -> NDArray[Any]:
        return np.ascontiguousarray(np.concatenate((x, y))[order])

    pairs = Pairs(
        satellite[order], both(a.rover, b.rover), both(a.base, b.base), both(a.likeness, b.likeness), both(a.group, b.group + a.groups),
        a.groups + b.groups, both(a.key, b.key),
    )  # fmt: skip
    return Differences(pairs, *(both(x, y) for x, y in zip(first[1:], second[1:], strict=True)))


@kernel_in_place
def blur_glonass_codes(d: Differences) -> None:
    """Let GLONASS codes say nothing of where the rover is."""
    for k in range(len(d.table)):
        if system_of(int(d.pairs.satellite[k])) == GLONASS:
            d.table[k, CODE_VARIANCE] += GLONASS_CODE_M**2
