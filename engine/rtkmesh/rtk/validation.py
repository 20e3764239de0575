"""Which integers are believed, for how long, and why.

Integers are *held* once they have proven themselves; the filter itself never learns of them (except in fix-and-hold), so it stays an
independent witness: every epoch the free search and the float solution can speak against what is held. New ambiguities join one by one
when what is held determines them. All thresholds are log odds (see ``models.odds``), so they adapt to the strength of the model.
"""

from math import exp, isfinite, sqrt
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place, scratch, scratch_flags
from rtkmesh.gnss.signals import GLONASS, SATELLITES_PER_SYSTEM
from rtkmesh.models.odds import NORM_LIMIT, PRIOR_DOF, log_odds
from rtkmesh.rtk.acceptance import FAR_COUNT, FAR_M, Question, log_space, search_all, try_new
from rtkmesh.rtk.agreement import DEPARTURE_ALONE, is_left_alone, is_unsafe, stands_alone
from rtkmesh.rtk.ambiguity import (
    Candidates,
    Search,
    compare_integers,
    held_among,
    held_differences,
    norm_of,
    pairs_of,
    take,
    tell,
    write_held_differences,
)
from rtkmesh.rtk.asked_odds import FAIR_CODES, asked_odds, asked_of_scant, is_reflected, is_street
from rtkmesh.rtk.joining import extend, join
from rtkmesh.rtk.memory import (
    ACCEPT_AFTER_STREAK,
    ACCEPT_AT_ONCE,
    CONFIRMED,
    DOUBTS,
    FIX_SIGMA,
    GLONASS_VOTES,
    HELD_SINCE_S,
    LAST_COUNT,
    LAST_NORM,
    LAST_ODDS,
    LAST_SECOND,
    LAST_SUCCESS,
    OBJECTED,
    SHARE,
    SHOWN,
    SINCE_SEARCH,
    STREAK_EPOCHS,
    STREAK_EPOCHS_LEAST,
    STREAK_S,
    TRUSTS_GLONASS,
    ResolveSetup,
    release,
)
from rtkmesh.rtk.objections import hear_objections
from rtkmesh.rtk.placing import Placing, place_integers
from rtkmesh.rtk.predicted import WEAK_M, carry, departure, learn_fix, with_prediction
from rtkmesh.rtk.redundancy import are_bare
from rtkmesh.rtk.solution import Reason
from rtkmesh.rtk.state import DYNAMIC, Filter
from rtkmesh.rtk.trust import Wide, learn_glonass, not_searched, search_wide
from rtkmesh.rtk.witness import has_witness, witnessed

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

RELEASE: Final = 6.0  # log odds of another vector against the held one at which doubt counts
RELEASE_EPOCHS: Final = 3
# Squared departure of a fix from the prediction, in sigmas of both. Far below what chi-square allows, for most of the errors of two epochs
# are the same. 3 leaves still fewer wrong ones in simulated streets, but takes 1.2 % of the right ones of galway_a.
DEPARTURE_LIMIT: Final = 6.0
SHARP_M: Final = 0.25  # beyond this a prediction tells little that the float solution does not
SELF_RELIANT: Final = 5  # so many held integers need no prediction
LARGE_COUNT: Final = 24
SEARCH_EVERY: Final = 5  # epochs between free searches of a large set that has been confirmed
FIX_SIGMA_M: Final = 0.15  # a fix must be this good: who reads FIX expects centimetres
# ... and so good where the codes are those of streets: phases are reflected there too, which no sigma knows of. Of 18635 simulated fixes in
# streets 143 were off by more than 0.15 m, 141 with such codes; 85 with sigmas beyond this, most of them with right integers.
STREET_SIGMA_M: Final = 0.07
JOIN_FIT_STREET: Final = 4.0  # squared norm per ambiguity that joins there: reflected phases are parts of a cycle off any integer
EXTEND_FIT: Final = 2.0  # squared norm per ambiguity of a search whose integers are taken beside those that are held
CONFIRMATIONS: Final = 3
INFORMED_EPOCHS: Final = 3  # epochs in which the informed filter must have found no strain for that to count as agreement

# Reasons as numbers, for kernels.
FIX_OK, FEW_AMBIGUITIES, NOT_SURE, TOO_UNCERTAIN, NOT_VALID, SWITCHED_OFF, TOO_RISKY = (int(reason) for reason in (
    Reason.OK, Reason.FEW_AMBIGUITIES, Reason.RATIO, Reason.FLOAT_TOO_UNCERTAIN, Reason.VALIDATION, Reason.AMBIGUITY_OFF,
    Reason.FAILURE_RATE,
))  # fmt: skip


