"""A solution in the local frame: east, north, up at its own position, with full covariances."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.frames import enu_from_ecef_at
from rtkmesh.rtk.solution import Solution

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class LocalSolution:
    """What of a solution has a direction, in east-north-up (m, m/s, m/s2), covariances 3x3; NaN where the solution has NaN or no place.

    The frame stands still: velocity and acceleration are those of ECEF, turned. ``rotation`` takes ECEF vectors to east-north-up.
    """

    rotation: Matrix
    position_cov_m2: Matrix
    velocity_mps: Vector
    velocity_cov_m2ps2: Matrix
    acceleration_mps2: Vector
    acceleration_cov_m2ps4: Matrix
    baseline_m: Vector
    baseline_cov_m2: Matrix


def in_enu(solution: Solution) -> LocalSolution:
    """Return a solution in the local frame of its position."""
    known = bool(np.isfinite(solution.position_ecef_m).all())
    rotation: Matrix = enu_from_ecef_at(solution.position_ecef_m) if known else np.full((3, 3), np.nan)
    return LocalSolution(
        rotation,
        _turned(rotation, solution.position_cov_ecef_m2),
        rotation @ solution.velocity_ecef_mps,
        _turned(rotation, solution.velocity_cov_ecef_m2ps2),
        rotation @ solution.acceleration_ecef_mps2,
        _turned(rotation, solution.acceleration_cov_ecef_m2ps4),
        rotation @ solution.baseline_ecef_m,
        _turned(rotation, solution.baseline_cov_ecef_m2),
    )


def _turned(rotation: Matrix, cov: Matrix) -> Matrix:
    return rotation @ cov @ rotation.T
