"""What an epoch does to the keyed states: which are wanted, where they are, how they begin, slip, grow and are remembered."""

from math import isfinite, nan
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place, scratch, scratch_indices, scratch_table
from rtkmesh.gnss.frames import write_enu, write_geodetic
from rtkmesh.gnss.signals import GLONASS, KEYS_PER_SATELLITE, SATELLITES_PER_SYSTEM, SBAS, SIGNALS_PER_SATELLITE, band_of
from rtkmesh.rtk.ambiguity import Candidates
from rtkmesh.rtk.code_arcs import inflation_of
from rtkmesh.rtk.filter import predict_motion, reset_state
from rtkmesh.rtk.phase_arcs import phase_inflations
from rtkmesh.rtk.predicted import share_of_step
from rtkmesh.rtk.residuals import BASE_PHASE, CHANNEL, CODE, ELEVATION_RAD, PHASE, ROVER_PHASE, WAVELENGTH, Differences
from rtkmesh.rtk.slips import CERTAIN, KNOWN_SLIP, NO_SLIP, SlipSetup, Verdicts, find_slips
from rtkmesh.rtk.slopes import Slopes, begin_slope
from rtkmesh.rtk.state import (
    ARC_EPOCHS,
    ARC_S,
    AWAY_ROVER,
    BASE_LOCK_S,
    BASE_M,
    BASE_S,
    DYNAMIC,
    EXCESS_KEY,
    FIRST_PAIR_KEY,
    HALF_CYC,
    INTEGER,
    REJECTS,
    ROVER_LOCK_S,
    ROVER_M,
    ROVER_S,
    SEEN_S,
    SLIPS,
    SLOPE_KEYS,
    STREAK,
    USUAL_M,
    ZENITH_KEY,
    Filter,
    is_ionosphere,
    place_of,
    use_keys,
)  # fmt: skip
from rtkmesh.rtk.update import Layout

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

_LARGEST: Final = 1e30
_AMBIGUITY_VARIANCE_CYC2: Final = 100.0**2
_GLONASS_VARIANCE_CYC2: Final = 20.0**2  # wavelengths differ by channel: the common part must be known to some metres
_KNOWN_SLIP_VARIANCE_CYC2: Final = 0.2**2
_REJECTS_MOST: Final = 2.0 - 1e-6  # parts of a second add up to it


class Walks(NamedTuple):
    """Random walks of the keyed states and how new shared ones begin (all in their units, walks per square root of second).

    An ionosphere does not walk away: within ``ionosphere_s`` it goes back to nothing, as far as its usual size ``ionosphere_sigma_m``; so
    does the part by which all exceed their model (``excess_sigma``).
    ``slopes`` are value and sigma of new GLONASS slopes on G1 and G2.
    """

    ambiguity_cyc: float
    ionosphere_s: float
    ionosphere_sigma_m: float
    zenith_m: float
    zenith_sigma_m: float
    excess_sigma: float
    slope_m: float
    slopes: Slopes


@kernel_in_place
def is_finite(x: Vector, P: Matrix) -> bool:
    """Return whether nothing has overflowed, or would when it is squared."""
    for i in range(len(x)):
        if not abs(x[i]) < _LARGEST:
            return False
        for j in range(len(x)):
            if not abs(P[i, j]) < _LARGEST:
                return False
    return True


