"""The solution of an epoch, from what the steps of the engine left behind."""

from dataclasses import dataclass
from math import isfinite, nan, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.models.code_selection import USED
from rtkmesh.models.single import Located, SingleStatus, receiver_clock_s
from rtkmesh.models.single_adjustment import CONVERGED
from rtkmesh.rtk.matching import count_runs, distinct
from rtkmesh.rtk.residuals import CN0, ELEVATION_RAD, Differences
from rtkmesh.rtk.solution import FIXED, HALF_CYCLE, REJECTED, SLIPPED, USED_CODE, USED_PHASE, Reason, SatelliteTable, Solution, Status
from rtkmesh.rtk.state import ARC_EPOCHS, ARC_S, DYNAMIC, INTEGER, SLIPS, Filter, FilterState
from rtkmesh.rtk.update import Layout, Update
from rtkmesh.rtk.validation import Resolution

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

# Places in the row of figures that ``figures`` writes.
_AMBIGUITIES, _USED, _ROVER, _BASE, _CODE_RMS, _PHASE_RMS, _PHASES, _CLOCK_S = range(8)
_FIGURES: Final = 8


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What the steps of one relative epoch gave; ``base`` is the single point of a moving base, else None."""

    differences: Differences
    layout: Layout
    update: Update
    resolution: Resolution
    age_s: float
    moves: bool
    base: Located | None
    resets: int


def from_single(rover: Epoch, base: Epoch | None, single: Located) -> Solution:
    """Return the single-point solution of an epoch, or none with the reason."""
    ok = single.status == CONVERGED
    return Solution(
        time=rover.time,
        status=Status.SINGLE if ok else Status.NONE,
        reason=_REASONS[single.status],
        position_ecef_m=single.position_ecef_m,
        position_cov_ecef_m2=single.covariance_m2,
        velocity_ecef_mps=single.velocity_mps[:3],
        velocity_cov_ecef_m2ps2=single.velocity_cov_m2ps2,
        single_position_ecef_m=single.position_ecef_m,
        receiver_clock_s=receiver_clock_s(single),
        satellites_used=int(np.count_nonzero(single.work[:, USED])) if ok else 0,
        satellites_rover=count_runs(rover.satellite),
        satellites_base=0 if base is None else count_runs(base.satellite),
    )


def report(rover: Epoch, base: Epoch, single: Located, state: FilterState, outcome: Outcome) -> Solution:
    """Return the relative solution: fixed where the resolution says so, else float, else differential code."""
    resolution, update = outcome.resolution, outcome.update
    x, P = (resolution.x, resolution.P) if resolution.fixed else (state.filter.x, state.filter.P)
    numbers = figures(rover.satellite, base.satellite, outcome.differences, outcome.layout, update, single).tolist()
    status = Status.FIX if resolution.fixed else (Status.FLOAT if numbers[_PHASES] >= 4 else Status.DGPS)
    covariance = P[:3, :3].copy()
    velocity, velocity_covariance, acceleration = _motion(single, x, P, outcome)
    return Solution(
        time=rover.time,
        status=status,
        reason=Reason(resolution.reason),
        position_ecef_m=state.base_ecef_m + x[:3],
        position_cov_ecef_m2=covariance if outcome.base is None else covariance + outcome.base.covariance_m2,
        velocity_ecef_mps=velocity,
        velocity_cov_ecef_m2ps2=velocity_covariance,
        acceleration_ecef_mps2=acceleration,
        base_ecef_m=state.base_ecef_m.copy(),
        baseline_ecef_m=x[:3].copy(),
        baseline_cov_ecef_m2=covariance,
        single_position_ecef_m=single.position_ecef_m,
        receiver_clock_s=numbers[_CLOCK_S],
        age_s=outcome.age_s,
        ratio=resolution.ratio,
        ratio_threshold=resolution.threshold,
        success_rate=resolution.success,
        grade=resolution.grade,
        ambiguities=int(numbers[_AMBIGUITIES]),
        ambiguities_fixed=resolution.count,
        satellites_used=int(numbers[_USED]),
        satellites_rover=int(numbers[_ROVER]),
        satellites_base=int(numbers[_BASE]),
        code_rms_m=numbers[_CODE_RMS],
        phase_rms_m=numbers[_PHASE_RMS],
        nis_per_observation=update.phase_chi2 / update.phase_dof if update.phase_dof > 0.5 else nan,
        satellites=_satellites(state, outcome),
        resets=outcome.resets,
    )


def _motion(single: Located, x: Vector, P: Matrix, outcome: Outcome) -> tuple[Vector, Matrix, Vector]:
    """Return velocity (with covariance) and acceleration of the filter; of a moving base its own velocity is added.

    Where nothing moves the velocity is the single-point one.
    """
    if not outcome.moves:
        return single.velocity_mps[:3], single.velocity_cov_m2ps2, np.full(3, nan)
    velocity, covariance = x[3:6].copy(), P[3:6, 3:6].copy()
    base = outcome.base
    if base is not None and isfinite(base.velocity_mps[0]):
        velocity += base.velocity_mps[:3]
        covariance += base.velocity_cov_m2ps2
    return velocity, covariance, x[6:9].copy()


def _satellites(state: FilterState, outcome: Outcome) -> SatelliteTable:
    d, update = outcome.differences, outcome.update
    n = len(d.table)
    signal, flags, slips = np.empty(n, np.int16), np.empty(n, np.uint8), np.empty(n, np.int32)
    ambiguity_cyc, lock_s = np.empty(n), np.empty(n)
    describe_phases(state.filter, d, outcome.layout, update, outcome.resolution.fixed, state.time_s, signal, flags, ambiguity_cyc, lock_s, slips)
    return SatelliteTable(
        satellite=d.pairs.satellite,
        signal=signal,
        state=flags,
        azimuth_rad=d.azimuth_rad,
        elevation_rad=d.table[:, ELEVATION_RAD],
        cn0_dbhz=d.table[:, CN0],
        code_residual_m=update.code_residual_m,
        phase_residual_m=update.phase_residual_m,
        ambiguity_cyc=ambiguity_cyc,
        lock_s=lock_s,
        slips=slips,
    )


@kernel
def figures(
    rover: NDArray[np.int16], base: NDArray[np.int16], d: Differences, layout: Layout, update: Update, single: Located
) -> Vector:
    """Return the counts and root mean squares of a relative solution."""
    n, out, used = len(layout.ambiguity), np.zeros(_FIGURES), np.empty(len(layout.ambiguity), np.bool_)
    for k in range(n):
        out[_AMBIGUITIES] += 1.0 if layout.ambiguity[k] >= 0 else 0.0
        used[k] = update.code_used[k] or update.phase_used[k]
    out[_USED], out[_PHASES] = distinct(d.pairs.satellite, used), distinct(d.pairs.satellite, update.phase_used)
    out[_ROVER], out[_BASE] = count_runs(rover), count_runs(base)
    out[_CODE_RMS], out[_PHASE_RMS] = _rms(update.code_residual_m, update.code_used), _rms(update.phase_residual_m, update.phase_used)
    out[_CLOCK_S] = receiver_clock_s(single)
    return out


@kernel
def _rms(values: Vector, used: NDArray[np.bool_]) -> float:
    """Return the root mean square of the used finite values; NaN if there are none."""
    total, count = 0.0, 0
    for k in range(len(values)):
        if used[k] and isfinite(values[k]):
            total += values[k] ** 2
            count += 1
    return sqrt(total / count) if count else np.nan


@kernel
def describe_phases(
    f: Filter, d: Differences, layout: Layout, update: Update, fixed: bool, time_s: float, signal: NDArray[np.int16],
    flags: NDArray[np.uint8], ambiguity_cyc: Vector, lock_s: Vector, slips: NDArray[np.int32],
) -> None:  # fmt: skip
    """Write per pair the rover's signal, the bits of SatelliteTable.state, and what the filter knows of its ambiguity."""
    for k in range(len(signal)):
        signal[k] = (d.pairs.key[k] % 262144) // 512
        bits = (USED_CODE if update.code_used[k] else 0) | (USED_PHASE if update.phase_used[k] else 0)
        bits |= HALF_CYCLE if d.half_cycle[k] else 0
        ambiguity_cyc[k], lock_s[k], slips[k] = nan, nan, 0
        place = layout.ambiguity[k]
        if place >= 0:
            row = f.history[place]
            if fixed and isfinite(row[INTEGER]):
                bits |= FIXED
            if row[ARC_EPOCHS] <= 1.0 and row[SLIPS] > 0.0:
                bits |= SLIPPED
            if not update.phase_used[k]:
                bits |= REJECTED
            ambiguity_cyc[k], lock_s[k], slips[k] = f.x[DYNAMIC + place], time_s - row[ARC_S], int(row[SLIPS])
        flags[k] = bits
