"""The velocity that is published: of the rover's antenna at the epoch's instant, from walks (``walk``) and Dopplers.

A walk is the mean velocity of an interval (van Graas and Soloviev 2004, Navigation 51(4)): known to millimetres, but of half an interval
ago. How much the velocity has changed since, walks themselves tell. A small filter follows the antenna, apart from that of positions:
nothing here moves one. Its states are the position against the place of the last epoch, velocity and acceleration. The place is what walks
observe, with the noise of one epoch's phases: so errors of successive walks are of opposite sign, as they are.

The motion is one of several: white jerk from what drones do to what walkers do, or standing. Each is tried, weighed by what it let expect
(Ackerson and Fu 1970, IEEE Trans. AC-15:10), and they are joined to one state. So a receiver that stands is known to millimetres per
second, and is as unsure as a vehicle as soon as a walk says that it is one. What no epoch can show, because it comes and goes between two,
Dopplers show: by how much they contradict the walks, these count less. How good walks are, a rest shows: where two in a row lead away from
it further than phases say, the sigma is larger, where they come back from the noise of one epoch, it is smaller.
"""

from math import exp, isfinite, log, nan
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel_in_place, scratch, scratch_table
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.around import FULL_STEP_S
from rtkmesh.rtk.bookkeeping import is_finite
from rtkmesh.rtk.filter import predict_motion
from rtkmesh.rtk.velocity import invert3_into
from rtkmesh.rtk.walk import WALK_COFACTOR, WALK_FREEDOM, WALK_M, WALK_S, WALK_SQUARES_M2

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

# Density of white jerk of each motion as a part of the options'. At 1 Hz the velocity is within 2.7, 0.9 and 0.15 m/s (each axis) of what
# walks say: the least is what a walker's sway or a hull does between two epochs. The others stand, or begin to move so slowly; the last
# one is at rest also where epochs are 30 s apart (1e-11 would let it change by 0.5 mm/s).
MOTIONS: Final = (10.0, 1.0, 0.03, 1e-3, 1e-6, 3e-14)
MOVING: Final = 3  # of them move
RESTING: Final = 4  # from here on they are at rest
STANDING_MPS: Final = 0.03  # what stands is no faster
CHANGE_S: Final = 100.0  # in the mean after so long a rover begins another motion
DECAY_S: Final = 5.0  # accelerations last seconds
GAP_S: Final = 4.0  # without a walk over it nothing of a motion is left; nor is a velocity told that was seen as long ago
BEGIN_MPS, BEGIN_MPS2 = 50.0, 3.0  # sigmas of a beginning

SIGMA_M: Final = 0.003  # of a phase's time difference, before any was seen
PRIOR_DOF: Final = 2.0  # what that is worth
EPOCH_PRIOR_DOF: Final = 12.0  # of what is remembered against the epoch's own residuals
MEMORY_DOF: Final = 200.0  # ten seconds under open sky
# Chi-square per degree of freedom of two walks in a row at rest for which the joined covariance is right. Were the noise that of places
# alone, it would be 1, but the joined motions are more careful than the best of them. Static pairs, recorded and simulated, ask for 1.5
# to 2.4.
REST_EXPECTED: Final = 2.0
REST_PRIOR_DOF: Final = 12.0  # that it is so
REST_MEMORY_DOF: Final = 180.0  # a minute
REST_MOST: Final = 100.0  # chi-square of one such pair: more is no noise
REST_LEAST: Final = 0.4  # factor of the covariance
SURELY: Final = 0.9  # weight of rest with which walks are held against it
SWAY_PRIOR_DOF: Final = 12.0  # that Dopplers and walks agree
SWAY_MEMORY_DOF: Final = 60.0  # 20 s
LIMIT: Final = 16.3  # chi-square of 3 degrees of freedom at 0.1 %

# Memory: weights of motions; squared residuals of phases (m2) and their degrees of freedom; seconds (of tags) since the place that the next
# walk begins at; 1 while that place is the first one; chi-square of Dopplers against walks and its degrees of freedom; seconds since there
# was a walk or a Doppler; chi-square of two walks in a row at rest and its degrees of freedom; the last walk (m, ECEF; NaN: there was
# none).
(
    SQUARES_M2, FREEDOM, SINCE_S, FIRST, SWAY_CHI2, SWAY_FREEDOM, UNSEEN_S, REST_CHI2, REST_FREEDOM, LAST_M,
) = range(len(MOTIONS), len(MOTIONS) + 10)  # fmt: skip
MEMORY: Final = len(MOTIONS) + 12
_PLACE, _VELOCITY, _STATES = 0, 3, 9


