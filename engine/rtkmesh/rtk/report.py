"""The solution of an epoch, from what the steps of the engine left behind."""

from math import isfinite, nan, sqrt
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel, kernel_in_place, scratch_flags
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.signals import KEYS_PER_SATELLITE, SIGNALS_PER_SATELLITE
from rtkmesh.models.code_selection import USED
from rtkmesh.models.single import Located, SingleStatus
from rtkmesh.models.single_adjustment import CONVERGED
from rtkmesh.rtk.integrity import Guard
from rtkmesh.rtk.matching import count_runs, distinct
from rtkmesh.rtk.memory import SLOPE_G1, SLOPE_SIGMA_G1
from rtkmesh.rtk.options import RtkOptions
from rtkmesh.rtk.residuals import CN0, ELEVATION_RAD, Differences
from rtkmesh.rtk.slopes import SLOPES_APART_M
from rtkmesh.rtk.solution import (
    FIXED,
    HALF_CYCLE,
    REJECTED,
    SLIPPED,
    T_AMBIGUITY_CYC,
    T_AZIMUTH_RAD,
    T_CN0_DBHZ,
    T_CODE_M,
    T_ELEVATION_RAD,
    T_LOCK_EPOCHS,
    T_LOCK_S,
    T_PHASE_M,
    T_REJECTS,
    T_SATELLITE,
    T_SIGNAL,
    T_SLIPS,
    T_STATE,
    T_VARIANCE_CYC2,
    TABLE,
    USED_CODE,
    USED_PHASE,
    FloatState,
    IntegrityReason,
    Reason,
    SatelliteTable,
    Solution,
    Status,
)
from rtkmesh.rtk.state import (
    ARC_EPOCHS,
    ARC_S,
    DYNAMIC,
    INTEGER,
    REJECTS,
    SLIPS,
    Filter,
)
from rtkmesh.rtk.update import Layout, Update
from rtkmesh.rtk.validation import Resolution
from rtkmesh.rtk.verdict import verdict

if TYPE_CHECKING:
    from rtkmesh.rtk.relative import Solved

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

_REASONS: Final = {
    int(SingleStatus.OK): Reason.OK,
    int(SingleStatus.NO_EPHEMERIS): Reason.NO_EPHEMERIS,
    int(SingleStatus.FEW_SATELLITES): Reason.FEW_SATELLITES,
    int(SingleStatus.POOR_GEOMETRY): Reason.FEW_SATELLITES,
    int(SingleStatus.NO_CONVERGENCE): Reason.NO_CONVERGENCE,
    int(SingleStatus.INCONSISTENT): Reason.RESIDUALS,
}

# Columns of the row of figures of a relative solution.
(
    AMBIGUITIES, SATELLITES_USED, PHASES, CODE_RMS_M, PHASE_RMS_M, NIS, REASON, IS_FIXED, RATIO, THRESHOLD, SUCCESS, COUNT_FIXED, GRADE,
    SLOPE_G1_M, SLOPE_G2_M, ODDS, WRONG, PROTECTION_H_M, PROTECTION_V_M, RESIDUAL_TEST, FLOAT_TEST, CODE_TEST,
) = range(22)  # fmt: skip
FIGURES: Final = 22
_NO_VECTOR: Final = np.full(3, nan)
_NO_MATRIX: Final = np.full((3, 3), nan)
_REASON_OF: Final = tuple(Reason)  # by number
_FIX, _FLOAT, _DGPS = Status.FIX, Status.FLOAT, Status.DGPS  # a member of an enumeration is looked up in 0.1 us


def from_single(rover: Epoch, base: Epoch | None, single: Located, rate_factor: float) -> Solution:
    """Return the single-point solution of an epoch, or none with the reason; ``rate_factor`` is of its velocity's covariance."""
    ok = single.status == CONVERGED
    return Solution(
        time=rover.time,
        status=Status.SINGLE if ok else Status.NONE,
        reason=_REASONS[single.status],
        position_ecef_m=single.position_ecef_m,
        position_cov_ecef_m2=single.covariance_m2,
        velocity_ecef_mps=single.velocity_mps[:3],
        velocity_cov_ecef_m2ps2=rate_factor * single.velocity_cov_m2ps2,
        single_position_ecef_m=single.position_ecef_m,
        receiver_clock_s=single.clock_s,
        clocks_s=single.clocks_s,
        satellites_used=int(np.count_nonzero(single.work[:, USED])) if ok else 0,
        satellites_rover=count_runs(rover.satellite),
        satellites_base=0 if base is None else count_runs(base.satellite),
        integrity_reason=IntegrityReason.NOT_WATCHED if ok else IntegrityReason.NO_SOLUTION,
    )


