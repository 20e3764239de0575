"""Which signals of rover and base make a single difference.

Per satellite up to ``frequencies`` bands that both receivers track, in the order of ``BANDS``; per band the pair of signals that fits best:
the same RINEX 3 code first, then codes of one component family (2L, 2S, 2X ...), then any of the band. RINEX 3.05 (9.1) and RTCM
10403.3 (3.5.16.1) demand phases of one band aligned, so other codes of a band cost a separate clock group and code variance, not a
quarter cycle per satellite.
"""

from math import isfinite
from typing import Final, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place, scratch_index_table, scratch_indices
from rtkmesh.gnss.beidou import is_geostationary
from rtkmesh.gnss.epoch import Signals
from rtkmesh.gnss.signals import ATTRIBUTES, KEYS_PER_SATELLITE, SATELLITES_PER_SYSTEM, SIGNALS_PER_SATELLITE, SYSTEMS, allowed_satellites

Vector = NDArray[np.float64]
Indices = NDArray[np.int64]

# Bands per system, most useful first (RINEX band digits). Galileo: E5b before E5a as most low-cost base/rover pairs share it; BeiDou: B1C
# last, it is 14 MHz from B1I and adds little to it.
BANDS: Final = {"G": "125", "R": "123", "E": "17586", "C": "27651", "J": "125", "S": "15", "I": "59"}

# Attributes of one band, best first; families are separated by a blank. The pilot of a modern signal goes before data and combined.
_FAMILIES: Final = {
    "G1": "C WPYM LXS N", "G2": "WPYDMN LXS C", "G5": "QXI",
    "R1": "C P", "R2": "C P", "R3": "QXI",
    "E1": "CXBZA", "E5": "QXI", "E6": "CXBZA", "E7": "QXI", "E8": "QXI",
    "C1": "PXD ZLS A N", "C2": "IXQ", "C5": "PXD", "C6": "IXQ PDZA", "C7": "IXQ PDZ", "C8": "PXD",
    "J1": "C LXS ZBE", "J2": "LXS", "J5": "QXI PDZ", "J6": "LXSEZ",
    "S1": "C", "S5": "IXQ", "I5": "ABCX", "I9": "ABCX",
}  # fmt: skip

_ZERO: Final = cast("int", np.int64(0))  # a literal as argument makes numba compile the callee once more
_LAST = 99  # rank and family of an attribute that the tables do not name
_STANDING = len(SYSTEMS)  # added to the system of geostationary satellites, so that their groups are others


