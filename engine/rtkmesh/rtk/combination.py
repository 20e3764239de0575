"""The forward and the backward run over a recording made into one.

Rules of this file. A fix is an epoch's own phases with integers; two fixes of one epoch with equal integers are nearly the same number, so
agreement confirms the integers but makes no sigma smaller. The runs find their integers from different data: what both have found is right,
and a stretch of one run that agrees with the other on both sides of a dispute has kept its integers through it. What is not believed is
called a float solution, with a covariance that covers what was in dispute. See docs/concepts/engine.md.
"""

from enum import IntEnum
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.integrity import Integrity
from rtkmesh.rtk.fusion import Estimate, fuse, misfit
from rtkmesh.rtk.noise import IONOSPHERE_PPM
from rtkmesh.rtk.solution import IntegrityReason, Reason, Status
from rtkmesh.rtk.track import INTEGRITY, Table
from rtkmesh.rtk.validation import FIX_SIGMA_M, RELEASE_EPOCHS

Mask = NDArray[np.bool_]
Indices = NDArray[np.int64]
Vector = NDArray[np.float64]
Matrices = NDArray[np.float64]

LIMIT: Final = 16.3  # chi-square of 3 degrees of freedom at 0.1 %: beyond it two solutions contradict each other
EQUAL_M: Final = 0.05  # fixes with equal integers differ by what few other satellites do to them, and more on long baselines (_model_m)
MODEL_M: Final = 0.01  # sigma per axis of what models leave in a solution, beside its own and what grows with the baseline
ANCHORS: Final = 3  # epochs of agreement that make a stretch a trusted one
HINDSIGHT: Final = RELEASE_EPOCHS  # epochs before a run lost its integers: doubt needs as many to release them
CODE_MEMORY_S: Final = 20.0  # what codes see in so many seconds they share (engine.md, variances)
GRADE_ALONE: Final = 2  # of a fix that no agreement supports
UNSURE_M: Final = 0.5  # sigma per axis of what is left of a fix that is not believed, where there is nothing else


class How(IntEnum):
    """How the solution of an epoch came about."""

    NONE = 0  # neither run has a solution
    ALIKE = 1  # both are single points: the same
    FORWARD = 2  # the forward run has the better kind of solution, and it is no fix
    BACKWARD = 3
    AGREED = 4  # both fixed, and equal
    NEAR = 5  # both fixed, not equal, but within their sigmas
    FORWARD_FIX = 6  # the forward run alone is fixed
    BACKWARD_FIX = 7
    FORWARD_CHOSEN = 8  # both fixed, in dispute, and the forward run has the evidence
    BACKWARD_CHOSEN = 9
    REFUSED = 10  # a fix, or both, not believed
    SMOOTHED = 11  # both float, or both differential codes


class Side(NamedTuple):
    """One run: its table in rising order of time, which epochs are fixed, and first and last epoch of each one's stretch of integers."""

    table: Table
    fixed: Mask
    first: Indices
    last: Indices
    fading: Mask  # among the last of a stretch that ended by losing its integers


class Combined(NamedTuple):
    """The combined table, and ``How`` per epoch."""

    table: Table
    how: Indices

    def counts(self) -> dict[str, int]:
        """Return how many epochs were combined how."""
        numbers = np.bincount(self.how, minlength=len(How)).tolist()
        return {how.name.lower(): numbers[how] for how in How if numbers[how]}


def combine_runs(forward: Table, backward: Table) -> Combined:
    """Return the solutions of both runs made into one; the tables have the same epochs in rising order of time."""
    if len(forward) != len(backward) or any((forward[name] != backward[name]).any() for name in ("week", "tow_s")):
        raise ValueError("the two runs are not over the same epochs")
    if not len(forward):
        return Combined(forward.copy(), np.zeros(0, np.int64))
    sides = _side(forward, later=1), _side(backward, later=-1)
    how = _decide(*sides)
    table = np.where(_from_backward(how, *sides), backward, forward)
    for fill in (_agree, _cover, _smooth):
        fill(table, how, forward, backward)
    _move(table, forward, backward)
    _demote(table, how, *sides)
    _leave_unwatched(table, how)
    return Combined(table, how)


# --- stretches ---


def _side(table: Table, later: int) -> Side:
    """Return a run with its stretches; ``later`` is 1 where it went through the epochs in rising order, -1 in falling order."""
    count = len(table)
    first, last = _stretches(table[::later])
    fixed, place = table["status"][::later] == Status.FIX, np.arange(count)
    fading = fixed & (last - place < HINDSIGHT) & (last < count - 1)
    if later == 1:
        return Side(table, fixed, first, last, fading)
    return Side(table, fixed[::-1], count - 1 - last[::-1], count - 1 - first[::-1], fading[::-1])