class Circumstances(NamedTuple):
    """What is around a relative solution: ``base_single`` is the single point of a moving base, else None; ``rate_factors`` are of the
    covariances of both receivers' velocities; ``satellites`` are how many both have; ``sense`` is 1.0, or -1.0 where the filter's clock
    runs against GPS time.
    """

    age_s: float
    moves: bool
    sense: float
    base_single: Located | None
    rate_factors: tuple[float, float]
    satellites: tuple[int, int]
    resets: int
    options: RtkOptions


class Moved(NamedTuple):
    """Velocity (m/s) and acceleration (m/s2), ECEF, and their covariances; NaN where not known."""

    velocity_mps: Vector
    velocity_cov_m2ps2: Matrix
    acceleration_mps2: Vector
    acceleration_cov_m2ps4: Matrix


def report(rover: Epoch, single: Located, base_ecef_m: Vector, solved: "Solved", motion: Moved, around: Circumstances) -> Solution:
    """Return the relative solution: fixed where the resolution says so, else float, else differential code; ``motion`` is published."""
    numbers, base_ecef_m = solved.figures.tolist(), base_ecef_m.copy()
    solution = object.__new__(Solution)  # field by field: its own initialiser takes 3 us for so many
    solution.time = rover.time
    solution.status = _FIX if numbers[IS_FIXED] else (_FLOAT if numbers[PHASES] >= 4 else _DGPS)
    solution.reason = _REASON_OF[int(numbers[REASON])]
    _tell_place(solution, single, base_ecef_m, solved, around)
    _tell_motion(solution, motion)
    _tell_figures(solution, numbers)
    _tell_integrity(solution, numbers, solved, around)
    solution.age_s = around.age_s
    solution.satellites_rover, solution.satellites_base = around.satellites
    solution.satellites = SatelliteTable(solved.satellites)
    solution.float_state = _float_state(solved, base_ecef_m, around)
    solution.resets = around.resets
    solution.waited_s = 0.0
    return solution


def _tell_place(solution: Solution, single: Located, base_ecef_m: Vector, solved: "Solved", around: Circumstances) -> None:
    """Say where rover and base are, and when it is there; the baseline is a view of this epoch's states, which nobody else has."""
    covariance, base = solved.position_cov_m2[:3, :3], around.base_single
    solution.base_ecef_m = base_ecef_m
    solution.baseline_ecef_m = solved.x[:3]
    solution.baseline_cov_ecef_m2 = covariance
    solution.position_ecef_m = base_ecef_m + solved.x[:3]
    solution.position_cov_ecef_m2 = covariance if base is None else covariance + base.covariance_m2
    solution.single_position_ecef_m = single.position_ecef_m
    solution.receiver_clock_s = single.clock_s
    solution.clocks_s = single.clocks_s


def _tell_motion(solution: Solution, motion: Moved) -> None:
    """Say how the rover moves."""
    solution.velocity_ecef_mps = motion.velocity_mps
    solution.velocity_cov_ecef_m2ps2 = motion.velocity_cov_m2ps2
    solution.acceleration_ecef_mps2 = motion.acceleration_mps2
    solution.acceleration_cov_ecef_m2ps4 = motion.acceleration_cov_m2ps4


def _tell_figures(solution: Solution, numbers: list[float]) -> None:
    """Say what integers and residuals are like."""
    solution.ratio = numbers[RATIO]
    solution.ratio_threshold = numbers[THRESHOLD]
    solution.success_rate = numbers[SUCCESS]
    solution.grade = int(numbers[GRADE])
    solution.ambiguities = int(numbers[AMBIGUITIES])
    solution.ambiguities_fixed = int(numbers[COUNT_FIXED])
    solution.satellites_used = int(numbers[SATELLITES_USED])
    solution.code_rms_m = numbers[CODE_RMS_M]
    solution.phase_rms_m = numbers[PHASE_RMS_M]
    solution.nis_per_observation = numbers[NIS]
    solution.glonass_slopes_m = numbers[SLOPE_G1_M], numbers[SLOPE_G2_M]


