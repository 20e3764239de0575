"""A second filter that is told the integers, for baselines over which the atmosphere differs.

The float filter is a witness because it never learns what is held; but so it also forgets what the held integers say of the atmosphere.
Both have the zenith delay and the slant ionospheres as states; this one is told every integer as soon as it is held: it knows the
atmosphere as well as fixed phases do, and gives the position. It also judges: integers that are wrong may strain the atmosphere beyond
what it does.
"""

from math import sqrt
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place
from rtkmesh.gnss.signals import KEYS_PER_SATELLITE, SATELLITES_PER_SYSTEM, SYSTEMS
from rtkmesh.rtk.ambiguity import Candidates, Search, held_among, held_differences, norm_of, pairs_of, tell
from rtkmesh.rtk.bookkeeping import Walks, find_candidates, is_finite, lay_out, remember
from rtkmesh.rtk.memory import HELD_SINCE_S, INFORMED, ResolveSetup
from rtkmesh.rtk.placing import by_itself
from rtkmesh.rtk.residuals import CODE, PHASE, Differences
from rtkmesh.rtk.slips import SlipSetup
from rtkmesh.rtk.state import DYNAMIC, FIRST_PAIR_KEY, HISTORY, INTEGER, ZENITH_KEY, Filter, is_ionosphere, place_of
from rtkmesh.rtk.update import update
from rtkmesh.rtk.validation import RELEASE_EPOCHS, Resolution, fix, let_go, note

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

NORM_LIMIT: Final = 3.0  # squared norm per integer that is told
# What an atmosphere may differ by over a baseline, as strain 1: the zenith delay; the slant ionospheres of satellites with held integers,
# per metre of length and at the base. Right integers ask for 0.3 ppm on nl_35km (90 %: 0.6) and for up to 1.5 on an active day. The limit
# of 0.75 ppm, from when the witness knew no ionosphere and needed a guard, cost a fifth of the right fixes of simulated 35 km runs.
_ZENITH_M: Final = 0.016
_IONOSPHERES: Final = (2e-6, 0.008)
STRAIN_SURE: Final = 0.6  # below it the atmosphere agrees with the integers (``integrity``)
_TOLD_CYC2: Final = 0.01**2  # variance of an integer that is told
_START_M: Final = 0.5  # sigma of each coordinate that a new filter adds to the witness's, which does not know of the atmosphere


class Motion(NamedTuple):
    """What an epoch knows beside its differences: times and the expected step as ``find_slips`` has them, where the differences were
    modelled (baseline, m), the Doppler velocity relative to the base with its covariance (NaN without), how long ago each code was seen.
    """

    times_s: Vector
    expected: Vector
    modelled_m: Vector
    velocity_mps: Vector
    velocity_cov_m2ps2: Matrix
    code_since_s: Vector


class Use(NamedTuple):
    """How this filter treats phases: the slip tests, random walks, memory of the code's noise, and which may become integers."""

    slip: SlipSetup
    walks: Walks
    scale: Matrix
    mask_rad: float
    least_epochs: float


class Informed(NamedTuple):
    """The filter after an epoch, the double differences that are held, and how these strain the atmosphere (above 1: too far)."""

    filter: Filter
    held: Indices
    strain: float


class Settled(NamedTuple):
    """What an epoch came to: the resolution, the informed filter, and the squared norm of the held integers against the witness."""

    resolution: Resolution
    informed: Filter
    norm: float


@kernel
def settle(
    witness: Filter, informed: Filter, candidates: Candidates, free: Search, d: Differences, motion: Motion, use: Use, memory: Vector,
    setup: ResolveSetup, prediction: Vector, level: float,
) -> Settled:  # fmt: skip
    """Tell the informed filter what the witness holds after ``decide``, and let it answer, if it has enough integers; else the witness."""
    held, time_s = pairs_of(held_among(witness, candidates)), motion.times_s[0]
    if len(held) < 4:
        memory[INFORMED] = 0.0
        return Settled(fix(by_itself(witness, held), free, memory, setup, prediction, time_s, level), _nothing(informed), 0.0)
    if len(informed.keys) == 0 or memory[HELD_SINCE_S] == time_s:
        informed, memory[INFORMED] = begin_informed(witness), 0.0
    norm, told = norm_of(witness, held, held_differences(witness, held)), inform(informed, witness, d, motion, use)
    if len(told.held) < 4:
        return Settled(fix(by_itself(witness, held), free, memory, setup, prediction, time_s, level), told.filter, norm)
    note_strain(witness, told.strain, memory, prediction)
    return Settled(fix(by_itself(told.filter, told.held), free, memory, setup, prediction, time_s, level), told.filter, norm)


@kernel_in_place
def note_strain(witness: Filter, strain: float, memory: Vector, prediction: Vector) -> None:
    """Count the epochs in a row in which the atmosphere agrees with what is held, or (below 0) is strained too far; release what it strains
    for as many as doubts may last.

    A strained epoch is a doubt, so that nothing is shown; but the witness takes back a doubt in each epoch in which it has none of its own.
    """
    agrees, strained = strain <= STRAIN_SURE, not strain <= 1.0
    memory[INFORMED] = max(memory[INFORMED], 0.0) + 1.0 if agrees else (min(memory[INFORMED], 0.0) - 1.0 if strained else 0.0)
    if strained:
        note(witness, True, memory, prediction)
    if memory[INFORMED] <= -RELEASE_EPOCHS:
        let_go(witness, memory, prediction)


