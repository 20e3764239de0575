"""One relative solution in one compiled call: the page of steps between two epochs and what is known of the rover."""

from math import isfinite, sqrt
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place, scratch, scratch_flags
from rtkmesh.gnss.epoch import Signals
from rtkmesh.models.single import Located
from rtkmesh.models.tides import solid_tides
from rtkmesh.rtk.acceptance import FAR_M, SURE
from rtkmesh.rtk.agreement import note_fix, note_proof
from rtkmesh.rtk.ambiguity import Candidates, held_among, pairs_of
from rtkmesh.rtk.asked_odds import at_least_street, code_level
from rtkmesh.rtk.bookkeeping import Arranged, Walks, find_candidates, is_finite, lay_out, remember
from rtkmesh.rtk.calm import is_atmospheric
from rtkmesh.rtk.code_arcs import since_seen
from rtkmesh.rtk.code_errors import float_factor
from rtkmesh.rtk.informed import Motion, Settled, Use, begin_informed, settle
from rtkmesh.rtk.integrity import Guard, IntegritySetup, guard, note_agreement
from rtkmesh.rtk.matching import Rules, distinct, match
from rtkmesh.rtk.memory import CONFIRMED, INFORMED, SHARE, SLOPE_G1, SLOPE_G2, SLOPE_SIGMA_G1, SLOPE_SIGMA_G2, ResolveSetup
from rtkmesh.rtk.noise import CLOCK_DRIFT_MPS, IONOSPHERE_PPM, ZENITH_SIGMA_M, learn_phases, phase_factor
from rtkmesh.rtk.placing import Placing, in_full, is_dense, place_by_epoch
from rtkmesh.rtk.predicted import learn_fix, share_of_step, spread
from rtkmesh.rtk.published import far_covariance, fix_covariance, held_satellites, is_vague
from rtkmesh.rtk.report import FIGURES, describe_fit, describe_guard, describe_pairs, describe_resolution, describe_slopes
from rtkmesh.rtk.residuals import CODE, Conditions, Differences, blur_glonass_codes, observe
from rtkmesh.rtk.separation import Codes, codes_alone
from rtkmesh.rtk.shade import leave_shade
from rtkmesh.rtk.single_epoch import held_norm, sharpness, with_sharper_phases
from rtkmesh.rtk.slips import SLOW_S, SlipSetup
from rtkmesh.rtk.state import DYNAMIC, Filter
from rtkmesh.rtk.time_differences import unit_variance_m2
from rtkmesh.rtk.update import Layout, Update, update
from rtkmesh.rtk.validation import TOO_RISKY, TOO_UNCERTAIN, Resolution, decide, fix, is_clear, least_count, not_resolved, withheld
from rtkmesh.rtk.walk import WALK_COFACTOR, WALK_FREEDOM, WALK_M, WALK_S, WALK_SQUARES_M2

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

TIDE_BASELINE_M: Final = 20e3  # nearer, both ends move alike to a millimetre (95 %)
# What the slant ionosphere usually differs by per metre of baseline where it is a state: in the witness, who searches by it, and in the
# informed filter, which knows the integers and may be open to more. Right fixes of nl_35km (a quiet day) with the witness's at 0.5, 0.6,
# 0.7, 0.8 and 1 ppm: 99, 100, 100, 83 and 56 %; of simulated 35 km runs (0.2 to 1.4 ppm) at 0.5 and 0.7: 57 and 59.
_IONOSPHERE_SIGMA_PPM: Final = 0.6e-6
_INFORMED_SIGMA_PPM: Final = 1.0e-6
_EXCESS_SIGMA: Final = 0.5  # Klobuchar's model leaves half of an ionosphere (IS-GPS-200, 20.3.3.5.2.5)
_IONOSPHERE_MEMORY_S: Final = 3600.0  # the time in which a satellite's ray comes to other parts of it
# The same beyond 10 km, where two ends are apart by what waves of minutes do: double differences between bands of nl_35km change by as much
# in 10 minutes as in an hour (20 mm, 22). An hour makes a state of what the troposphere and antennas do, and wrong integers fit.
_FAR_IONOSPHERE_MEMORY_S: Final = 600.0
_ZENITH_WALK_M: Final = 5e-5  # per square root of second
# Between antennas that are not both calibrated the zenith delay has little freedom: their patterns would take it for decimetres of height.
_ZENITH_HELD: Final = (0.0, 0.002)
_SLOPE_WALK_M: Final = 1e-6  # per square root of second: temperature

