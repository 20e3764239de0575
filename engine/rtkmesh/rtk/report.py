"""The solution of an epoch, from what the steps of the engine left behind."""

from dataclasses import dataclass, replace
from math import nan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.epoch import Epoch
from rtkmesh.models.single import SinglePoint, SingleStatus
from rtkmesh.rtk.matching import distinct
from rtkmesh.rtk.residuals import CN0, ELEVATION_RAD, Differences
from rtkmesh.rtk.slips import rms
from rtkmesh.rtk.solution import FIXED, HALF_CYCLE, REJECTED, SLIPPED, USED_CODE, USED_PHASE, Reason, SatelliteTable, Solution, Status
from rtkmesh.rtk.state import ARC_EPOCHS, ARC_S, INTEGER, SLIPS, FilterState
from rtkmesh.rtk.update import Layout, Update
from rtkmesh.rtk.validation import Resolution

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

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
        satellites_used=int(single.used.sum()),
        satellites_rover=_count(rover.satellite),
        satellites_base=0 if base is None else _count(base.satellite),
    )


def _count(ordered: NDArray[np.int16]) -> int:
    return distinct(ordered, np.ones(len(ordered), np.bool_))


def report(solution: Solution, state: FilterState, outcome: Outcome) -> Solution:
    """Return the relative solution: fixed where the resolution says so, else float, else differential code."""
    resolution, update = outcome.resolution, outcome.update
    fixed = resolution.x is not None and resolution.P is not None
    x = resolution.x if resolution.x is not None else state.x
    P = resolution.P if resolution.P is not None else state.cov
    satellites = outcome.differences.pairs.satellite
    phases = distinct(satellites, update.phase_used)
    status = Status.FIX if fixed else (Status.FLOAT if phases >= 4 else Status.DGPS)
    base, covariance = outcome.base_single, P[:3, :3].copy()
    motion = _motion(x, P, outcome)
    return replace(
        solution,
        status=status,
        reason=resolution.reason,
        position_ecef_m=state.base_ecef_m + x[:3],
        position_cov_ecef_m2=covariance if base is None else covariance + base.position_cov_ecef_m2,
        base_ecef_m=state.base_ecef_m.copy(),
        baseline_ecef_m=x[:3].copy(),
        baseline_cov_ecef_m2=covariance,
        age_s=outcome.age_s,
        ratio=resolution.ratio,
        ratio_threshold=resolution.threshold,
        success_rate=resolution.success,
        grade=resolution.grade,
        ambiguities=int((outcome.layout.ambiguity >= 0).sum()),
        ambiguities_fixed=resolution.count,
        satellites_used=distinct(satellites, update.phase_used | update.code_used),
        code_rms_m=rms(update.code_residual_m[update.code_used]),
        phase_rms_m=rms(update.phase_residual_m[update.phase_used]),
        nis_per_observation=update.phase_chi2 / update.phase_dof if update.phase_dof > 0.5 else nan,
        satellites=_satellites(state, outcome),
        resets=outcome.resets,
        **motion,
    )


def _motion(x: Vector, P: Matrix, outcome: Outcome) -> dict[str, Any]:
    """Return velocity and acceleration of the filter; of a moving base its own velocity is added. Empty where nothing moves."""
    if not outcome.moves:
        return {}
    velocity, covariance = x[3:6].copy(), P[3:6, 3:6].copy()
    base = outcome.base_single
    if base is not None and base.has_velocity:
        velocity += base.velocity_ecef_mps
        covariance += base.velocity_cov_ecef_m2ps2
    return {"velocity_ecef_mps": velocity, "velocity_cov_ecef_m2ps2": covariance, "acceleration_ecef_mps2": x[6:9].copy()}


def _satellites(state: FilterState, outcome: Outcome) -> SatelliteTable:
    d, update, place = outcome.differences, outcome.update, outcome.layout.ambiguity
    seen = place >= 0
    row = np.where(seen, place, 0)
    if len(state.keys):
        history, value = state.history[row], state.x[state.dynamic + row]
    else:
        history, value = np.full((len(row), state.history.shape[1]), nan), np.full(len(row), nan)
    fixed = np.isfinite(history[:, INTEGER]) & seen & (outcome.resolution.x is not None)
    flags = (
        USED_CODE * update.code_used + USED_PHASE * update.phase_used + FIXED * fixed
        + SLIPPED * (seen & (history[:, ARC_EPOCHS] <= 1.0) & (history[:, SLIPS] > 0.0))
        + REJECTED * (seen & ~update.phase_used) + HALF_CYCLE * d.half_cycle
    )  # fmt: skip
    return SatelliteTable(
        satellite=d.pairs.satellite.copy(),
        signal=((d.pairs.key % 262144) // 512).astype(np.int16),
        state=flags.astype(np.uint8),
        azimuth_rad=d.azimuth_rad,
        elevation_rad=d.table[:, ELEVATION_RAD],
        cn0_dbhz=d.table[:, CN0],
        code_residual_m=update.code_residual_m,
        phase_residual_m=update.phase_residual_m,
        ambiguity_cyc=np.where(seen, value, nan),
        lock_s=np.where(seen, state.time_s - history[:, ARC_S], nan),
        slips=np.where(seen, history[:, SLIPS], 0).astype(np.int32),
    )