def _tell_integrity(solution: Solution, numbers: list[float], solved: "Solved", around: Circumstances) -> None:
    """Say how far the solution may be trusted."""
    levels_m = numbers[PROTECTION_H_M], numbers[PROTECTION_V_M]
    solution.fix_probability = 1.0 - numbers[WRONG] if solution.status is _FIX else 0.0
    solution.protection_horizontal_m, solution.protection_vertical_m = levels_m
    solution.integrity, solution.integrity_reason = verdict(
        solution.status, numbers[RESIDUAL_TEST:], levels_m, solved.x, solved.P, around.options
    )


def _float_state(solved: "Solved", base_ecef_m: Vector, around: Circumstances) -> FloatState:
    """Return what the filters know beside the integers; the atmosphere of the informed one where there is one."""
    x, informed = solved.filter.x.copy(), solved.informed
    if len(informed.keys):
        return FloatState(base_ecef_m, x, informed.keys, informed.x[DYNAMIC:].copy(), around.sense, around.moves)
    return FloatState(base_ecef_m, x, solved.filter.keys, x[DYNAMIC:], around.sense, around.moves)


def motion_of(single: Located, x: Vector, P: Matrix, around: Circumstances) -> Moved:
    """Return the motion by the filter; of a moving base its own velocity is added, but the acceleration is the baseline's.

    Where nothing moves, or nobody knows how the base does, the velocity is the single-point one.
    """
    base, factor = around.base_single, around.rate_factors[0]
    if not around.moves or (base is not None and not isfinite(base.velocity_mps[0])):
        return Moved(single.velocity_mps[:3], factor * single.velocity_cov_m2ps2, _NO_VECTOR.copy(), _NO_MATRIX.copy())
    velocity, covariance = x[3:6] if around.sense > 0.0 else -x[3:6], P[3:6, 3:6]
    if base is not None:
        velocity = velocity + base.velocity_mps[:3]
        covariance = covariance_of_sum(covariance, single, base, around.rate_factors)
    elif isfinite(single.velocity_mps[0]):  # else the covariance is what motion and phases make of it
        covariance = factor * covariance
    return Moved(velocity, covariance, x[6:9], P[6:9, 6:9])


def covariance_of_sum(P: Matrix, single: Located, base: Located, factors: tuple[float, float]) -> Matrix:
    """Return the covariance (m2/s2) of the sum of a base's Doppler velocity and the filter's relative one, in which the same Dopplers are.

    With D and B the covariances of rover's and base's, the filter has taken K = P (D + B)^-1 of the difference of both: its error
    and that of the base's have -K B in common. Without Dopplers of the rover they have nothing in common.
    """
    D, B = factors[0] * single.velocity_cov_m2ps2, factors[1] * base.velocity_cov_m2ps2
    if not isfinite(D[0, 0]):
        return P + B
    relative = P * (np.trace(D + B) / np.trace(single.velocity_cov_m2ps2 + base.velocity_cov_m2ps2))
    common = _taken(relative, D + B) @ B
    return relative + B - common - common.T


def _taken(P: Matrix, D: Matrix) -> Matrix:
    """Return the part that a filter of covariance P has taken of a velocity of covariance D: P D^-1, but in no direction more than all.

    P is larger than D where the filter gave it less weight: what contradicts the prediction, and what lasts (``velocity``). Were more than
    all taken, variances of sums could be negative. In the axes in which D is the identity and P diagonal, what is taken is diagonal too.
    """
    whitened = np.linalg.inv(np.linalg.cholesky(D))
    shares, axes = np.linalg.eigh(whitened @ P @ whitened.T)
    back = axes.T @ whitened
    return D @ (back.T * np.minimum(shares, 1.0)) @ back


@kernel_in_place
def describe_resolution(resolution: Resolution, out: Vector) -> None:
    """Write the figures of ambiguity resolution."""
    out[REASON], out[IS_FIXED], out[RATIO], out[THRESHOLD] = resolution.reason, resolution.fixed, resolution.ratio, resolution.threshold
    out[SUCCESS], out[COUNT_FIXED], out[GRADE] = resolution.success, resolution.integers, resolution.grade


