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
from rtkmesh.rtk.code_places import PLACE_SQUARES
from rtkmesh.rtk.memory import forget
from rtkmesh.rtk.noise import PHASE, SHADE
from rtkmesh.rtk.predicted import FULL_STEP_S

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


class Past(NamedTuple):
    """What an engine has learned beside its filter, as ``relative.Known`` has it; all is written to."""

    memory: Vector
    prediction: Vector
    scale: Matrix
    informed_scale: Matrix
    walk: Vector

    def copy(self) -> "Past":
        """Return a past of its own."""
        return Past(*(part.copy() for part in self))

    def learned(self, step_s: float) -> tuple[Matrix, Matrix] | None:
        """Return what is known of the noise, to be held against what an epoch makes of it, if that counts in part after ``step_s``."""
        return (self.scale.copy(), self.informed_scale.copy()) if step_s < FULL_STEP_S else None

    def count_in_part(self, before: tuple[Matrix, Matrix] | None, step_s: float) -> None:
        """Let what an epoch has taught of the noise since ``before`` count for its part, when it came ``step_s`` after the last one.

        At more than 1 Hz most errors of an epoch are those of the epoch before it. What is learned lasts for seconds, not for epochs.
        """
        if before is None:
            return
        for scale, then in zip((self.scale, self.informed_scale), before, strict=True):
            for part in (np.s_[:PHASE], np.s_[PHASE, :PLACE_SQUARES], np.s_[SHADE]):  # places of codes know of time
                scale[part] = then[part] + step_s / FULL_STEP_S * (scale[part] - then[part])

    def forget(self) -> None:
        """Forget integers and predictions; what was learned of the receivers stays."""
        self.prediction[:], self.walk[:] = nan, nan
        forget(self.memory)


class Around(NamedTuple):
    """What an epoch comes with: the base epochs that share no system, ephemerides, the single points of the rover and of a moving base, the
    base's position (ECEF, m), how many satellites rover and base have, the age of the base (s).
    """

    rover: Epoch
    bases: list[Epoch]
    issues: Issues
    singles: tuple[Located, Located | None]
    base_ecef_m: Vector
    satellites: tuple[int, int]
    age_s: float


def at_instant_of(rover: Epoch, single: Located, base: Epoch, base_single: Located, issues: Issues) -> Epoch:
    """Return the epoch of a moving base as if it had been measured, like the rover's, at the instant that the rover's tag names."""
    move_ecef_m = base_move_ecef_m(single, base_single, rover.time - base.time)
    if not move_ecef_m.any():
        return base
    codes_m, phases_cyc = moved_base(base.signals, base_single, issues.channel, move_ecef_m)
    return replace(base, pseudorange_m=codes_m, phase_cyc=phases_cyc)
