"""From when on the integers of GLONASS are trusted: when what is held of the others has determined them for some epochs.

Whole cycles for each channel, and a slope that is a wavelength steeper: that is nearly the same phases, and the rover in nearly the same
place. So integers may seem to have a runner-up that nothing but the slope's size tells from them, and of receivers' slopes that is known:
between two of them it is up to 5 cm (Wanninger 2012, J. Geodesy 86:139-148; 54 mm on one of our recordings), so within ``STEEPEST_M``.
"""

from math import isfinite
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place, scratch_flags
from rtkmesh.gnss.signals import GLONASS, SATELLITES_PER_SYSTEM
from rtkmesh.models.odds import NORM_LIMIT, log_odds
from rtkmesh.rtk.ambiguity import (
    NODE_LIMIT,
    Candidates,
    Search,
    compare_integers,
    condition,
    found_best,
    held_differences,
    nothing_found,
    pack_pairs,
    pairs_of,
    search,
    search_pairs,
    take,
)
from rtkmesh.rtk.filter import take_value
from rtkmesh.rtk.lambda_search import OK
from rtkmesh.rtk.memory import ACCEPT_AT_ONCE, GLONASS_VOTES, TRUSTS_GLONASS, ResolveSetup
from rtkmesh.rtk.slopes import learn_slopes, slope_states
from rtkmesh.rtk.state import INTEGER, Filter

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

TRUSTED_AFTER: Final = 10  # epochs in which GLONASS must have fitted
STEEPEST_M: Final = 0.1  # per channel
TOLD_SIGMA_M: Final = 0.01  # of a slope that is told: a twentieth of a cycle, so that a wrong one is not for ever
RIVALS: Final = 8  # vectors among which the first with a slope that may be is looked for


class Given(NamedTuple):
    """States of the filter given what is held: ambiguities of GLONASS, whose ``pairs`` are places in ``x`` as the ``slopes`` are."""

    x: Vector
    P: Matrix
    pairs: Indices
    slopes: Indices


class Wide(NamedTuple):
    """A search of all ambiguities, with the RIVALS best vectors and their squared norms; without them where it was cut off, or where the
    length of the baseline is known.
    """

    found: Search
    fixed: Matrix
    norms: Vector


@kernel
def learn_glonass(f: Filter, everything: Candidates, wide: Wide, held: Indices, memory: Vector, setup: ResolveSetup) -> None:
    """Trust GLONASS integers once what is held has determined them, and has not been contradicted by both together, for some epochs;
    remember the slopes. ``wide`` is the search of all, if it has been made.
    """
    own, count = scratch_flags(len(everything.satellite)), 0
    for k in range(len(own)):
        own[k] = everything.satellite[k] // SATELLITES_PER_SYSTEM == GLONASS
        count += 1 if own[k] else 0
    states = slope_states(f)
    if count < 3 or len(states) == 0:
        return
    if memory[TRUSTS_GLONASS] > 0.0:
        learn_slopes(f, held, memory)
        return
    slopes_m, odds = found_slopes(f, pairs_of(take(everything, own)), states, held)
    if odds < setup.confidence * ACCEPT_AT_ONCE or _contradicted(f, everything, wide, setup):
        memory[GLONASS_VOTES] = 0.0
        return
    memory[GLONASS_VOTES] += 1.0
    if memory[GLONASS_VOTES] >= TRUSTED_AFTER:
        memory[TRUSTS_GLONASS] = 1.0
        _tell(f, states, slopes_m)


@kernel
def _contradicted(f: Filter, everything: Candidates, wide: Wide, setup: ResolveSetup) -> bool:
    """Return whether the best integers of all are others than those that are held."""
    best = wide.found if len(wide.norms) > 0 else search(f, everything, setup.length_m, setup.length_sigma_m)
    return not best.resolved or compare_integers(f.keys, f.history[:, INTEGER].copy(), f.keys, best.values)[1] > 0


@kernel
def found_slopes(f: Filter, pairs: Indices, states: Indices, held: Indices) -> tuple[Vector, float]:
    """Return the slopes (m) that the best integers of GLONASS's double differences have, given what is held, and the log odds against the
    best that have others; - infinity if they do not fit. Integers with these slopes may be others: they are not told.
    """
    n = len(pairs)
    slopes, fixed, norms = np.empty((RIVALS, len(states))), np.zeros((RIVALS, n)), np.zeros(RIVALS)
    known = _given(f, pairs, states, held)
    if n == 0 or len(known.x) == 0 or search_pairs(known.x, known.P, known.pairs, NODE_LIMIT, fixed, norms)[0] != OK:
        return slopes[0], -np.inf
    _slopes_of(known.x, known.P, known.pairs, fixed, known.slopes, slopes)
    if not norms[0] <= NORM_LIMIT * n or _is_steep(slopes[0]):
        return slopes[0], -np.inf
    return slopes[0], log_odds(norms[0], norms[_rival(slopes, TOLD_SIGMA_M)], n)


