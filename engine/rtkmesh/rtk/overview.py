"""What an engine knows of its newest epoch beside the solution, for people: made when asked for, never per epoch."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.signals import SYSTEMS
from rtkmesh.models.code_selection import CLOCK_OF_SYSTEM, GROUP, RESIDUAL, USED
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
    receiver clock by system (s, in the order of ``SYSTEMS``, receiver minus system), the float filter's baseline with its covariance
    and where its base is (ECEF), and the number of states: of motion, and of all. Unknown is NaN.
    """

    satellite: NDArray[np.int16] = field(default_factory=lambda: np.zeros(0, np.int16))
    azimuth_rad: Vector = field(default_factory=lambda: np.zeros(0))
    elevation_rad: Vector = field(default_factory=lambda: np.zeros(0))
    code_used: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))
    code_residual_m: Vector = field(default_factory=lambda: np.zeros(0))
    clock_s: Vector = field(default_factory=lambda: np.full(len(SYSTEMS), np.nan))
    float_baseline_m: Vector = field(default_factory=lambda: np.full(3, np.nan))
    float_cov_m2: Matrix = field(default_factory=lambda: np.full((3, 3), np.nan))
    base_ecef_m: Vector = field(default_factory=lambda: np.full(3, np.nan))
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
    return replace(
        seen,
        float_baseline_m=f.x[:3].copy(),
        float_cov_m2=f.P[:3, :3].copy(),
        base_ecef_m=state.base_ecef_m.copy(),
        states_of_motion=DYNAMIC,
        states=len(f.x),
    )


def _of_single(single: Located) -> Overview:
    used = (single.work[:, USED] != 0.0) & (single.status == CONVERGED)
    return Overview(
        satellite=single.satellites,
        azimuth_rad=single.geometry[:, AZIMUTH],
        elevation_rad=single.geometry[:, ELEVATION],
        code_used=used,
        code_residual_m=np.where(used, single.work[:, RESIDUAL], np.nan),
        clock_s=np.array([_clock_s(single, used, group) for group in CLOCK_OF_SYSTEM.tolist()]),
    )


def _clock_s(single: Located, used: NDArray[np.bool_], group: int) -> float:
    """Return the receiver clock of a group of systems, NaN where none of its codes was used."""
    told = bool((used & (single.work[:, GROUP] == group)).any())
    return float(single.clocks_m[group]) / SPEED_OF_LIGHT_MPS if told else float("nan")


def phase_dilution(table: SatelliteTable) -> Dilution:
    """Return the dilution of the satellites that a relative solution has used."""
    used = table.state & (USED_CODE | USED_PHASE) != 0
    _, rows = np.unique(table.satellite[used], return_index=True)
    return dilution(table.azimuth_rad[used][rows], table.elevation_rad[used][rows])
