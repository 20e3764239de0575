"""How far a solution may be off, and whether it may be used: docs/concepts/integrity.md has the equations and what they assume.

Every hypothesis has another solution that it cannot have touched: nothing is wrong (the solution itself), one satellite is wrong (the
epoch's solution without it), the integers are wrong (the float solution, and the codes without each satellite). The protection level is
the largest distance to one of these plus what it may be off itself, at its share of the risk: solution separation (Blanch et al. 2015,
IEEE Trans. AES 51:713) with the separation that is seen, so that no test has to have passed for the bound to hold.
"""

from math import exp, isfinite, log, sqrt
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place, scratch, scratch_table
from rtkmesh.models.odds import SURENESS
from rtkmesh.rtk.acceptance import FAR_M
from rtkmesh.rtk.asked_odds import SURVEY_CODES
from rtkmesh.rtk.matching import count_runs
from rtkmesh.rtk.memory import CONFIRMED, HELD_SINCE_S, INFORMED, UNAGREED
from rtkmesh.rtk.noise import phase_factor
from rtkmesh.rtk.residuals import Differences
from rtkmesh.rtk.separation import (
    CLOCK,
    COLUMNS,
    Codes,
    Epochwise,
    Ranges,
    Rest,
    horizontal_sigma,
    leave_out,
    normalised_square,
    phase_ranges,
    solve_epoch,
)
from rtkmesh.rtk.state import Filter
from rtkmesh.rtk.update import Layout, Update
from rtkmesh.rtk.validation import INFORMED_EPOCHS, Resolution

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

SATELLITE_FAULT: Final = 1e-3  # prior probability per satellite and epoch of a bias that the noise model does not hold: our choice
INFLATION: Final = 2.0  # factor on sigmas: mean squares of normalised errors reach 1.7 (fixes) and 4.5 (floats) on recordings
FALSE_ALARM_SIGMAS: Final = 3.72  # tests fail sound epochs with 1e-4

# By what factor log odds are too sure: SURENESS at the base, less with codes of survey antennas, SURENESS_ATMOSPHERE just before FAR_M, as
# what is left of the atmosphere lasts and later epochs do not unmask it; beyond, ionospheres are states and the odds know of them.
SURENESS_SURVEY: Final = 1.0
SURENESS_ATMOSPHERE: Final = 3.0
SURENESS_FAR: Final = 2.0
# With no odds at all, at the base and from FAR_M on: what is held has been believed for some reason. Near by so is what no free search gave
# for UNAGREED_EPOCHS; beyond, WRONG_UNAGREED.
WRONG_NEAR: Final = 0.08
WRONG_FAR: Final = 0.3
WRONG_UNAGREED: Final = 0.5
UNAGREED_EPOCHS: Final = 5.0  # SEARCH_EVERY: large sets are searched that rarely
WRONG_LEAST: Final = 1e-6  # nothing supports less
# Satellites of held integers beyond one per system, for its clock: with fewer no satellite is left that could object. In simulated streets
# 22 of 290 such fixes were wrong whatever their odds (of others 61 of 22995), so the largest probability is theirs near by.
SPARE_LEAST: Final = 4
HIDDEN_M: Final = 0.15  # a level of the phases beyond this: one wrong satellite, by an untold slip, hides a wrong fix from every search
HIDDEN_FAULT: Final = 5e-5  # per satellite: of such fixes with odds above 10 one of 5800 was wrong, now one of 16900 is


class IntegritySetup(NamedTuple):
    """Options of integrity for kernels; with ``watching`` False nothing is computed. ``independent``: the float solution is never told of
    integers.
    """

    watching: bool
    risk: float
    independent: bool


class Guard(NamedTuple):
    """What integrity found in an epoch: probability of wrong integers, protection levels (m), and tests: a chi-square over its limit, above
    1 the test has failed, NaN where there is none.

    ``residual_test`` is of the phases with integers, without these of phases and codes; ``float_test`` and ``code_test`` hold the
    solution against the float one and against the codes of this epoch.
    """

    wrong: float
    horizontal_m: float
    vertical_m: float
    residual_test: float
    float_test: float
    code_test: float


class Place(NamedTuple):
    """A position, east-north-up from the place that the differences were modelled for, and its covariance."""

    enu_m: Vector
    cov_m2: Matrix


@kernel_in_place
def no_guard() -> Guard:
    """Return what is known when nothing was computed."""
    return Guard(1.0, np.nan, np.nan, np.nan, np.nan, np.nan)


