"""Which integers are believed, for how long, and why.

Integers are *held* once they have proven themselves; the filter itself never learns of them (except in fix-and-hold), so it stays an
independent witness: every epoch the free search and the float solution can speak against what is held. New ambiguities join one by one
when what is held determines them. All thresholds are log odds (see ``ambiguity.log_odds``), so they adapt to the strength of the model.
"""

from math import exp, inf, isfinite, log, nan, sqrt
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.gnss.signals import GLONASS, SATELLITES_PER_SYSTEM
from rtkmesh.rtk.ambiguity import (
    NODE_LIMIT,
    PRIOR_DOF,
    Candidates,
    Search,
    add_constraints,
    compare_integers,
    condition,
    held_differences,
    held_references,
    log_odds,
    pack_pairs,
    pairs_of,
    search,
    search_pairs,
    take,
)
from rtkmesh.rtk.filter import posterior
from rtkmesh.rtk.lambda_search import OK
from rtkmesh.rtk.options import AmbiguityMode, AmbiguityOptions
from rtkmesh.rtk.solution import Reason
from rtkmesh.rtk.state import ARC_EPOCHS, ARC_S, DYNAMIC, INTEGER, SLOPE_KEY, STREAK, Filter, place_of

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

ACCEPT_AT_ONCE: Final = 7.0  # log odds for a fix from one search: of 4400 searches above 5.5 on recordings none was wrong
ACCEPT_AFTER_STREAK: Final = 5.0  # log odds for a fix from a row of searches with equal results
STREAK_S: Final = 10.0
WEAK_STREAK_S: Final = 30.0  # with few ambiguities: code multipath must have changed in between
WEAK_COUNT: Final = 8
STREAK_EPOCHS_LEAST: Final = 5
RELEASE: Final = 6.0  # log odds of another vector against the held one at which doubt counts
RELEASE_EPOCHS: Final = 3
NORM_LIMIT: Final = 8.0  # squared norm per ambiguity that honest float solutions do not exceed
JOIN_ODDS: Final = 9.0  # log odds for ambiguities that join the held ones, whose norm has set the scale
JOIN_TRIES: Final = 4  # all of the new ones, then without the newer, at last the oldest alone
SLOPE_SIGMA_M: Final = 0.03  # per channel between makes (Wanninger 2012, J. Geodesy 86:139-148: up to 25 mm on L1)
SLOPE_CHANGE_M: Final = 5e-4  # what a slope may change over a reset
PREDICTION_LIMIT_M: Final = 0.05  # by how much a fix may leave the prediction, beyond 4 sigma of both
PREDICTION_FLOOR_M: Final = 0.02  # sigma of a prediction beside that of the motion since the last fix
SHARP_M: Final = 0.25  # beyond this a prediction tells little that the float solution does not
SELF_RELIANT: Final = 5  # so many held integers need no prediction
LARGE_COUNT: Final = 24
SEARCH_EVERY: Final = 5  # epochs between free searches of a large set that has been confirmed
GLONASS_EPOCHS: Final = 10  # epochs in which GLONASS must have fitted before it is trusted
FIX_SIGMA_M: Final = 0.15  # a fix must be this good: who reads FIX expects centimetres
STRONG_COUNT: Final = 20  # with so many ambiguities that fit, ACCEPT_MANY is enough: their norm is a test in itself
ACCEPT_MANY: Final = 5.5
SURE: Final = 8.0  # log odds from which a new fix is shown at once, like one that fits well; others must be confirmed
GOOD_FIT: Final = 1.0  # squared norm per ambiguity of integers of all candidates that fit well
CONFIRMATIONS: Final = 3
SUBSET_TRIES: Final = 8
NEW_S: Final = (0.0, 5.0, 20.0)  # subsets leave out what is younger

# Reasons as numbers, for kernels.
FIX_OK, FEW_AMBIGUITIES, NOT_SURE, TOO_UNCERTAIN, NOT_VALID, SWITCHED_OFF = (int(reason) for reason in (
    Reason.OK, Reason.FEW_AMBIGUITIES, Reason.RATIO, Reason.FLOAT_TOO_UNCERTAIN, Reason.VALIDATION, Reason.AMBIGUITY_OFF
))  # fmt: skip


