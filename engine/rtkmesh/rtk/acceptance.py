"""Which integers are believed when none are held: from one clear search, from a subset, or from searches that keep agreeing."""

from math import isfinite, log, sqrt
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place
from rtkmesh.gnss.signals import SATELLITES_PER_SYSTEM, SYSTEMS
from rtkmesh.models.odds import NORM_LIMIT
from rtkmesh.rtk.ambiguity import Candidates, Search, compare_integers, search, take
from rtkmesh.rtk.asked_odds import SCANT_COUNT, WEAK_COUNT, is_felt, odds_of_lasting
from rtkmesh.rtk.common_integers import search_common
from rtkmesh.rtk.memory import (
    ACCEPT_AFTER_STREAK,
    ACCEPT_AT_ONCE,
    CONFIRMED,
    DOUBTS,
    HELD_SINCE_S,
    LAST_ODDS,
    OBJECTED,
    SHOWN,
    STREAK_EPOCHS,
    STREAK_EPOCHS_LEAST,
    STREAK_S,
    STREAK_START_S,
    TRUSTS_GLONASS,
    ResolveSetup,
    release,
)
from rtkmesh.rtk.redundancy import are_bare
from rtkmesh.rtk.slopes import slope_states, without_slopes
from rtkmesh.rtk.state import ARC_S, DYNAMIC, INTEGER, STREAK, Filter
from rtkmesh.rtk.trust import Wide, possible, search_wide, tell_slopes
from rtkmesh.rtk.witness import LEAST, others_of

Vector = NDArray[np.float64]

WEAK_STREAK_S: Final = 30.0  # with few ambiguities: code multipath must have changed in between
# Beyond FAR_M the atmosphere may make a few wrong integers fit, and goes on to: fewer than FAR_COUNT, however clear, must last, for
# WEAK_STREAK_S times the square of the distance in FAR_M, FAR_STREAK_S at most. Believed at once where one search is clear, simulated runs
# of two seeds had 82 wrong fixes for 26, up to 33 s long for 11, and right ones 99 and 93 for 98 and 90 % at 10 km, 79 and 76 for 66 and
# 64 % at 35 km. With 8 for 13 one of 260 runs at 35 km had 23 wrong fixes.
FAR_M: Final = 10e3
FAR_COUNT: Final = 13
FAR_STREAK_S: Final = 300.0
STRONG_COUNT: Final = 20  # with so many ambiguities that fit, ACCEPT_MANY is enough: their norm is a test in itself
ACCEPT_MANY: Final = 5.5
SURE: Final = 8.0  # log odds from which a new fix is shown at once, like one that fits well; others must be confirmed
GOOD_FIT: Final = 1.0  # squared norm per ambiguity of integers of all candidates that fit well
NEW_S: Final = (0.0, 5.0, 20.0)  # subsets leave out what is younger
WEAKEST: Final = 5  # so many of the weakest satellites are left out in turn
# Log odds that the search with an open slope must have, for one that takes GLONASS phases to have none to be believed: that assumption
# alone may make integers look sure. Three of 530 simulated runs on one band were wrong by it for 23 to 79 s, with 2.8 of six integers
# of the others, 0.9 of four and 3.5 of five; right ones had 3.6 and more of six to eight, 4.6 and more of five.
OPEN_SLOPE_LEAST: Final = 3.0
OPEN_SLOPE_FEW: Final = 4.0  # where the integers of the others are fewer than ``witness.LEAST``
# By so many squared norms per integer (1 at least) they may fit worse without a slope, of each: 2.4 sigmas. With 4 the backward run of
# galway_b_walk, where there is none, has 995 fixes instead of 1026.
NO_SLOPE_FIT: Final = 6.0
SILENT, AGREES, OBJECTS = range(3)  # what GLONASS says of integers that were found without it
# Log odds of other integers by the search with GLONASS that forbid those which are found without it.
AGAINST_LEAST: Final = 2.5
# Log odds by which the search of all must bear out a subset of few over a baseline whose atmosphere is felt. Of 34 such in simulation 25 of
# 27 right ones had 3.3 and more, the three wrong ones 0.5, 1.8 and 3.8; nearer by four of 16 right ones had less, and none was wrong.
ALL_LEAST: Final = 3.0
WIDE_M: Final = 5.0  # sigma in 3D of a float solution from which on odds must be better: epochs under open sky are three times as good
SUBSETS: Final = 13  # with five systems: who looks so often finds odds by chance