@kernel_in_place
def note_agreement(memory: Vector, confirmed: float, time_s: float) -> None:
    """Count the epochs since a free search gave what is held, or the informed filter stood for it; ``confirmed`` is the count of such
    searches before this epoch.
    """
    agreed = memory[CONFIRMED] > confirmed or memory[HELD_SINCE_S] == time_s or memory[INFORMED] >= INFORMED_EPOCHS
    memory[UNAGREED] = 0.0 if agreed else memory[UNAGREED] + 1.0


@kernel_in_place
def sureness(length_m: float, level: float) -> float:
    """Return by what factor log odds are too sure on a baseline of this length, with codes of this variance factor (``code_level``)."""
    if length_m > FAR_M:
        return SURENESS_FAR
    near = SURENESS_SURVEY if level <= SURVEY_CODES else SURENESS
    return near + (SURENESS_ATMOSPHERE - near) * length_m / FAR_M


@kernel_in_place
def wrong_probability(odds: float, unagreed: float, spare: int, length_m: float, level: float) -> float:
    """Return the probability that the integers of a fix are wrong: by the log odds of the last free search, the epochs since such a search
    gave what is held, its satellites beyond one per system, the length of the baseline, and the variance factor of codes.
    """
    most = WRONG_NEAR + (WRONG_FAR - WRONG_NEAR) * min(length_m / FAR_M, 1.0)
    if spare < SPARE_LEAST and length_m <= FAR_M and isfinite(level):
        return most
    if unagreed > UNAGREED_EPOCHS:
        return WRONG_UNAGREED if length_m > FAR_M else most
    return min(max(exp(-odds / sureness(length_m, level)), WRONG_LEAST), most)


@kernel_in_place
def chi2_limit(dof: float) -> float:
    """Return what a chi-square of inflated sigmas exceeds with the false alarm probability (Wilson and Hilferty 1931)."""
    spread = 2.0 / (9.0 * dof)
    return INFLATION**2 * dof * (1.0 - spread + FALSE_ALARM_SIGMAS * sqrt(spread)) ** 3


@kernel_in_place
def widening(prior: float, budget: float) -> float:
    """Return how many sigmas a normal error of a hypothesis stays within but for its share ``budget`` of the risk; below 0: the
    hypothesis itself is less likely than that.

    P(|e| > k sigma) <= exp(-k^2 / 2) of one axis, and of two whose sigmas are at most sigma (Rayleigh).
    """
    return sqrt(2.0 * log(prior / budget)) if prior > budget else -1.0


@kernel_in_place
def widen(levels: Vector, judged: Vector, place: Vector, cov: Matrix, sigmas: float) -> None:
    """Raise horizontal and vertical levels (m) to what the solution at ``place`` allows of one at ``judged``."""
    gap_m = sqrt((judged[0] - place[0]) ** 2 + (judged[1] - place[1]) ** 2)
    levels[0] = max(levels[0], gap_m + sigmas * horizontal_sigma(cov))
    levels[1] = max(levels[1], abs(judged[2] - place[2]) + sigmas * sqrt(max(cov[2, 2], 0.0)))


@kernel_in_place
def widen_by_satellites(levels: Vector, judged: Vector, ranges: Ranges, whole: Epochwise, prior: float, budget: float) -> None:
    """Raise the levels to what the solutions without each satellite allow, each at its part of ``budget``."""
    n = len(ranges.weight)
    sigmas = INFLATION * widening(prior * SATELLITE_FAULT, budget / max(count_runs(ranges.satellite), 1))
    if sigmas < 0.0:
        return
    rest, first = Rest(scratch(3), scratch_table(3, 3), scratch_table(CLOCK, CLOCK), scratch_table(COLUMNS, COLUMNS)), 0
    for k in range(1, n + 1):
        if k < n and ranges.satellite[k] == ranges.satellite[first]:
            continue
        if leave_out(ranges, whole, first, k, rest):
            widen(levels, judged, rest.place, rest.cov, sigmas)
        else:
            levels[:] = np.inf
        first = k


@kernel_in_place
def protect(levels: Vector, judged: Vector, other: Place, ranges: Ranges, whole: Epochwise, prior: float, risk: float) -> None:
    """Raise the levels to what a hypothesis of this probability, under which ``other`` is sound and the ranges are but for one satellite,
    allows at its ``risk``; a quarter of it each for horizontal and vertical, without a fault and with one.
    """
    sigmas = INFLATION * widening(prior, 0.25 * risk)
    if sigmas < 0.0:
        return
    widen(levels, judged, other.enu_m, other.cov_m2, sigmas)
    widen_by_satellites(levels, judged, ranges, whole, prior, 0.25 * risk)