class Told(NamedTuple):
    """What an epoch tells: the walk, and a velocity (m/s, ECEF, GPS time) by Dopplers with its covariance; NaN what there is not.

    ``factor`` is by how much that covariance is to be larger.
    """

    walk: Vector
    velocity_mps: Vector
    velocity_cov_m2ps2: Matrix
    factor: float = 1.0


class Pace:
    """Follows the antenna of one receiver. Mutable. Velocities are on the filter's clock, which ``sense`` (1 or -1) turns to GPS time."""

    def __init__(self) -> None:
        self._x, self._P, self._memory = np.zeros(_STATES), np.zeros((_STATES, _STATES)), np.zeros(MEMORY)
        self._memory[SQUARES_M2], self._memory[FREEDOM] = PRIOR_DOF * SIGMA_M**2, PRIOR_DOF
        self._memory[SWAY_CHI2] = self._memory[SWAY_FREEDOM] = SWAY_PRIOR_DOF
        self._memory[REST_CHI2], self._memory[REST_FREEDOM] = REST_PRIOR_DOF * REST_EXPECTED, REST_PRIOR_DOF
        self._memory[LAST_M : LAST_M + 3] = nan
        self._cov_m2ps2 = np.zeros((3, 3))
        self._time: GpsTime | None = None
        self._clock_s = nan

    def copy(self) -> "Pace":
        """Return a pace of its own."""
        other = Pace()
        for mine, its in ((self._x, other._x), (self._P, other._P), (self._memory, other._memory)):
            its[:] = mine
        other._time, other._clock_s = self._time, self._clock_s
        return other

    def follow(self, time: GpsTime, clock_s: float, told: Told, jerk_mps2: float, sense: float) -> tuple[Vector, Matrix] | None:
        """Take in an epoch; return the velocity (m/s, ECEF, GPS time) at the instant when it was measured and its covariance. None where
        too little was told for too long.

        ``clock_s`` is the receiver's clock, ``jerk_mps2`` the options' (per square root of second).
        """
        tags_s = nan if self._time is None else sense * (time - self._time)
        late_s = sense * (clock_s - self._clock_s)
        self._time, self._clock_s = time, clock_s
        between_s = tags_s - late_s if isfinite(late_s) else tags_s
        seen = follow(
            self._x,
            self._P,
            self._memory,
            self._cov_m2ps2,
            (tags_s, between_s),
            (jerk_mps2**2, sense),
            (told.walk, told.velocity_mps, told.velocity_cov_m2ps2, told.factor),
        )
        return (sense * self._x[3:6], self._cov_m2ps2.copy()) if seen else None


@kernel_in_place
def follow(
    x: Vector,
    P: Matrix,
    memory: Vector,
    cov_m2ps2: Matrix,
    step_s: tuple[float, float],
    motion: tuple[float, float],
    says: tuple[Vector, Vector, Matrix, float],
) -> bool:
    """Move states and memory (written to) on by what an epoch tells, and write the covariance (m2/s2) of the velocity; return whether it is
    to be told.

    ``step_s`` is the time since the last epoch, by tags and in truth (NaN: it is the first one); ``motion`` the density
    (m2/s5) of jerk and the sense of the clock; ``says`` are the fields of Told.
    """
    (tags_s, dt), density = step_s, motion[0]
    told = Told(says[0], scratch(3), scratch_table(3, 3), 1.0)
    _turn(Told(*says), motion[1], told)
    memory[SINCE_S] += tags_s
    by_walk = isfinite(told.walk[WALK_S]) and abs(told.walk[WALK_S] - memory[SINCE_S]) < 1e-3 and dt > 0.0
    if not dt > 0.0 or (dt > GAP_S and not by_walk):
        _begin(x, P, memory)
        dt = 0.0
    by_doppler = isfinite(told.velocity_mps[0])
    variance_m2 = learn_walk(memory, told.walk, dt) if by_walk else 0.0
    joined = _tried(x, P, memory, told, (dt, density, variance_m2), (by_walk, by_doppler))
    if by_walk and by_doppler:
        learn_sway(memory, joined, dt)
    memory[UNSEEN_S] = 0.0 if by_walk or by_doppler else memory[UNSEEN_S] + dt
    factor = learn_rest(memory, told.walk, variance_m2, dt)
    for i in range(3):
        for j in range(3):
            cov_m2ps2[i, j] = factor * P[_VELOCITY + i, _VELOCITY + j]
    _stand_here(x, P, memory, told.walk, by_walk)
    if not is_finite(x, P):
        _begin(x, P, memory)
    return memory[UNSEEN_S] <= GAP_S