class Resolution(NamedTuple):
    """What ambiguity resolution gave in one epoch. ``x`` and ``P`` are the fixed dynamic states, if ``fixed``; ``norm`` is that of the held
    integers against the float ambiguities.
    """

    reason: int
    fixed: bool
    x: Vector
    P: Matrix
    ratio: float
    odds: float
    threshold: float
    success: float
    integers: int
    grade: int
    norm: float


@kernel
def not_resolved() -> Resolution:
    """Return the resolution of an epoch in which no integers were looked for."""
    return Resolution(SWITCHED_OFF, False, np.zeros(DYNAMIC), np.zeros((DYNAMIC, DYNAMIC)), 0.0, 0.0, 0.0, 0.0, 0, 0, 0.0)


@kernel
def withheld(r: Resolution, reason: int) -> Resolution:
    """Return the resolution of an epoch whose fix is not shown, for this reason."""
    return Resolution(reason, False, r.x, r.P, r.ratio, r.odds, r.threshold, r.success, 0, 0, r.norm)


@kernel
def decide(
    f: Filter, everything: Candidates, memory: Vector, setup: ResolveSetup, prediction: Vector, time_s: float, level: float
) -> Search:
    """Find, keep or release integers in this epoch; return the free search. ``prediction`` is where the last fix and time differences of
    the phase put the baseline (m, ECEF) and its sigma, NaN without; ``level`` the variance factor of the codes (``asked_odds``).
    """
    candidates, held = _trusted(everything, memory), pairs_of(held_among(f, everything))
    free, told, wide = _searched(f, everything, candidates, len(held), memory, setup, level)
    asked, asked_of_told = asked_odds(level, False, f.x), asked_odds(level, told.odds > free.odds, f.x)
    free = told
    if len(held) >= 3:
        confirmed = memory[CONFIRMED]
        if not is_reflected(level) and not _is_far(f):
            hear_objections(f, candidates, len(held), memory, setup)
        _watch(f, held, free, memory, setup, prediction)
        if memory[CONFIRMED] > confirmed and len(free.pairs) > len(held) and extends(f, free, setup.confidence * asked_of_told):
            extend(f, free)
        held = pairs_of(held_among(f, everything))
    helped = prediction[3] <= SHARP_M and len(held) < SELF_RELIANT
    aided = with_prediction(f, prediction) if helped else f
    if len(held) < 3:
        question = Question(
            f, aided, helped, candidates, everything, wide, free, asked, asked_of_told, asked_of_scant(level), is_reflected(level)
        )
        try_new(question, memory, setup, time_s)
    else:
        join(f, aided, candidates, held, JOIN_FIT_STREET if is_street(level) else NORM_LIMIT, not _is_far(f))
        learn_glonass(f, everything, wide, held, memory, setup)
    return free


@kernel
def is_clear(f: Filter, everything: Candidates, memory: Vector, setup: ResolveSetup, level: float, odds: float) -> bool:
    """Return whether the search of an epoch in which nothing is held has such log odds: those that ``decide`` goes by and returns."""
    return _searched(f, everything, _trusted(everything, memory), 0, memory, setup, level)[1].odds >= odds


@kernel
def _trusted(everything: Candidates, memory: Vector) -> Candidates:
    """Return the candidates without GLONASS's, unless these are trusted."""
    allowed = scratch_flags(len(everything.satellite))
    for k in range(len(allowed)):
        allowed[k] = memory[TRUSTS_GLONASS] > 0.0 or everything.satellite[k] // SATELLITES_PER_SYSTEM != GLONASS
    return take(everything, allowed)


@kernel
def _searched(
    f: Filter, everything: Candidates, candidates: Candidates, held: int, memory: Vector, setup: ResolveSetup, level: float
) -> tuple[Search, Search, Wide]:
    """Return the free search, and what GLONASS makes of it where codes are good enough for a witness, with the search of all by which it
    does.
    """
    free = _free_search(f, candidates, held, memory, setup)
    unclear = free.resolved and free.odds < setup.confidence * ACCEPT_AT_ONCE
    if unclear and level <= FAIR_CODES and len(candidates.row) < len(everything.row) and has_witness(f, everything):
        wide = search_wide(f, everything, setup)
        return free, _surer(f, witnessed(f, wide), free, held), wide
    return free, free, not_searched(f)


