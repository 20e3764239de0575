"""A base epoch for an instant between two base epochs, where the later one is known: in recordings.

What is observed minus modelled (``residuals.undifferenced``, the base's known position, one issue of each ephemeris) changes by the base's
clock, by what satellite clocks and atmosphere do beyond their models, and by noise: nearly linearly over half a minute. So it is
interpolated per signal, and the model of the instant is put back. No slip is ever interpolated, which would give a part of it. A phase of
which the receiver says that it slipped, or that the later epoch does not have, goes on from the earlier epoch by the common change of the
clock, as old as that epoch is, and the slip is where it was recorded. A base that stands shows other slips as a change unlike the others';
over seconds that can be the reflections of a poor place as well, so such a phase has no value until the later epoch.
"""

from math import hypot, isfinite, isnan, sqrt
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place, scratch, scratch_indices, scratch_table
from rtkmesh.gnss.constants import SECONDS_PER_WEEK
from rtkmesh.gnss.ephemeris import KlobucharParameters
from rtkmesh.gnss.epoch import SLIP, Epoch, Signals
from rtkmesh.gnss.signals import GLONASS, system_of
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.atmosphere import klobuchar_vector
from rtkmesh.models.ephemeris_table import ROW, Issues, select_issues
from rtkmesh.models.geometry import GEOMETRY, receiver_geometry, receiver_model
from rtkmesh.models.orbit import LONGEST_RANGE_M, SHORTEST_RANGE_M, STATE, satellite_states
from rtkmesh.models.single import Plain
from rtkmesh.rtk.matching import runs
from rtkmesh.rtk.noise import CLOCK_DRIFT_MPS
from rtkmesh.rtk.ordered import sort_finite
from rtkmesh.rtk.residuals import ionosphere_m, undifferenced, wavelengths, without_ionosphere_m
from rtkmesh.rtk.slips import lost_lock

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

_LIMIT_CYC: Final = 0.35  # a phase that changes more against the others may have slipped, by half a cycle or more
_BANDS_M: Final = 0.02  # what two bands of one satellite show alike so nearly is its clock or its orbit ...
_BANDS_LIMIT_M: Final = 0.3  # ... up to this: below, no numbers of half cycles of two bands are so near to each other
_ANOTHER_BAND_M: Final = 0.01  # wavelengths of one band differ by less
_LEAST_PHASES: Final = 4  # so many at least, and more than half of them, must agree on the change of the clock
# Error of an interpolated phase per square root of second, where satellite clocks walk at random between two epochs that hold them:
# measured on the recorded bases at intervals of 5 to 30 s (caesium of GLONASS 3 to 4, all others 0.5 to 1.3 mm).
_BRIDGE_M: Final = 1.2e-3
_BRIDGE_GLONASS_M: Final = 4e-3
_ITERATIONS: Final = 3  # an instant of transmission that is off by 1 ms moves the model by 1 m, that by 10 nm


class Way(NamedTuple):
    """What models need: ephemerides, position of the base antenna (ECEF, m), coefficients of ``klobuchar_vector``."""

    issues: Issues
    base_ecef_m: Vector
    klobuchar: Vector


class Between(NamedTuple):
    """The columns of an epoch between two, per signal of the earlier one, NaN where not known; ``agreed``: the change of the clock is
    known.
    """

    pseudorange_m: Vector
    phase_cyc: Vector
    doppler_hz: Vector
    cn0_dbhz: Vector
    lock_s: Vector
    pseudorange_sigma_m: Vector
    phase_sigma_cyc: Vector
    agreed: bool


def resampled(
    earlier: Epoch, later: Epoch, time: GpsTime, issues: Issues, base_ecef_m: Vector, klobuchar: KlobucharParameters | None,
    *, slips_told: bool,
) -> Epoch | None:  # fmt: skip
    """Return the epoch of a base that stands at ``base_ecef_m`` as recorded at ``time``, between the two; None where they do not fit
    together: too few phases agree on the change of its clock.

    It has the signals of the earlier epoch, and of what the receiver says of them the worse of both. Slip flags are those of the earlier
    one, unless they were heard (``slips_told``); the later one's own come with it. The sigma of a phase has what interpolation, or its age,
    adds.
    """
    part, way = (time - earlier.time) / (later.time - earlier.time), (tuple(issues), base_ecef_m, klobuchar_vector(klobuchar))
    *columns, agreed = _between(earlier.plain_signals, later.plain_signals, time.week, time.tow_s, part, way)
    flags = earlier.flags & ~np.uint8(SLIP) if slips_told else earlier.flags
    return Epoch(time, earlier.satellite, earlier.signal, earlier.channel, flags, *columns) if agreed else None


@kernel
def _between(earlier: Plain, later: Plain, week: int, tow_s: float, part: float, way: Plain) -> Plain:
    """Return the fields of ``between``: without names they cross sooner (rtk/crossing.py)."""
    made = between(Signals(*earlier), Signals(*later), week, tow_s, part, Way(Issues(*way[0]), way[1], way[2]))
    return (
        made.pseudorange_m, made.phase_cyc, made.doppler_hz, made.cn0_dbhz, made.lock_s, made.pseudorange_sigma_m, made.phase_sigma_cyc,
        made.agreed,
    )  # fmt: skip