_DOPPLER_STEP_S: Final = 2.5  # over longer steps the mean of two velocities says little
_DOPPLER_SIGMA_MPS: Final = 0.3  # of that mean: Doppler noise of patch antennas, and jerk
_STEP_SIGMA_M: Final = 0.05  # of the motion in a step by Dopplers, beside their own sigma
_JERK_SHARE: Final = 0.25  # part of a change of velocity by which the mean of two can be wrong

SOLVED, FEW_COMMON, NOT_FINITE, UNCLEAR = range(4)


class Setup(NamedTuple):
    """What one engine's options say to kernels: angles in rad, noise parameters as ``residuals`` has them.

    ``antennas`` are of ``models.antenna.join_patterns``, empty where they are not both known; ``by_epoch``: every epoch is by itself.
    """

    rules: Rules
    slip: SlipSetup
    resolve: ResolveSetup
    integrity: IntegritySetup
    phase_a_m: float
    phase_b_m: float
    code_ratio: float
    ephemeris_m_per_m: float
    mask_rad: float
    ambiguity_mask_rad: float
    minimum_lock_epochs: float
    ambiguity_walk_cyc: float
    phases: bool
    resolving: bool
    failure_rate: float
    antennas: Vector
    by_epoch: bool


class Known(NamedTuple):
    """What is carried from epoch to epoch beside the filter; ``memory``, ``scale``, ``prediction`` and ``codes_s`` are written to.

    ``times_s`` are now rover, now base, last rover, last base on the filter's clock; ``last_model_ecef_m`` is where the rover was taken to
    be in the last epoch; ``prediction`` where the last fix and the motion since put the baseline (m, ECEF), its sigma (m), and the last
    epoch's velocity; the velocity is the Doppler velocity relative to the base. What is not known is NaN. ``codes_s`` is when codes were
    seen (``code_arcs``); ``walk`` is written to (``walk``). ``least_odds`` are the log odds of integers without which nobody wants the
    solution; minus infinite: it is wanted in any case. ``stands``: the rover does, somewhere.
    """

    times_s: Vector
    base_ecef_m: Vector
    last_model_ecef_m: Vector
    prediction: Vector
    memory: Vector
    scale: Matrix
    velocity_mps: Vector
    velocity_cov_m2ps2: Matrix
    informed_scale: Matrix
    codes_s: Matrix
    walk: Vector
    least_odds: float
    stands: bool


class Look(NamedTuple):
    """How integers are looked for: with the informed filter (``far``), or with the atmosphere as a state of the witness that the place of a
    fix has nothing of (``calm``), at this length of the baseline, with phases whose variance is this
    factor of the filter's (``sharper``, 1: the same), and codes of this variance factor (``level``, infinite: not known); ``apart``: fixes
    are placed by the epoch alone (``placing``).
    """

    far: bool
    calm: bool
    length_m: float
    sharper: float
    level: float
    apart: bool


class Updated(NamedTuple):
    """A filter updated by an epoch: what by, how that went, what the codes say alone, and the baseline (m) that all is modelled at."""

    f: Filter
    d: Differences
    layout: Layout
    outcome: Update
    codes: Codes
    modelled_m: Vector


class Solved(NamedTuple):
    """What came of a pair of epochs: SOLVED, FEW_COMMON, NOT_FINITE or UNCLEAR (no such integers as are wanted); the filter and the
    informed one; dynamic states and their covariance; the row of figures and the satellite table as ``report`` has them; the covariance of
    the position that is published; states and covariance of the filter that says where integers would put the rover (``placing``).
    """

    status: int
    filter: Filter
    informed: Filter
    x: Vector
    P: Matrix
    figures: Vector
    satellites: Matrix
    position_cov_m2: Matrix
    place: tuple[Vector, Matrix]


@kernel
def conditions(setup: Setup, length_m: float, atmospheric: bool, age_s: float, base_s: float) -> Conditions:
    """Return what decides variances for a base epoch of this age and a baseline of this length; ``atmospheric``: ionospheres are states."""
    common = (CLOCK_DRIFT_MPS * age_s) ** 2 + (setup.ephemeris_m_per_m * length_m) ** 2
    if not atmospheric:
        common += (IONOSPHERE_PPM * length_m) ** 2
    return Conditions(np.array((setup.phase_a_m, setup.phase_b_m, setup.code_ratio, common)), setup.mask_rad, base_s, setup.antennas)


