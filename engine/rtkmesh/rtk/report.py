"""The solution of an epoch, from what the steps of the engine left behind."""

from dataclasses import dataclass
from math import isfinite, nan

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.models.single import SinglePoint, SingleStatus
from rtkmesh.rtk.matching import count_runs, distinct
from rtkmesh.rtk.residuals import CN0, ELEVATION_RAD, Differences
from rtkmesh.rtk.slips import rms
from rtkmesh.rtk.solution import FIXED, HALF_CYCLE, REJECTED, SLIPPED, USED_CODE, USED_PHASE, Reason, SatelliteTable, Solution, Status
from rtkmesh.rtk.state import ARC_EPOCHS, ARC_S, INTEGER, SLIPS, FilterState
from rtkmesh.rtk.update import Layout, Update
from rtkmesh.rtk.validation import Resolution

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.int64]

_REASONS = {
    SingleStatus.OK: Reason.OK,
    SingleStatus.NO_EPHEMERIS: Reason.NO_EPHEMERIS,
    SingleStatus.FEW_SATELLITES: Reason.FEW_SATELLITES,
    SingleStatus.POOR_GEOMETRY: Reason.FEW_SATELLITES,
    SingleStatus.NO_CONVERGENCE: Reason.NO_CONVERGENCE,
    SingleStatus.INCONSISTENT: Reason.RESIDUALS,
}


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What the steps of one relative epoch gave."""

    differences: Differences
    layout: Layout
    update: Update
    resolution: Resolution
    age_s: float
    moves: bool
    base_single: SinglePoint | None
    resets: int


def from_single(rover: Epoch, base: Epoch | None, single: SinglePoint) -> Solution:
    """Return the single-point solution of an epoch, or none with the reason."""
    return Solution(
        time=rover.time,
        status=Status.SINGLE if single.ok else Status.NONE,
        reason=_REASONS[single.status],
        position_ecef_m=single.position_ecef_m,
        position_cov_ecef_m2=single.position_cov_ecef_m2,
        velocity_ecef_mps=single.velocity_ecef_mps,
        velocity_cov_ecef_m2ps2=single.velocity_cov_ecef_m2ps2,
        single_position_ecef_m=single.position_ecef_m,
        receiver_clock_s=single.receiver_clock_s,
        satellites_used=int(np.count_nonzero(single.used)),
        satellites_rover=count_runs(rover.satellite),
        satellites_base=0 if base is None else count_runs(base.satellite),
    )


def report(rover: Epoch, base: Epoch, single: SinglePoint, state: FilterState, outcome: Outcome) -> Solution:
    """Return the relative solution: fixed where the resolution says so, else float, else differential code."""
    resolution, update = outcome.resolution, outcome.update
    fixed = resolution.x is not None and resolution.P is not None
    x = resolution.x if resolution.x is not None else state.x
    P = resolution.P if resolution.P is not None else state.cov
    satellites = outcome.differences.pairs.satellite
    phases = distinct(satellites, update.phase_used)
    status = Status.FIX if fixed else (Status.FLOAT if phases >= 4 else Status.DGPS)
    base_single, covariance = outcome.base_single, P[:3, :3].copy()
    velocity, velocity_covariance, acceleration = _motion(single, x, P, outcome)
    return Solution(
        time=rover.time,
        status=status,
        reason=resolution.reason,
        position_ecef_m=state.base_ecef_m + x[:3],
        position_cov_ecef_m2=covariance if base_single is None else covariance + base_single.position_cov_ecef_m2,
        velocity_ecef_mps=velocity,
        velocity_cov_ecef_m2ps2=velocity_covariance,
        acceleration_ecef_mps2=acceleration,
        base_ecef_m=state.base_ecef_m.copy(),
        baseline_ecef_m=x[:3].copy(),
        baseline_cov_ecef_m2=covariance,
        single_position_ecef_m=single.position_ecef_m,
        receiver_clock_s=single.receiver_clock_s,
        age_s=outcome.age_s,
        ratio=resolution.ratio,
        ratio_threshold=resolution.threshold,
        success_rate=resolution.success,
        grade=resolution.grade,
        ambiguities=int(np.count_nonzero(outcome.layout.ambiguity >= 0)),
        ambiguities_fixed=resolution.count,
        satellites_used=distinct(satellites, update.phase_used | update.code_used),
        satellites_rover=count_runs(rover.satellite),
        satellites_base=count_runs(base.satellite),
        code_rms_m=rms(update.code_residual_m[update.code_used]),
        phase_rms_m=rms(update.phase_residual_m[update.phase_used]),
        nis_per_observation=update.phase_chi2 / update.phase_dof if update.phase_dof > 0.5 else nan,
        satellites=_satellites(state, outcome),
        resets=outcome.resets,
    )


def _motion(single: SinglePoint, x: Vector, P: Matrix, outcome: Outcome) -> tuple[Vector, Matrix, Vector]:
    """Return velocity (with covariance) and acceleration of the filter; of a moving base its own velocity is added.

    Where nothing moves the velocity is the single-point one.
    """
    if not outcome.moves:
        return single.velocity_ecef_mps, single.velocity_cov_ecef_m2ps2, np.full(3, nan)
    velocity, covariance = x[3:6].copy(), P[3:6, 3:6].copy()
    base = outcome.base_single
    if base is not None and base.has_velocity:
        velocity += base.velocity_ecef_mps
        covariance += base.velocity_cov_ecef_m2ps2
    return velocity, covariance, x[6:9].copy()


def _satellites(state: FilterState, outcome: Outcome) -> SatelliteTable:
    d, update = outcome.differences, outcome.update
    n = len(d.pairs)
    signal, flags, slips = np.empty(n, np.int16), np.empty(n, np.uint8), np.empty(n, np.int32)
    ambiguity_cyc, lock_s = np.empty(n), np.empty(n)
    describe_phases(
        state.history, state.x, state.dynamic, outcome.layout.ambiguity, d.pairs.key, update.code_used, update.phase_used, d.half_cycle,
        outcome.resolution.x is not None, state.time_s, signal, flags, ambiguity_cyc, lock_s, slips,
    )  # fmt: skip
    return SatelliteTable(
        satellite=d.pairs.satellite.copy(),
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
def describe_phases(
    history: Matrix, x: Vector, dynamic: int, place: Indices, key: Indices, code_used: NDArray[np.bool_], phase_used: NDArray[np.bool_],
    half_cycle: NDArray[np.bool_], fixed: bool, time_s: float, signal: NDArray[np.int16], flags: NDArray[np.uint8], ambiguity_cyc: Vector,
    lock_s: Vector, slips: NDArray[np.int32],
) -> None:  # fmt: skip
    """Write per pair the rover's signal, the bits of SatelliteTable.state, and what the filter knows of its ambiguity."""
    for k in range(len(place)):
        signal[k] = (key[k] % 262144) // 512
        bits = (USED_CODE if code_used[k] else 0) | (USED_PHASE if phase_used[k] else 0) | (HALF_CYCLE if half_cycle[k] else 0)
        ambiguity_cyc[k], lock_s[k], slips[k] = nan, nan, 0
        if place[k] >= 0:
            row = history[place[k]]
            if fixed and isfinite(row[INTEGER]):
                bits |= FIXED
            if row[ARC_EPOCHS] <= 1.0 and row[SLIPS] > 0.0:
                bits |= SLIPPED
            if not phase_used[k]:
                bits |= REJECTED
            ambiguity_cyc[k], lock_s[k], slips[k] = x[dynamic + place[k]], time_s - row[ARC_S], int(row[SLIPS])
        flags[k] = bits