@kernel_in_place
def describe_slopes(memory: Vector, out: Vector) -> None:
    """Write the slopes of GLONASS phases that held integers have shown, NaN before."""
    for band in range(2):
        known = memory[SLOPE_SIGMA_G1 + band] <= SLOPES_APART_M
        out[SLOPE_G1_M + band] = memory[SLOPE_G1 + band] if known else nan


@kernel_in_place
def describe_guard(guarded: Guard, odds: float, out: Vector) -> None:
    """Write the figures of integrity."""
    out[ODDS], out[WRONG], out[PROTECTION_H_M], out[PROTECTION_V_M] = odds, guarded.wrong, guarded.horizontal_m, guarded.vertical_m
    out[RESIDUAL_TEST], out[FLOAT_TEST], out[CODE_TEST] = guarded.residual_test, guarded.float_test, guarded.code_test


@kernel_in_place
def describe_fit(d: Differences, layout: Layout, update: Update, out: Vector) -> None:
    """Write the counts and root mean squares of an update."""
    used = scratch_flags(len(layout.ambiguity))
    for k in range(len(used)):
        out[AMBIGUITIES] += 1.0 if layout.ambiguity[k] >= 0 else 0.0
        used[k] = update.code_used[k] or update.phase_used[k]
    out[SATELLITES_USED], out[PHASES] = distinct(d.pairs.satellite, used), distinct(d.pairs.satellite, update.phase_used)
    out[CODE_RMS_M], out[PHASE_RMS_M] = _rms(update.code_residual_m, update.code_used), _rms(update.phase_residual_m, update.phase_used)
    out[NIS] = update.phase_chi2 / update.phase_dof if update.phase_dof > 0.5 else np.nan


@kernel_in_place
def _rms(values: Vector, used: NDArray[np.bool_]) -> float:
    """Return the root mean square of the used finite values; NaN if there are none."""
    total, count = 0.0, 0
    for k in range(len(values)):
        if used[k] and isfinite(values[k]):
            total += values[k] ** 2
            count += 1
    return sqrt(total / count) if count else np.nan


@kernel
def describe_pairs(f: Filter, d: Differences, layout: Layout, update: Update, fixed: bool, time_s: float) -> Matrix:
    """Return what the filter made of each pair, in the columns of SatelliteTable."""
    n = len(layout.ambiguity)
    out = np.empty((n, TABLE))
    for k in range(n):
        row, place = out[k], layout.ambiguity[k]
        bits = (USED_CODE if update.code_used[k] else 0) | (USED_PHASE if update.phase_used[k] else 0)
        bits |= HALF_CYCLE if d.half_cycle[k] else 0
        row[T_AMBIGUITY_CYC], row[T_LOCK_S], row[T_SLIPS] = np.nan, np.nan, 0.0
        row[T_VARIANCE_CYC2], row[T_LOCK_EPOCHS], row[T_REJECTS] = np.nan, 0.0, 0.0
        if place >= 0:
            history = f.history[place]
            if fixed and isfinite(history[INTEGER]):
                bits |= FIXED
            if history[ARC_EPOCHS] <= 1.0 and history[SLIPS] > 0.0:
                bits |= SLIPPED
            if not update.phase_used[k]:
                bits |= REJECTED
            row[T_AMBIGUITY_CYC], row[T_LOCK_S], row[T_SLIPS] = f.x[DYNAMIC + place], time_s - history[ARC_S], history[SLIPS]
            row[T_VARIANCE_CYC2] = f.P[DYNAMIC + place, DYNAMIC + place]
            row[T_LOCK_EPOCHS], row[T_REJECTS] = history[ARC_EPOCHS], history[REJECTS]
        row[T_SATELLITE], row[T_STATE] = d.pairs.satellite[k], bits
        row[T_SIGNAL] = d.pairs.key[k] % KEYS_PER_SATELLITE // SIGNALS_PER_SATELLITE
        row[T_AZIMUTH_RAD], row[T_ELEVATION_RAD], row[T_CN0_DBHZ] = d.azimuth_rad[k], d.table[k, ELEVATION_RAD], d.table[k, CN0]
        row[T_CODE_M], row[T_PHASE_M] = update.code_residual_m[k], update.phase_residual_m[k]
    return out