@kernel_in_place
def _is_far(length_m: float, setup: Setup) -> bool:
    """Return whether a baseline is so long that the informed filter has a say; moving bases have none."""
    return bool(length_m > FAR_M and not setup.slip.base_moves)


@kernel
def walks_of(setup: Setup, length_m: float, memory: Vector) -> Walks:
    """Return the random walks of the keyed states of the witness for a baseline of this length."""
    return _walks(setup, length_m, _IONOSPHERE_SIGMA_PPM, memory)


@kernel
def _walks(setup: Setup, length_m: float, ionosphere_m_per_m: float, memory: Vector) -> Walks:
    """Return the random walks of the keyed states of a filter with ionospheres that are usually so large per metre of baseline."""
    memory_s = _FAR_IONOSPHERE_MEMORY_S if _is_far(length_m, setup) else _IONOSPHERE_MEMORY_S
    zenith = (_ZENITH_WALK_M, ZENITH_SIGMA_M) if len(setup.antennas) > 0 else _ZENITH_HELD
    return Walks(
        setup.ambiguity_walk_cyc, memory_s, ionosphere_m_per_m * length_m, zenith[0], zenith[1], _EXCESS_SIGMA, _SLOPE_WALK_M,
        ((memory[SLOPE_G1], memory[SLOPE_SIGMA_G1]), (memory[SLOPE_G2], memory[SLOPE_SIGMA_G2])),
    )  # fmt: skip


@kernel
def solve_pair(
    f: Filter, informed: Filter, rover: Signals, base: Signals, located: Located, channel: NDArray[np.int8], klobuchar: Vector,
    known: Known, setup: Setup,
) -> Solved:  # fmt: skip
    """Return the relative solution of a rover epoch, ``located`` by its single point, and a base epoch; both are matched here."""
    d, atmospheric = differences_of(f, rover, base, located, channel, klobuchar, known.base_ecef_m, known.times_s, setup)
    return solve(f, informed, d, atmospheric, known, setup)


@kernel
def differences_of(
    f: Filter, rover: Signals, base: Signals, located: Located, channel: NDArray[np.int8], klobuchar: Vector, base_ecef_m: Vector,
    times_s: Vector, setup: Setup,
) -> tuple[Differences, bool]:  # fmt: skip
    """Return the single differences of the signals that both epochs have, and whether the atmosphere is a state over them; the first two of
    ``times_s`` are theirs.
    """
    length_m = sqrt(f.x[0] ** 2 + f.x[1] ** 2 + f.x[2] ** 2)
    pairs = match(rover, base, setup.rules)
    atmospheric = is_atmospheric(length_m, pairs.satellite)
    given = conditions(setup, length_m, atmospheric, times_s[0] - times_s[1], times_s[1])
    rover_ecef_m = base_ecef_m + f.x[:3]
    if length_m > TIDE_BASELINE_M:
        tide_m = solid_tides(rover.week, rover.tow_s, rover_ecef_m, base_ecef_m)
        rover_ecef_m, base_ecef_m = rover_ecef_m + tide_m[0], base_ecef_m + tide_m[1]
    return observe(rover, base, pairs, located, channel, klobuchar, rover_ecef_m, base_ecef_m, given), atmospheric


@kernel
def unsolved(status: int, f: Filter, informed: Filter) -> Solved:
    """Return what there is of an epoch without a solution: why, and its filters."""
    return Solved(status, f, informed, f.x, f.P, np.zeros(FIGURES), np.zeros((0, 0)), f.P, (f.x, f.P))