# What is remembered of one filter from epoch to epoch, in the memory of ``resolve``. SLOPE and SLOPE_SIGMA (m) are those of GLONASS phase
# biases per channel; LAST_* are numbers of the last free search; truth values are 0.0 and 1.0.
(
    STREAK_START_S, STREAK_EPOCHS, DOUBTS, HELD_SINCE_S, CONFIRMED, SHOWN, SINCE_SEARCH, TRUSTS_GLONASS, GLONASS_VOTES, SLOPE, SLOPE_SIGMA,
    LAST_COUNT, LAST_NORM, LAST_SECOND, LAST_SUCCESS, LAST_ODDS,
) = range(16)  # fmt: skip
MEMORY: Final = 16


class ResolveSetup(NamedTuple):
    """Options of ambiguity resolution for kernels; ``confidence`` is the factor on log odds, ``length_m`` NaN where it is not known.

    With ``hold_after`` >= 0 the filter is told of integers that as many searches have confirmed, with this variance (cycles squared).
    """

    confidence: float
    minimum_ambiguities: int
    length_m: float
    length_sigma_m: float
    hold_variance_cyc2: float
    hold_after: int


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


def resolve_setup(options: AmbiguityOptions, length_m: float | None, length_sigma_m: float) -> ResolveSetup:
    """Return the options for kernels; ``length_m`` is the known length of the baseline."""
    after = options.hold_after_epochs if options.mode is AmbiguityMode.FIX_AND_HOLD else -1
    return ResolveSetup(
        confidence(options.ratio), options.minimum_ambiguities, nan if length_m is None else length_m, length_sigma_m,
        options.hold_variance_cyc2, after,
    )  # fmt: skip


def new_memory() -> Vector:
    """Return the memory of a filter that has resolved nothing."""
    memory = np.zeros(MEMORY)
    memory[SLOPE_SIGMA] = SLOPE_SIGMA_M
    forget(memory)
    return memory


def forget(memory: Vector) -> None:
    """Forget the integers; what was learned of GLONASS belongs to the receivers and stays."""
    kept = memory[[TRUSTS_GLONASS, SLOPE, SLOPE_SIGMA]]
    memory[:] = 0.0
    memory[[STREAK_START_S, HELD_SINCE_S]] = inf
    memory[LAST_COUNT] = -1.0
    memory[[TRUSTS_GLONASS, SLOPE, SLOPE_SIGMA]] = kept


@kernel
def not_resolved() -> Resolution:
    """Return the resolution of an epoch in which no integers were looked for."""
    return Resolution(SWITCHED_OFF, False, np.zeros(DYNAMIC), np.zeros((DYNAMIC, DYNAMIC)), 0.0, 0.0, 0.0, 0.0, 0, 0, 0.0)