@kernel
def _nothing(f: Filter) -> Filter:
    """Return a filter without states."""
    return Filter(f.x[:DYNAMIC].copy(), f.P[:DYNAMIC, :DYNAMIC].copy(), np.zeros(0, np.int64), np.zeros((0, HISTORY)))


@kernel
def begin_informed(witness: Filter) -> Filter:
    """Return a filter that knows nearly what the witness knows of the rover's motion, and nothing else."""
    f = _nothing(witness)
    for i in range(3):
        f.P[i, i] += _START_M**2
    return f


@kernel
def with_states(d: Differences, shift_ecef_m: Vector) -> Differences:
    """Return the differences as a filter sees them whose baseline is longer by a shift (m, ECEF)."""
    table = d.table.copy()
    for k in range(len(table)):
        nearer_m = 0.0
        for i in range(3):
            nearer_m += d.rover_direction[k, i] * shift_ecef_m[i]
        table[k, CODE] += nearer_m
        table[k, PHASE] += nearer_m
    return Differences(d.pairs, table, d.rover_direction, d.base_direction, d.azimuth_rad, d.flagged, d.half_cycle, d.lock_s, d.base_s)


@kernel_in_place
def adopt(f: Filter, witness: Filter) -> None:
    """Take over the integers that the witness holds; what it does not know stays."""
    for k in range(len(f.keys)):
        place = place_of(witness.keys, f.keys[k])
        if place >= 0 and np.isfinite(witness.history[place, INTEGER]):
            f.history[k, INTEGER] = witness.history[place, INTEGER]


@kernel
def inform(before: Filter, witness: Filter, d: Differences, motion: Motion, use: Use) -> Informed:
    """Update the filter by an epoch that the witness has been updated by, and tell it the integers that the witness holds."""
    length_m = sqrt(before.x[0] ** 2 + before.x[1] ** 2 + before.x[2] ** 2)
    sharp = with_states(d, before.x[:3] - motion.modelled_m)
    arranged = lay_out(before, sharp, motion.code_since_s, motion.times_s, use.slip, motion.expected, use.walks, True, 2)
    f, layout = arranged.filter, arranged.layout
    outcome = update(f, sharp, layout, use.scale, motion.velocity_mps, motion.velocity_cov_m2ps2)
    candidates = find_candidates(f, sharp, layout, outcome.phase_used, use.mask_rad, use.least_epochs)
    if not outcome.ok or not is_finite(f.x, f.P):
        return Informed(_nothing(witness), np.zeros((0, 2), np.int64), np.inf)
    remember(f, sharp, layout, outcome.phase_used, motion.times_s[0])
    adopt(f, witness)
    held = pairs_of(held_among(f, candidates))
    integers = held_differences(f, held)
    norm = norm_of(f, held, integers)
    tell(f, held, integers, _TOLD_CYC2)
    return Informed(f, held, strain(f, length_m) if norm <= NORM_LIMIT * len(held) else np.inf)


@kernel
def strain(f: Filter, length_m: float) -> float:
    """Return how far the atmosphere is from none, over what may be: the zenith delay, or the spread of the ionospheres (in each system)
    of satellites that have integers on two bands.

    What all of a system share is not known: it is part of the clocks.
    """
    total, count, zenith, sums, members = 0.0, 0, 0.0, np.zeros(len(SYSTEMS)), np.zeros(len(SYSTEMS))
    sure = _held_on_two_bands(f)
    for k in range(len(f.keys)):
        if f.keys[k] == ZENITH_KEY:
            zenith = abs(f.x[DYNAMIC + k]) / _ZENITH_M
        elif sure[k]:
            sums[f.keys[k] // SATELLITES_PER_SYSTEM] += f.x[DYNAMIC + k]
            members[f.keys[k] // SATELLITES_PER_SYSTEM] += 1.0
    for k in range(len(f.keys)):
        if sure[k]:
            system = f.keys[k] // SATELLITES_PER_SYSTEM
            total += (f.x[DYNAMIC + k] - sums[system] / members[system]) ** 2
            count += 1
    may_m = _IONOSPHERES[0] * length_m + _IONOSPHERES[1]
    return max(zenith, sqrt(total / count) / may_m) if count > 0 else zenith


@kernel
def _held_on_two_bands(f: Filter) -> NDArray[np.bool_]:
    """Return which keys are ionospheres of satellites with two held integers."""
    out = np.zeros(len(f.keys), np.bool_)
    for k in range(len(out)):
        if not is_ionosphere(f.keys[k]):
            continue
        count = 0
        for j in range(len(out)):
            mine = f.keys[j] >= FIRST_PAIR_KEY and f.keys[j] // KEYS_PER_SATELLITE == f.keys[k]
            count += 1 if mine and np.isfinite(f.history[j, INTEGER]) else 0
        out[k] = count >= 2
    return out
