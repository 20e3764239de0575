"""Old and new base side by side, for the first epochs after a change: the old engine goes on with the base epochs that it has."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.ephemeris import KlobucharParameters
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.rtk.base_change import COMPARED_S, Jump, jump_between
from rtkmesh.rtk.engine import Rtk
from rtkmesh.rtk.solution import Solution


@dataclass(slots=True)
class Comparison:
    """The engine of the old base, its epochs in rising time, and where it stood (ECEF, m). Mutable."""

    engine: Rtk
    bases: Sequence[Epoch]
    position_ecef_m: "NDArray[np.float64] | None"
    _begun: GpsTime | None = field(default=None)

    def jump(self, rover: Epoch, solution: Solution, table: EphemerisTable, klobuchar: KlobucharParameters | None) -> Jump:
        """Solve a rover epoch with the old base too; return how far apart the solutions are."""
        self._begun = self._begun or rover.time
        base = min(self.bases, key=lambda epoch: abs(epoch.time - rover.time), default=None)
        old = self.engine.step(rover, base, table, klobuchar, base_position_ecef_m=self.position_ecef_m)
        return jump_between(old, solution, over=rover.time - self._begun >= COMPARED_S)