@kernel_in_place
def _turn(told: Told, sense: float, out: Told) -> None:
    """Write the velocity that was told on the filter's clock, and its covariance as large as it is to be."""
    for i in range(3):
        out.velocity_mps[i] = sense * told.velocity_mps[i]
        for j in range(3):
            out.velocity_cov_m2ps2[i, j] = told.factor * told.velocity_cov_m2ps2[i, j]


@kernel_in_place
def _begin(x: Vector, P: Matrix, memory: Vector) -> None:
    """Forget the motion; what is known of phases and Dopplers stays."""
    x[:], P[:, :] = 0.0, 0.0
    for i in range(3):
        P[3 + i, 3 + i], P[6 + i, 6 + i] = BEGIN_MPS**2, BEGIN_MPS2**2
    for k in range(len(MOTIONS)):
        memory[k] = 1.0 / len(MOTIONS)
    memory[FIRST], memory[SINCE_S], memory[UNSEEN_S] = 1.0, 0.0, 2.0 * GAP_S
    memory[LAST_M : LAST_M + 3] = nan


@kernel_in_place
def _stand_here(x: Vector, P: Matrix, memory: Vector, walk: Vector, by_walk: bool) -> None:
    """Let the next walk begin here: the place is where the walk of this epoch has led, or, without one, wherever the antenna is."""
    memory[FIRST], memory[SINCE_S] = 0.0 if by_walk else 1.0, 0.0
    for i in range(3):
        if by_walk:
            x[i] -= walk[WALK_M + i]
            continue
        x[i] = 0.0
        for j in range(_STATES):
            P[i, j] = 0.0
            P[j, i] = 0.0


# --- what is learned ---


@kernel_in_place
def learn_walk(memory: Vector, walk: Vector, dt_s: float) -> float:
    """Take in the residuals of a walk's phases; return the variance (m2) of their time differences in this epoch."""
    squares, freedom = walk[WALK_SQUARES_M2], walk[WALK_FREEDOM]
    own = (EPOCH_PRIOR_DOF * memory[SQUARES_M2] / memory[FREEDOM] + squares) / (EPOCH_PRIOR_DOF + freedom)
    _remember(memory, SQUARES_M2, squares, freedom, (dt_s, MEMORY_DOF))
    return own


@kernel_in_place
def learn_sway(memory: Vector, chi2: float, dt_s: float) -> None:
    """Take in the chi-square of a Doppler velocity against what walks let expect."""
    _remember(memory, SWAY_CHI2, chi2, 3.0, (dt_s, SWAY_MEMORY_DOF))


@kernel_in_place
def _remember(memory: Vector, at: int, squares: float, freedom: float, duration: tuple[float, float]) -> None:
    """Add squares and their degrees of freedom to a pair of the memory, by the part that an epoch of this step counts, up to a limit."""
    share = min(duration[0] / FULL_STEP_S, 1.0)
    memory[at], memory[at + 1] = memory[at] + share * squares, memory[at + 1] + share * freedom
    fade = min(duration[1] / memory[at + 1], 1.0)
    memory[at], memory[at + 1] = fade * memory[at], fade * memory[at + 1]


@kernel_in_place
def learn_rest(memory: Vector, walk: Vector, variance_m2: float, dt_s: float) -> float:
    """Take in a walk, of which the phases' time differences have this variance (nothing: there is none); return the factor of the
    covariance of the velocity.

    At rest two walks in a row lead from the noise of one place to that of another one, while what lasts (satellites' clocks, the
    ionosphere, phases that a receiver smooths) adds up in them: the square of their sum says how much of either there is.
    """
    resting, square = 0.0, nan
    for k in range(RESTING, len(MOTIONS)):
        resting += memory[k]
    if variance_m2 > 0.0:
        square = _square_of_two(memory, walk) / variance_m2
        for i in range(3):
            memory[LAST_M + i] = walk[WALK_M + i]
    else:
        memory[LAST_M : LAST_M + 3] = nan
    if resting > SURELY and isfinite(square):
        _remember(memory, REST_CHI2, min(square, REST_MOST), 3.0, (dt_s, REST_MEMORY_DOF))
    factor = max(memory[REST_CHI2] / (REST_EXPECTED * memory[REST_FREEDOM]), REST_LEAST)
    return 1.0 + resting * (factor - 1.0)