def _stretches(rows: Table) -> tuple[Indices, Indices]:
    """Return the first and the last epoch of the stretch that each fix belongs to, of other epochs their own place.

    A stretch is a row of fixes of which none was begun anew: its grade has not fallen to 1, and no reset came between.
    """
    fixed, grade, place = rows["status"] == Status.FIX, rows["grade"], np.arange(len(rows))
    begins = fixed.copy()
    begins[1:] &= ~fixed[:-1] | ((grade[1:] == 1) & (grade[:-1] > 1)) | (rows["resets"][1:] != rows["resets"][:-1])
    starts, number = np.flatnonzero(begins), np.cumsum(begins)[fixed] - 1
    ends = np.zeros(len(starts), np.int64)
    ends[number] = place[fixed]  # of equal numbers the last one stays
    first, last = place.copy(), place.copy()
    first[fixed], last[fixed] = starts[number], ends[number]
    return first, last


def _anchored(side: Side, agreed: Mask) -> tuple[Mask, Mask]:
    """Return whether the stretch around each epoch agrees with the other run before it, and after it."""
    total = np.concatenate(([0], np.cumsum(agreed)))
    place = np.arange(len(agreed))
    before, after = total[place] - total[side.first], total[side.last + 1] - total[place + 1]
    return side.fixed & (before >= ANCHORS), side.fixed & (after >= ANCHORS)


# --- what is believed ---


def _decide(forward: Side, backward: Side) -> Indices:
    """Return ``How`` per epoch."""
    f, b = forward.table, backward.table
    gap_m = np.linalg.norm(_gap_m(f, b), axis=1)
    apart = misfit(_gap_m(f, b), _spread(f, b))
    both, rank_f, rank_b = forward.fixed & backward.fixed, _rank(f), _rank(b)
    agreed = both & (gap_m <= EQUAL_M + _model_m(f) - MODEL_M)
    anchors = [np.array(_anchored(side, agreed)).sum(axis=0) for side in (forward, backward)]
    how = np.full(len(f), How.NONE)
    how[(rank_f == rank_b) & (rank_f > 0)] = How.ALIKE
    how[(rank_f == rank_b) & np.isin(f["status"], (Status.FLOAT, Status.DGPS))] = How.SMOOTHED
    how[rank_f > rank_b], how[rank_b > rank_f] = How.FORWARD, How.BACKWARD
    for side, other, anchored, fix in ((forward, backward, anchors[0], How.FORWARD_FIX), (backward, forward, anchors[1], How.BACKWARD_FIX)):
        alone = side.fixed & ~other.fixed
        supported = (anchored > 0) | ((side.table["grade"] >= GRADE_ALONE) & ~(apart > LIMIT))
        how[alone] = np.where(supported & ~side.fading, fix, How.REFUSED)[alone]
    how[both] = np.where(apart <= LIMIT, How.NEAR, How.REFUSED)[both]
    how[both & (anchors[0] > anchors[1])], how[both & (anchors[1] > anchors[0])] = How.FORWARD_CHOSEN, How.BACKWARD_CHOSEN
    how[agreed] = How.AGREED
    return how


def _rank(table: Table) -> Indices:
    """Return how good a kind of solution is: fix, float, differential, single, none."""
    ranks = np.zeros(max(Status) + 1, np.int64)
    ranks[[Status.SINGLE, Status.DGPS, Status.FLOAT, Status.FIX]] = 1, 2, 3, 4
    return ranks[table["status"]]


def _gap_m(f: Table, b: Table) -> Vector:
    return b["baseline_ecef_m"] - f["baseline_ecef_m"]


def _spread(f: Table, b: Table) -> Matrices:
    """Return the covariance of the difference of both runs' baselines, were they independent."""
    model_m2 = 2.0 * np.square(np.nan_to_num(_model_m(f)))
    return f["baseline_cov_ecef_m2"] + b["baseline_cov_ecef_m2"] + model_m2[:, None, None] * np.eye(3)


def _model_m(table: Table) -> Vector:
    """Return the sigma per axis of what models leave: other satellites see another atmosphere, the more of it the longer the baseline."""
    return MODEL_M + IONOSPHERE_PPM * np.linalg.norm(table["baseline_ecef_m"], axis=1)


def _from_backward(how: Indices, forward: Side, backward: Side) -> Mask:
    """Return which epochs begin as the backward run's row: those that it decides, and of the others those in which it is the surer."""
    decided = np.isin(how, (How.BACKWARD, How.BACKWARD_FIX, How.BACKWARD_CHOSEN))
    open_ = np.isin(how, (How.AGREED, How.NEAR, How.SMOOTHED))
    surer = _variance(backward.table) < _variance(forward.table)
    # The other run's float stands for a fix that is not believed, if it has one.
    for_forward = forward.fixed & ~backward.fixed & (_rank(backward.table) >= 2)
    for_backward = backward.fixed & ~forward.fixed & (_rank(forward.table) < 2)
    return decided | (open_ & surer) | ((how == How.REFUSED) & (for_forward | for_backward))


def _variance(table: Table) -> Vector:
    return np.trace(table["baseline_cov_ecef_m2"], axis1=1, axis2=2)


# --- what they become ---


