"""GLONASS as a witness of the others' integers, before its own are trusted."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place
from rtkmesh.gnss.signals import GLONASS, KEYS_PER_SATELLITE, SATELLITES_PER_SYSTEM
from rtkmesh.models.odds import log_odds
from rtkmesh.rtk.ambiguity import NODE_LIMIT, Candidates, Search, pairs_of, search_pairs
from rtkmesh.rtk.lambda_search import OK
from rtkmesh.rtk.state import DYNAMIC, Filter

Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

LEAST: Final = 6  # integers of the others: those of five are lost with one, and GLONASS's own, which would stay, are not held
RIVALS: Final = 8  # vectors among which the first with other integers of the others is looked for


@kernel
def witnessed(f: Filter, everything: Candidates) -> Search:
    """Search all ambiguities, and return the integers of those that are not of GLONASS with their odds.

    Between receivers of two makes the slope of GLONASS phases between channels is not known, so a runner-up often differs in integers of
    GLONASS alone, and puts the rover where the best does. The odds are against the best vector with other integers of the others. If there
    is none among the RIVALS, against the last of these: less than they are.
    """
    pairs, values = pairs_of(everything), np.full(len(f.keys), np.nan)
    n = len(pairs)
    fixed, norms = np.zeros((RIVALS, n)), np.zeros(RIVALS)
    own = others_of(f, pairs)
    if len(own) < LEAST or len(own) == n:
        return Search(pairs[:0], fixed[0, :0], values, np.inf, np.inf, 0.0, -np.inf, False)
    status, success = search_pairs(f.x, f.P, pairs, NODE_LIMIT, fixed, norms)
    if status != OK:
        return Search(pairs[:0], fixed[0, :0], values, np.inf, np.inf, success, -np.inf, False)
    integers = np.empty(len(own))
    for i in range(len(own)):
        k = own[i]
        integers[i] = fixed[0, k]
        values[pairs[k, 1] - DYNAMIC], values[pairs[k, 0] - DYNAMIC] = 0.0, fixed[0, k]
    second = norms[first_rival(fixed, own)]
    return Search(pairs[own], integers, values, norms[0], second, success, log_odds(norms[0], second, n), True)


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