class Question(NamedTuple):
    """What an epoch asks in which no integers are held: the filter, and the one that knows a prediction, where that ``helped``; candidates
    without those of GLONASS that are not trusted, and ``everything``, with the search of all of it, if that was made (``wide``); the log
    odds from which one search is believed (``asked_odds``), those of the ``free`` search, and those that ``scant`` integers must have in
    any case; ``reflected``: codes are worse than those of patches in the open.
    """

    f: Filter
    aided: Filter
    helped: bool
    candidates: Candidates
    everything: Candidates
    wide: Wide
    free: Search
    asked: float
    asked_of_free: float
    scant: float
    reflected: bool


class Answer(NamedTuple):
    """Integers that may be believed: their search, and the filter whose slopes of GLONASS phases they go with; the log odds from which one
    search is believed, and the ``penalty`` for having looked so often; ``wide``: GLONASS is in it, ``part``: a subset.
    """

    search: Search
    f: Filter
    needed: float
    penalty: float
    wide: bool
    part: bool


@kernel
def try_new(q: Question, memory: Vector, setup: ResolveSetup, time_s: float) -> None:
    """Look for integers without any that are held, and hold them where they are believed."""
    release(q.f)
    memory[HELD_SINCE_S] = np.inf
    space, far2 = log_space(q.f), (q.f.x[0] ** 2 + q.f.x[1] ** 2 + q.f.x[2] ** 2) / FAR_M**2
    answer = _looked_for(q, space, far2, setup, time_s)
    found = answer.search
    if not found.resolved or len(found.pairs) < setup.minimum_ambiguities:
        memory[STREAK_EPOCHS] = 0.0
        return
    _follow(q.f, found, memory, time_s)
    strong = not _are_few_afar(found, far2) and _strong(answer, space, setup)
    if (strong or _is_likely(answer, space, far2, memory, setup, time_s)) and _stands(q, answer, strong, space, far2, memory, setup):
        _believe(q.f, answer, strong, memory, setup, time_s)


@kernel
def _looked_for(q: Question, space: float, far2: float, setup: ResolveSetup, time_s: float) -> Answer:
    """Return the best of all searches that are worth it: the free one; with the prediction; of subsets, and with GLONASS; of what likely
    vectors have in common. Where one is strong no more are made.
    """
    answer, several = Answer(q.free, q.f, q.asked_of_free, 0.0, False, False), len(q.candidates.row) > 1
    if not _strong(answer, space, setup) and q.helped and several:
        found = search_all(q.aided, q.candidates, setup)
        if found.odds > answer.search.odds:
            answer = Answer(found, q.f, q.asked, 0.0, False, False)
    if not _strong(answer, space, setup) and several:
        found = _best_subset(q.f, q.candidates, q.free, setup, time_s)
        if found.odds > answer.search.odds:
            answer = Answer(found, q.f, q.asked, log(SUBSETS), False, True)
        if len(q.everything.row) > len(q.candidates.row):
            answer = _with_glonass(q, answer, setup)
    if far2 <= 1.0 and not isfinite(setup.length_m) and not _strong(answer, space, setup):
        found = search_common(q.f, q.candidates, setup.confidence * q.asked + log(SUBSETS) + space)
        if found.resolved:
            answer = Answer(found, answer.f, q.asked, log(SUBSETS), False, False)
    return answer


@kernel
def _with_glonass(q: Question, answer: Answer, setup: ResolveSetup) -> Answer:
    """Return the search of all, GLONASS too, if its odds are better: with an open slope, or without one where the other bears it out."""
    flat, wide = without_slopes(q.f), q.wide if len(q.wide.norms) > 0 else search_wide(q.f, q.everything, setup)
    straight = search_all(flat, q.everything, setup)
    slopeless = straight.odds > wide.found.odds and bears_out(q.f, wide.found, straight)
    found = straight if slopeless else possible(q.f, wide)
    if not found.odds > answer.search.odds:
        return answer
    return Answer(found, flat if slopeless else q.f, max(q.asked, ACCEPT_AT_ONCE), log(SUBSETS), True, False)


@kernel_in_place
def _are_few_afar(found: Search, far2: float) -> bool:
    """Return whether integers are so few, over a baseline of this square (in FAR_M), that they must last."""
    return far2 > 1.0 and len(found.pairs) < FAR_COUNT


@kernel_in_place
def _is_likely(answer: Answer, space: float, far2: float, memory: Vector, setup: ResolveSetup, time_s: float) -> bool:
    """Return whether searches have given these integers for long enough."""
    lasting_s = STREAK_S if len(answer.search.pairs) >= WEAK_COUNT else WEAK_STREAK_S
    if _are_few_afar(answer.search, far2):
        lasting_s = max(lasting_s, min(far2 * WEAK_STREAK_S, FAR_STREAK_S))
    persistent = memory[STREAK_EPOCHS] >= STREAK_EPOCHS_LEAST and time_s - memory[STREAK_START_S] >= lasting_s
    return bool(persistent and answer.search.odds >= setup.confidence * ACCEPT_AFTER_STREAK + answer.penalty + space)