def _tables() -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return (band order per system, rank and family per system, band, attribute)."""
    order = np.zeros((len(SYSTEMS), 6), np.int64)
    rank = np.full((len(SYSTEMS), 10, ATTRIBUTES), _LAST, np.int64)
    family = np.full((len(SYSTEMS), 10, ATTRIBUTES), _LAST, np.int64)
    for system, bands in BANDS.items():
        order[SYSTEMS.index(system), : len(bands)] = [int(b) for b in bands]
    for name, groups in _FAMILIES.items():
        system, band, place = SYSTEMS.index(name[0]), int(name[1]), 0
        for number, group in enumerate(groups.split()):
            for attribute in group:
                rank[system, band, ord(attribute) - ord("A")] = place
                family[system, band, ord(attribute) - ord("A")] = number
                place += 1
    return order, rank, family


_ORDER, _RANK, _FAMILY = _tables()

# Columns of a pair (held as rows of one table, so that each is contiguous).
ROVER, BASE, LIKENESS, KEY, CLOCK_GROUP = range(5)
PAIR: Final = 5
SAME_CODE, SAME_FAMILY, SAME_BAND = range(3)


class Rules(NamedTuple):
    """What decides which signals are paired: satellites by number, bands per satellite, C/N0 mask, and the tables of this module."""

    allowed: NDArray[np.bool_]
    frequencies: int
    cn0_mask_dbhz: float
    order: Indices
    rank: Indices
    family: Indices


class Pairs(NamedTuple):
    """Single differences that can be formed, sorted by (satellite, band order): rows of the two epochs and the clock group of each.

    ``group`` numbers the (system, rover signal, base signal) combinations in rising order; ``likeness`` is SAME_CODE, SAME_FAMILY or
    SAME_BAND. ``key`` is unique to (satellite, rover signal, base signal) and rises with them.
    """

    satellite: NDArray[np.int16]
    rover: Indices
    base: Indices
    likeness: Indices
    group: Indices
    groups: int
    key: Indices


def matching_rules(systems: str, frequencies: int, excluded: tuple[str, ...] = (), cn0_mask_dbhz: float = 0.0) -> Rules:
    """Return the rules for RINEX letters of systems, a number of bands, excluded RINEX ids and a least C/N0."""
    return Rules(allowed_satellites(systems, excluded), frequencies, cn0_mask_dbhz, _ORDER, _RANK, _FAMILY)


@kernel
def match(rover: Signals, base: Signals, rules: Rules) -> Pairs:
    """Return the pairs of two epochs."""
    rover_usable, base_usable = scratch_indices(len(rover.satellite)), scratch_indices(len(base.satellite))
    _usable(rover.pseudorange_m, rover.phase_cyc, rover.cn0_dbhz, rules.cn0_mask_dbhz, rover_usable)
    _usable(base.pseudorange_m, base.phase_cyc, base.cn0_dbhz, rules.cn0_mask_dbhz, base_usable)
    rows = scratch_index_table(min(len(rover.satellite), len(base.satellite)), 3)
    count = _match(
        rover.satellite, rover.signal, rover_usable, base.satellite, base.signal, base_usable, rules.allowed, rules.frequencies,
        rules.order, rules.rank, rules.family, rows,
    )  # fmt: skip
    satellite, columns = np.empty(count, np.int16), np.empty((PAIR, count), np.int64)
    for k in range(count):
        satellite[k] = rover.satellite[rows[k, ROVER]]
        for i in range(3):
            columns[i, k] = rows[k, i]
    groups = _keys(count, satellite, rover.signal, base.signal, columns)
    return Pairs(satellite, columns[ROVER], columns[BASE], columns[LIKENESS], columns[CLOCK_GROUP], groups, columns[KEY])


@kernel_in_place
def _usable(pseudorange_m: Vector, phase_cyc: Vector, cn0_dbhz: Vector, cn0_mask_dbhz: float, out: Indices) -> None:
    """Write 0 where a row has no pseudorange (or too little C/N0), 1 with pseudorange only, 2 with phase too."""
    for k in range(len(out)):
        out[k] = 0
        masked = cn0_mask_dbhz > 0.0 and cn0_dbhz[k] < cn0_mask_dbhz
        if isfinite(pseudorange_m[k]) and not masked:
            out[k] = 2 if isfinite(phase_cyc[k]) else 1


@kernel_in_place
def _match(
    rover_satellite: NDArray[np.int16],
    rover_signal: NDArray[np.int16],
    rover_usable: NDArray[np.int64],
    base_satellite: NDArray[np.int16],
    base_signal: NDArray[np.int16],
    base_usable: NDArray[np.int64],
    allowed: NDArray[np.bool_],
    frequencies: int,
    order: NDArray[np.int64],
    rank: NDArray[np.int64],
    family: NDArray[np.int64],
    out: NDArray[np.int64],
) -> int:
    """Walk through both sorted epochs and write (rover row, base row, likeness) per pair; return how many."""
    count, i, j = 0, _ZERO, _ZERO
    while i < len(rover_satellite) and j < len(base_satellite):
        satellite = rover_satellite[i]
        if satellite != base_satellite[j]:
            if satellite < base_satellite[j]:
                i += 1
            else:
                j += 1
            continue
        i_end, j_end = i, j
        while i_end < len(rover_satellite) and rover_satellite[i_end] == satellite:
            i_end += 1
        while j_end < len(base_satellite) and base_satellite[j_end] == satellite:
            j_end += 1
        if allowed[satellite]:
            used = 0
            for band in order[satellite // SATELLITES_PER_SYSTEM]:
                if band == 0 or used == frequencies or count == len(out):
                    break
                if _best_pair(
                    rover_signal, rover_usable, i, i_end, base_signal, base_usable, j, j_end, band,
                    rank[satellite // SATELLITES_PER_SYSTEM, band], family[satellite // SATELLITES_PER_SYSTEM, band], out[count],
                ):  # fmt: skip
                    used += 1
                    count += 1
        i, j = i_end, j_end
    return count


@kernel_in_place
def _best_pair(
    rover_signal: NDArray[np.int16],
    rover_usable: NDArray[np.int64],
    i_start: int,
    i_end: int,
    base_signal: NDArray[np.int16],
    base_usable: NDArray[np.int64],
    j_start: int,
    j_end: int,
    band: int,
    rank: NDArray[np.int64],
    family: NDArray[np.int64],
    out: NDArray[np.int64],
) -> bool:
    """Write the best pair of one band of one satellite; False if there is none."""
    least = 1 << 40
    for i in range(i_start, i_end):
        if rover_signal[i] // 26 != band or rover_usable[i] == 0:
            continue
        for j in range(j_start, j_end):
            if base_signal[j] // 26 != band or base_usable[j] == 0:
                continue
            a, b = rover_signal[i] % 26, base_signal[j] % 26
            likeness = 0 if a == b else (1 if family[a] == family[b] else 2)
            phase = 0 if rover_usable[i] == 2 and base_usable[j] == 2 else 1
            cost = ((phase * 4 + likeness) * 128 + rank[a]) * 128 + rank[b]
            if cost < least:
                least = cost
                out[0], out[1], out[2] = i, j, likeness
    return bool(least < 1 << 40)


@kernel_in_place
def distinct(ordered: NDArray[np.int16], mask: NDArray[np.bool_]) -> int:
    """Return how many different values a sorted array has where the mask is true."""
    count, last = 0, -1
    for k in range(len(ordered)):
        if mask[k] and ordered[k] != last:
            last = ordered[k]
            count += 1
    return count


@kernel_in_place
def count_runs(ordered: NDArray[np.int16]) -> int:
    """Return how many different values a sorted array has."""
    count, last = 0, -1
    for k in range(len(ordered)):
        if ordered[k] != last:
            last = ordered[k]
            count += 1
    return count


@kernel_in_place
def census(rover: NDArray[np.int16], base: NDArray[np.int16]) -> tuple[int, int, int]:
    """Return the systems that satellites of the rover belong to and none of the base (a bit each), and how many satellites both have."""
    missing = 0
    for satellite in rover:
        missing |= 1 << (int(satellite) // SATELLITES_PER_SYSTEM)
    for satellite in base:
        missing &= ~(1 << (int(satellite) // SATELLITES_PER_SYSTEM))
    return missing, count_runs(rover), count_runs(base)


@kernel_in_place
def runs(ordered: NDArray[np.int16], first: Indices, index: Indices) -> int:
    """Write where each value of a sorted array begins, and per entry the number of its value; return how many there are."""
    count = 0
    for k in range(len(ordered)):
        if k == 0 or ordered[k] != ordered[k - 1]:
            first[count] = k
            count += 1
        index[k] = count - 1
    return count


@kernel_in_place
def clock_group(satellite: int, signals: int) -> int:
    """Return the number of the clock group that a satellite's pair of signals belongs to; groups of one epoch are told apart by it.

    BeiDou's geostationary satellites have a clock of their own: between receivers of two makes their phases can be half a cycle off those
    of the others (Nadarajah, Teunissen and Raziq 2013, Sensors 13(7)).
    """
    return (satellite // SATELLITES_PER_SYSTEM + (_STANDING if is_geostationary(satellite) else 0)) * KEYS_PER_SATELLITE + signals


@kernel_in_place
def _keys(count: int, satellite: NDArray[np.int16], rover_signal: NDArray[np.int16], base_signal: NDArray[np.int16], table: Indices) -> int:
    """Write the key and the clock group of each pair; return the number of groups (numbered in the order of their content)."""
    kind, kinds, groups = scratch_indices(count), scratch_indices(count), 0
    for k in range(count):
        signals = int(rover_signal[table[ROVER, k]]) * SIGNALS_PER_SATELLITE + int(base_signal[table[BASE, k]])
        number = int(satellite[k])
        table[KEY, k] = number * KEYS_PER_SATELLITE + signals
        kind[k] = clock_group(number, signals)
        place = 0
        while place < groups and kinds[place] < kind[k]:
            place += 1
        if place < groups and kinds[place] == kind[k]:
            continue
        for i in range(groups, place, -1):
            kinds[i] = kinds[i - 1]
        kinds[place] = kind[k]
        groups += 1
    for k in range(count):
        group = 0
        while kinds[group] != kind[k]:
            group += 1
        table[CLOCK_GROUP, k] = group
    return groups