@kernel_in_place
def _rival(slopes: Matrix, apart_m: float) -> int:
    """Return the first vector after the best whose slopes may be, and are so far from the best one's; the last one if there is none."""
    for k in range(1, len(slopes)):
        if not _is_steep(slopes[k]) and _distance_m(slopes[0], slopes[k]) >= apart_m:
            return k
    return len(slopes) - 1


@kernel_in_place
def _distance_m(one: Vector, other: Vector) -> float:
    largest = 0.0
    for k in range(len(one)):
        largest = max(largest, abs(one[k] - other[k]))
    return largest


@kernel_in_place
def _is_steep(slopes_m: Vector) -> bool:
    steep = False
    for slope_m in slopes_m:
        steep = steep or not abs(slope_m) <= STEEPEST_M
    return steep


@kernel
def search_wide(f: Filter, everything: Candidates, setup: ResolveSetup) -> Wide:
    """Search all ambiguities, with slopes as open as the filter has them."""
    pairs = pairs_of(everything)
    fixed, norms = np.zeros((RIVALS, len(pairs))), np.zeros(RIVALS)
    if len(pairs) > 0 and not isfinite(setup.length_m):
        status, success = search_pairs(f.x, f.P, pairs, NODE_LIMIT, fixed, norms)
        if status == OK:
            return Wide(found_best(f, pairs, fixed, norms, success), fixed, norms)
    return Wide(search(f, everything, setup.length_m, setup.length_sigma_m), np.zeros((0, 0)), np.zeros(0))


@kernel
def not_searched(f: Filter) -> Wide:
    """Return what there is of a search of all ambiguities that has not been made."""
    return Wide(nothing_found(f, np.zeros((0, 2), np.int64), 0.0), np.zeros((0, 0)), np.zeros(0))


@kernel
def possible(f: Filter, wide: Wide) -> Search:
    """Return a search of all ambiguities with its odds against the best integers whose slopes may be; as it is where its own may not."""
    found, norms, rival = wide.found, wide.norms, 1
    if len(norms) == 0 or _have_steep(f, found.pairs, wide.fixed[0]):
        return found
    while rival < len(norms) - 1 and _have_steep(f, found.pairs, wide.fixed[rival]):
        rival += 1
    odds = log_odds(norms[0], norms[rival], len(found.pairs))
    return Search(found.pairs, found.integers, found.values, norms[0], norms[rival], found.success, odds, True)


@kernel
def _have_steep(f: Filter, pairs: Indices, integers: Vector) -> bool:
    """Return whether integers have slopes that no receivers have."""
    states = slope_states(f)
    slopes_m, room = np.empty(len(states)), np.empty((len(states), len(states)))
    condition(f.x, f.P, pairs, integers, 0.0, states, slopes_m, room)
    return _is_steep(slopes_m)


@kernel
def tell_slopes(f: Filter, pairs: Indices, integers: Vector) -> None:
    """Tell the filter, roughly, the slopes that these integers have."""
    states = slope_states(f)
    found, room = np.empty(len(states)), np.empty((len(states), len(states)))
    if condition(f.x, f.P, pairs, integers, 0.0, states, found, room) < np.inf:
        _tell(f, states, found)


@kernel_in_place
def _tell(f: Filter, states: Indices, slopes_m: Vector) -> None:
    for k in range(len(states)):
        take_value(f.x, f.P, states[k], slopes_m[k], TOLD_SIGMA_M**2)


@kernel
def _slopes_of(x: Vector, P: Matrix, pairs: Indices, fixed: Matrix, states: Indices, out: Matrix) -> None:
    """Write the slopes (m) of each of these integer vectors."""
    room = np.empty((len(states), len(states)))
    for k in range(len(fixed)):
        condition(x, P, pairs, fixed[k], 0.0, states, out[k], room)


@kernel
def _given(f: Filter, pairs: Indices, slopes: Indices, held: Indices) -> Given:
    """Return the ambiguities of these double differences, and the slopes, given what is held; empty where that contradicts itself."""
    packed, wanted = pairs.copy(), np.empty(pairs.size + len(slopes), np.int64)
    count = pack_pairs(packed, wanted)
    m = count + len(slopes)
    wanted[count:m] = slopes
    x, P = np.empty(m), np.empty((m, m))
    norm = condition(f.x, f.P, held, held_differences(f, held), 0.0, wanted[:m], x, P)
    return Given(x[:0] if norm == np.inf else x, P, packed, np.arange(count, m))