@kernel
def guard(
    f: Filter, d: Differences, layout: Layout, update: Update, codes: Codes, resolution: Resolution, held: tuple[int, int], scale: Matrix,
    memory: Vector, setup: IntegritySetup, level: float, modelled_m: Vector,
) -> Guard:  # fmt: skip
    """Return what integrity finds; ``codes`` are what the epoch's codes say alone, ``held`` of how many satellites integers are held and of
    how many systems these are, ``level`` is the variance factor of codes that odds are judged by, ``modelled_m`` the baseline (ECEF) that
    the differences were modelled for.
    """
    if not setup.watching:
        return no_guard()
    levels, floating, fixed = scratch(2), Place(scratch(3), scratch_table(3, 3)), Place(scratch(3), scratch_table(3, 3))
    turn, by_codes = codes.turn, codes.whole
    levels[:] = 0.0
    place_in(turn, f.x, f.P, modelled_m, floating)
    if not resolution.fixed:
        protect(levels, floating.enu_m, floating, codes.ranges, by_codes, 1.0, setup.risk)
        residual_test = larger(test_of(update.phase_chi2, update.phase_dof), test_of(by_codes.chi2, float(by_codes.dof)))
        return Guard(1.0, levels[0], levels[1], residual_test, np.nan, test_against(floating, by_codes))
    place_in(turn, resolution.x, resolution.P, modelled_m, fixed)
    length_m = sqrt(modelled_m[0] ** 2 + modelled_m[1] ** 2 + modelled_m[2] ** 2)
    phases = phase_ranges(f, d, layout, update.phase_used, phase_factor(scale), turn, length_m > FAR_M)
    by_phases = solve_epoch(phases)
    wrong = wrong_probability(resolution.odds, memory[UNAGREED], held[0] - held[1], length_m, level)
    float_test = np.nan
    if setup.independent:
        float_test = square_apart(fixed, floating) / chi2_limit(3.0)
    elif by_codes.solved:
        floating = Place(by_codes.place, by_codes.cov)
    protect(levels, fixed.enu_m, fixed, phases, by_phases, 1.0, 0.5 * setup.risk)
    hidden = HIDDEN_FAULT * count_runs(phases.satellite) if max(levels[0], levels[1]) > HIDDEN_M else 0.0
    protect(levels, fixed.enu_m, floating, codes.ranges, by_codes, wrong, 0.5 * setup.risk)
    residual_test = test_of(by_phases.chi2, float(by_phases.dof))
    return Guard(min(wrong + hidden, 1.0), levels[0], levels[1], residual_test, float_test, test_against(fixed, by_codes))


@kernel_in_place
def test_of(chi2: float, dof: float) -> float:
    """Return a chi-square over its limit, NaN without redundancy."""
    return chi2 / chi2_limit(dof) if dof > 0.5 else np.nan


@kernel_in_place
def test_against(place: Place, whole: Epochwise) -> float:
    """Return the test of a place against the epoch's own solution, NaN without one."""
    gap_m = scratch(3)
    for i in range(3):
        gap_m[i] = place.enu_m[i] - whole.place[i]
    return normalised_square(gap_m, whole.cov) / chi2_limit(3.0) if whole.solved else np.nan


@kernel_in_place
def square_apart(fixed: Place, floating: Place) -> float:
    """Return the normalised square of what lies between a fixed and a float place: integers take from the covariance what they explain."""
    gap_m, cov_m2 = scratch(3), scratch_table(3, 3)
    for i in range(3):
        gap_m[i] = fixed.enu_m[i] - floating.enu_m[i]
        for j in range(3):
            cov_m2[i, j] = floating.cov_m2[i, j] - fixed.cov_m2[i, j]
    return normalised_square(gap_m, cov_m2)


@kernel_in_place
def larger(first: float, second: float) -> float:
    """Return the larger of two tests, the other one where one is NaN."""
    return second if not first >= second and isfinite(second) else first


@kernel_in_place
def place_in(turn: Matrix, x: Vector, P: Matrix, origin: Vector, out: Place) -> None:
    """Write the first three of x minus an origin, and their covariance, in the frame that ``turn`` leads to."""
    place, cov = out.enu_m, out.cov_m2
    place[:], cov[:, :] = 0.0, 0.0
    for i in range(3):
        for a in range(3):
            place[i] += turn[i, a] * (x[a] - origin[a])
            for b in range(3):
                for j in range(3):
                    cov[i, j] += turn[i, a] * P[a, b] * turn[j, b]
