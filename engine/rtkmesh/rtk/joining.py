"""How new ambiguities join the held ones: when these (and a prediction of the rover's place) determine them."""

from math import isfinite
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, scratch_flags
from rtkmesh.rtk.ambiguity import (
    NODE_LIMIT,
    Candidates,
    Search,
    condition,
    held_among,
    held_differences,
    held_references,
    pack_pairs,
    pairs_of,
    search_pairs,
    take,
)
from rtkmesh.rtk.lambda_search import OK
from rtkmesh.rtk.state import ARC_EPOCHS, DYNAMIC, INTEGER, Filter

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

JOIN_ODDS: Final = 9.0  # log odds for ambiguities that join the held ones, whose norm has set the scale
JOIN_TRIES: Final = 4  # all of the new ones, then without the newer, at last the oldest alone


@kernel
def join(f: Filter, aided: Filter, candidates: Candidates, held: Indices, fit: float, groups: bool) -> None:
    """Give integers to ambiguities that the held ones (and a prediction) determine: all of the new ones, or without the newer, at last the
    oldest alone; ``fit`` is the squared norm that each may have, ``groups`` whether clock groups of which none is held may join.
    """
    new, old = scratch_flags(len(candidates.row)), held_among(f, candidates)
    for k in range(len(new)):
        history = f.history[candidates.row[k]]
        new[k] = not isfinite(history[INTEGER]) and history[ARC_EPOCHS] >= 1.0
    fresh = take(candidates, new)
    nearest = np.empty(len(fresh.row), np.int64)
    count = held_references(fresh.group, old.group, old.weight, nearest)
    if groups and count < len(nearest):
        _join_groups(f, aided, take(fresh, nearest < 0), held, fit)
    if count == 0:
        return
    rows, references, pairs, j = np.empty(count, np.int64), np.empty(count, np.int64), np.empty((count, 2), np.int64), 0
    for k in range(len(nearest)):
        if nearest[k] >= 0:
            rows[j], references[j] = fresh.row[k], old.row[nearest[k]]
            pairs[j, 0], pairs[j, 1] = rows[j] + DYNAMIC, references[j] + DYNAMIC
            j += 1
    wanted = np.empty(2 * count, np.int64)
    wanted = wanted[: pack_pairs(pairs, wanted)]
    x, P = np.empty(len(wanted)), np.empty((len(wanted), len(wanted)))
    norm = condition(aided.x, aided.P, held, held_differences(f, held), 0.0, wanted, x, P)
    if norm == np.inf:
        return
    scale = max(1.0, norm / len(held))
    for least in _tries(f, rows):
        if _join_older(f, rows, references, pairs, least, x, P, scale, fit):
            return


@kernel
def _join_groups(f: Filter, aided: Filter, fresh: Candidates, held: Indices, fit: float) -> None:
    """Give integers to double differences of groups of which none is held, as a system that was left out when integers were found."""
    older = np.empty(len(fresh.row), np.bool_)
    for least in _tries(f, fresh.row):
        for k in range(len(older)):
            older[k] = f.history[fresh.row[k], ARC_EPOCHS] >= least
        pairs = pairs_of(take(fresh, older))
        if len(pairs) > 0 and _groups_join(f, aided, pairs, held, fit):
            return


@kernel
def _groups_join(f: Filter, aided: Filter, pairs: Indices, held: Indices, fit: float) -> bool:
    """Give integers to these double differences, if the held ones determine them; their references get rounded float values."""
    count, packed, wanted = len(pairs), pairs.copy(), np.empty(pairs.size, np.int64)
    wanted = wanted[: pack_pairs(packed, wanted)]
    x, P = np.empty(len(wanted)), np.empty((len(wanted), len(wanted)))
    norm = condition(aided.x, aided.P, held, held_differences(f, held), 0.0, wanted, x, P)
    if norm == np.inf:
        return False
    fixed = np.zeros((2, count))
    if not _are_clear(x, P, packed, max(1.0, norm / len(held)), fit, fixed):
        return False
    for k in range(count):
        f.history[pairs[k, 1] - DYNAMIC, INTEGER] = np.rint(f.x[pairs[k, 1]])
    for k in range(count):
        f.history[pairs[k, 0] - DYNAMIC, INTEGER] = f.history[pairs[k, 1] - DYNAMIC, INTEGER] + fixed[0, k]
    return True


