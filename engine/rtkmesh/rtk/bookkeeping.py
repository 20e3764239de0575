"""What an epoch does to the keyed states: which are wanted, where they are, how they begin, slip, grow and are remembered."""

from math import isfinite, nan
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.gnss.signals import BEIDOU, GLONASS, SBAS
from rtkmesh.rtk.filter import reset_state
from rtkmesh.rtk.residuals import BASE_PHASE, CHANNEL, CODE, ELEVATION_RAD, PHASE, ROVER_PHASE, WAVELENGTH
from rtkmesh.rtk.slips import KNOWN_SLIP, NO_SLIP
from rtkmesh.rtk.state import (
    ARC_EPOCHS,
    ARC_S,
    BASE_LOCK_S,
    BASE_M,
    BASE_S,
    FIRST_PAIR_KEY,
    INTEGER,
    ISSUE,
    REJECTS,
    ROVER_LOCK_S,
    ROVER_M,
    ROVER_S,
    SEEN_S,
    SLIPS,
    SLOPE_KEY,
    ZENITH_KEY,
)  # fmt: skip

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

_AMBIGUITY_VARIANCE_CYC2: Final = 100.0**2
_GLONASS_VARIANCE_CYC2: Final = 20.0**2  # wavelengths differ by channel: the common part must be known to some metres
_KNOWN_SLIP_VARIANCE_CYC2: Final = 0.2**2


@kernel
def is_finite(x: Vector, P: Matrix) -> bool:
    """Return whether nothing has overflowed."""
    for i in range(len(x)):
        if not isfinite(x[i]):
            return False
        for j in range(len(x)):
            if not isfinite(P[i, j]):
                return False
    return True


@kernel
def grow(P: Matrix, keys: Indices, dynamic: int, ambiguity: float, ionosphere: float, zenith: float, slope: float) -> None:
    """Add to the variances of the keyed states what their random walks add in this step."""
    for k in range(len(keys)):
        walk = ionosphere
        if keys[k] >= FIRST_PAIR_KEY:
            walk = ambiguity
        elif keys[k] == ZENITH_KEY:
            walk = zenith
        elif keys[k] == SLOPE_KEY:
            walk = slope
        P[dynamic + k, dynamic + k] += walk


@kernel
def wanted_keys(pair_key: Indices, satellite: NDArray[np.int16], table: Matrix, phases: bool, atmosphere: bool) -> Indices:
    """Return the sorted keys of the states that these pairs need.

    They are an ambiguity per phase (if ``phases``), the GLONASS slope where channels differ, and with ``atmosphere`` the zenith delay
    and an ionosphere per satellite with a code.
    """
    n = len(pair_key)
    keys, count = np.empty(2 * n + 2, np.int64), 0
    sloped = False
    if atmosphere:
        count = _insert(keys, count, ZENITH_KEY)
    for k in range(n):
        if atmosphere and isfinite(table[k, CODE]):
            count = _insert(keys, count, int(satellite[k]))
        if phases and isfinite(table[k, PHASE]):
            count = _insert(keys, count, pair_key[k])
            sloped = sloped or table[k, CHANNEL] != 0.0
    if sloped:
        count = _insert(keys, count, SLOPE_KEY)
    return keys[:count].copy()


@kernel
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


@kernel
def place_of(keys: Indices, key: int) -> int:
    """Return where a key is in the sorted keys, -1 if it is not there."""
    low, high = 0, len(keys)
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low if low < len(keys) and keys[low] == key else -1


@kernel
def find_places(
    keys: Indices, pair_key: Indices, satellite: NDArray[np.int16], table: Matrix, phases: bool, atmosphere: bool, ambiguity: Indices,
    ionosphere: Indices,
) -> None:  # fmt: skip
    """Write per pair the rows of its ambiguity and its ionosphere state, -1 for none."""
    for k in range(len(pair_key)):
        ambiguity[k] = place_of(keys, pair_key[k]) if phases and isfinite(table[k, PHASE]) else -1
        ionosphere[k] = place_of(keys, int(satellite[k])) if atmosphere else -1