@kernel
def between(earlier: Signals, later: Signals, week: int, tow_s: float, part: float, way: Way) -> Between:
    """Return what would have been observed at an instant (GPST) that is ``part`` (0 to 1) of the way from one epoch to the other."""
    n = len(earlier.satellite)
    first, index = np.empty(n, np.int64), np.empty(n, np.int64)
    satellites = earlier.satellite[first[: runs(earlier.satellite, first, index)]]
    rows, own, partner = np.empty((len(satellites), ROW)), np.arange(n), np.empty(n, np.int64)
    select_issues(way.issues, satellites, week * SECONDS_PER_WEEK + tow_s, True, rows)
    _find_partners(earlier, later, partner)
    wavelength_m, channels, residual_m = np.empty(n), np.empty(n), np.empty((2, n, 2))
    wavelengths(earlier.satellite, earlier.signal, earlier.channel, own, way.issues.channel, wavelength_m, channels)
    code_m = np.empty((2, len(satellites)))
    _observe(earlier, own, index, wavelength_m, rows, way, code_m[0], residual_m[0])
    _observe(later, partner, index, wavelength_m, rows, way, code_m[1], residual_m[1])
    codes_m, phases_cyc, sigma_m = np.empty(n), np.empty(n), np.empty(n)
    agreed = _bridge(earlier, later, partner, wavelength_m, part, residual_m, sigma_m)
    _put_back(week, tow_s, index, wavelength_m, rows, way, code_m[0], residual_m[0], codes_m, phases_cyc)
    words, rates_hz = np.empty((4, n)), np.full(n, np.nan)
    _take_worse(earlier, later, partner, (week - earlier.week) * SECONDS_PER_WEEK + (tow_s - earlier.tow_s), words)
    for k in range(n):
        words[3, k] = hypot(words[3, k], sigma_m[k] / wavelength_m[k])
    return Between(codes_m, phases_cyc, rates_hz, words[0], words[1], words[2], words[3], agreed)


@kernel_in_place
def _take_worse(earlier: Signals, later: Signals, partner: Indices, after_s: float, words: Matrix) -> None:
    """Write what a receiver says of the signals ``after_s`` the earlier epoch, the worse of both: C/N0 (dB-Hz), lock time (s), sigmas of
    code (m) and phase (cycles; 0 where it does not say).
    """
    for k in range(len(partner)):
        cn0, lock_s, code_m, phase_cyc = earlier.cn0_dbhz[k], earlier.lock_s[k], earlier.pseudorange_sigma_m[k], earlier.phase_sigma_cyc[k]
        now_s, j = lock_s + after_s, int(partner[k])
        if j >= 0:
            cn0, lock_s = _smaller(cn0, later.cn0_dbhz[j]), _larger(lock_s, later.lock_s[j])
            code_m, phase_cyc = _larger(code_m, later.pseudorange_sigma_m[j]), _larger(phase_cyc, later.phase_sigma_cyc[j])
        words[0, k], words[1, k] = cn0, np.nan if isnan(now_s + lock_s) else min(now_s, lock_s)
        words[2, k], words[3, k] = code_m, 0.0 if isnan(phase_cyc) else phase_cyc


@kernel_in_place
def _smaller(a: float, b: float) -> float:
    return a if a <= b or isnan(b) else b


@kernel_in_place
def _larger(a: float, b: float) -> float:
    return a if a >= b or isnan(b) else b


@kernel_in_place
def _find_partners(earlier: Signals, later: Signals, partner: Indices) -> None:
    """Write the row of the later epoch that has the same satellite and signal, -1 without; both are sorted by these."""
    j, count = 0, len(later.satellite)
    for i in range(len(partner)):
        satellite, signal = earlier.satellite[i], earlier.signal[i]
        while j < count and (later.satellite[j] < satellite or (later.satellite[j] == satellite and later.signal[j] < signal)):
            j += 1
        found = j < count and later.satellite[j] == satellite and later.signal[j] == signal
        partner[i] = j if found else -1


@kernel_in_place
def _observe(
    signals: Signals, place: Indices, index: Indices, wavelength_m: Vector, rows: Matrix, way: Way, code_m: Vector, out: Matrix
) -> None:
    """Write a code per satellite, and code and phase minus model (m, n x 2) of the signals in these rows (-1: none); NaN without."""
    count = len(code_m)
    states, geometry, there = scratch_table(count, STATE), scratch_table(count, GEOMETRY), scratch_indices(len(place))
    code_m[:] = np.nan
    for k in range(len(place)):
        there[k] = max(place[k], 0)
        own_m = signals.pseudorange_m[there[k]] if place[k] >= 0 else np.nan
        if SHORTEST_RANGE_M < own_m < LONGEST_RANGE_M and not isfinite(code_m[index[k]]):
            code_m[index[k]] = own_m
    receiver_model(rows, signals.week, signals.tow_s, code_m, way.base_ecef_m, way.klobuchar, states, geometry)
    undifferenced(there, index, wavelength_m, signals.pseudorange_m, signals.phase_cyc, signals.flags, states, geometry, out)
    for k in range(len(place)):
        if place[k] < 0:
            out[k, 0], out[k, 1] = np.nan, np.nan


