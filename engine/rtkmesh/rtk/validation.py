"""Which integers are believed, for how long, and why.

Integers are *held* once they have proven themselves; the filter itself never learns of them (except in fix-and-hold), so it stays an
independent witness: every epoch the free search and the float solution can speak against what is held. New ambiguities join one by one
when what is held determines them. All thresholds are log odds (see ``ambiguity.log_odds``), so they adapt to the strength of the model.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from math import exp, inf, log, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.signals import GLONASS, SATELLITES_PER_SYSTEM
from rtkmesh.rtk.ambiguity import (
    NODE_LIMIT,
    PRIOR_DOF,
    choose_references,
    compare_integers,
    condition,
    held_differences,
    held_references,
    log_odds,
    pack_pairs,
    search_pairs,
)
from rtkmesh.rtk.lambda_search import OK
from rtkmesh.rtk.options import AmbiguityMode, AmbiguityOptions
from rtkmesh.rtk.solution import Reason
from rtkmesh.rtk.state import ARC_EPOCHS, ARC_S, INTEGER, SLOPE_KEY, FilterState, length_m

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

ACCEPT_AT_ONCE: Final = 8.5  # log odds for a fix from one search
ACCEPT_AFTER_STREAK: Final = 5.0  # log odds for a fix from a row of searches with equal results
STREAK_S: Final = 10.0
WEAK_STREAK_S: Final = 30.0  # with few ambiguities: code multipath must have changed in between
WEAK_COUNT: Final = 8
STREAK_EPOCHS: Final = 5
RELEASE: Final = 5.0  # log odds of another vector against the held one at which doubt counts
RELEASE_EPOCHS: Final = 3
NORM_LIMIT: Final = 8.0  # squared norm per ambiguity that honest float solutions do not exceed
JOIN_ODDS: Final = 9.0  # log odds for ambiguities that join the held ones, whose norm has set the scale
JOIN_TRIES: Final = 4  # all of the new ones, then without the newer, at last the oldest alone
SLOPE_SIGMA_M: Final = 0.03  # per channel between makes (Wanninger 2012, J. Geodesy 86:139-148: up to 25 mm on L1)
SLOPE_CHANGE_M: Final = 5e-4  # what a slope may change over a reset
PREDICTION_LIMIT_M: Final = 0.05  # by how much a fix may leave the prediction, beyond 4 sigma of both
CONSTRAINED_CANDIDATES: Final = 40  # how many candidates a known length chooses from
LARGE_COUNT: Final = 24
SEARCH_EVERY: Final = 5  # epochs between free searches of a large set that has been confirmed
GLONASS_VOTES: Final = 10  # epochs in which GLONASS must have fitted before it is trusted
FIX_SIGMA_M: Final = 0.30  # a fix must be this good, or too few of its ambiguities are known
STRONG_COUNT: Final = 20  # with so many ambiguities that fit, ACCEPT_MANY is enough: their norm is a test in itself
ACCEPT_MANY: Final = 5.5
SURE: Final = 11.0  # log odds from which a new fix is shown at once; with less it must be confirmed
CONFIRMATIONS: Final = 3
SUBSET_TRIES: Final = 8


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """The ambiguities of this epoch that may become integers; all columns go together.

    ``row`` is the place in the filter's keys, ``group`` the clock group, ``weight`` says which makes the better reference.
    """

    row: Indices
    group: Indices
    satellite: Indices
    weight: Vector

    def take(self, mask: NDArray[np.bool_]) -> "Candidates":
        """Return those of the mask."""
        return Candidates(self.row[mask], self.group[mask], self.satellite[mask], self.weight[mask])

    def __len__(self) -> int:
        return len(self.row)


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Where the last fix and time differences of the phase put the baseline (m, ECEF), and how sure that is (one sigma)."""

    baseline_ecef_m: Vector
    sigma_m: float


@dataclass(frozen=True, slots=True)
class LengthConstraint:
    """Known length of the baseline (m) and its sigma."""

    length_m: float
    sigma_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """Result of one free search: (state, reference) pairs, their integers, and how sure they are.

    ``values`` goes with the filter's keys: the integers with that of each group's reference set to 0, NaN for keys not in the search.
    """

    pairs: Indices
    integers: Vector
    values: Vector
    norm: float
    second: float
    success: float
    odds: float
    resolved: bool

    @property
    def ratio(self) -> float:
        """Second-best over best squared norm."""
        return min(self.second / max(self.norm, 1e-9), 9999.9) if self.second < inf else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Resolution:
    """What ambiguity resolution gave in one epoch. ``x`` and ``P`` are the fixed dynamic states; None without a fix."""

    reason: Reason
    x: Vector | None = None
    P: Matrix | None = None
    pairs: Indices | None = None
    integers: Vector | None = None
    ratio: float = 0.0
    odds: float = 0.0
    threshold: float = 0.0
    success: float = 0.0
    count: int = 0
    grade: int = 0


