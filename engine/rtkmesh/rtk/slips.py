"""Cycle slips: what the receivers say, what bands of one satellite say of each other, and time differences that do not fit the others.

Rover and base are tested apart (``time_differences``); over long intervals, in which the atmosphere moves too much for one alone, their
difference is. Phases of which the receiver or another band says that they slipped do not vote on the motion. What is measured so well
that only one number of half cycles is possible is *certain*: the ambiguity moves by it and is as good as before. A satellite that was
away is held against the motion and clocks of all epochs since.
"""

from math import isfinite
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place, scratch, scratch_flags, scratch_indices
from rtkmesh.rtk.matching import distinct
from rtkmesh.rtk.ordered import sort_finite
from rtkmesh.rtk.residuals import BASE_PHASE, ROVER_PHASE, WAVELENGTH, Differences
from rtkmesh.rtk.state import (
    AWAY_BASE,
    AWAY_ROVER,
    BASE_LOCK_S,
    BASE_M,
    BASE_S,
    ROVER_LOCK_S,
    ROVER_M,
    ROVER_S,
    SEEN_S,
    STEP,
)  # fmt: skip
from rtkmesh.rtk.time_differences import (
    UNTESTED,
    Motion,
    Voices,
    agreeing,
    no_motion,
    predicted_change_m,
    prediction_sigma_m,
    time_difference_test,
)  # fmt: skip

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]

DRIFT_MPS: Final = 0.004  # what atmosphere and satellite clocks may add to a time difference per second
TOGETHER: Final = 0.25  # part of it that is left in a difference between receivers
REPAIR_REDUNDANCY: Final = 3  # from here on the size of a jump is taken from the residual
SLOW_S: Final = 2.5  # from this interval on, phases of both receivers are tested as one
_BANDS: Final = 5  # of one satellite at most
_BANDS_M: Final = 0.02  # by how much bands of one satellite may change apart: 5 and 4 cycles of L1 and L2 are 0.025 m
_BANDS_MPS: Final = 0.002  # ... and per second, by the ionosphere
_BANDS_SPREAD: Final = 4.0  # ... and at least so many times the median of all satellites
_MANY: Final = 0.25  # part of the satellites that slip which the fit to the L1 norm does not bear for sure
_CERTAIN_CYC: Final = 0.15  # a jump is a number of cycles if it is so near to one ...
_HALF_CYC: Final = 0.08  # ... an odd number of half cycles if so near ...
_CERTAIN_SIGMA_CYC: Final = 0.07  # ... and known so well: the next is 5 sigma away

# What happened to the phase of a pair. KNOWN_SLIP: the size of the jump was measured; CERTAIN: it is this number of half cycles.
NO_SLIP, KNOWN_SLIP, LOST, CERTAIN = range(4)
# Why a phase does not vote.
_HEARD, _SHOWN = 1, 2


@kernel_in_place
def lost_lock(lock_s: float, previous_lock_s: float, elapsed_s: float) -> bool:
    """Return whether lock times say that tracking was interrupted. ``lock_s`` may be a lower bound within a factor of 2 (RTCM DF407)."""
    if not isfinite(lock_s) or not isfinite(previous_lock_s):
        return False
    return lock_s < previous_lock_s - 1e-3 or 2.0 * lock_s + 0.5 < elapsed_s


class SlipSetup(NamedTuple):
    """Threshold of the time-difference test (cycles), longest gap that ambiguities survive (s), and who moves."""

    threshold_cyc: float
    maximum_gap_s: float
    base_moves: bool
    rover_moves: bool


class Changes(NamedTuple):
    """Changes of observed minus modelled phase since the last epoch (m, NaN: none), and the thresholds of their residuals (m).

    ``together``: the rover's are those of the difference, and of the base there are none.
    """

    rover_m: Vector
    base_m: Vector
    rover_threshold_m: Vector
    base_threshold_m: Vector
    rover_dt_s: float
    base_dt_s: float
    together: bool


class Tested(NamedTuple):
    """What the tests of both receivers found; redundancies are in satellites: two bands of one satellite witness the same thing."""

    rover: Motion
    base: Motion
    redundancy: int
    base_redundancy: int