@kernel
def solve(before: Filter, informed: Filter, d: Differences, atmospheric: bool, known: Known, setup: Setup) -> Solved:
    """Return the relative solution of single differences: the steps of an epoch. ``atmospheric``: the atmosphere is a state."""
    time_s, step_s, model_ecef_m = known.times_s[0], known.times_s[0] - known.times_s[2], known.base_ecef_m + before.x[:3]
    coded = scratch_flags(len(d.table))
    for k in range(len(coded)):
        coded[k] = isfinite(d.table[k, CODE])
    if distinct(d.pairs.satellite, coded) < 4:
        return unsolved(FEW_COMMON, before, informed)
    length_m = sqrt(before.x[0] ** 2 + before.x[1] ** 2 + before.x[2] ** 2)
    far = atmospheric and _is_far(length_m, setup)
    atmosphere, walks = (2 if far else 3) if atmospheric else 0, walks_of(setup, length_m, known.memory)
    mirrored = not far and leave_shade(before, d, known.scale, model_ecef_m)
    if far:
        blur_glonass_codes(d)
    expected = expected_step(known, model_ecef_m, setup.slip.base_moves)
    since_s = since_seen(known.codes_s, d.pairs, coded, time_s)
    arranged = lay_out(before, d, since_s, known.times_s, setup.slip, expected, walks, setup.phases, atmosphere)
    f, layout = arranged.filter, arranged.layout
    _note_walk(known, arranged, model_ecef_m, setup.slip)
    known.memory[SHARE] = share_of_step(step_s)
    predict_fix(known, arranged, model_ecef_m, setup.slip.base_moves)
    dense = not far and is_dense(layout)
    prior = Filter(f.x.copy(), f.P.copy(), f.keys, f.history) if dense else f
    outcome = update(f, d, layout, known.scale, known.velocity_mps, known.velocity_cov_m2ps2)
    if not outcome.ok or not is_finite(f.x, f.P):
        return unsolved(NOT_FINITE, f, informed)
    remember(f, d, layout, outcome.phase_used, time_s)
    look = _look_of(known, setup, length_m, atmospheric, far, dense, mirrored)
    candidates = find_candidates(f, d, layout, outcome.phase_used, setup.ambiguity_mask_rad, setup.minimum_lock_epochs)
    wanted = isfinite(known.least_odds)
    if wanted and not look.far and not is_clear(f, candidates, known.memory, setup.resolve, look.level, known.least_odds):
        return unsolved(UNCLEAR, f, informed)
    codes = codes_alone(d, outcome.code_used, known.scale, model_ecef_m)
    updated = Updated(f, d, layout, outcome, codes, model_ecef_m - known.base_ecef_m)
    float_scale = float_factor(f, d, layout, codes, known.scale, setup.ambiguity_walk_cyc, step_s, updated.modelled_m)
    if not setup.resolving:
        return _published(updated, f, informed, not_resolved(), False, float_scale, look, known, setup)
    motion = Motion(known.times_s, expected, updated.modelled_m, known.velocity_mps, known.velocity_cov_m2ps2, since_s)
    settled, place = _find_integers(f, prior, informed, d, layout, candidates, known, setup, look, motion)
    resolution, informed = settled.resolution, settled.informed
    sure = resolution.fixed and (resolution.grade >= 2 or resolution.odds >= SURE)
    if wanted and (not resolution.fixed or resolution.odds < known.least_odds):
        return unsolved(UNCLEAR, f, informed)
    if sure:
        squares = (outcome.phase_chi2 + settled.norm) * phase_factor(known.scale)
        learn_phases(known.scale, squares, outcome.phase_dof + resolution.integers)
    return _published(updated, place, informed, resolution, sure, float_scale, look, known, setup)


@kernel
def _look_of(known: Known, setup: Setup, length_m: float, atmospheric: bool, far: bool, dense: bool, mirrored: bool) -> Look:
    """Return how integers are looked for in this epoch; ``dense``: its phases count for less than they are worth (``placing``)."""
    sharper = sharpness(known.scale) if setup.by_epoch and not far else 1.0
    # Odds by a known length, or by sharper phases, are others than those that ``asked_odds`` knows.
    level = np.inf if sharper < 1.0 or isfinite(setup.resolve.length_m) else code_level(known.scale)
    if mirrored:
        level = at_least_street(level)
    return Look(far, atmospheric and not far, length_m, sharper, level, dense and sharper == 1.0)


