"""What an epoch comes with, and what an engine has learned before it."""

from dataclasses import replace
from math import nan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.epoch import Epoch
from rtkmesh.models.common_instant import base_move_ecef_m, moved_base
from rtkmesh.models.ephemeris_table import Issues
from rtkmesh.models.single import Located
from rtkmesh.rtk.memory import forget

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


class Past(NamedTuple):
    """What an engine has learned beside its filter, as ``relative.Known`` has it; all is written to."""

    memory: Vector
    prediction: Vector
    scale: Matrix
    informed_scale: Matrix

    def copy(self) -> "Past":
        """Return a past of its own."""
        return Past(*(part.copy() for part in self))

    def forget(self) -> None:
        """Forget integers and predictions; what was learned of the receivers stays."""
        self.prediction[:] = nan
        forget(self.memory)


class Around(NamedTuple):
    """What an epoch comes with: the base epochs that share no system, ephemerides, the single points of the rover and of a moving base, the
    base's position (ECEF, m).
    """

    rover: Epoch
    bases: list[Epoch]
    issues: Issues
    singles: tuple[Located, Located | None]
    base_ecef_m: Vector


def at_instant_of(rover: Epoch, single: Located, base: Epoch, base_single: Located, issues: Issues) -> Epoch:
    """Return the epoch of a moving base as if it had been measured, like the rover's, at the instant that the rover's tag names."""
    move_ecef_m = base_move_ecef_m(single, base_single, rover.time - base.time)
    if not move_ecef_m.any():
        return base
    codes_m, phases_cyc = moved_base(base.signals, base_single, issues.channel, move_ecef_m)
    return replace(base, pseudorange_m=codes_m, phase_cyc=phases_cyc)