@kernel
def _free_search(f: Filter, candidates: Candidates, held: int, memory: Vector, setup: ResolveSetup) -> Search:
    """Search without regard to what is held; of a large set that has proven itself only every few epochs.

    In between the last search's numbers stand for it, not resolved.
    """
    trusted = held >= LARGE_COUNT and memory[CONFIRMED] >= STREAK_EPOCHS_LEAST and memory[DOUBTS] == 0.0
    if trusted and memory[SINCE_SEARCH] < SEARCH_EVERY and memory[LAST_COUNT] >= 0.0:
        memory[SINCE_SEARCH] += 1.0
        pairs, none = np.empty((int(memory[LAST_COUNT]), 2), np.int64), np.empty(0)
        return Search(pairs, none, none, memory[LAST_NORM], memory[LAST_SECOND], memory[LAST_SUCCESS], memory[LAST_ODDS], False)
    found = search_all(f, candidates, setup)
    memory[SINCE_SEARCH], memory[LAST_COUNT] = 1.0, float(len(found.pairs))
    memory[LAST_NORM], memory[LAST_SECOND], memory[LAST_SUCCESS], memory[LAST_ODDS] = found.norm, found.second, found.success, found.odds
    return found


@kernel
def _surer(f: Filter, told: Search, free: Search, held: int) -> Search:
    """Return what GLONASS makes of a search that is not clear: other integers only where none are held, else surer odds of the same."""
    same = held < 3 or compare_integers(f.keys, free.values, f.keys, told.values)[1] == 0
    return told if told.odds > free.odds and same else free


@kernel
def _watch(f: Filter, held: Indices, free: Search, memory: Vector, setup: ResolveSetup, prediction: Vector) -> None:
    """Let the float solution speak against what is held; release it when the doubt lasts."""
    n, integers = len(held), scratch(len(held))
    write_held_differences(f, held, integers)
    norm = norm_of(f, held, integers)
    doubt = norm > NORM_LIMIT * n * 2.0
    if free.resolved:
        other, same = scratch(n), True
        for k in range(n):
            other[k] = free.values[held[k, 0] - DYNAMIC] - free.values[held[k, 1] - DYNAMIC]
            same = same and other[k] == integers[k]
        if same:
            memory[CONFIRMED] += 1.0
            least = ACCEPT_AT_ONCE if memory[OBJECTED] > 0.0 else ACCEPT_AFTER_STREAK
            if memory[CONFIRMED] >= CONFIRMATIONS and free.odds >= setup.confidence * least:
                memory[SHOWN] = 1.0
        else:
            against = free.odds >= setup.confidence * ACCEPT_AT_ONCE and free.norm <= NORM_LIMIT * len(free.pairs)
            doubt = doubt or against or log_odds(norm_of(f, held, other), norm, n) > RELEASE
    note(f, doubt, memory, prediction)


@kernel
def extends(f: Filter, free: Search, asked: float) -> bool:
    """Return whether a search that gives what is held would be believed by itself, so that its other integers are held too."""
    many = not _is_far(f) or len(free.pairs) >= FAR_COUNT
    return many and free.odds >= asked + log_space(f) and free.norm <= EXTEND_FIT * len(free.pairs)


@kernel_in_place
def note(f: Filter, doubt: bool, memory: Vector, prediction: Vector) -> None:
    """Count doubts in a row; release what is held when they last, and forget where it put the rover."""
    memory[DOUBTS] = memory[DOUBTS] + 1.0 if doubt else max(memory[DOUBTS] - 1.0, 0.0)
    if memory[DOUBTS] >= RELEASE_EPOCHS:
        let_go(f, memory, prediction)


@kernel_in_place
def let_go(f: Filter, memory: Vector, prediction: Vector) -> None:
    """Release what is held and forget where it put the rover; integers are looked for anew from the next epoch on."""
    release(f)
    prediction[:4] = np.nan
    memory[DOUBTS], memory[STREAK_EPOCHS], memory[SHOWN] = 0.0, 0.0, 0.0
    memory[TRUSTS_GLONASS], memory[GLONASS_VOTES] = 0.0, 0.0


@kernel
def fix(p: Placing, free: Search, memory: Vector, setup: ResolveSetup, prediction: Vector, time_s: float, level: float) -> Resolution:
    """Return the state that follows from what is held now (``p``); ``level`` is the variance factor of the codes (``asked_odds``)."""
    x, P, count = np.zeros(DYNAMIC), np.zeros((DYNAMIC, DYNAMIC)), len(p.pairs)
    if count < least_count(setup):
        reason = FEW_AMBIGUITIES if len(free.pairs) < setup.minimum_ambiguities else NOT_SURE
        return _resolution(reason, x, P, free, setup, 0, 0, 0.0)
    integers, street = held_differences(p.f, p.pairs), is_street(level)
    norm, predicted = place_integers(p, integers, x, P), isfinite(prediction[3])
    away = departure(x, P, prediction) if predicted else 0.0
    if predicted and street and _sigma_m(P) > WEAK_M and not _is_far(p.f):
        carry(x, P, prediction, memory[FIX_SIGMA])
    alone = stands_alone(memory, away, time_s, is_unsafe(count, level), free.odds)
    alone = alone or (street and is_left_alone(memory, count, norm / count))
    reason = _refused(p.f, p.pairs, norm, x, P, away, alone, street, memory, setup, prediction)
    grade = _grade(memory, time_s) if reason == FIX_OK else 0
    _tell(p.f, p.pairs, integers, memory, setup, grade)
    return _resolution(reason, x, P, free, setup, count, grade, norm)


