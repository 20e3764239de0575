"""Which integers are believed, for how long, and why.

Integers are *held* once they have proven themselves; the filter itself never learns of them (except in fix-and-hold), so it stays an independent
witness: every epoch the free search and the float solution can speak against what is held. New ambiguities join one by one when what is
held determines them. All thresholds are log odds (see ``ambiguity.log_odds``), so they adapt to the strength of the model.
"""

from dataclasses import dataclass
from math import exp, inf, log
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.rtk.ambiguity import NODE_LIMIT, choose_references, compare_integers, condition, log_odds, search_pairs
from rtkmesh.rtk.lambda_search import OK
from rtkmesh.rtk.options import AmbiguityMode, AmbiguityOptions
from rtkmesh.rtk.solution import Reason
from rtkmesh.rtk.state import ARC_EPOCHS, ARC_S, INTEGER, FilterState

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

ACCEPT_AT_ONCE: Final = 8.5  # log odds for a fix from one search
ACCEPT_AFTER_STREAK: Final = 5.0  # log odds for a fix from a row of searches with equal results
STREAK_S: Final = 10.0
STREAK_EPOCHS: Final = 5
RELEASE: Final = 5.0  # log odds of another vector against the held one at which doubt counts
RELEASE_EPOCHS: Final = 3
NORM_LIMIT: Final = 4.0  # squared norm per ambiguity that honest float solutions do not exceed
JOIN_SIGMA_CYC: Final = 0.12
JOIN_RESIDUAL_CYC: Final = 0.22
FIX_SIGMA_M: Final = 0.10  # a fix must be this good, or too few of its ambiguities are known
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
        return min(self.second / max(self.norm, 1e-9), 9999.9) if self.resolved else 0.0


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

    def __init__(self, options: AmbiguityOptions) -> None:
        self.options = options
        self._streak_start_s = inf
        self._streak_epochs = 0
        self._streak_keys: Indices = np.zeros(0, np.int64)
        self._streak_values: Vector = np.zeros(0)
        self._doubts = 0
        self._held_since_s = inf
        self._confirmed = 0

    def reset(self) -> None:
        """Forget everything."""
        self.__init__(self.options)

    def resolve(self, state: FilterState, candidates: Candidates) -> Resolution:
        """Find or keep integers for this epoch."""
        if self.options.mode is AmbiguityMode.OFF:
            return Resolution(Reason.AMBIGUITY_OFF)
        held = candidates.take(np.isfinite(state.history[candidates.row, INTEGER]))
        held_pairs = _pairs(state, held)
        free = _search(state, candidates)
        if len(held_pairs) >= 3:
            self._watch(state, held_pairs, free)
            held_pairs = _pairs(state, candidates.take(np.isfinite(state.history[candidates.row, INTEGER])))
        if len(held_pairs) < 3:
            self._try_new(state, candidates, free)
        else:
            self._join(state, candidates, held_pairs)
        return self._fix(state, candidates, free)

    def _try_new(self, state: FilterState, candidates: Candidates, free: Search) -> None:
        """Look for integers without any that are held."""
        _release(state)
        self._held_since_s = inf
        best = free
        if not self._strong(best, 0.0) and len(candidates) > 1:
            best = max([free, *_subsets(state, candidates)], key=lambda search: search.odds)
        if not best.resolved or len(best.pairs) < self.options.minimum_ambiguities:
            self._streak_epochs = 0
            return
        self._follow(state, best)
        penalty = 0.0 if best is free else log(SUBSET_TRIES)
        persistent = self._streak_epochs >= STREAK_EPOCHS and state.time_s - self._streak_start_s >= STREAK_S
        if self._strong(best, penalty) or (persistent and best.odds >= ACCEPT_AFTER_STREAK + penalty):
            if best.norm > NORM_LIMIT * len(best.pairs):
                return
            _hold(state, best.pairs, best.integers)
            self._held_since_s, self._doubts, self._confirmed = state.time_s, 0, 0

    def _strong(self, search: Search, penalty: float) -> bool:
        return search.resolved and search.odds >= ACCEPT_AT_ONCE + penalty and len(search.pairs) >= self.options.minimum_ambiguities

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
        norm = condition(state.x, state.P, pairs, integers, 0.0, _NOTHING, _NO_VECTOR, _NO_MATRIX)
        doubt = norm > NORM_LIMIT * len(pairs) * 2.0
        if free.resolved:
            other = free.values[pairs[:, 0] - state.dynamic] - free.values[pairs[:, 1] - state.dynamic]
            if np.array_equal(other, integers):
                self._confirmed += 1
            else:
                best = condition(state.x, state.P, pairs, other, 0.0, _NOTHING, _NO_VECTOR, _NO_MATRIX)
                doubt = doubt or log_odds(best, norm, len(pairs)) > RELEASE
        self._doubts = self._doubts + 1 if doubt else 0
        if self._doubts >= RELEASE_EPOCHS:
            _release(state)
            self._doubts, self._streak_epochs = 0, 0

    def _join(self, state: FilterState, candidates: Candidates, held_pairs: Indices) -> None:
        """Give integers to ambiguities that the held ones determine."""
        history = state.history
        known = np.isfinite(history[candidates.row, INTEGER])
        new = candidates.take(~known & (history[candidates.row, ARC_EPOCHS] >= 1.0))
        if len(new) == 0:
            return
        held = candidates.take(known)
        reference = np.full(len(new), -1, np.int64)
        for k in range(len(new)):
            same = np.flatnonzero(held.group == new.group[k])
            if len(same):
                reference[k] = held.row[same[np.argmax(held.weight[same])]]
        usable = reference >= 0
        if not usable.any():
            return
        rows, reference = new.row[usable], reference[usable]
        wanted = np.unique(np.concatenate((rows, reference))) + state.dynamic
        x, P = np.empty(len(wanted)), np.empty((len(wanted), len(wanted)))
        norm = condition(state.x, state.P, held_pairs, _held_integers(state, held_pairs), 0.0, wanted, x, P)
        if norm == inf:
            return
        i, r = np.searchsorted(wanted, rows + state.dynamic), np.searchsorted(wanted, reference + state.dynamic)
        value = x[i] - x[r]
        sigma = np.sqrt(np.maximum(P[i, i] + P[r, r] - 2.0 * P[i, r], 0.0))
        whole = np.rint(value)
        good = (sigma < JOIN_SIGMA_CYC) & (np.abs(value - whole) < np.minimum(JOIN_RESIDUAL_CYC, 4.0 * np.maximum(sigma, 0.02)))
        history[rows[good], INTEGER] = history[reference[good], INTEGER] + whole[good]

    def _fix(self, state: FilterState, candidates: Candidates, free: Search) -> Resolution:
        """Return the state that follows from what is held now."""
        held = candidates.take(np.isfinite(state.history[candidates.row, INTEGER]))
        pairs = _pairs(state, held)
        known = dict(ratio=free.ratio, odds=free.odds, success=free.success, threshold=_ratio_for(len(free.pairs), ACCEPT_AT_ONCE))
        if len(pairs) < 4:
            reason = Reason.FEW_AMBIGUITIES if len(free.pairs) < self.options.minimum_ambiguities else Reason.RATIO
            return Resolution(reason, **known)
        wanted = np.arange(state.dynamic)
        x, P = np.empty(state.dynamic), np.empty((state.dynamic, state.dynamic))
        integers = _held_integers(state, pairs)
        norm = condition(state.x, state.P, pairs, integers, 0.0, wanted, x, P)
        if norm == inf or norm > 2.0 * NORM_LIMIT * len(pairs) or self._doubts > 0:
            return Resolution(Reason.VALIDATION, **known)
        if P[0, 0] + P[1, 1] + P[2, 2] > FIX_SIGMA_M**2:
            return Resolution(Reason.FLOAT_TOO_UNCERTAIN, **known)
        grade = 1 + (self._confirmed > 0) + (self._confirmed >= STREAK_EPOCHS and state.time_s - self._held_since_s >= STREAK_S)
        return Resolution(Reason.OK, x, P, pairs, integers, count=len(pairs), grade=int(grade), **known)


