"""What an engine knows of its newest epoch beside the solution, for people: made when asked for, never per epoch."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rtkmesh.models.code_selection import RESIDUAL, USED
from rtkmesh.models.dilution import Dilution, dilution
from rtkmesh.models.geometry import AZIMUTH, ELEVATION
from rtkmesh.models.single import Located
from rtkmesh.models.single_adjustment import CONVERGED
from rtkmesh.rtk.solution import USED_CODE, USED_PHASE, SatelliteTable
from rtkmesh.rtk.state import DYNAMIC, FilterState

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Overview:
    """The single point's satellites (one row each with a code: azimuth and elevation, whether its code was used, its residual), the
    covariance of the float filter's position (ECEF), and the number of states: of motion, and of all. Unknown is NaN.
    """

    satellite: NDArray[np.int16] = field(default_factory=lambda: np.zeros(0, np.int16))
    azimuth_rad: Vector = field(default_factory=lambda: np.zeros(0))
    elevation_rad: Vector = field(default_factory=lambda: np.zeros(0))
    code_used: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))
    code_residual_m: Vector = field(default_factory=lambda: np.zeros(0))
    float_cov_m2: Matrix = field(default_factory=lambda: np.full((3, 3), np.nan))
    states_of_motion: int = 0
    states: int = 0

    @property
    def code_dilution(self) -> Dilution:
        """Dilution of the satellites whose codes were used."""
        return dilution(self.azimuth_rad[self.code_used], self.elevation_rad[self.code_used])


def overview_of(state: FilterState | None, single: Located | None) -> Overview:
    """Return the overview of an engine with this filter (None: none) whose newest single point is this (None: none yet)."""
    seen = Overview() if single is None else _of_single(single)
    if state is None:
        return seen
    f = state.filter
    return replace(seen, float_cov_m2=f.P[:3, :3].copy(), states_of_motion=DYNAMIC, states=len(f.x))


def _of_single(single: Located) -> Overview:
    used = (single.work[:, USED] != 0.0) & (single.status == CONVERGED)
    return Overview(
        satellite=single.satellites,
        azimuth_rad=single.geometry[:, AZIMUTH],
        elevation_rad=single.geometry[:, ELEVATION],
        code_used=used,
        code_residual_m=np.where(used, single.work[:, RESIDUAL], np.nan),
    )


def phase_dilution(table: SatelliteTable) -> Dilution:
    """Return the dilution of the satellites that a relative solution has used."""
    used = table.state & (USED_CODE | USED_PHASE) != 0
    _, rows = np.unique(table.satellite[used], return_index=True)
    return dilution(table.azimuth_rad[used][rows], table.elevation_rad[used][rows])
