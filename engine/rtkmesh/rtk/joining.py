"""How new ambiguities join the held ones: when these (and a prediction of the rover's place) determine them."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.rtk.ambiguity import NODE_LIMIT, Candidates, condition, held_differences, held_references, pack_pairs, search_pairs, take
from rtkmesh.rtk.lambda_search import OK
from rtkmesh.rtk.memory import is_held
from rtkmesh.rtk.state import ARC_EPOCHS, DYNAMIC, INTEGER, Filter

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

JOIN_ODDS: Final = 9.0  # log odds for ambiguities that join the held ones, whose norm has set the scale
JOIN_TRIES: Final = 4  # all of the new ones, then without the newer, at last the oldest alone


@kernel
def join(f: Filter, aided: Filter, candidates: Candidates, held: Indices, fit: float) -> None:
    """Give integers to ambiguities that the held ones (and a prediction) determine: all of the new ones, or without the newer, at last the
    oldest alone; ``fit`` is the squared norm that each may have.
    """
    known = is_held(f, candidates)
    new = np.empty(len(known), np.bool_)
    for k in range(len(known)):
        new[k] = not known[k] and f.history[candidates.row[k], ARC_EPOCHS] >= 1.0
    fresh, old = take(candidates, new), take(candidates, known)
    nearest = np.empty(len(fresh.row), np.int64)
    count = held_references(fresh.group, old.group, old.weight, nearest)
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
    scale, ages = max(1.0, norm / len(held)), _ages(f, rows)
    for k in range(JOIN_TRIES):
        place = (k * (len(ages) - 1)) // (JOIN_TRIES - 1)
        if k > 0 and place == ((k - 1) * (len(ages) - 1)) // (JOIN_TRIES - 1):
            continue
        if _join_older(f, rows, references, pairs, ages[place], x, P, scale, fit):
            return


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
    fixed, norms = np.zeros((2, count)), np.zeros(2)
    status, _ = search_pairs(x, P, some, NODE_LIMIT, fixed, norms)
    if status != OK or norms[1] - norms[0] < 2.0 * JOIN_ODDS * scale or norms[0] > fit * scale * count:
        return False
    for i in range(count):
        f.history[rows[chosen[i]], INTEGER] = f.history[references[chosen[i]], INTEGER] + fixed[0, i]
    return True