class Verdicts(NamedTuple):
    """What happened per pair, in arrays that are written to: NO_SLIP, KNOWN_SLIP, LOST or CERTAIN; the jump (cycles)."""

    slip: Indices
    jump_cyc: Vector


@kernel
def find_slips(
    d: Differences, history: Matrix, place: Indices, times_s: Vector, setup: SlipSetup, expected: Vector, verdicts: Verdicts
) -> Tested:
    """Write the verdict on each pair; return the motions of both receivers (against their model positions).

    ``place`` are rows of ``history`` (-1: no phase); ``times_s`` are now rover, now base, last rover, last base; ``expected`` is the
    rover's motion by its Dopplers (m; its sigma), NaN without.
    """
    n, rover_dt_s, base_dt_s = len(place), times_s[0] - times_s[2], times_s[1] - times_s[3]
    together = rover_dt_s > SLOW_S and abs(rover_dt_s - base_dt_s) < 0.1
    changes = Changes(scratch(n), scratch(n), scratch(n), scratch(n), rover_dt_s, base_dt_s, together)
    _compare(d, history, place, times_s, setup.threshold_cyc, changes)
    heard, suspect, rover, base = (scratch_flags(n), scratch_flags(n)), scratch_flags(n), no_motion(n), no_motion(n)
    _hear(d, history, place, times_s, heard)
    redundancy, base_redundancy = _test(d, changes, heard, setup, expected, rover, base)
    tested = Tested(rover, base, redundancy, base_redundancy)
    _suspect(changes, heard, tested, suspect)
    for k in range(n):
        verdicts.slip[k], verdicts.jump_cyc[k] = NO_SLIP, 0.0
        if place[k] < 0:
            continue
        h = history[place[k]]
        gap_s = times_s[0] - h[SEEN_S]
        if gap_s > 1.5 * changes.rover_dt_s:
            longest_s = max(setup.maximum_gap_s, 2.5 * changes.rover_dt_s)
            _judge_return(d, k, h, times_s, heard[0][k] or heard[1][k], tested, longest_s, setup.threshold_cyc, verdicts)
        elif suspect[k]:
            _judge(d, k, h[BASE_S], changes, tested, verdicts)
    _follow_absent(history, place, times_s, changes, tested)
    return tested


@kernel_in_place
def _compare(d: Differences, history: Matrix, place: Indices, times_s: Vector, threshold_cyc: float, out: Changes) -> None:
    """Write the changes of both receivers and their thresholds."""
    drift_m = (TOGETHER if out.together else 1.0) * DRIFT_MPS
    out.rover_m[:], out.base_m[:], out.rover_threshold_m[:], out.base_threshold_m[:] = np.nan, np.nan, np.nan, np.nan
    for k in range(len(place)):
        if place[k] < 0:
            continue
        h = history[place[k]]
        out.rover_threshold_m[k] = threshold_cyc * d.table[k, WAVELENGTH] + drift_m * out.rover_dt_s
        out.base_threshold_m[k] = threshold_cyc * d.table[k, WAVELENGTH] + DRIFT_MPS * out.base_dt_s
        if h[ROVER_S] == times_s[2]:
            out.rover_m[k] = d.table[k, ROVER_PHASE] - h[ROVER_M]
        if h[BASE_S] == times_s[3] and d.base_s[k] == times_s[1] and out.base_dt_s > 0.0:
            out.base_m[k] = d.table[k, BASE_PHASE] - h[BASE_M]
        if out.together:
            out.rover_m[k] -= out.base_m[k]
            out.base_m[k] = np.nan