@kernel
def _published(
    u: Updated, place: Filter, informed: Filter, resolution: Resolution, sure: bool, float_scale: float, look: Look, known: Known,
    setup: Setup,
) -> Solved:  # fmt: skip
    """Return the solution of an epoch: the fix, if it is neither vague nor too risky, else the float solution; and what is said of it."""
    f, d, layout, outcome = u.f, u.d, u.layout, u.outcome
    published, held = resolution.P, held_satellites(f, d, layout)
    if resolution.fixed:
        learn_fix(known.prediction, resolution.x, known.memory[SHARE])
    if resolution.fixed and len(informed.keys) == 0:
        alike = resolution.P / look.sharper
        published = fix_covariance(f, d, layout, outcome, alike, known.scale, sure, known.base_ecef_m, u.modelled_m, known.stands)
        if is_vague(published, look.level, held[0]):
            resolution = withheld(resolution, TOO_UNCERTAIN)
    guarded = _guarded(u, resolution, held, look, known, setup)
    if resolution.fixed and guarded.wrong > setup.failure_rate:
        resolution = withheld(resolution, TOO_RISKY)
        guarded = _guarded(u, resolution, held, look, known, setup)
    figures = np.zeros(FIGURES)
    describe_resolution(resolution, figures)
    describe_fit(d, layout, outcome, figures)
    describe_guard(guarded, resolution.odds, figures)
    describe_slopes(known.memory, figures)
    satellites = describe_pairs(f, d, layout, outcome, resolution.fixed, known.times_s[0])
    if not resolution.fixed:
        P = f.P[:DYNAMIC, :DYNAMIC].copy()
        return Solved(SOLVED, f, informed, f.x[:DYNAMIC].copy(), P, figures, satellites, float_scale * P[:3, :3], (place.x, place.P))
    if len(informed.keys) > 0:
        published = far_covariance(resolution.P, known.base_ecef_m, resolution.x[:3], len(setup.antennas) > 0)
    return Solved(SOLVED, f, informed, resolution.x, resolution.P, figures, satellites, published, (place.x, place.P))


@kernel
def _guarded(u: Updated, resolution: Resolution, held: tuple[int, int], look: Look, known: Known, setup: Setup) -> Guard:
    """Return what integrity says of the solution."""
    return guard(
        u.f, u.d, u.layout, u.outcome, u.codes, resolution, held, known.scale, known.memory, setup.integrity, look.level, u.modelled_m
    )


@kernel
def _find_integers(
    f: Filter, prior: Filter, informed: Filter, d: Differences, layout: Layout, candidates: Candidates, known: Known, setup: Setup,
    look: Look, motion: Motion,
) -> tuple[Settled, Filter]:  # fmt: skip
    """Return what the epoch says of integers, near by the witness alone, beyond 10 km with the informed filter; and the filter that says
    where they put the rover. ``prior`` is the filter of before the epoch, if the epoch places them by itself (``look.apart``).
    """
    time_s, confirmed = known.times_s[0], known.memory[CONFIRMED]
    sharp = with_sharper_phases(f, look.sharper) if look.sharper < 1.0 else f
    free = decide(sharp, candidates, known.memory, setup.resolve, known.prediction, time_s, look.level)
    if look.far:
        walks = _walks(setup, look.length_m, _INFORMED_SIGMA_PPM, known.memory)
        use = Use(setup.slip, walks, known.informed_scale, setup.ambiguity_mask_rad, setup.minimum_lock_epochs)
        settled = settle(f, informed, candidates, free, d, motion, use, known.memory, setup.resolve, known.prediction, look.level)
        note_agreement(known.memory, confirmed, time_s)
        note_proof(known.memory, confirmed, free.odds, time_s)
        note_fix(known.memory, settled.resolution.fixed, time_s)
        return settled, f
    note_agreement(known.memory, confirmed, time_s)
    note_proof(known.memory, confirmed, free.odds, time_s)
    placing = _placing(sharp, prior, d, layout, candidates, known, setup, look)
    resolution = fix(placing, free, known.memory, setup.resolve, known.prediction, time_s, look.level)
    note_fix(known.memory, resolution.fixed, time_s)
    norm = held_norm(f, candidates) if look.sharper < 1.0 else resolution.norm
    if len(informed.keys) > 0:  # the rover has come near
        informed, known.memory[INFORMED] = begin_informed(f), 0.0
    return Settled(resolution, informed, norm), placing.place if placing.apart else f