@kernel
def _stands(q: Question, answer: Answer, strong: bool, space: float, far2: float, memory: Vector, setup: ResolveSetup) -> bool:
    """Return whether integers fit, could show that one of them is wrong, and nothing at hand says otherwise."""
    found = answer.search
    if found.norm > NORM_LIMIT * len(found.pairs):
        return False
    if q.reflected and far2 <= 1.0 and are_bare(q.f, found.pairs):
        return False  # elsewhere GLONASS, or another system, may be found by them
    suspect = answer.part and is_felt(q.f) and not q.reflected and len(found.pairs) < FAR_COUNT
    if suspect and not is_borne_out(q.f, found, q.free, memory[LAST_ODDS], setup):
        return False
    said = glonass_says(q.aided, q.everything, found, setup) if len(q.everything.row) > len(q.candidates.row) else SILENT
    if len(found.pairs) < SCANT_COUNT and far2 <= 1.0 and said != AGREES and found.odds < setup.confidence * q.scant:
        return False
    least = setup.confidence * odds_of_lasting(q.f, len(found.pairs)) + answer.penalty + space
    return said != OBJECTS and (strong or not (answer.part or said != AGREES) or found.odds >= least)


@kernel
def _believe(f: Filter, answer: Answer, strong: bool, memory: Vector, setup: ResolveSetup, time_s: float) -> None:
    """Hold integers, and show a fix at once where they are sure or fit well."""
    found, count = answer.search, len(answer.search.pairs)
    if answer.wide:  # the slope that GLONASS fits with is known now
        f.x[:], f.P[:, :] = answer.f.x, answer.f.P
        memory[TRUSTS_GLONASS] = 1.0
        tell_slopes(f, found.pairs, found.integers)
    _hold(f, found)
    memory[HELD_SINCE_S], memory[DOUBTS], memory[CONFIRMED], memory[OBJECTED] = time_s, 0.0, 0.0, 0.0
    good = answer.penalty == 0.0 and found.norm <= GOOD_FIT * count
    clear = strong and answer.penalty == 0.0 and answer.needed < ACCEPT_AT_ONCE  # so are odds that are enough where codes are good
    memory[SHOWN] = 1.0 if good or clear or found.odds >= setup.confidence * SURE or count >= STRONG_COUNT else 0.0


@kernel_in_place
def log_space(f: Filter) -> float:
    """Return the logarithm of the space in which integers are looked for, over that of a sigma of WIDE_M (0 at least).

    So many more places are there at which wrong integers may fit by chance; and where phases are reflected, the right ones do not fit.
    """
    sigma_m = sqrt(f.P[0, 0] + f.P[1, 1] + f.P[2, 2])
    return 3.0 * log(max(sigma_m / WIDE_M, 1.0))


@kernel
def search_all(f: Filter, candidates: Candidates, setup: ResolveSetup) -> Search:
    """Search the integers of all these candidates."""
    return search(f, candidates, setup.length_m, setup.length_sigma_m)


@kernel
def _best_subset(f: Filter, candidates: Candidates, free: Search, setup: ResolveSetup, time_s: float) -> Search:
    """Search without the newest ambiguities, without each system and without each of the weakest satellites in turn; return what has the
    best odds, or the ``free`` search of all.
    """
    n = len(candidates.row)
    best, mask = free, np.empty(n, np.bool_)
    for age_s in NEW_S:
        for k in range(n):
            mask[k] = time_s - f.history[candidates.row[k], ARC_S] > age_s
        best = _better(f, candidates, mask, best, setup)
    for system in range(len(SYSTEMS)):
        for k in range(n):
            mask[k] = candidates.satellite[k] // SATELLITES_PER_SYSTEM != system
        best = _better(f, candidates, mask, best, setup)
    left = np.ones(n, np.bool_)  # satellites that have not been left out yet
    for _ in range(WEAKEST):
        weakest = _weakest(candidates, left)
        if weakest < 0:
            break
        for k in range(n):
            mask[k] = candidates.satellite[k] != candidates.satellite[weakest]
        left[weakest] = False
        best = _better(f, candidates, mask, best, setup)
    return best