@kernel_in_place
def _square_of_two(memory: Vector, walk: Vector) -> float:
    """Return the square (m2) of this walk and the last one together, by the cofactors of this one; NaN without one."""
    cofactor, inverse, square = scratch_table(3, 3), scratch_table(3, 3), 0.0
    for i in range(3):
        for j in range(3):
            cofactor[i, j] = walk[WALK_COFACTOR + 3 * i + j]
    invert3_into(cofactor, inverse)
    for i in range(3):
        for j in range(3):
            square += (walk[WALK_M + i] + memory[LAST_M + i]) * inverse[i, j] * (walk[WALK_M + j] + memory[LAST_M + j])
    return square


# --- motions ---


@kernel_in_place
def _tried(x: Vector, P: Matrix, memory: Vector, told: Told, known: tuple[float, float, float], has: tuple[bool, bool]) -> float:
    """Try all motions, weigh and join them; return the chi-square of the Doppler velocity, in the mean.

    ``known``: step (s), density of jerk (m2/s5), variance of time differences (m2); ``has``: there is a walk, a Doppler velocity.
    """
    count, dt, chi2 = len(MOTIONS), known[0], scratch(len(MOTIONS))
    states, covs, weight = scratch_table(count, _STATES), scratch_table(count * _STATES, _STATES), scratch(count)
    R, D, place_m = scratch_table(3, 3), told.velocity_cov_m2ps2, told.walk[WALK_M : WALK_M + 3]  # R and D are written to
    desk = Desk(scratch_table(3, 3), scratch_table(3, 3), scratch_table(3, _STATES), scratch(3), scratch_table(3, 3))
    chi2[:] = 0.0
    _place_noise(told.walk, known[2], memory[FIRST], R)
    _set_standing(desk)
    sway = max(memory[SWAY_CHI2] / memory[SWAY_FREEDOM], 1.0) if has[0] else 1.0
    share = min(dt / FULL_STEP_S, 1.0)  # that it stands is asked once a second, at any rate
    predict_motion(x, P, dt, DECAY_S, desk.S)
    for k in range(count):
        state, cov = states[k], covs[k * _STATES : (k + 1) * _STATES]
        for i in range(_STATES):
            state[i] = x[i]
            for j in range(_STATES):
                cov[i, j] = P[i, j]
        _disturb(cov, dt, MOTIONS[k] * known[1])
        weight[k] = log(memory[k] + (1.0 - exp(-dt / CHANGE_S)) * (1.0 / count - memory[k]))
        if k >= MOVING:
            weight[k] -= 0.5 * share * _misfit(state, cov, _VELOCITY, desk.nothing, desk.slow, desk)[0]
        if has[0]:
            weight[k] += _observe(state, cov, _PLACE, place_m, R, (k == 0, 1.0), desk)[1]
        if has[1]:
            way = (k == 0, sway if k < MOVING else 1.0)
            chi2[k], likely = _observe(state, cov, _VELOCITY, told.velocity_mps, D, way, desk)
            weight[k] += likely
    _weigh(weight, memory)
    _join(states, covs, memory, x, P)
    mean = 0.0
    for k in range(count):
        mean += memory[k] * chi2[k]
    return mean


@kernel_in_place
def _place_noise(walk: Vector, variance_m2: float, first: float, R: Matrix) -> None:
    """Write the covariance (m2) of the place that a walk leads to: half that of a time difference; the first one has that of both ends."""
    for i in range(3):
        for j in range(3):
            R[i, j] = 0.5 * (1.0 + first) * variance_m2 * walk[WALK_COFACTOR + 3 * i + j]


@kernel_in_place
def _disturb(P: Matrix, dt_s: float, density: float) -> None:
    """Add what white jerk of this density does in all directions alike."""
    t2, t3, t4, t5 = density * dt_s**2 / 2.0, density * dt_s**3 / 6.0, density * dt_s**4 / 8.0, density * dt_s**5 / 20.0
    for i in range(3):
        v, a = 3 + i, 6 + i
        P[i, i], P[v, v], P[a, a] = P[i, i] + t5, P[v, v] + 2.0 * t3, P[a, a] + density * dt_s
        P[i, v], P[i, a], P[v, a] = P[i, v] + t4, P[i, a] + t3, P[v, a] + t2
        P[v, i], P[a, i], P[a, v] = P[i, v], P[i, a], P[v, a]


class Desk(NamedTuple):
    """Room to work in: the covariance of three states that were seen against the prediction, its inverse, and the rows of these states;
    nothing (3), and the covariance of what stands.
    """

    S: Matrix
    inverse: Matrix
    rows: Matrix
    nothing: Vector
    slow: Matrix