@kernel
def extend(f: Filter, found: Search) -> None:
    """Hold, beside what is held, the other integers of a search that gives that too; where none of a group is held its reference gets its
    rounded float value.
    """
    for k in range(len(found.pairs)):
        reference = found.pairs[k, 1] - DYNAMIC
        if not np.isfinite(f.history[reference, INTEGER]):
            f.history[reference, INTEGER] = _offset(f, found, found.pairs[k, 1])
    for k in range(len(found.pairs)):
        state, reference = found.pairs[k, 0] - DYNAMIC, found.pairs[k, 1] - DYNAMIC
        f.history[state, INTEGER] = f.history[reference, INTEGER] + found.integers[k]


@kernel
def _offset(f: Filter, found: Search, reference: int) -> float:
    """Return the integer of a reference by what is held of its group, or rounded."""
    for k in range(len(found.pairs)):
        integer = f.history[found.pairs[k, 0] - DYNAMIC, INTEGER]
        if found.pairs[k, 1] == reference and np.isfinite(integer):
            return float(integer - found.integers[k])
    return float(np.rint(f.x[reference]))


@kernel
def _are_clear(x: Vector, P: Matrix, pairs: Indices, scale: float, fit: float, fixed: Matrix) -> bool:
    """Write the two best integer vectors of double differences whose norms are in units of ``scale``; return whether the best one fits and
    stands out.
    """
    norms = np.zeros(2)
    status, _ = search_pairs(x, P, pairs, NODE_LIMIT, fixed, norms)
    return status == OK and norms[1] - norms[0] >= 2.0 * JOIN_ODDS * scale and norms[0] <= fit * scale * len(pairs)


@kernel
def _tries(f: Filter, rows: Indices) -> Vector:
    """Return the arc lengths (epochs) from which on new ambiguities are tried: all of them, then without the newer, at last the oldest."""
    ages, out, count = _ages(f, rows), np.empty(JOIN_TRIES), 0
    for k in range(JOIN_TRIES):
        least = ages[(k * (len(ages) - 1)) // (JOIN_TRIES - 1)]
        if count == 0 or least != out[count - 1]:
            out[count] = least
            count += 1
    return out[:count]


@kernel
def _ages(f: Filter, rows: Indices) -> Vector:
    """Return the different arc lengths (epochs) of these ambiguities, rising."""
    ages, count = np.empty(len(rows)), 0
    for row in rows:
        age, place = f.history[row, ARC_EPOCHS], count
        while place > 0 and ages[place - 1] > age:
            place -= 1
        if place > 0 and ages[place - 1] == age:
            continue
        for i in range(count, place, -1):
            ages[i] = ages[i - 1]
        ages[place] = age
        count += 1
    return ages[:count]


@kernel
def _join_older(
    f: Filter, rows: Indices, references: Indices, pairs: Indices, least: float, x: Vector, P: Matrix, scale: float, fit: float
) -> bool:
    """Give integers to the new ambiguities whose arcs have at least so many epochs, if the held ones determine them."""
    chosen, count = np.empty(len(rows), np.int64), 0
    for k in range(len(rows)):
        if f.history[rows[k], ARC_EPOCHS] >= least:
            chosen[count] = k
            count += 1
    some = np.empty((count, 2), np.int64)
    for i in range(count):
        some[i, 0], some[i, 1] = pairs[chosen[i], 0], pairs[chosen[i], 1]
    fixed = np.zeros((2, count))
    if not _are_clear(x, P, some, scale, fit, fixed):
        return False
    for i in range(count):
        f.history[rows[chosen[i]], INTEGER] = f.history[references[chosen[i]], INTEGER] + fixed[0, i]
    return True