@kernel_in_place
def _hear(d: Differences, history: Matrix, place: Indices, times_s: Vector, out: tuple[Flags, Flags]) -> None:
    """Write whether the rover, and whether the base, says that a phase slipped or lost lock.

    What a base epoch says counts once, however long it is used.
    """
    for k in range(len(place)):
        out[0][k], out[1][k] = False, False
        if place[k] < 0:
            continue
        h = history[place[k]]
        out[0][k] = d.flagged[k, 0] or lost_lock(d.lock_s[k, 0], h[ROVER_LOCK_S], times_s[0] - h[ROVER_S])
        new_base = d.base_s[k] != h[BASE_S]
        out[1][k] = new_base and (d.flagged[k, 1] or lost_lock(d.lock_s[k, 1], h[BASE_LOCK_S], d.base_s[k] - h[BASE_S]))


# --- the tests ---


@kernel_in_place
def _test(
    d: Differences, changes: Changes, heard: tuple[Flags, Flags], setup: SlipSetup, expected: Vector, rover: Motion, base: Motion
) -> tuple[int, int]:
    """Test the phases of both receivers; write their motions, return their redundancies."""
    n, satellite = len(changes.rover_m), d.pairs.satellite
    wavelength_m, said, doubt, votes, unexpected = scratch(n), scratch_flags(n), scratch_indices(n), scratch_flags(n), scratch(4)
    unexpected[:] = np.nan
    for k in range(n):
        wavelength_m[k], said[k] = d.table[k, WAVELENGTH], heard[0][k] or (changes.together and heard[1][k])
    _doubt(satellite, changes.rover_m, (TOGETHER if changes.together else 1.0) * changes.rover_dt_s, said, doubt)
    _elect(satellite, changes.rover_m, doubt, setup.rover_moves, votes)
    voices = Voices(satellite, d.rover_direction, votes, setup.rover_moves, expected, wavelength_m)
    redundancy = time_difference_test(changes.rover_m, changes.rover_threshold_m, voices, rover)
    if redundancy != UNTESTED:
        redundancy = min(redundancy, agreeing(satellite, rover.residual_m, changes.rover_threshold_m) - _unknowns(setup.rover_moves))
    base_redundancy = UNTESTED
    if not changes.together and changes.base_dt_s > 0.0:
        _doubt(satellite, changes.base_m, changes.base_dt_s, heard[1], doubt)
        _elect(satellite, changes.base_m, doubt, setup.base_moves, votes)
        voices = Voices(satellite, d.base_direction, votes, setup.base_moves, unexpected, wavelength_m)
        base_redundancy = time_difference_test(changes.base_m, changes.base_threshold_m, voices, base)
    return redundancy, base_redundancy


@kernel_in_place
def _unknowns(moving: bool) -> int:
    return 4 if moving else 1


@kernel_in_place
def _doubt(satellite: NDArray[np.int16], change_m: Vector, dt_s: float, heard: Flags, doubt: Indices) -> None:
    """Write per phase 0, _HEARD (the receiver says that it slipped) or _SHOWN (another band of the satellite changed otherwise)."""
    limit_m, apart = _BANDS_M + _BANDS_MPS * dt_s, False
    for k in range(len(change_m)):
        doubt[k] = _HEARD if heard[k] else 0
        apart = apart or (k > 0 and satellite[k] == satellite[k - 1] and abs(change_m[k] - change_m[k - 1]) > limit_m)
    if apart:
        _compare_bands(satellite, change_m, limit_m, doubt)


@kernel_in_place
def _compare_bands(satellite: NDArray[np.int16], change_m: Vector, least_m: float, doubt: Indices) -> None:
    """Mark phases that differ from other bands of their satellite and agree with none."""
    n = len(change_m)
    apart_m = scratch(n)
    apart_m[:] = np.nan
    for k in range(1, n):
        if satellite[k] == satellite[k - 1]:
            apart_m[k] = abs(change_m[k] - change_m[k - 1])
    limit_m = max(least_m, _BANDS_SPREAD * _median(apart_m))
    for k in range(n):
        agreed, differs = False, False
        for j in range(max(k - _BANDS, 0), min(k + _BANDS + 1, n)):
            if satellite[j] != satellite[k] or j == k or not isfinite(change_m[j] - change_m[k]):
                continue
            agreed = agreed or abs(change_m[j] - change_m[k]) <= limit_m
            differs = differs or abs(change_m[j] - change_m[k]) > limit_m
        if differs and not agreed:
            doubt[k] = _SHOWN