@kernel_in_place
def _weakest(candidates: Candidates, left: NDArray[np.bool_]) -> int:
    """Return the first row of the satellite with the smallest weight among those that are left, -1 if there is none."""
    weakest = -1
    for k in range(len(left)):
        first = k == 0 or candidates.satellite[k] != candidates.satellite[k - 1]
        if left[k] and first and (weakest < 0 or candidates.weight[k] < candidates.weight[weakest]):
            weakest = k
    return weakest


@kernel
def _better(f: Filter, candidates: Candidates, mask: NDArray[np.bool_], best: Search, setup: ResolveSetup) -> Search:
    """Return the search of a subset (no less than five, not all) if its odds are better."""
    count = 0
    for kept in mask:
        count += 1 if kept else 0
    if not 4 < count < len(mask):
        return best
    found = search_all(f, take(candidates, mask), setup)
    return found if found.odds > best.odds else best


@kernel
def bears_out(f: Filter, sloped: Search, straight: Search) -> bool:
    """Return whether the search of all that leaves the slopes of GLONASS phases open gives the integers of the other systems that the one
    without a slope gives, with odds of its own, and that no slope fits much better than none. Beyond ``FAR_M``, where
    integers must last and fit the atmosphere, small slopes are let pass.
    """
    own = others_of(f, sloped.pairs)
    least = OPEN_SLOPE_LEAST if len(own) >= LEAST else OPEN_SLOPE_FEW
    if not sloped.resolved or not straight.resolved or sloped.odds < least:
        return False
    may = NO_SLOPE_FIT * len(slope_states(f)) * max(sloped.norm / len(sloped.pairs), 1.0)
    fits = straight.norm - sloped.norm <= may or f.x[0] ** 2 + f.x[1] ** 2 + f.x[2] ** 2 > FAR_M**2
    return fits and bool((sloped.integers[own] == straight.integers[own]).all())


@kernel
def is_borne_out(f: Filter, subset: Search, everything: Search, odds: float, setup: ResolveSetup) -> bool:
    """Return whether the search of all gives the integers of a subset, with log odds of its own (``odds``: without GLONASS as a witness).

    What is left out of a subset makes its odds. If it was right to leave it out, the search of all becomes sure as well.
    """
    clear = everything.resolved and odds >= setup.confidence * ALL_LEAST
    return clear and compare_integers(f.keys, subset.values, f.keys, everything.values)[1] == 0


@kernel
def glonass_says(f: Filter, everything: Candidates, found: Search, setup: ResolveSetup) -> int:
    """Return what the search of all, with an open slope of GLONASS phases, says of integers that were found without it: whether it gives
    the same or others, and is clear enough for that.
    """
    told = search_all(f, everything, setup)
    if not told.resolved:
        return SILENT
    same = compare_integers(f.keys, found.values, f.keys, told.values)[1] == 0
    if told.odds < setup.confidence * (ALL_LEAST if same else AGAINST_LEAST):
        return SILENT
    return AGREES if same else OBJECTS


@kernel_in_place
def _strong(answer: Answer, space: float, setup: ResolveSetup) -> bool:
    """Return whether one search is clear enough by itself; ``space`` is that of ``log_space``."""
    found, count = answer.search, len(answer.search.pairs)
    if not found.resolved or count < setup.minimum_ambiguities:
        return False
    many = count >= STRONG_COUNT and found.norm <= 0.25 * NORM_LIMIT * count
    asked = min(ACCEPT_MANY, answer.needed) if many else answer.needed
    return found.odds >= setup.confidence * asked + (answer.penalty + space)


@kernel
def _follow(f: Filter, found: Search, memory: Vector, time_s: float) -> None:
    """Count for how long searches have given the same integers."""
    common, different = compare_integers(f.keys, f.history[:, STREAK].copy(), f.keys, found.values)
    if different > 0 or common < 3:
        memory[STREAK_START_S], memory[STREAK_EPOCHS] = time_s, 0.0
    memory[STREAK_EPOCHS] += 1.0
    f.history[:, STREAK] = found.values


@kernel_in_place
def _hold(f: Filter, found: Search) -> None:
    """Make these integers the held ones, and only these; a group's reference gets its rounded float value."""
    release(f)
    for k in range(len(found.pairs)):
        state, reference = found.pairs[k, 0], found.pairs[k, 1]
        f.history[reference - DYNAMIC, INTEGER] = np.rint(f.x[reference])
    for k in range(len(found.pairs)):
        state, reference = found.pairs[k, 0], found.pairs[k, 1]
        f.history[state - DYNAMIC, INTEGER] = f.history[reference - DYNAMIC, INTEGER] + found.integers[k]
