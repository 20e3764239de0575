"""The screened measurement update: observations from differences, the update, its residuals, what they say of the noise."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place, scratch, scratch_index_table, scratch_indices, scratch_table
from rtkmesh.gnss.signals import SATELLITES_PER_SYSTEM
from rtkmesh.rtk.filter import (
    AT_AMBIGUITY,
    AT_EXCESS,
    AT_IONOSPHERE,
    AT_SLOPE,
    AT_ZENITH,
    GROUP,
    H_AMBIGUITY,
    H_EXCESS,
    H_IONOSPHERE,
    H_SLOPE,
    H_X,
    H_ZENITH,
    OBSERVATION,
    OK,
    PLACES,
    SHARED,
    W,
    Y,
    factor,
    normal_equations,
    posterior_in,
    residuals,
)  # fmt: skip
from rtkmesh.rtk.noise import DOF, SQUARES, code_factors, learn_codes, phase_factor
from rtkmesh.rtk.residuals import (
    CHANNEL,
    CODE,
    CODE_VARIANCE,
    ELEVATION_RAD,
    IONOSPHERE,
    MODEL_L1,
    PHASE,
    PHASE_VARIANCE,
    WAVELENGTH,
    Differences,
)  # fmt: skip
from rtkmesh.rtk.state import DYNAMIC, Filter
from rtkmesh.rtk.velocity import add_velocity

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Cube = NDArray[np.float64]
Indices = NDArray[np.int64]

CODE_LIMIT: Final = 4.0  # normalised residuals beyond these are left out
PHASE_LIMIT: Final = 4.5
_ROUNDS: Final = 8
_SOLUTIONS: Final = 3  # the last is made with what the second one says of the codes
_RESCALE: Final = 1.25  # the update is made again when the code's variance factor turns out to be off by this


class Update(NamedTuple):
    """Outcome of an update: residuals (m; of observations left out: predicted ones), which were used, and the fit of the phases."""

    ok: bool
    code_residual_m: Vector
    phase_residual_m: Vector
    code_used: NDArray[np.bool_]
    phase_used: NDArray[np.bool_]
    phase_chi2: float
    phase_dof: float


class Layout(NamedTuple):
    """Where the states of each pair are (rows of the filter's keys, -1: none) and how much the variances of its code and its
    phase are inflated.
    """

    ambiguity: Indices
    ionosphere: Indices
    slope: Indices
    zenith: int
    excess: int
    code_inflation: Vector
    phase_inflation: Vector


class Work(NamedTuple):
    """The arrays of one update: observations and their places, the factor U of the prior covariance (it serves every adjustment) and room
    for what one makes of it, normal equations, posterior and room for what it is made of, residuals.
    """

    observations: Matrix
    places: Indices
    U: Matrix
    V: Matrix
    N: Matrix
    P_new: Matrix
    room: Cube
    b: Vector
    mean: Matrix
    dx: Vector
    value: Vector
    variance: Vector


@kernel
def update(f: Filter, d: Differences, layout: Layout, scale: Matrix, velocity_mps: Vector, velocity_cov_m2ps2: Matrix) -> Update:
    """Update the filter, in place, by the differences and a velocity (NaN: none); learn the code's noise (``scale``)."""
    n, states, systems = len(d.pairs.satellite), len(f.x), scale.shape[1]
    large = np.empty((7, states, states))
    work = Work(
        scratch_table(2 * n, OBSERVATION), scratch_index_table(2 * n, PLACES), large[0], large[1], large[2], large[3], large[4:],
        scratch(states), scratch_table(2 * d.pairs.groups, states + 2), scratch(states), np.empty(2 * n), scratch(2 * n),
    )  # fmt: skip
    trial, factors, found = scratch_table(2, systems), scratch(systems), scratch(systems)
    trial[:, :] = 0.0
    phase_scale = phase_factor(scale)
    code_factors(scale, trial, factors)
    ok = factor(f.P, work.U) == OK
    for _ in range(_SOLUTIONS):
        fill_observations(f, d, layout, factors, phase_scale, work)
        ok = ok and adjust(f, work, velocity_mps, velocity_cov_m2ps2)
        if not ok:
            break
        code_statistics(d, work, trial)
        code_factors(scale, trial, found)
        if not _differ(found, factors):
            break
        factors[:] = found
    for _ in range(_ROUNDS):
        if not ok or screen(work, layout.phase_inflation) == 0:
            break
        ok = adjust(f, work, velocity_mps, velocity_cov_m2ps2)
    if ok:
        code_statistics(d, work, trial)
        learn_codes(scale, trial)
        for i in range(states):
            f.x[i] += work.dx[i]
            f.P[i, :] = work.P_new[i]
    return _outcome(ok, work, layout.phase_inflation)


@kernel_in_place
def adjust(f: Filter, work: Work, velocity_mps: Vector, velocity_cov_m2ps2: Matrix) -> bool:
    """Adjust with the weights as they are; False if the covariance is not positive definite any more."""
    normal_equations(work.observations, work.places, DYNAMIC, work.mean.shape[0], work.N, work.b, work.mean)
    add_velocity(f.x, f.P, velocity_mps, velocity_cov_m2ps2, work.N, work.b)
    for i in range(len(work.V)):
        for j in range(len(work.V)):
            work.V[i, j] = work.U[i, j]
    if posterior_in(work.room, scratch(len(work.b)), work.V, work.N, work.b, work.P_new, work.dx) != OK:
        return False
    residuals(work.observations, work.places, DYNAMIC, work.mean, work.P_new, work.dx, False, work.value, work.variance)
    return True


@kernel_in_place
def _differ(found: Vector, factors: Vector) -> bool:
    largest = 0.0
    for k in range(len(factors)):
        largest = max(largest, found[k] / factors[k], factors[k] / found[k])
    return largest > _RESCALE


@kernel
def _outcome(ok: bool, work: Work, phase_inflation: Vector) -> Update:
    """Return residuals and what was used; squares of phases are normalised by variances that are not inflated."""
    n = len(phase_inflation)
    used, chi2, dof = np.empty((2, n), np.bool_), 0.0, 0.0
    code_used, phase_used = used[0], used[1]
    for k in range(n):
        w = work.observations[n + k, W]
        code_used[k], phase_used[k] = work.observations[k, W] > 0.0, w > 0.0
        if w > 0.0:
            chi2 += work.value[n + k] ** 2 * w * phase_inflation[k]
            dof += min(max(work.variance[n + k] * w, 0.0), 1.0)
    return Update(ok, work.value[:n], work.value[n:], code_used, phase_used, chi2, dof)


@kernel_in_place
def fill_observations(f: Filter, d: Differences, layout: Layout, factors: Vector, phase_scale: float, work: Work) -> None:
    """Write code (first n rows) and phase (last n rows) observations of n pairs; ``factors`` are those of code variances per system."""
    n, table, out, places = len(d.pairs.satellite), d.table, work.observations, work.places
    for k in range(n):
        sin_el = np.sin(table[k, ELEVATION_RAD])
        mapping = 1.001 / np.sqrt(0.002001 + sin_el * sin_el)  # Black and Eisner 1984
        scale = factors[int(d.pairs.satellite[k]) // SATELLITES_PER_SYSTEM]
        for part in range(2):
            row = k + part * n
            for i in range(3):
                out[row, H_X + i] = -d.rover_direction[k, i]
            out[row, H_ZENITH] = mapping
            out[row, H_IONOSPHERE] = table[k, IONOSPHERE] if part == 0 else -table[k, IONOSPHERE]
            out[row, H_AMBIGUITY] = table[k, WAVELENGTH]
            places[row, GROUP] = d.pairs.group[k] + part * d.pairs.groups
            places[row, AT_ZENITH] = layout.zenith
            places[row, AT_IONOSPHERE] = layout.ionosphere[k]
            places[row, AT_AMBIGUITY] = layout.ambiguity[k] if part == 1 else -1
            out[row, H_SLOPE] = table[k, CHANNEL]
            places[row, AT_SLOPE] = layout.slope[k] if part == 1 else -1
            out[row, H_EXCESS] = out[row, H_IONOSPHERE] * table[k, MODEL_L1]
            places[row, AT_EXCESS] = layout.excess
            y = table[k, CODE] if part == 0 else table[k, PHASE]
            variance = table[k, CODE_VARIANCE] * layout.code_inflation[k] * scale
            if part == 1:
                variance = table[k, PHASE_VARIANCE] * layout.phase_inflation[k] * phase_scale
            for i in range(SHARED):
                if places[row, AT_ZENITH + i] >= 0:
                    y -= out[row, H_ZENITH + i] * f.x[DYNAMIC + places[row, AT_ZENITH + i]]
            usable = np.isfinite(y) and np.isfinite(variance) and (part == 0 or layout.ambiguity[k] >= 0)
            out[row, Y] = y if usable else 0.0
            out[row, W] = 1.0 / variance if usable else 0.0


@kernel_in_place
def code_statistics(d: Differences, work: Work, out: Matrix) -> None:
    """Write, per system, sums of squared code residuals normalised by the sigma for a factor of 1, and their redundancy."""
    out[:, :] = 0.0
    for k in range(len(d.pairs.satellite)):
        w, system = work.observations[k, W], int(d.pairs.satellite[k]) // SATELLITES_PER_SYSTEM
        if not w > 0.0:
            continue
        redundancy = min(max(work.variance[k] * w, 0.0), 1.0)
        out[SQUARES, system] += min(work.value[k] ** 2 / d.table[k, CODE_VARIANCE], 60.0 * redundancy)
        out[DOF, system] += redundancy


@kernel_in_place
def screen(work: Work, phase_inflation: Vector) -> int:
    """Put aside (negative weight) the worst observation of each group that is beyond its limit, if it is not far better than the worst
    of all; return how many. Codes come first, then as many phases, which are held against their own sigmas without the inflation.
    """
    observations, groups, count = work.observations, work.mean.shape[0], len(phase_inflation)
    ratio, best, worst = scratch(observations.shape[0]), scratch_indices(groups), 0.0
    ratio[:], best[:] = 0.0, -1
    for k in range(observations.shape[0]):
        w = observations[k, W]
        if not (w > 0.0 and work.variance[k] > 0.01 / w):
            continue
        ratio[k] = abs(work.value[k]) / np.sqrt(work.variance[k]) / (CODE_LIMIT if k < count else PHASE_LIMIT)
        if k >= count:
            ratio[k] *= np.sqrt(phase_inflation[k - count])
        worst = max(worst, ratio[k])
        group = work.places[k, GROUP]
        if best[group] < 0 or ratio[k] > ratio[best[group]]:
            best[group] = k
    put_aside = 0
    for k in best:
        if k >= 0 and ratio[k] > 1.0 and ratio[k] >= 0.5 * worst:
            observations[k, W] = -observations[k, W]
            put_aside += 1
    return put_aside
