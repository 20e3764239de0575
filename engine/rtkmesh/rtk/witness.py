"""GLONASS as a witness of the others' integers, before its own are trusted."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place
from rtkmesh.gnss.signals import GLONASS, KEYS_PER_SATELLITE, SATELLITES_PER_SYSTEM
from rtkmesh.models.odds import log_odds
from rtkmesh.rtk.ambiguity import Candidates, Search, nothing_found, pairs_of
from rtkmesh.rtk.state import DYNAMIC, Filter
from rtkmesh.rtk.trust import Wide

Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

LEAST: Final = 6  # integers of the others: those of five are lost with one, and GLONASS's own, which would stay, are not held


@kernel
def has_witness(f: Filter, everything: Candidates) -> bool:
    """Return whether GLONASS has ambiguities that may be a witness of enough of the others'."""
    pairs = pairs_of(everything)
    return LEAST <= len(others_of(f, pairs)) < len(pairs)


@kernel
def witnessed(f: Filter, wide: Wide) -> Search:
    """Return, of a search of all ambiguities, the integers of those that are not of GLONASS with their odds.

    Between receivers of two makes the slope of GLONASS phases between channels is not known, so a runner-up often differs in integers of
    GLONASS alone, and puts the rover where the best does. The odds are against the best vector with other integers of the others. If there
    is none among those of the search, against the last of these: less than they are.
    """
    pairs, fixed, norms, success = wide.found.pairs, wide.fixed, wide.norms, wide.found.success
    if len(norms) == 0:
        return nothing_found(f, pairs[:0], success)
    own, values = others_of(f, pairs), np.full(len(f.keys), np.nan)
    integers = np.empty(len(own))
    for i in range(len(own)):
        k = own[i]
        integers[i] = fixed[0, k]
        values[pairs[k, 1] - DYNAMIC], values[pairs[k, 0] - DYNAMIC] = 0.0, fixed[0, k]
    second = norms[first_rival(fixed, own)]
    return Search(pairs[own], integers, values, norms[0], second, success, log_odds(norms[0], second, len(pairs)), True)


@kernel
def others_of(f: Filter, pairs: Indices) -> Indices:
    """Return which double differences (rows of ``pairs``) are not of GLONASS."""
    rows, count = np.empty(len(pairs), np.int64), 0
    for k in range(len(pairs)):
        if f.keys[pairs[k, 0] - DYNAMIC] // KEYS_PER_SATELLITE // SATELLITES_PER_SYSTEM != GLONASS:
            rows[count] = k
            count += 1
    return rows[:count]


@kernel_in_place
def first_rival(fixed: Matrix, own: Indices) -> int:
    """Return the first vector that differs from the best in one of its ``own`` places, the last one if none does."""
    for j in range(1, len(fixed)):
        for k in own:
            if fixed[j, k] != fixed[0, k]:
                return j
    return len(fixed) - 1