@kernel_in_place
def _bridge(
    earlier: Signals, later: Signals, partner: Indices, wavelength_m: Vector, part: float, residual_m: NDArray[np.float64], sigma_m: Vector
) -> bool:
    """Let the earlier residuals be those ``part`` of the way on, write what it adds to phases; return whether the clock's change is known.

    A phase votes on the clock where neither a flag nor the lock times say that it slipped; if it changes otherwise there is none.
    """
    n, elapsed_s = len(partner), (later.week - earlier.week) * SECONDS_PER_WEEK + later.tow_s - earlier.tow_s
    change_m = scratch_table(2, n)
    for k in range(n):
        change_m[0, k], change_m[1, k] = residual_m[1, k, 0] - residual_m[0, k, 0], residual_m[1, k, 1] - residual_m[0, k, 1]
        j = partner[k]
        if j >= 0 and (later.flags[j] & SLIP != 0 or lost_lock(float(later.lock_s[j]), float(earlier.lock_s[k]), elapsed_s)):
            change_m[1, k] = np.nan
    clock_m, votes, agreeing = (median_of(change_m[0]), median_of(change_m[1])), 0, 0
    for k in range(n):
        change_m[1, k] -= clock_m[1]
        votes += 1 if isfinite(change_m[1, k]) else 0
    for k in range(n):
        change, walk_m = change_m[1, k], _walk_m(earlier.satellite[k])
        agrees = abs(change) <= _LIMIT_CYC * wavelength_m[k]
        agreeing += 1 if agrees else 0
        sigma_m[k] = walk_m * sqrt(part * (1.0 - part) * elapsed_s)
        if not agrees and _is_of_satellite(earlier.satellite, wavelength_m, change_m[1], k):
            sigma_m[k] = abs(change) * sqrt(part * (1.0 - part))
        elif not isfinite(change):
            change, sigma_m[k] = 0.0, CLOCK_DRIFT_MPS * part * elapsed_s
        elif not agrees:
            change = np.nan
        residual_m[0, k, 0] += part * (change_m[0, k] if isfinite(change_m[0, k]) else clock_m[0])
        residual_m[0, k, 1] += part * (clock_m[1] + change)
    return agreeing >= _LEAST_PHASES and 2 * agreeing > votes


@kernel_in_place
def _walk_m(satellite: int) -> float:
    return _BRIDGE_GLONASS_M if system_of(satellite) == GLONASS else _BRIDGE_M


@kernel_in_place
def _is_of_satellite(satellite: NDArray[np.int16], wavelength_m: Vector, change_m: Vector, k: int) -> bool:
    """Return whether another band of the satellite of phase ``k`` changed alike (m, against all others): so it is no slip."""
    for step in (-1, 1):
        j = k + step
        while 0 <= j < len(satellite) and satellite[j] == satellite[k]:
            alike = abs(change_m[j] - change_m[k]) <= _BANDS_M and abs(change_m[k]) <= _BANDS_LIMIT_M
            if alike and abs(wavelength_m[j] - wavelength_m[k]) > _ANOTHER_BAND_M:
                return True
            j += step
    return False


@kernel_in_place
def _put_back(
    week: int, tow_s: float, index: Indices, wavelength_m: Vector, rows: Matrix, way: Way, code_m: Vector, residual_m: Matrix,
    codes_m: Vector, phases_cyc: Vector,
) -> None:  # fmt: skip
    """Write codes (m) and phases (cycles) with these residuals (m, n x 2) at an instant; ``code_m`` is near by and becomes that of it."""
    states, geometry = scratch_table(len(code_m), STATE), scratch_table(len(code_m), GEOMETRY)
    for _ in range(_ITERATIONS):
        satellite_states(rows, week, tow_s, code_m, states)
        receiver_geometry(states, week, tow_s, way.base_ecef_m, way.klobuchar, geometry)
        for k in range(len(index)):
            s = index[k]
            model_m, delay_m = without_ionosphere_m(states, geometry, s), ionosphere_m(geometry, s, wavelength_m[k])
            codes_m[k] = model_m + delay_m + residual_m[k, 0]
            phases_cyc[k] = (model_m - delay_m + residual_m[k, 1]) / wavelength_m[k]
        for k in range(len(index)):
            if isfinite(codes_m[k]):
                code_m[index[k]] = codes_m[k]


@kernel_in_place
def median_of(values: Vector) -> float:
    """Return the median of the finite values, NaN without one."""
    kept = scratch(len(values))
    n = sort_finite(values, kept)
    return np.nan if n == 0 else 0.5 * (kept[n // 2] + kept[(n - 1) // 2])