@kernel
def apply_slips(
    x: Vector, P: Matrix, history: Matrix, place: Indices, slip: Indices, jump_cyc: Vector, dynamic: int, time_s: float
) -> None:
    """Deal with slips and with phases that did not fit twice: a jump of known size moves its ambiguity, others begin anew."""
    for k in range(len(place)):
        if place[k] < 0 or not history[place[k], ARC_EPOCHS] >= 0.0:
            continue
        row, again = history[place[k]], history[place[k], REJECTS] >= 2.0
        if slip[k] == NO_SLIP and not again:
            continue
        row[SLIPS] += 1.0
        row[INTEGER], row[REJECTS] = nan, 0.0
        if slip[k] == KNOWN_SLIP and not again:
            i = dynamic + place[k]
            x[i] += jump_cyc[k]
            P[i, i] += _KNOWN_SLIP_VARIANCE_CYC2
            row[ARC_EPOCHS], row[ARC_S] = 0.0, time_s
        else:
            row[ARC_EPOCHS] = -1.0


@kernel
def begin_ambiguities(
    x: Vector, P: Matrix, history: Matrix, place: Indices, satellite: NDArray[np.int16], table: Matrix, dynamic: int, time_s: float,
    memory: float, inflation: Vector,
) -> None:  # fmt: skip
    """Give new ambiguities the difference of phase and code; write the code's ``inflation``: ``memory`` where the ambiguity is older."""
    for k in range(len(place)):
        inflation[k] = 1.0
        if place[k] < 0:
            continue
        row = history[place[k]]
        if not row[ARC_EPOCHS] >= 0.0:
            variance = _GLONASS_VARIANCE_CYC2 if satellite[k] // 64 == GLONASS else _AMBIGUITY_VARIANCE_CYC2
            reset_state(x, P, dynamic + place[k], (table[k, PHASE] - table[k, CODE]) / table[k, WAVELENGTH], variance)
            row[ARC_EPOCHS], row[ARC_S], row[INTEGER] = 0.0, time_s, nan
        if row[ARC_EPOCHS] > 0.0:
            inflation[k] = memory


@kernel
def remember(
    history: Matrix,
    place: Indices,
    table: Matrix,
    base_s: Vector,
    lock_s: Matrix,
    issue: Vector,
    phase_used: NDArray[np.bool_],
    time_s: float,
) -> None:
    """Write what the next epoch must know of the phases of this one."""
    for k in range(len(place)):
        if place[k] < 0:
            continue
        row = history[place[k]]
        row[SEEN_S], row[ROVER_S], row[BASE_S] = time_s, time_s, base_s[k]
        row[ROVER_M], row[BASE_M] = table[k, ROVER_PHASE], table[k, BASE_PHASE]
        row[ROVER_LOCK_S], row[BASE_LOCK_S] = lock_s[k, 0], lock_s[k, 1]
        row[ISSUE] = issue[k]
        row[ARC_EPOCHS] += 1.0
        row[REJECTS] = 0.0 if phase_used[k] else row[REJECTS] + 1.0


@kernel
def candidate_pairs(
    history: Matrix, place: Indices, satellite: NDArray[np.int16], table: Matrix, phase_used: NDArray[np.bool_], mask_rad: float,
    least_epochs: float, out: Indices,
) -> int:  # fmt: skip
    """Write the pairs whose ambiguities may become integers; return how many.

    Geostationary BeiDou satellites and SBAS are none: their multipath does not average out.
    """
    count = 0
    for k in range(len(place)):
        system, number = int(satellite[k]) // 64, int(satellite[k]) % 64
        if system == SBAS or (system == BEIDOU and (number <= 5 or number >= 59)):
            continue
        usable = phase_used[k] and place[k] >= 0 and table[k, ELEVATION_RAD] >= mask_rad
        if usable and history[place[k], ARC_EPOCHS] > least_epochs:
            out[count] = k
            count += 1
    return count


@kernel
def systems_of(satellite: NDArray[np.int16]) -> int:
    """Return a bit per system that the satellites belong to."""
    bits = 0
    for k in range(len(satellite)):
        bits |= 1 << (int(satellite[k]) // 64)
    return bits