def _agree(table: Table, how: Indices, f: Table, b: Table) -> None:
    """Write what both runs agree on: the surer baseline and its covariance, since both are made of the same phases."""
    at = how == How.AGREED
    table["grade"][at] = np.maximum(GRADE_ALONE, np.maximum(f["grade"], b["grade"]))[at]


def _cover(table: Table, how: Indices, f: Table, b: Table) -> None:
    """Write, where two fixes are not equal and neither can be chosen, their mean with a covariance that covers both."""
    at = (how == How.NEAR) | ((how == How.REFUSED) & (f["status"] == Status.FIX) & (b["status"] == Status.FIX))
    half = 0.5 * _gap_m(f, b)[at]
    P = 0.5 * (f["baseline_cov_ecef_m2"] + b["baseline_cov_ecef_m2"])[at] + half[:, :, None] * half[:, None, :]
    _place(table, at, f["baseline_ecef_m"][at] + half, P)
    wide = np.trace(P, axis1=1, axis2=2) > FIX_SIGMA_M**2
    how[np.flatnonzero(at)[wide]] = How.REFUSED


def _smooth(table: Table, how: Indices, f: Table, b: Table) -> None:
    """Write float solutions made of both: independent but for what the codes of the last seconds say, which both know.

    Where they contradict each other beyond their sigmas, these are not believed either and grow until they do not.
    """
    at = how == How.SMOOTHED
    estimates = [Estimate(t["baseline_ecef_m"][at], t["baseline_cov_ecef_m2"][at], _shared(t[at])) for t in (f, b)]
    x, P = fuse(*estimates)
    excess = np.maximum(1.0, misfit(_gap_m(f, b)[at], _spread(f, b)[at]) / 3.0)
    _place(table, at, x, P * excess[:, None, None])


def _shared(table: Table) -> Vector:
    """Return the part of a float solution's variance that the last seconds of codes have made: all of it in a young arc or without any."""
    return np.clip(CODE_MEMORY_S / np.maximum(np.nan_to_num(table["arc_s"]), 1e-3), 0.0, 1.0)


def _place(table: Table, at: Mask, baseline_ecef_m: Vector, P: Matrices) -> None:
    """Write baselines with their covariances; what a moving base's own position adds to that of the rover stays."""
    table["position_ecef_m"][at] = table["base_ecef_m"][at] + baseline_ecef_m
    table["position_cov_ecef_m2"][at] += P - table["baseline_cov_ecef_m2"][at]
    table["baseline_ecef_m"][at], table["baseline_cov_ecef_m2"][at] = baseline_ecef_m, P


def _move(table: Table, f: Table, b: Table) -> None:
    """Write velocities made of both runs: one lags behind a change of motion, the other runs ahead of it.

    Both contain the epoch's own Dopplers, so nothing is taken as independent.
    """
    known = [np.isfinite(t["velocity_ecef_mps"]).all(axis=1) & np.isfinite(t["velocity_cov_ecef_m2ps2"]).all(axis=(1, 2)) for t in (f, b)]
    at = known[0] & known[1] & (_rank(f) >= 2) & (_rank(b) >= 2)
    everything = np.ones(int(at.sum()))
    v, P = fuse(*(Estimate(t["velocity_ecef_mps"][at], t["velocity_cov_ecef_m2ps2"][at], everything) for t in (f, b)))
    table["velocity_ecef_mps"][at], table["velocity_cov_ecef_m2ps2"][at] = v, P
    table["acceleration_ecef_mps2"][at] = 0.5 * (f["acceleration_ecef_mps2"] + b["acceleration_ecef_mps2"])[at]


def _demote(table: Table, how: Indices, forward: Side, backward: Side) -> None:
    """Say that refused fixes are none; where only a fix was there, its covariance grows to that of a solution that codes made."""
    at = how == How.REFUSED
    fixed = at & (table["status"] == Status.FIX)
    table["status"][fixed], table["ambiguities_fixed"][at], table["grade"][at] = Status.FLOAT, 0, 0
    table["reason"][at] = Reason.VALIDATION
    lonely = fixed & ~(forward.fixed & backward.fixed)
    own: Any = table["position_cov_ecef_m2"][lonely]
    widened = np.maximum(1.0, UNSURE_M**2 / (np.trace(own, axis1=1, axis2=2) / 3.0))[:, None, None]
    table["position_cov_ecef_m2"][lonely], table["baseline_cov_ecef_m2"][lonely] = own * widened, own * widened


def _leave_unwatched(table: Table, how: Indices) -> None:
    """Say that nothing bounds what was made of both runs, or refused: the levels of one run are not of that."""
    at = (how == How.NEAR) | (how == How.SMOOTHED) | (how == How.REFUSED)
    table["fix_probability"][at & (table["status"] != Status.FIX)] = 0.0
    table["protection_horizontal_m"][at], table["protection_vertical_m"][at] = np.nan, np.nan
    table["integrity"][at], table["integrity_reason"][at] = INTEGRITY.index(Integrity.UNAVAILABLE), IntegrityReason.NOT_WATCHED