_NOTHING = np.zeros(0, np.int64)
_NO_VECTOR = np.zeros(0)
_NO_MATRIX = np.zeros((0, 0))


def _pairs(state: FilterState, candidates: Candidates) -> Indices:
    """Return (state, reference) of all double differences that the candidates form."""
    out = np.empty((len(candidates), 2), np.int64)
    n = choose_references(candidates.row + state.dynamic, candidates.group, candidates.weight, out)
    return out[:n].copy()


def _search(state: FilterState, candidates: Candidates) -> Search:
    pairs = _pairs(state, candidates)
    values = np.full(len(state.keys), np.nan)
    if len(pairs) == 0:
        return Search(pairs, np.zeros(0), values, inf, inf, 0.0, -inf, False)
    fixed, norms = np.zeros((2, len(pairs))), np.zeros(2)
    status, success = search_pairs(state.x, state.P, pairs, NODE_LIMIT, fixed, norms)
    if status != OK:
        return Search(pairs, fixed[0], values, inf, inf, success, -inf, False)
    values[pairs[:, 1] - state.dynamic] = 0.0
    values[pairs[:, 0] - state.dynamic] = fixed[0]
    return Search(pairs, fixed[0], values, norms[0], norms[1], success, log_odds(norms[0], norms[1], len(pairs)), True)


def _subsets(state: FilterState, candidates: Candidates) -> list[Search]:
    """Search without the newest ambiguities, and without each of the weakest satellites in turn."""
    age = state.time_s - state.history[candidates.row, ARC_S]
    masks = [age > 0.0, age > 5.0, age > 20.0]
    satellites, first = np.unique(candidates.satellite, return_index=True)
    order = np.argsort(candidates.weight[first], kind="stable")
    masks += [candidates.satellite != satellites[k] for k in order[: SUBSET_TRIES - len(masks)]]
    return [_search(state, candidates.take(mask)) for mask in masks if 4 < mask.sum() < len(mask)]


def _held_integers(state: FilterState, pairs: Indices) -> Vector:
    held = state.history[:, INTEGER]
    return held[pairs[:, 0] - state.dynamic] - held[pairs[:, 1] - state.dynamic]


def _hold(state: FilterState, pairs: Indices, integers: Vector) -> None:
    """Make these integers the held ones, and only these; a group's reference gets its rounded float value."""
    held = state.history[:, INTEGER]
    held[:] = np.nan
    rows = pairs - state.dynamic
    held[rows[:, 1]] = np.rint(state.x[pairs[:, 1]])
    held[rows[:, 0]] = held[rows[:, 1]] + integers


def _release(state: FilterState) -> None:
    state.history[:, INTEGER] = np.nan


def _ratio_for(count: int, odds: float) -> float:
    """Return the ratio that gives these odds when the best norm is what is expected of it (its count)."""
    if count == 0:
        return 0.0
    return (exp(2.0 * odds / (4.0 + count)) * (4.0 + count) - 4.0) / count
