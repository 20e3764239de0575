"""What is said against integers that searches have given for a while, and that nobody has been shown: all satellites but one are sure of
others.

The odds of a row of searches do not exclude that one phase is off for as long, as that of a low satellite whose reflection lasts. What it
makes fit, it makes fit alone: without it the others soon are as sure of their integers.
"""

from math import isfinite

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.models.odds import NORM_LIMIT
from rtkmesh.rtk.acceptance import FAR_COUNT, search_all
from rtkmesh.rtk.ambiguity import Candidates, Search, compare_integers, take
from rtkmesh.rtk.memory import ACCEPT_AFTER_STREAK, OBJECTED, SHOWN, ResolveSetup
from rtkmesh.rtk.state import INTEGER, Filter

Vector = NDArray[np.float64]


@kernel
def hear_objections(f: Filter, candidates: Candidates, held: int, memory: Vector, setup: ResolveSetup) -> None:
    """Note whether all satellites but one give others than these ``held`` integers, as long as these are few and have not been shown."""
    if memory[SHOWN] > 0.0 or memory[OBJECTED] > 0.0 or held >= FAR_COUNT or isfinite(setup.length_m):
        return
    memory[OBJECTED] = 1.0 if one_is_needed(f, candidates, setup) else 0.0


@kernel
def one_is_needed(f: Filter, candidates: Candidates, setup: ResolveSetup) -> bool:
    """Return whether there is a satellite without which the search gives other integers than those that are held, and would be believed
    if it lasted.
    """
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
    count = len(found.pairs)
    if not found.resolved or count < setup.minimum_ambiguities or found.norm > NORM_LIMIT * count:
        return False
    if found.odds < setup.confidence * ACCEPT_AFTER_STREAK:
        return False
    return compare_integers(f.keys, f.history[:, INTEGER].copy(), f.keys, found.values)[1] > 0