class Validation:
    """The memory of validated integers of one filter. Mutable."""

    def __init__(self, options: AmbiguityOptions, constraint: LengthConstraint | None = None) -> None:
        self.options = options
        self._constraint = constraint
        self._confidence = confidence(options.ratio)
        self._streak_start_s = inf
        self._streak_epochs = 0
        self._streak_keys: Indices = np.zeros(0, np.int64)
        self._streak_values: Vector = np.zeros(0)
        self._doubts = 0
        self._held_since_s = inf
        self._confirmed = 0
        self._shown = False
        self._since_search = 0
        self._last: Search | None = None
        self._glonass = False
        self._glonass_votes = 0
        self.slope = (0.0, SLOPE_SIGMA_M)  # of GLONASS phase biases per channel, and its sigma

    def reset(self) -> None:
        """Forget the integers; what was learned of GLONASS belongs to the receivers and stays."""
        glonass, slope = self._glonass, self.slope
        self.__init__(self.options, self._constraint)
        self._glonass, self.slope = glonass, slope

    def resolve(self, state: FilterState, candidates: Candidates, prediction: Prediction | None = None) -> Resolution:
        """Find or keep integers for this epoch."""
        if self.options.mode is AmbiguityMode.OFF:
            return Resolution(Reason.AMBIGUITY_OFF)
        everything = candidates
        if not self._glonass:
            candidates = everything.take(everything.satellite // SATELLITES_PER_SYSTEM != GLONASS)
        held_pairs = _pairs(state, _held(state, everything))
        free = self._free_search(state, candidates, len(held_pairs))
        if len(held_pairs) >= 3:
            self._watch(state, held_pairs, free)
            held_pairs = _pairs(state, _held(state, everything))
        if len(held_pairs) < 3:
            self._try_new(state, candidates, everything, free)
        else:
            self._join(state, candidates, held_pairs)
            self._learn_glonass(state, everything, held_pairs)
        return self._fix(state, everything, free, prediction)

    def _free_search(self, state: FilterState, candidates: Candidates, held: int) -> Search:
        """Search without regard to what is held; of a large set that has proven itself only every few epochs.

        In between the last search's numbers stand for it, not resolved.
        """
        trusted = held >= LARGE_COUNT and self._confirmed >= STREAK_EPOCHS and self._doubts == 0
        if trusted and self._since_search < SEARCH_EVERY and self._last is not None:
            self._since_search += 1
            return replace(self._last, resolved=False)
        self._since_search, self._last = 1, self._search(state, candidates)
        return self._last

    def _try_new(self, state: FilterState, candidates: Candidates, everything: Candidates, free: Search) -> None:
        """Look for integers without any that are held."""
        _release(state)
        self._held_since_s = inf
        best, wide, level = free, free, state
        if not self._strong(best, 0.0) and len(candidates) > 1:
            searches = [free, *self._subsets(state, candidates)]
            if len(everything) > len(candidates):
                level = _without_slope(state)
                wide = max(self._search(state, everything), flat := self._search(level, everything), key=lambda search: search.odds)
                level = level if wide is flat else state
                searches.append(wide)
            best = max(searches, key=lambda search: search.odds)
        if not best.resolved or len(best.pairs) < self.options.minimum_ambiguities:
            self._streak_epochs = 0
            return
        self._follow(state, best)
        penalty = 0.0 if best is free else log(SUBSET_TRIES)
        lasting_s = STREAK_S if len(best.pairs) >= WEAK_COUNT else WEAK_STREAK_S
        persistent = self._streak_epochs >= STREAK_EPOCHS and state.time_s - self._streak_start_s >= lasting_s
        if self._strong(best, penalty) or (persistent and best.odds >= self._confidence * ACCEPT_AFTER_STREAK + penalty):
            if best.norm > NORM_LIMIT * len(best.pairs):
                return
            if best is wide and wide is not free:  # the slope that GLONASS fits with is known now
                state.x, state.cov, self._glonass = level.x, level.cov, True
            _hold(state, best.pairs, best.integers)
            self._held_since_s, self._doubts, self._confirmed = state.time_s, 0, 0
            self._shown = best.odds >= self._confidence * SURE or len(best.pairs) >= STRONG_COUNT

    def _learn_glonass(self, state: FilterState, everything: Candidates, held_pairs: Indices) -> None:
        """Trust GLONASS integers once they agree with those of the others, with a slope that fits; remember the slope."""
        slope = int(state.keys.searchsorted(SLOPE_KEY))
        if slope == len(state.keys) or state.keys[slope] != SLOPE_KEY:
            return
        if np.count_nonzero(everything.satellite // SATELLITES_PER_SYSTEM == GLONASS) < 3:
            return
        if self._glonass:
            x, P = np.empty(1), np.empty((1, 1))
            condition(state.x, state.cov, held_pairs, _held_integers(state, held_pairs), 0.0, np.full(1, state.dynamic + slope), x, P)
            self.slope = (float(x[0]), sqrt(max(float(P[0, 0]), 0.0)) + SLOPE_CHANGE_M)
            return
        wide = self._search(state, everything)
        fits = wide.resolved and wide.odds >= self._confidence * ACCEPT_AT_ONCE and wide.norm <= NORM_LIMIT * len(wide.pairs)
        if not fits or compare_integers(state.keys, state.history[:, INTEGER].copy(), state.keys, wide.values)[1] > 0:
            self._glonass_votes = 0
            return
        self._glonass_votes += 1
        if self._glonass_votes >= GLONASS_VOTES:
            self._glonass = True

    def _strong(self, search: Search, penalty: float) -> bool:
        count = len(search.pairs)
        if not search.resolved or count < self.options.minimum_ambiguities:
            return False
        many = count >= STRONG_COUNT and search.norm <= 0.25 * NORM_LIMIT * count
        return search.odds >= self._confidence * (ACCEPT_MANY if many else ACCEPT_AT_ONCE) + penalty

    def _follow(self, state: FilterState, search: Search) -> None:
        """Count for how long searches have given the same integers."""
        common, different = compare_integers(self._streak_keys, self._streak_values, state.keys, search.values)
        if different > 0 or common < 3:
            self._streak_start_s, self._streak_epochs = state.time_s, 0
        self._streak_epochs += 1
        self._streak_keys, self._streak_values = state.keys, search.values

    def _watch(self, state: FilterState, pairs: Indices, free: Search) -> None:
        """Let the float solution speak against what is held; release it when the doubt lasts."""
        integers = _held_integers(state, pairs)
        norm = condition(state.x, state.cov, pairs, integers, 0.0, _NOTHING, _NO_VECTOR, _NO_MATRIX)
        doubt = norm > NORM_LIMIT * len(pairs) * 2.0
        if free.resolved:
            other = free.values[pairs[:, 0] - state.dynamic] - free.values[pairs[:, 1] - state.dynamic]
            if np.array_equal(other, integers):
                self._confirmed += 1
                self._shown = self._shown or (self._confirmed >= CONFIRMATIONS and free.odds >= self._confidence * ACCEPT_AFTER_STREAK)
            else:
                best = condition(state.x, state.cov, pairs, other, 0.0, _NOTHING, _NO_VECTOR, _NO_MATRIX)
                doubt = doubt or log_odds(best, norm, len(pairs)) > RELEASE
        self._note(state, doubt)

    def _note(self, state: FilterState, doubt: bool) -> None:
        """Count doubts in a row; release what is held when they last."""
        self._doubts = self._doubts + 1 if doubt else max(self._doubts - 1, 0)
        if self._doubts >= RELEASE_EPOCHS:
            _release(state)
            self._doubts, self._streak_epochs, self._glonass, self._glonass_votes, self._shown = 0, 0, False, 0, False

    def _join(self, state: FilterState, candidates: Candidates, held_pairs: Indices) -> None:
        """Give integers to ambiguities that the held ones determine."""
        history = state.history
        known = np.isfinite(history[candidates.row, INTEGER])
        new = candidates.take(~known & (history[candidates.row, ARC_EPOCHS] >= 1.0))
        if len(new) == 0:
            return
        held = candidates.take(known)
        nearest = np.empty(len(new), np.int64)
        if held_references(new.group, held.group, held.weight, nearest) == 0:
            return
        usable = nearest >= 0
        rows, reference = new.row[usable], held.row[nearest[usable]]
        pairs, wanted = np.column_stack((rows, reference)) + state.dynamic, np.empty(2 * len(rows), np.int64)
        wanted = wanted[: pack_pairs(pairs, wanted)]
        x, P = np.empty(len(wanted)), np.empty((len(wanted), len(wanted)))
        norm = condition(state.x, state.cov, held_pairs, _held_integers(state, held_pairs), 0.0, wanted, x, P)
        if norm == inf:
            return
        scale = max(1.0, norm / len(held_pairs))
        age = history[rows, ARC_EPOCHS]
        ages = sorted(set(age.tolist()))
        for k in _spread(len(ages)):
            old = age >= ages[k]
            fixed, norms = np.zeros((2, np.count_nonzero(old))), np.zeros(2)
            status, _ = search_pairs(x, P, pairs[old], NODE_LIMIT, fixed, norms)
            if status == OK and norms[1] - norms[0] >= 2.0 * JOIN_ODDS * scale and norms[0] <= NORM_LIMIT * scale * len(fixed[0]):
                history[rows[old], INTEGER] = history[reference[old], INTEGER] + fixed[0]
                return

    def _fix(self, state: FilterState, candidates: Candidates, free: Search, prediction: Prediction | None) -> Resolution:
        """Return the state that follows from what is held now."""
        pairs = _pairs(state, _held(state, candidates))
        threshold = _ratio_for(len(free.pairs), self._confidence * ACCEPT_AT_ONCE)

        def unfixed(reason: Reason) -> Resolution:
            return Resolution(reason, ratio=free.ratio, odds=free.odds, success=free.success, threshold=threshold)

        if len(pairs) < 4:
            return unfixed(Reason.FEW_AMBIGUITIES if len(free.pairs) < self.options.minimum_ambiguities else Reason.RATIO)
        x, P = np.empty(state.dynamic), np.empty((state.dynamic, state.dynamic))
        integers = _held_integers(state, pairs)
        norm = condition(state.x, state.cov, pairs, integers, 0.0, np.arange(state.dynamic), x, P)
        if norm == inf or norm > 2.0 * NORM_LIMIT * len(pairs) or self._doubts > 0 or not self._shown:
            return unfixed(Reason.VALIDATION)
        if P[0, 0] + P[1, 1] + P[2, 2] > FIX_SIGMA_M**2:
            return unfixed(Reason.FLOAT_TOO_UNCERTAIN)
        if prediction is not None:
            limit_m = PREDICTION_LIMIT_M + 4.0 * (prediction.sigma_m + sqrt(P[0, 0] + P[1, 1] + P[2, 2]))
            if length_m(x[:3] - prediction.baseline_ecef_m) > limit_m:
                self._note(state, True)
                return unfixed(Reason.VALIDATION)
        grade = 1 + (self._confirmed > 0) + (self._confirmed >= STREAK_EPOCHS and state.time_s - self._held_since_s >= STREAK_S)
        return Resolution(
            Reason.OK, x, P, pairs, integers, ratio=free.ratio, odds=free.odds, threshold=threshold, success=free.success,
            count=len(pairs), grade=int(grade),
        )  # fmt: skip

    @property
    def confirmations(self) -> int:
        """How many free searches have agreed with what is held."""
        return self._confirmed

    def _subsets(self, state: FilterState, candidates: Candidates) -> list[Search]:
        """Search without the newest ambiguities, and without each of the weakest satellites in turn."""
        age = state.time_s - state.history[candidates.row, ARC_S]
        masks = [age > 0.0, age > 5.0, age > 20.0]
        satellites, first = np.unique(candidates.satellite, return_index=True)
        order = np.argsort(candidates.weight[first], kind="stable")
        masks += [candidates.satellite != satellites[k] for k in order[: SUBSET_TRIES - len(masks)]]
        return [self._search(state, candidates.take(mask)) for mask in masks if 4 < mask.sum() < len(mask)]

    def _search(self, state: FilterState, candidates: Candidates) -> Search:
        """Search the integers of all double differences of the candidates."""
        pairs, values = _pairs(state, candidates), np.full(len(state.keys), np.nan)
        if len(pairs) == 0:
            return Search(pairs, np.zeros(0), values, inf, inf, 0.0, -inf, False)
        count = 2 if self._constraint is None else CONSTRAINED_CANDIDATES
        fixed, norms = np.zeros((count, len(pairs))), np.zeros(count)
        status, success = search_pairs(state.x, state.cov, pairs, NODE_LIMIT, fixed, norms)
        if status != OK:
            return Search(pairs, fixed[0], values, inf, inf, success, -inf, False)
        first, second = 0, 1
        if self._constraint is not None:
            norms = norms + _length_norms(state, pairs, fixed, self._constraint)
            first, second = np.argsort(norms, kind="stable")[:2].tolist()
        values[pairs[:, 1] - state.dynamic] = 0.0
        values[pairs[:, 0] - state.dynamic] = fixed[first]
        odds = log_odds(norms[first], norms[second], len(pairs))
        return Search(pairs, fixed[first], values, float(norms[first]), float(norms[second]), success, odds, True)


_NOTHING = np.zeros(0, np.int64)
_NO_VECTOR = np.zeros(0)
_NO_MATRIX = np.zeros((0, 0))


def _held(state: FilterState, candidates: Candidates) -> Candidates:
    return candidates.take(np.isfinite(state.history[candidates.row, INTEGER]))


def _without_slope(state: FilterState) -> FilterState:
    """Return the state under the hypothesis that GLONASS phases have no slope (receivers of one make)."""
    slope = int(np.searchsorted(state.keys, SLOPE_KEY))
    if slope == len(state.keys) or state.keys[slope] != SLOPE_KEY:
        return state
    i = state.dynamic + slope
    gain = state.cov[:, i] / state.cov[i, i]
    P = state.cov - np.outer(gain, state.cov[i])
    P[i, :], P[:, i] = 0.0, 0.0
    P[i, i] = SLOPE_CHANGE_M**2
    x = state.x - gain * state.x[i]
    x[i] = 0.0
    return replace(state, x=x, cov=P)


@lru_cache(maxsize=64)
def _spread(count: int) -> list[int]:
    """Return up to JOIN_TRIES places spread evenly over so many."""
    return sorted(set(np.linspace(0, count - 1, JOIN_TRIES).astype(np.intp).tolist()))


def _pairs(state: FilterState, candidates: Candidates) -> Indices:
    """Return (state, reference) of all double differences that the candidates form."""
    out = np.empty((len(candidates), 2), np.int64)
    n = choose_references(candidates.row + state.dynamic, candidates.group, candidates.weight, out)
    return out[:n].copy()


def _length_norms(state: FilterState, pairs: Indices, fixed: Matrix, constraint: LengthConstraint) -> Vector:
    """Return per candidate the squared misfit of the baseline's length, in sigmas of length and candidate together."""
    out = np.empty(len(fixed))
    x, P = np.empty(3), np.empty((3, 3))
    for k, integers in enumerate(fixed):
        condition(state.x, state.cov, pairs, integers, 0.0, np.arange(3), x, P)
        length = float(np.linalg.norm(x))
        unit = x / max(length, 1e-6)
        out[k] = (length - constraint.length_m) ** 2 / (constraint.sigma_m**2 + float(unit @ P @ unit))
    return out


def _held_integers(state: FilterState, pairs: Indices) -> Vector:
    return held_differences(state.history, INTEGER, pairs, state.dynamic)


def _hold(state: FilterState, pairs: Indices, integers: Vector) -> None:
    """Make these integers the held ones, and only these; a group's reference gets its rounded float value."""
    held = state.history[:, INTEGER]
    held[:] = np.nan
    rows = pairs - state.dynamic
    held[rows[:, 1]] = np.rint(state.x[pairs[:, 1]])
    held[rows[:, 0]] = held[rows[:, 1]] + integers


def _release(state: FilterState) -> None:
    state.history[:, INTEGER] = np.nan


def confidence(ratio: float) -> float:
    """Return the factor on log odds that a ratio asks for: 1 at 3, by the odds of that ratio for ten honest ambiguities."""
    return log((PRIOR_DOF + 10.0 * max(ratio, 1.05)) / (PRIOR_DOF + 10.0)) / log((PRIOR_DOF + 30.0) / (PRIOR_DOF + 10.0))


def _ratio_for(count: int, odds: float) -> float:
    """Return the ratio that gives these odds when the best norm is what is expected of it (its count)."""
    if count == 0:
        return 0.0
    return (exp(min(2.0 * odds / (PRIOR_DOF + count), 50.0)) * (PRIOR_DOF + count) - PRIOR_DOF) / count