@kernel_in_place
def _elect(satellite: NDArray[np.int16], change_m: Vector, doubt: Indices, moving: bool, votes: Flags) -> None:
    """Write which phases vote: not those that are shown to slip, nor those that are heard to where these are many and the others test
    each other; all where too few are left.
    """
    n, unknowns, doubted = len(change_m), _unknowns(moving), False
    sure, unshown = scratch_flags(n), scratch_flags(n)
    for k in range(n):
        votes[k], doubted = isfinite(change_m[k]), doubted or doubt[k] != 0
        sure[k], unshown[k] = votes[k] and doubt[k] == 0, votes[k] and doubt[k] != _SHOWN
    if not doubted:
        return
    few = (1.0 - _MANY) * distinct(satellite, unshown)
    only_sure = unknowns + REPAIR_REDUNDANCY <= distinct(satellite, sure) < few
    if only_sure or distinct(satellite, unshown) >= unknowns:
        for k in range(n):
            votes[k] = sure[k] if only_sure else unshown[k]


@kernel_in_place
def _median(values: Vector) -> float:
    """Return the (lower) median of the finite values, 0 if there are none."""
    kept = scratch(len(values))
    n = sort_finite(values, kept)
    return kept[(n - 1) // 2] if n > 0 else 0.0


# --- verdicts ---


@kernel_in_place
def _suspect(changes: Changes, heard: tuple[Flags, Flags], tested: Tested, out: Flags) -> None:
    """Write which phases are to be judged: they stand out, a receiver says that they slipped, or nothing has tested them for long."""
    rover_m, base_m = tested.rover.residual_m, tested.base.residual_m
    by_rover, by_base = tested.redundancy != UNTESTED, tested.base_redundancy != UNTESTED
    untested = changes.rover_dt_s > SLOW_S and tested.redundancy < 1
    for k in range(len(out)):
        out[k] = untested or heard[0][k] or heard[1][k]
        out[k] = out[k] or (by_rover and abs(rover_m[k]) > changes.rover_threshold_m[k])
        out[k] = out[k] or (by_base and abs(base_m[k]) > changes.base_threshold_m[k])


@kernel_in_place
def _judge(d: Differences, k: int, last_base_s: float, changes: Changes, tested: Tested, verdicts: Verdicts) -> None:
    """Judge a suspect that was there in the last epoch."""
    rover, base = tested.rover, tested.base
    if changes.rover_dt_s > SLOW_S and tested.redundancy < 1:
        verdicts.slip[k] = LOST
        return
    jump, sigma = np.nan, 0.0
    if tested.redundancy >= _needed(d.pairs.satellite, k, rover.residual_m):
        jump, sigma = rover.residual_m[k], prediction_sigma_m(d.rover_direction, k, rover)
    if not changes.together and d.base_s[k] != last_base_s:
        if tested.base_redundancy >= _needed(d.pairs.satellite, k, base.residual_m):
            jump -= base.residual_m[k]
            sigma += prediction_sigma_m(d.base_direction, k, base)
        else:
            jump = np.nan
    _conclude(k, jump / d.table[k, WAVELENGTH], sigma / d.table[k, WAVELENGTH], verdicts)
    if changes.rover_dt_s > SLOW_S:
        _doubt_halves(k, KNOWN_SLIP, jump / d.table[k, WAVELENGTH], verdicts)


@kernel_in_place
def _doubt_halves(k: int, verdict: int, jump_cyc: float, verdicts: Verdicts) -> None:
    """Where time has passed, no odd number of half cycles is certain."""
    if verdicts.slip[k] == CERTAIN and verdicts.jump_cyc[k] != np.floor(verdicts.jump_cyc[k]):
        verdicts.slip[k], verdicts.jump_cyc[k] = verdict, jump_cyc


@kernel_in_place
def _needed(satellite: NDArray[np.int16], k: int, residual_m: Vector) -> int:
    """Return the redundancy that makes a residual the size of a jump: one satellite where another band of this one is at its place."""
    for j in range(max(k - _BANDS, 0), min(k + _BANDS + 1, len(satellite))):
        if j != k and satellite[j] == satellite[k] and abs(residual_m[j]) <= _BANDS_M:
            return 1
    return REPAIR_REDUNDANCY


@kernel_in_place
def _conclude(k: int, jump_cyc: float, sigma_cyc: float, verdicts: Verdicts) -> None:
    """Write the verdict on a phase that slipped."""
    halves = np.rint(2.0 * jump_cyc)
    near = _CERTAIN_CYC if halves % 2.0 == 0.0 else _HALF_CYC
    if not isfinite(jump_cyc):
        verdicts.slip[k] = LOST
    elif abs(jump_cyc - 0.5 * halves) <= near and sigma_cyc <= _CERTAIN_SIGMA_CYC:
        verdicts.slip[k], verdicts.jump_cyc[k] = CERTAIN, 0.5 * halves
    else:
        verdicts.slip[k], verdicts.jump_cyc[k] = KNOWN_SLIP, jump_cyc


# --- satellites that were away ---


@kernel
def _judge_return(
    d: Differences, k: int, h: Vector, times_s: Vector, heard: bool, tested: Tested, longest_s: float, threshold_cyc: float,
    verdicts: Verdicts,
) -> None:  # fmt: skip
    """Judge a phase that was away, by the motions and clocks since; where they are not known, by the receivers' words alone.

    What was acquired anew begins anew: whole numbers of cycles from before cost fixes on recordings.
    """
    gap_s = times_s[0] - h[SEEN_S]
    kept = d.lock_s[k, 0] > gap_s and not heard
    if gap_s > longest_s:
        verdicts.slip[k] = LOST
        return
    jump_m, known = np.nan, tested.redundancy >= REPAIR_REDUNDANCY and d.base_s[k] == times_s[1]
    if known:
        jump_m = d.table[k, ROVER_PHASE] - h[ROVER_M] - d.table[k, BASE_PHASE] + h[BASE_M]
        jump_m -= predicted_change_m(d.rover_direction, k, h[AWAY_ROVER : AWAY_ROVER + STEP] + tested.rover.step_m)
        jump_m += predicted_change_m(d.base_direction, k, h[AWAY_BASE : AWAY_BASE + STEP] + tested.base.step_m)
    jump_cyc = jump_m / d.table[k, WAVELENGTH]
    if kept and known and not abs(jump_cyc) > threshold_cyc + TOGETHER * DRIFT_MPS * gap_s / d.table[k, WAVELENGTH]:
        return
    sigma_m = prediction_sigma_m(d.rover_direction, k, tested.rover) if known else np.nan
    _conclude(k, jump_cyc, sigma_m / d.table[k, WAVELENGTH], verdicts)
    _doubt_halves(k, LOST, 0.0, verdicts)
    if verdicts.slip[k] == KNOWN_SLIP or not (kept or not isfinite(d.lock_s[k, 0])):
        verdicts.slip[k] = LOST


@kernel_in_place
def _follow_absent(history: Matrix, place: Indices, times_s: Vector, changes: Changes, tested: Tested) -> None:
    """Add this step of both receivers to those that the phases which are not here have missed; NaN where a step is not known."""
    present = scratch_flags(len(history))
    present[:] = False
    for k in range(len(place)):
        if place[k] >= 0:
            present[place[k]] = True
    rover_known = tested.redundancy >= REPAIR_REDUNDANCY
    base_moved = changes.base_dt_s != 0.0 and not changes.together
    base_known = not base_moved or tested.base_redundancy >= REPAIR_REDUNDANCY
    for row in range(len(history)):
        if present[row]:
            continue
        h = history[row]
        unlike = h[SEEN_S] == times_s[2] and h[BASE_S] != times_s[3]  # its base epoch was another one
        for i in range(STEP):
            h[AWAY_ROVER + i] += tested.rover.step_m[i] if rover_known and not unlike else np.nan
            if base_moved:
                h[AWAY_BASE + i] += tested.base.step_m[i] if base_known else np.nan