@kernel_in_place
def _set_standing(desk: Desk) -> None:
    """Write what stands; the room for a covariance is nothing yet."""
    desk.S[:, :], desk.nothing[:], desk.slow[:, :] = 0.0, 0.0, 0.0
    for i in range(3):
        desk.slow[i, i] = STANDING_MPS**2


@kernel_in_place
def _observe(x: Vector, P: Matrix, first: int, seen: Vector, R: Matrix, way: tuple[bool, float], desk: Desk) -> tuple[float, float]:
    """Update by three states from ``first`` on that were seen with covariance R; return chi-square and the logarithm of the likelihood.

    ``way``: whether this is the widest motion: if even that contradicts what was seen, R is scaled (written to) until it does not; and by
    how many times the covariance of what was seen against the prediction is larger than they say, for the prediction's part.
    """
    chi2, spread = _misfit(x, P, first, seen, R, desk)
    if way[0] and chi2 > LIMIT:
        for i in range(3):
            for j in range(3):
                R[i, j] *= chi2 / LIMIT
        chi2, spread = _misfit(x, P, first, seen, R, desk)
    if way[1] > 1.0:
        for i in range(3):
            for j in range(3):
                P[first + i, first + j] += (way[1] - 1.0) * desk.S[i, j]
                desk.inverse[i, j] /= way[1]
    _update(x, P, first, seen, desk)
    return chi2, -0.5 * (chi2 + spread)


@kernel_in_place
def _misfit(x: Vector, P: Matrix, first: int, seen: Vector, R: Matrix, desk: Desk) -> tuple[float, float]:
    """Return chi-square of three states that were seen with covariance R, and the logarithm of the determinant of its covariance."""
    S, inverse, chi2 = desk.S, desk.inverse, 0.0
    for i in range(3):
        for j in range(3):
            S[i, j] = P[first + i, first + j] + R[i, j]
    determinant = invert3_into(S, inverse)
    for i in range(3):
        for j in range(3):
            chi2 += (seen[i] - x[first + i]) * inverse[i, j] * (seen[j] - x[first + j])
    return chi2, log(determinant)


@kernel_in_place
def _update(x: Vector, P: Matrix, first: int, seen: Vector, desk: Desk) -> None:
    """Update states and covariance by three states that were seen (Kalman 1960), and keep the covariance symmetric."""
    inverse, rows = desk.inverse, desk.rows
    for i in range(3):
        for j in range(_STATES):
            rows[i, j] = P[first + i, j]
    d0, d1, d2 = seen[0] - x[first], seen[1] - x[first + 1], seen[2] - x[first + 2]
    for i in range(_STATES):
        k0 = rows[0, i] * inverse[0, 0] + rows[1, i] * inverse[1, 0] + rows[2, i] * inverse[2, 0]
        k1 = rows[0, i] * inverse[0, 1] + rows[1, i] * inverse[1, 1] + rows[2, i] * inverse[2, 1]
        k2 = rows[0, i] * inverse[0, 2] + rows[1, i] * inverse[1, 2] + rows[2, i] * inverse[2, 2]
        x[i] += k0 * d0 + k1 * d1 + k2 * d2
        for j in range(i, _STATES):
            P[i, j] -= k0 * rows[0, j] + k1 * rows[1, j] + k2 * rows[2, j]
            P[j, i] = P[i, j]


@kernel_in_place
def _weigh(weight: Vector, memory: Vector) -> None:
    """Write the weights of motions, of sum 1, that have these logarithms."""
    largest, total = weight[0], 0.0
    for k in range(1, len(weight)):
        largest = max(largest, weight[k])
    for k in range(len(weight)):
        memory[k] = exp(weight[k] - largest)
        total += memory[k]
    for k in range(len(weight)):
        memory[k] /= total


@kernel_in_place
def _join(states: Matrix, covs: Matrix, memory: Vector, x: Vector, P: Matrix) -> None:
    """Write mean and covariance of the weighted motions; ``covs`` are one below the other."""
    x[:], P[:, :] = 0.0, 0.0
    for k in range(len(states)):
        for i in range(_STATES):
            x[i] += memory[k] * states[k, i]
    for k in range(len(states)):
        for i in range(_STATES):
            for j in range(_STATES):
                P[i, j] += memory[k] * (covs[k * _STATES + i, j] + (states[k, i] - x[i]) * (states[k, j] - x[j]))