@kernel
def _placing(
    f: Filter, prior: Filter, d: Differences, layout: Layout, candidates: Candidates, known: Known, setup: Setup, look: Look
) -> Placing:
    """Return what ``f`` holds and says of the rover's place, or the epoch by itself (``look.apart``), where enough is held for a fix; of a
    moving base in any case, as those who know its length or shape look at candidates.
    """
    held = pairs_of(held_among(f, candidates))
    if not look.apart or (len(held) < least_count(setup.resolve) and not setup.slip.base_moves):
        return Placing(f, f, held, False, look.calm)
    place = place_by_epoch(prior, d, in_full(layout), known.scale, known.velocity_mps, known.velocity_cov_m2ps2)
    return Placing(f, place, held, True, look.calm)


@kernel
def expected_step(known: Known, model_ecef_m: Vector, base_moves: bool) -> Vector:
    """Return where the Dopplers of both epochs say that the rover moved, against its model positions (m), and the sigma; NaN without."""
    dt, out, change = known.times_s[0] - known.times_s[2], np.full(4, np.nan), 0.0
    if base_moves or not dt <= _DOPPLER_STEP_S:
        return out
    for i in range(3):
        before, now = known.prediction[4 + i], known.velocity_mps[i]
        out[i] = 0.5 * dt * (before + now) - model_ecef_m[i] + known.last_model_ecef_m[i]
        change += (now - before) ** 2
    cov = known.velocity_cov_m2ps2
    sigma_mps = min(sqrt(cov[0, 0] + cov[1, 1] + cov[2, 2]), _DOPPLER_SIGMA_MPS)
    out[3] = _STEP_SIGMA_M + dt * (sigma_mps + _JERK_SHARE * sqrt(change))
    return out


@kernel_in_place
def _note_walk(known: Known, arranged: Arranged, model_ecef_m: Vector, slip: SlipSetup) -> None:
    """Write how far the phases say that the rover has walked since the last epoch, where they do.

    After a long step phases are those of both receivers: then it is the motion of the baseline, and where the base moves none of the rover.
    """
    walk, dt = known.walk, known.times_s[0] - known.times_s[2]
    if arranged.redundancy < 1 or not slip.rover_moves or (slip.base_moves and dt > SLOW_S):
        return
    unit_m2 = unit_variance_m2(arranged.motion_fit)
    walk[WALK_S], walk[WALK_SQUARES_M2], walk[WALK_FREEDOM] = dt, arranged.motion_fit[0], arranged.motion_fit[1]
    for i in range(3):
        walk[WALK_M + i] = model_ecef_m[i] - known.last_model_ecef_m[i] + arranged.motion_m[i]
        for j in range(3):
            walk[WALK_COFACTOR + 3 * i + j] = arranged.motion_cov_m2[i, j] / unit_m2


@kernel_in_place
def predict_fix(known: Known, arranged: Arranged, model_ecef_m: Vector, base_moves: bool) -> None:
    """Carry the last fix on by the motion that the phases show; where these are too few or contradict the Dopplers, by that of these.

    A rover that stands is where it was, however long nothing was seen, unless its base is said to be elsewhere since.
    """
    last, velocity, dt = known.prediction, known.velocity_mps, known.times_s[0] - known.times_s[2]
    cov, by_phase, by_doppler, apart_m = arranged.motion_cov_m2, scratch(3), scratch(3), 0.0
    for i in range(3):
        by_doppler[i] = 0.5 * dt * (velocity[i] + last[4 + i])
        by_phase[i] = model_ecef_m[i] - known.last_model_ecef_m[i] + arranged.motion_m[i]
        apart_m += (by_phase[i] - by_doppler[i]) ** 2
    for i in range(3):
        last[4 + i] = velocity[i]
    heard = isfinite(by_doppler[0]) and dt <= _DOPPLER_STEP_S
    contradicted = heard and sqrt(apart_m) > 4.0 * _DOPPLER_SIGMA_MPS * dt
    if arranged.redundancy >= 1 and not base_moves and not contradicted:
        for i in range(3):
            last[i] += by_phase[i]
        spread(last, sqrt(cov[0, 0] + cov[1, 1] + cov[2, 2]), known.memory[SHARE])
    elif known.stands and isfinite(known.times_s[3]):
        return
    elif heard:
        for i in range(3):
            last[i] += by_doppler[i]
        spread(last, _DOPPLER_SIGMA_MPS * dt, known.memory[SHARE])
    else:
        last[:4] = np.nan