@kernel_in_place
def seed(f: Filter, baseline_ecef_m: Vector, sigmas: Vector) -> None:
    """Begin the dynamic states anew with these sigmas of position, velocity and acceleration; the keyed states stay."""
    for i in range(DYNAMIC):
        reset_state(f.x, f.P, i, baseline_ecef_m[i] if i < 3 else 0.0, sigmas[i // 3] ** 2)


class Motion(NamedTuple):
    """How a rover moves: jerk density in the horizontal and the vertical (m/s2 per square root of second), decay of accelerations (s)."""

    horizontal_mps2: float
    vertical_mps2: float
    decay_s: float


@kernel_in_place
def move(f: Filter, dt_s: float, motion: Motion, base_ecef_m: Vector, sigmas: Vector) -> None:
    """Move the dynamic states on; what stood until now begins to move with these ``sigmas``."""
    if f.P[3, 3] < 1e-9:
        for i in range(3, DYNAMIC):
            reset_state(f.x, f.P, i, 0.0, sigmas[i // 3] ** 2)
    place_ecef_m, geodetic, turn, Q = scratch(3), scratch(3), scratch_table(3, 3), scratch_table(3, 3)
    for i in range(3):
        place_ecef_m[i] = base_ecef_m[i] + f.x[i]
    write_geodetic(place_ecef_m, geodetic)
    write_enu(geodetic[0], geodetic[1], turn)
    h, v = motion.horizontal_mps2**2, motion.vertical_mps2**2
    for i in range(3):
        for j in range(3):
            Q[i, j] = h * (turn[0, i] * turn[0, j] + turn[1, i] * turn[1, j]) + v * turn[2, i] * turn[2, j]
    predict_motion(f.x, f.P, dt_s, motion.decay_s, Q)


@kernel_in_place
def advance(f: Filter, dt_s: float, moving: bool, motion: Motion, base_ecef_m: Vector, walks: Walks, sigmas: Vector) -> bool:
    """Move the filter on by ``dt_s``; return whether it is still finite."""
    if moving:
        move(f, dt_s, motion, base_ecef_m, sigmas)
    grow(f.P, f.keys, DYNAMIC, walks, dt_s)
    relax(f, walks.ionosphere_s, dt_s)
    return is_finite(f.x, f.P)


@kernel_in_place
def grow(P: Matrix, keys: Indices, dynamic: int, walks: Walks, dt_s: float) -> None:
    """Add to the variances of the keyed states what their random walks add in this step."""
    for k in range(len(keys)):
        walk = 0.0
        if keys[k] >= FIRST_PAIR_KEY:
            walk = walks.ambiguity_cyc
        elif keys[k] == ZENITH_KEY:
            walk = walks.zenith_m
        elif keys[k] > EXCESS_KEY:
            walk = walks.slope_m
        P[dynamic + k, dynamic + k] += walk * walk * dt_s


@kernel_in_place
def relax(f: Filter, memory_s: float, dt_s: float) -> None:
    """Let ionospheres forget what they were and become of their usual size again, within their memory (first-order Gauss-Markov process;
    Gelb 1974, Applied Optimal Estimation, 2.2).
    """
    keep = np.exp(-dt_s / memory_s)
    for k in range(len(f.keys)):
        if f.keys[k] >= FIRST_PAIR_KEY:
            return
        if not ZENITH_KEY < f.keys[k] <= EXCESS_KEY:
            continue
        i = DYNAMIC + k
        f.x[i] *= keep
        for j in range(len(f.x)):
            f.P[i, j] *= keep
        for j in range(len(f.x)):
            f.P[j, i] *= keep
        f.P[i, i] += (1.0 - keep * keep) * f.history[k, USUAL_M] ** 2


@kernel
def wanted_keys(pair_key: Indices, satellite: NDArray[np.int16], table: Matrix, phases: bool, atmosphere: int) -> Indices:
    """Return the sorted keys of the states that these pairs need.

    They are an ambiguity per phase (if ``phases``), the GLONASS slope of each band where channels differ, the zenith delay where
    ``atmosphere`` is 1, with 2 an ionosphere per satellite with a code too, and with 3 what all exceed their model by.
    """
    n = len(pair_key)
    keys, count = scratch_indices(2 * n + 4), 0
    sloped = 0
    if atmosphere > 0:
        count = _insert(keys, count, ZENITH_KEY)
    if atmosphere == 3:
        count = _insert(keys, count, EXCESS_KEY)
    for k in range(n):
        if atmosphere >= 2 and isfinite(table[k, CODE]):
            count = _insert(keys, count, int(satellite[k]))
        if phases and isfinite(table[k, PHASE]):
            count = _insert(keys, count, pair_key[k])
            sloped |= 1 << _sloped_band(pair_key[k], table[k, CHANNEL])
    for band in range(len(SLOPE_KEYS)):
        if sloped & (2 << band):
            count = _insert(keys, count, SLOPE_KEYS[band])
    return keys[:count].copy()


@kernel_in_place
def _sloped_band(pair_key: int, channel: float) -> int:
    """Return the band on which a pair's phase has a slope of GLONASS (1, 2), 0 if it has none."""
    return band_of(pair_key % KEYS_PER_SATELLITE // SIGNALS_PER_SATELLITE) if channel != 0.0 else 0


@kernel_in_place
def _insert(keys: Indices, count: int, key: int) -> int:
    """Put a key in its place among the first ``count`` (sorted, each once); return how many there are now."""
    place = count
    while place > 0 and keys[place - 1] > key:
        place -= 1
    if place > 0 and keys[place - 1] == key:
        return count
    for i in range(count, place, -1):
        keys[i] = keys[i - 1]
    keys[place] = key
    return count + 1


@kernel_in_place
def find_places(
    keys: Indices, pair_key: Indices, satellite: NDArray[np.int16], table: Matrix, phases: bool, atmosphere: bool, ambiguity: Indices,
    ionosphere: Indices, slope: Indices,
) -> None:  # fmt: skip
    """Write per pair the rows of its ambiguity, its ionosphere and its slope state, -1 for none."""
    on_g1, on_g2 = place_of(keys, SLOPE_KEYS[0]), place_of(keys, SLOPE_KEYS[1])
    for k in range(len(pair_key)):
        ambiguity[k] = place_of(keys, pair_key[k]) if phases and isfinite(table[k, PHASE]) else -1
        band = _sloped_band(pair_key[k], table[k, CHANNEL])
        slope[k] = -1 if band == 0 else on_g1 if band == 1 else on_g2
        ionosphere[k] = place_of(keys, int(satellite[k])) if atmosphere else -1


@kernel_in_place
def apply_slips(x: Vector, P: Matrix, history: Matrix, place: Indices, verdicts: Verdicts, dynamic: int, time_s: float) -> None:
    """Deal with slips and with phases that did not fit twice.

    A jump that is certain moves its ambiguity and nothing else, one of measured size makes it less certain, others begin it anew.
    """
    for k in range(len(place)):
        if place[k] < 0 or not history[place[k], ARC_EPOCHS] >= 0.0:
            continue
        row, again, verdict = history[place[k]], history[place[k], REJECTS] >= _REJECTS_MOST, verdicts.slip[k]
        if verdict == NO_SLIP and not again:
            continue
        row[SLIPS] += 1.0
        row[REJECTS] = 0.0
        if verdict == CERTAIN and not again and _move_certainly(x, row, dynamic + place[k], verdicts.jump_cyc[k]):
            continue
        row[INTEGER] = nan
        if verdict in (KNOWN_SLIP, CERTAIN) and not again:
            x[dynamic + place[k]] += verdicts.jump_cyc[k]
            P[dynamic + place[k], dynamic + place[k]] += _KNOWN_SLIP_VARIANCE_CYC2
            row[ARC_EPOCHS], row[ARC_S] = 0.0, time_s
        else:
            row[ARC_EPOCHS] = -1.0


@kernel_in_place
def _move_certainly(x: Vector, row: Vector, i: int, jump_cyc: float) -> bool:
    """Move an ambiguity by a number of half cycles; an odd one stays in the phase of a held integer. False where it cannot stay there."""
    whole = np.floor(jump_cyc)
    if whole != jump_cyc:
        if not isfinite(row[INTEGER]):
            return False
        whole += 1.0 if row[HALF_CYC] > 0.0 else 0.0
        row[HALF_CYC] = 0.0 if row[HALF_CYC] > 0.0 else 0.5
    x[i] += whole
    row[INTEGER] += whole
    row[STREAK] += whole
    return True


@kernel_in_place
def take_half_cycles(table: Matrix, history: Matrix, place: Indices) -> None:
    """Take from the phases the half cycles that they are off their integers."""
    for k in range(len(place)):
        if place[k] >= 0 and history[place[k], ARC_EPOCHS] >= 0.0 and history[place[k], HALF_CYC] > 0.0:
            table[k, PHASE] -= history[place[k], HALF_CYC] * table[k, WAVELENGTH]


@kernel_in_place
def begin_ambiguities(
    x: Vector, P: Matrix, history: Matrix, place: Indices, satellite: NDArray[np.int16], table: Matrix, dynamic: int, time_s: float
) -> None:
    """Give new ambiguities the difference of phase and code."""
    for k in range(len(place)):
        if place[k] < 0:
            continue
        row = history[place[k]]
        if not row[ARC_EPOCHS] >= 0.0:
            variance = _GLONASS_VARIANCE_CYC2 if satellite[k] // SATELLITES_PER_SYSTEM == GLONASS else _AMBIGUITY_VARIANCE_CYC2
            reset_state(x, P, dynamic + place[k], (table[k, PHASE] - table[k, CODE]) / table[k, WAVELENGTH], variance)
            row[ARC_EPOCHS], row[ARC_S], row[INTEGER], row[HALF_CYC] = 0.0, time_s, nan, 0.0


@kernel
def inflations(history: Matrix, place: Indices, code_since_s: Vector) -> Vector:
    """Return the inflation of each code's variance."""
    out = np.empty(len(place))
    for k in range(len(place)):
        out[k] = inflation_of(code_since_s[k], place[k] >= 0 and history[place[k], ARC_EPOCHS] > 0.0)
    return out


@kernel_in_place
def remember(f: Filter, d: Differences, layout: Layout, phase_used: NDArray[np.bool_], time_s: float) -> None:
    """Write what the next epoch must know of the phases of this one."""
    for k in range(len(layout.ambiguity)):
        if layout.ambiguity[k] < 0:
            continue
        row = f.history[layout.ambiguity[k]]
        share = share_of_step(time_s - row[SEEN_S])
        row[SEEN_S], row[ROVER_S], row[BASE_S] = time_s, time_s, d.base_s[k]
        row[ROVER_M], row[BASE_M] = d.table[k, ROVER_PHASE], d.table[k, BASE_PHASE]
        row[ROVER_LOCK_S], row[BASE_LOCK_S] = d.lock_s[k, 0], d.lock_s[k, 1]
        row[AWAY_ROVER:] = 0.0
        row[ARC_EPOCHS] += 1.0
        row[REJECTS] = 0.0 if phase_used[k] else row[REJECTS] + share


@kernel
def find_candidates(
    f: Filter, d: Differences, layout: Layout, phase_used: NDArray[np.bool_], mask_rad: float, least_epochs: float
) -> Candidates:
    """Return the ambiguities of this epoch that may become integers.

    SBAS satellites have none.
    """
    chosen, count = scratch_indices(len(layout.ambiguity)), 0
    for k in range(len(chosen)):
        if int(d.pairs.satellite[k]) // SATELLITES_PER_SYSTEM == SBAS:
            continue
        usable = phase_used[k] and layout.ambiguity[k] >= 0 and d.table[k, ELEVATION_RAD] >= mask_rad
        if usable and f.history[layout.ambiguity[k], ARC_EPOCHS] > least_epochs:
            chosen[count] = k
            count += 1
    row, group, satellite, weight = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count)
    for i in range(count):
        k = chosen[i]
        row[i], group[i], satellite[i] = layout.ambiguity[k], d.pairs.group[k], d.pairs.satellite[k]
        weight[i] = d.table[k, ELEVATION_RAD]
    return Candidates(row, group, satellite, weight)


@kernel_in_place
def systems_of(satellite: NDArray[np.int16]) -> int:
    """Return a bit per system that the satellites belong to."""
    bits = 0
    for k in range(len(satellite)):
        bits |= 1 << (int(satellite[k]) // SATELLITES_PER_SYSTEM)
    return bits


class Arranged(NamedTuple):
    """A filter laid out for an epoch: its places, and the rover's motion and clock (m, 4) against its models by time differences of the
    phases, with covariance and fit (``time_differences.Motion``).
    """

    filter: Filter
    layout: Layout
    redundancy: int
    motion_m: Vector
    motion_cov_m2: Matrix
    motion_fit: Vector


@kernel
def lay_out(
    before: Filter, d: Differences, code_since_s: Vector, times_s: Vector, slips: SlipSetup, expected: Vector, walks: Walks, phases: bool,
    atmosphere: int,
) -> Arranged:  # fmt: skip
    """Give every pair its states; deal with slips; begin new states.

    ``code_since_s`` is how long ago each code was seen; ``times_s`` and ``expected`` are those of ``find_slips``; ``atmosphere`` 0: none,
    1: the zenith delay is a state, 2: the ionosphere per satellite too, 3: and what all exceed their model by.
    """
    n, dt = len(d.pairs.satellite), times_s[0] - times_s[2]
    known_step = isfinite(dt)
    wanted = wanted_keys(d.pairs.key, d.pairs.satellite, d.table, phases, atmosphere)
    f = use_keys(before, wanted, times_s[0], max(slips.maximum_gap_s, 2.5 * dt if known_step else 0.0))
    places = np.empty((3, n), np.int64)
    ambiguity, ionosphere, slope = places[0], places[1], places[2]
    find_places(f.keys, d.pairs.key, d.pairs.satellite, d.table, phases, atmosphere >= 2, ambiguity, ionosphere, slope)
    begin_shared(f, walks, times_s[0], ionosphere)
    verdicts = Verdicts(scratch_indices(n), scratch(n))
    tested = find_slips(d, f.history, ambiguity, times_s, slips, expected, verdicts)
    apply_slips(f.x, f.P, f.history, ambiguity, verdicts, DYNAMIC, times_s[0])
    take_half_cycles(d.table, f.history, ambiguity)
    begin_ambiguities(f.x, f.P, f.history, ambiguity, d.pairs.satellite, d.table, DYNAMIC, times_s[0])
    inflation = inflations(f.history, ambiguity, code_since_s)
    by_phase = phase_inflations(f.history, ambiguity, times_s[0])
    excess = place_of(f.keys, EXCESS_KEY) if atmosphere == 3 else -1
    layout = Layout(ambiguity, ionosphere, slope, place_of(f.keys, ZENITH_KEY), excess, inflation, by_phase)
    return Arranged(f, layout, tested.redundancy, tested.rover.step_m, tested.rover.cov_m2, tested.rover.fit)


@kernel_in_place
def begin_shared(f: Filter, walks: Walks, time_s: float, ionosphere: Indices) -> None:
    """Give a value to new states of the atmosphere and to the GLONASS slopes; those of this epoch's satellites (``ionosphere``) and of none
    count as seen.
    """
    for k in ionosphere:
        if k >= 0:
            f.history[k, SEEN_S], f.history[k, USUAL_M] = time_s, walks.ionosphere_sigma_m
    for i in range(len(f.keys)):
        if f.keys[i] >= FIRST_PAIR_KEY:
            return
        if not is_ionosphere(f.keys[i]):
            f.history[i, SEEN_S] = time_s
        if f.history[i, ARC_EPOCHS] >= 0.0:
            continue
        if f.keys[i] == ZENITH_KEY:
            reset_state(f.x, f.P, DYNAMIC + i, 0.0, walks.zenith_sigma_m**2)
        elif f.keys[i] == EXCESS_KEY:
            f.history[i, USUAL_M] = walks.excess_sigma
            reset_state(f.x, f.P, DYNAMIC + i, 0.0, walks.excess_sigma**2)
        elif is_ionosphere(f.keys[i]):
            reset_state(f.x, f.P, DYNAMIC + i, 0.0, walks.ionosphere_sigma_m**2)
        else:
            begin_slope(f, i, walks.slopes)
        f.history[i, ARC_EPOCHS] = 0.0
