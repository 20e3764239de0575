"""Which integers are not shown because all satellites but one are sure of others.

Integers that searches give for a while are believed by odds that do not exclude one phase that is off for as long: of a low satellite
whose reflection lasts. What it makes fit, it makes fit alone: without it the others soon are as sure of their integers.
"""

from math import isfinite

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.models.odds import NORM_LIMIT
from rtkmesh.rtk.acceptance import FAR_COUNT, search_all
from rtkmesh.rtk.ambiguity import Candidates, Search, compare_integers, take
from rtkmesh.rtk.memory import ACCEPT_AFTER_STREAK, ACCEPT_AT_ONCE, OBJECTION, ResolveSetup
from rtkmesh.rtk.state import INTEGER, Filter

Vector = NDArray[np.float64]

OPEN, OBJECTED, CLEARED = range(3)  # what was found since the integers are held


@kernel
def weigh_objections(f: Filter, candidates: Candidates, held: int, free: Search, memory: Vector, setup: ResolveSetup) -> None:
    """Note whether all satellites but one have given others than these (few) ``held`` integers, with the odds from which those would be
    believed after a while. A ``free`` search of all that gives what is held with the odds of one search settles it, before and after.
    """
    if memory[OBJECTION] == CLEARED or held >= FAR_COUNT or isfinite(setup.length_m):
        return
    if free.resolved and free.odds >= setup.confidence * ACCEPT_AT_ONCE and _is_held(f, free):
        memory[OBJECTION] = CLEARED
    elif memory[OBJECTION] == OPEN and one_is_needed(f, candidates, setup):
        memory[OBJECTION] = OBJECTED


@kernel
def one_is_needed(f: Filter, candidates: Candidates, setup: ResolveSetup) -> bool:
    """Return whether there is a satellite without which the search gives other integers than those that are held, clearly."""
    n = len(candidates.row)
    mask = np.empty(n, np.bool_)
    for first in range(n):
        if first > 0 and candidates.satellite[first] == candidates.satellite[first - 1]:
            continue
        for k in range(n):
            mask[k] = candidates.satellite[k] != candidates.satellite[first]
        if _objects(f, search_all(f, take(candidates, mask), setup), setup):
            return True
    return False


@kernel
def _objects(f: Filter, found: Search, setup: ResolveSetup) -> bool:
    """Return whether a search gives others than what is held, and would be believed if it lasted."""
    count = len(found.pairs)
    if not found.resolved or count < setup.minimum_ambiguities or found.norm > NORM_LIMIT * count:
        return False
    return found.odds >= setup.confidence * ACCEPT_AFTER_STREAK and not _is_held(f, found)


@kernel
def _is_held(f: Filter, found: Search) -> bool:
    """Return whether a search gives no others than the held integers."""
    return compare_integers(f.keys, f.history[:, INTEGER].copy(), f.keys, found.values)[1] == 0