@kernel_in_place
def _refused(
    f: Filter, pairs: Indices, norm: float, x: Vector, P: Matrix, away: float, alone: bool, street: bool, memory: Vector,
    setup: ResolveSetup, prediction: Vector,
) -> int:  # fmt: skip
    """Return why a fix is not shown, FIX_OK where it is: integers must fit, its place be sharp, and not far ``away`` from the prediction (a
    doubt of them, too) nor ``alone``.
    """
    sigma_m, far = _sigma_m(P), _is_far(f)
    if norm == np.inf or norm > 2.0 * NORM_LIMIT * len(pairs) or memory[DOUBTS] > 0.0 or memory[SHOWN] == 0.0:
        return NOT_VALID
    if sigma_m > (STREET_SIGMA_M if street and not far else FIX_SIGMA_M):
        return TOO_UNCERTAIN
    if away > DEPARTURE_LIMIT:
        note(f, True, memory, prediction)
        return NOT_VALID
    refused = not far and (alone or (are_bare(f, pairs) and not isfinite(setup.length_m)))
    if refused and away <= DEPARTURE_ALONE:  # not shown, but where the next one is expected from
        learn_fix(prediction, x, memory[SHARE])
    if not refused or away <= DEPARTURE_ALONE:
        memory[FIX_SIGMA] = sigma_m
    return NOT_VALID if refused else FIX_OK


@kernel_in_place
def _grade(memory: Vector, time_s: float) -> int:
    """Return how proven the integers of a fix are: 1, 2 once a search has confirmed them, and one more after many over some seconds."""
    lasting = memory[CONFIRMED] >= STREAK_EPOCHS_LEAST and time_s - memory[HELD_SINCE_S] >= STREAK_S
    return 1 + (1 if memory[CONFIRMED] > 0.0 else 0) + (1 if lasting else 0)


@kernel
def _resolution(reason: int, x: Vector, P: Matrix, free: Search, setup: ResolveSetup, count: int, grade: int, norm: float) -> Resolution:
    """Return what came of so many held integers, and what the free search says."""
    fixed = reason == FIX_OK
    ratio = min(free.second / max(free.norm, 1e-9), 9999.9) if free.second < np.inf else 0.0
    threshold = ratio_for(len(free.pairs), setup.confidence * ACCEPT_AT_ONCE)
    return Resolution(reason, fixed, x, P, ratio, free.odds, threshold, free.success, count if fixed else 0, grade, norm)


@kernel_in_place
def _sigma_m(P: Matrix) -> float:
    """Return the sigma of a position in 3D (m)."""
    return sqrt(max(P[0, 0] + P[1, 1] + P[2, 2], 0.0))


@kernel_in_place
def least_count(setup: ResolveSetup) -> int:
    """Return how many integers a fix must have: four may do where a length that is known constrains them."""
    return min(setup.minimum_ambiguities, 4) if isfinite(setup.length_m) else setup.minimum_ambiguities


@kernel_in_place
def _is_far(f: Filter) -> bool:
    """Return whether the informed filter has a say."""
    return f.x[0] ** 2 + f.x[1] ** 2 + f.x[2] ** 2 > FAR_M**2


@kernel_in_place
def _tell(f: Filter, pairs: Indices, integers: Vector, memory: Vector, setup: ResolveSetup, grade: int) -> None:
    """In fix-and-hold, tell the filter of integers that have proven themselves (softly, so that it can still object)."""
    if setup.hold_after < 0 or grade < 3 or memory[CONFIRMED] < setup.hold_after:
        return
    tell(f, pairs, integers, setup.hold_variance_cyc2)


@kernel_in_place
def ratio_for(count: int, odds: float) -> float:
    """Return the ratio that gives these odds when the best norm is what is expected of it (its count)."""
    if count == 0:
        return 0.0
    return (exp(min(2.0 * odds / (PRIOR_DOF + count), 50.0)) * (PRIOR_DOF + count) - PRIOR_DOF) / count