@kernel
def resolve(f: Filter, everything: Candidates, memory: Vector, setup: ResolveSetup, prediction: Vector, time_s: float) -> Resolution:
    """Find or keep integers for this epoch; ``prediction`` is where the last fix and time differences of the phase put the baseline (m,
    ECEF) and its sigma, NaN without.
    """
    candidates = everything if memory[TRUSTS_GLONASS] > 0.0 else take(everything, everything.satellite // SATELLITES_PER_SYSTEM != GLONASS)
    held = pairs_of(take(everything, _is_held(f, everything)))
    free = _free_search(f, candidates, len(held), memory, setup)
    if len(held) >= 3:
        _watch(f, held, free, memory, setup, prediction)
        held = pairs_of(take(everything, _is_held(f, everything)))
    helped = prediction[3] <= SHARP_M and len(held) < SELF_RELIANT
    aided = with_prediction(f, prediction) if helped else f
    if len(held) < 3:
        _try_new(f, aided, helped, candidates, everything, free, memory, setup, time_s)
    else:
        _join(f, aided, candidates, held)
        _learn_glonass(f, everything, held, memory, setup)
    return _fix(f, everything, free, memory, setup, prediction, time_s)


@kernel
def with_prediction(f: Filter, prediction: Vector) -> Filter:
    """Return the filter that also knows where the last fix and the phases since put the rover."""
    n, variance = len(f.x), (PREDICTION_FLOOR_M + prediction[3]) ** 2
    x, P, gain = f.x.copy(), f.P.copy(), np.empty(n)
    for i in range(3):
        spread = P[i, i] + variance
        innovation = prediction[i] - x[i]
        for a in range(n):
            gain[a] = P[a, i] / spread
            x[a] += gain[a] * innovation
        for a in range(n):
            for b in range(n):
                P[a, b] -= gain[a] * gain[b] * spread
    return Filter(x, P, f.keys, f.history)


@kernel
def _is_held(f: Filter, candidates: Candidates) -> NDArray[np.bool_]:
    out = np.empty(len(candidates.row), np.bool_)
    for k in range(len(out)):
        out[k] = isfinite(f.history[candidates.row[k], INTEGER])
    return out


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
    found = search(f, candidates, setup.length_m, setup.length_sigma_m)
    memory[SINCE_SEARCH], memory[LAST_COUNT] = 1.0, float(len(found.pairs))
    memory[LAST_NORM], memory[LAST_SECOND], memory[LAST_SUCCESS], memory[LAST_ODDS] = found.norm, found.second, found.success, found.odds
    return found


@kernel
def _try_new(
    f: Filter, aided: Filter, helped: bool, candidates: Candidates, everything: Candidates, free: Search, memory: Vector,
    setup: ResolveSetup, time_s: float,
) -> None:  # fmt: skip
    """Look for integers without any that are held; ``aided`` is the filter that knows a prediction, where that ``helped``."""
    _release(f)
    memory[HELD_SINCE_S] = np.inf
    best, level, penalty, wide = free, f, 0.0, False
    if not _strong(best, 0.0, setup) and helped and len(candidates.row) > 1:
        found = _search(aided, candidates, setup)
        best = found if found.odds > best.odds else best
    if not _strong(best, 0.0, setup) and len(candidates.row) > 1:
        other = _best_subset(f, candidates, setup, time_s)
        if other.odds > best.odds:
            best, penalty = other, log(SUBSET_TRIES)
        if len(everything.row) > len(candidates.row):
            flat = without_slope(f)
            sloped, straight = _search(f, everything, setup), _search(flat, everything, setup)
            with_glonass = straight if straight.odds > sloped.odds else sloped
            if with_glonass.odds > best.odds:
                best, penalty, wide = with_glonass, log(SUBSET_TRIES), True
                level = flat if straight.odds > sloped.odds else f
    if not best.resolved or len(best.pairs) < setup.minimum_ambiguities:
        memory[STREAK_EPOCHS] = 0.0
        return
    _follow(f, best, memory, time_s)
    lasting_s = STREAK_S if len(best.pairs) >= WEAK_COUNT else WEAK_STREAK_S
    persistent = memory[STREAK_EPOCHS] >= STREAK_EPOCHS_LEAST and time_s - memory[STREAK_START_S] >= lasting_s
    likely = persistent and best.odds >= setup.confidence * ACCEPT_AFTER_STREAK + penalty
    if not (likely or _strong(best, penalty, setup)) or best.norm > NORM_LIMIT * len(best.pairs):
        return
    if wide:  # the slope that GLONASS fits with is known now
        f.x[:], f.P[:, :] = level.x, level.P
        memory[TRUSTS_GLONASS] = 1.0
    _hold(f, best)
    memory[HELD_SINCE_S], memory[DOUBTS], memory[CONFIRMED] = time_s, 0.0, 0.0
    good = penalty == 0.0 and best.norm <= GOOD_FIT * len(best.pairs)
    memory[SHOWN] = 1.0 if good or best.odds >= setup.confidence * SURE or len(best.pairs) >= STRONG_COUNT else 0.0


@kernel
def _search(f: Filter, candidates: Candidates, setup: ResolveSetup) -> Search:
    return search(f, candidates, setup.length_m, setup.length_sigma_m)


@kernel
def _best_subset(f: Filter, candidates: Candidates, setup: ResolveSetup, time_s: float) -> Search:
    """Search without the newest ambiguities, and without each of the weakest satellites in turn; return the one with the best odds."""
    n = len(candidates.row)
    best, mask, tries = search(f, take(candidates, np.zeros(n, np.bool_)), setup.length_m, setup.length_sigma_m), np.empty(n, np.bool_), 0
    for age_s in NEW_S:
        for k in range(n):
            mask[k] = time_s - f.history[candidates.row[k], ARC_S] > age_s
        best = _better(f, candidates, mask, best, setup)
        tries += 1
    left = np.ones(n, np.bool_)  # satellites that have not been left out yet
    while tries < SUBSET_TRIES:
        weakest = -1
        for k in range(n):
            first = k == 0 or candidates.satellite[k] != candidates.satellite[k - 1]
            if left[k] and first and (weakest < 0 or candidates.weight[k] < candidates.weight[weakest]):
                weakest = k
        if weakest < 0:
            break
        for k in range(n):
            mask[k] = candidates.satellite[k] != candidates.satellite[weakest]
        left[weakest] = False
        best = _better(f, candidates, mask, best, setup)
        tries += 1
    return best


@kernel
def _better(f: Filter, candidates: Candidates, mask: NDArray[np.bool_], best: Search, setup: ResolveSetup) -> Search:
    """Return the search of a subset (no less than five, not all) if its odds are better."""
    count = 0
    for kept in mask:
        count += 1 if kept else 0
    if not 4 < count < len(mask):
        return best
    found = _search(f, take(candidates, mask), setup)
    return found if found.odds > best.odds else best


@kernel
def without_slope(f: Filter) -> Filter:
    """Return the filter under the hypothesis that GLONASS phases have no slope (receivers of one make)."""
    slope = place_of(f.keys, SLOPE_KEY)
    if slope < 0:
        return f
    n, i = len(f.x), DYNAMIC + slope
    x, P = f.x.copy(), f.P.copy()
    for a in range(n):
        gain = f.P[a, i] / f.P[i, i]
        x[a] -= gain * f.x[i]
        for b in range(n):
            P[a, b] -= gain * f.P[i, b]
    for a in range(n):
        P[a, i], P[i, a] = 0.0, 0.0
    x[i], P[i, i] = 0.0, SLOPE_CHANGE_M**2
    return Filter(x, P, f.keys, f.history)


@kernel
def _learn_glonass(f: Filter, everything: Candidates, held: Indices, memory: Vector, setup: ResolveSetup) -> None:
    """Trust GLONASS integers once they agree with those of the others, with a slope that fits; remember the slope."""
    slope, count = place_of(f.keys, SLOPE_KEY), 0
    for satellite in everything.satellite:
        count += 1 if satellite // SATELLITES_PER_SYSTEM == GLONASS else 0
    if slope < 0 or count < 3:
        return
    if memory[TRUSTS_GLONASS] > 0.0:
        x, P, wanted = np.empty(1), np.empty((1, 1)), np.full(1, DYNAMIC + slope)
        if isfinite(condition(f.x, f.P, held, held_differences(f, held), 0.0, wanted, x, P)):
            memory[SLOPE], memory[SLOPE_SIGMA] = x[0], sqrt(max(P[0, 0], 0.0)) + SLOPE_CHANGE_M
        return
    wide = _search(f, everything, setup)
    fits = wide.resolved and wide.odds >= setup.confidence * ACCEPT_AT_ONCE and wide.norm <= NORM_LIMIT * len(wide.pairs)
    if not fits or compare_integers(f.keys, f.history[:, INTEGER].copy(), f.keys, wide.values)[1] > 0:
        memory[GLONASS_VOTES] = 0.0
        return
    memory[GLONASS_VOTES] += 1.0
    if memory[GLONASS_VOTES] >= GLONASS_EPOCHS:
        memory[TRUSTS_GLONASS] = 1.0


@kernel
def _strong(found: Search, penalty: float, setup: ResolveSetup) -> bool:
    count = len(found.pairs)
    if not found.resolved or count < setup.minimum_ambiguities:
        return False
    many = count >= STRONG_COUNT and found.norm <= 0.25 * NORM_LIMIT * count
    return found.odds >= setup.confidence * (ACCEPT_MANY if many else ACCEPT_AT_ONCE) + penalty


@kernel
def _follow(f: Filter, found: Search, memory: Vector, time_s: float) -> None:
    """Count for how long searches have given the same integers."""
    common, different = compare_integers(f.keys, f.history[:, STREAK].copy(), f.keys, found.values)
    if different > 0 or common < 3:
        memory[STREAK_START_S], memory[STREAK_EPOCHS] = time_s, 0.0
    memory[STREAK_EPOCHS] += 1.0
    f.history[:, STREAK] = found.values


@kernel
def _watch(f: Filter, held: Indices, free: Search, memory: Vector, setup: ResolveSetup, prediction: Vector) -> None:
    """Let the float solution speak against what is held; release it when the doubt lasts."""
    integers, n = held_differences(f, held), len(held)
    norm = _norm(f, held, integers)
    doubt = norm > NORM_LIMIT * n * 2.0
    if free.resolved:
        other, same = np.empty(n), True
        for k in range(n):
            other[k] = free.values[held[k, 0] - DYNAMIC] - free.values[held[k, 1] - DYNAMIC]
            same = same and other[k] == integers[k]
        if same:
            memory[CONFIRMED] += 1.0
            if memory[CONFIRMED] >= CONFIRMATIONS and free.odds >= setup.confidence * ACCEPT_AFTER_STREAK:
                memory[SHOWN] = 1.0
        else:
            doubt = doubt or log_odds(_norm(f, held, other), norm, n) > RELEASE
    _note(f, doubt, memory, prediction)


@kernel
def _norm(f: Filter, pairs: Indices, integers: Vector) -> float:
    """Return the squared norm of integers against the float ambiguities."""
    return condition(f.x, f.P, pairs, integers, 0.0, np.empty(0, np.int64), np.empty(0), np.empty((0, 0)))


@kernel
def _note(f: Filter, doubt: bool, memory: Vector, prediction: Vector) -> None:
    """Count doubts in a row; release what is held when they last, and forget where it put the rover."""
    memory[DOUBTS] = memory[DOUBTS] + 1.0 if doubt else max(memory[DOUBTS] - 1.0, 0.0)
    if memory[DOUBTS] >= RELEASE_EPOCHS:
        _release(f)
        prediction[:4] = np.nan
        memory[DOUBTS], memory[STREAK_EPOCHS], memory[SHOWN] = 0.0, 0.0, 0.0
        memory[TRUSTS_GLONASS], memory[GLONASS_VOTES] = 0.0, 0.0


@kernel
def _join(f: Filter, aided: Filter, candidates: Candidates, held: Indices) -> None:
    """Give integers to ambiguities that the held ones (and a prediction) determine: all of the new ones, or without the newer, at last the
    oldest alone.
    """
    known = _is_held(f, candidates)
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
        if _join_older(f, rows, references, pairs, ages[place], x, P, scale):
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
def _join_older(f: Filter, rows: Indices, references: Indices, pairs: Indices, least: float, x: Vector, P: Matrix, scale: float) -> bool:
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
    if status != OK or norms[1] - norms[0] < 2.0 * JOIN_ODDS * scale or norms[0] > NORM_LIMIT * scale * count:
        return False
    for i in range(count):
        f.history[rows[chosen[i]], INTEGER] = f.history[references[chosen[i]], INTEGER] + fixed[0, i]
    return True


@kernel
def _fix(
    f: Filter, candidates: Candidates, free: Search, memory: Vector, setup: ResolveSetup, prediction: Vector, time_s: float
) -> Resolution:
    """Return the state that follows from what is held now."""
    pairs, x, P = pairs_of(take(candidates, _is_held(f, candidates))), np.zeros(DYNAMIC), np.zeros((DYNAMIC, DYNAMIC))
    count, grade, sigma_m, norm = len(pairs), 0, np.nan, 0.0
    if count < 4:
        reason = FEW_AMBIGUITIES if len(free.pairs) < setup.minimum_ambiguities else NOT_SURE
    else:
        integers = held_differences(f, pairs)
        norm = condition(f.x, f.P, pairs, integers, 0.0, np.arange(DYNAMIC), x, P)
        sigma_m = sqrt(max(P[0, 0] + P[1, 1] + P[2, 2], 0.0))
        reason = FIX_OK
        if norm == np.inf or norm > 2.0 * NORM_LIMIT * count or memory[DOUBTS] > 0.0 or memory[SHOWN] == 0.0:
            reason = NOT_VALID
        elif sigma_m > FIX_SIGMA_M:
            reason = TOO_UNCERTAIN
        elif isfinite(prediction[3]) and _distance_m(x, prediction) > PREDICTION_LIMIT_M + 4.0 * (prediction[3] + sigma_m):
            _note(f, True, memory, prediction)
            reason = NOT_VALID
        else:
            grade = 1 + (1 if memory[CONFIRMED] > 0.0 else 0)
            if memory[CONFIRMED] >= STREAK_EPOCHS_LEAST and time_s - memory[HELD_SINCE_S] >= STREAK_S:
                grade += 1
            _tell(f, pairs, integers, memory, setup, grade)
    ratio = min(free.second / max(free.norm, 1e-9), 9999.9) if free.second < np.inf else 0.0
    threshold = ratio_for(len(free.pairs), setup.confidence * ACCEPT_AT_ONCE)
    fixed = reason == FIX_OK
    return Resolution(reason, fixed, x, P, ratio, free.odds, threshold, free.success, count if fixed else 0, grade, norm)


@kernel
def _distance_m(x: Vector, prediction: Vector) -> float:
    return sqrt((x[0] - prediction[0]) ** 2 + (x[1] - prediction[1]) ** 2 + (x[2] - prediction[2]) ** 2)


@kernel
def _tell(f: Filter, pairs: Indices, integers: Vector, memory: Vector, setup: ResolveSetup, grade: int) -> None:
    """In fix-and-hold, tell the filter of integers that have proven themselves (softly, so that it can still object)."""
    if setup.hold_after < 0 or grade < 3 or memory[CONFIRMED] < setup.hold_after:
        return
    n = len(f.x)
    N, b, P, dx = np.zeros((n, n)), np.zeros(n), np.empty((n, n)), np.empty(n)
    add_constraints(pairs, f.x, integers, setup.hold_variance_cyc2, N, b)
    if posterior(f.P, N, b, P, dx) == OK:
        for i in range(n):
            f.x[i] += dx[i]
            f.P[i, :] = P[i]


@kernel
def _hold(f: Filter, found: Search) -> None:
    """Make these integers the held ones, and only these; a group's reference gets its rounded float value."""
    _release(f)
    for k in range(len(found.pairs)):
        state, reference = found.pairs[k, 0], found.pairs[k, 1]
        f.history[reference - DYNAMIC, INTEGER] = np.rint(f.x[reference])
    for k in range(len(found.pairs)):
        state, reference = found.pairs[k, 0], found.pairs[k, 1]
        f.history[state - DYNAMIC, INTEGER] = f.history[reference - DYNAMIC, INTEGER] + found.integers[k]


@kernel
def _release(f: Filter) -> None:
    f.history[:, INTEGER] = np.nan


def confidence(ratio: float) -> float:
    """Return the factor on log odds that a ratio asks for: 1 at 3, by the odds of that ratio for ten honest ambiguities."""
    return log((PRIOR_DOF + 10.0 * max(ratio, 1.05)) / (PRIOR_DOF + 10.0)) / log((PRIOR_DOF + 30.0) / (PRIOR_DOF + 10.0))


@kernel
def ratio_for(count: int, odds: float) -> float:
    """Return the ratio that gives these odds when the best norm is what is expected of it (its count)."""
    if count == 0:
        return 0.0
    return (exp(min(2.0 * odds / (PRIOR_DOF + count), 50.0)) * (PRIOR_DOF + count) - PRIOR_DOF) / count
