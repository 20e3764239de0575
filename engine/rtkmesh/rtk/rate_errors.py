"""How good velocities by Doppler are, as Dopplers of an epoch agree with each other.

The weights of Dopplers are those of a receiver that nobody knows: 0.1 m/s at the zenith, while geodetic receivers have 0.01 and patch
antennas in streets 0.05. What is published says what this receiver has: chi-square of its range rates by their degrees of freedom,
remembered over epochs and joined with the epoch's own, is the factor of the covariance (variance component estimation; Teunissen and
Amiri-Simkooei 2008). Weights in the filter stay as they are: nothing here moves a position.
"""

from math import isfinite
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.single_adjustment import RATE_CHI2, RATE_FREEDOM
from rtkmesh.rtk.around import FULL_STEP_S

PRIOR_DOF: Final = 2.0  # at a factor of 1: an epoch says more
MEMORY_DOF: Final = 200.0  # half a minute under open sky
EPOCH_PRIOR_DOF: Final = 12.0  # of the remembered factor against the epoch's own: streets change within seconds


class RateErrors:
    """What the Dopplers of one receiver have shown so far. Mutable."""

    def __init__(self) -> None:
        self._squares = self._freedom = PRIOR_DOF
        self._time: GpsTime | None = None
        self.factor = 1.0  # of the newest epoch's ``velocity_cov_m2ps2``

    def copy(self) -> "RateErrors":
        """Return what is known of the same receiver, to be learned from by somebody else."""
        other = RateErrors()
        other._squares, other._freedom, other._time, other.factor = self._squares, self._freedom, self._time, self.factor
        return other

    def learn(self, time: GpsTime, quality: NDArray[np.float64]) -> None:
        """Take in an epoch's Dopplers, as its single point's ``quality`` tells of them; without velocity the factor says nothing."""
        squares, freedom = quality.item(RATE_CHI2), quality.item(RATE_FREEDOM)
        if not isfinite(squares):
            self.factor = 1.0
            return
        step_s = FULL_STEP_S if self._time is None else abs(time - self._time)
        remembered = self._squares / self._freedom
        own = (EPOCH_PRIOR_DOF * remembered + squares) / (EPOCH_PRIOR_DOF + freedom)
        counted = max(1.0, squares / freedom) if freedom > 0.0 else 1.0  # the covariance has it already
        self.factor, self._time = own / counted, time
        self._remember(squares, freedom, min(step_s / FULL_STEP_S, 1.0))

    def _remember(self, squares: float, freedom: float, share: float) -> None:
        self._squares, self._freedom = self._squares + share * squares, self._freedom + share * freedom
        fade = min(MEMORY_DOF / self._freedom, 1.0)
        self._squares, self._freedom = fade * self._squares, fade * self._freedom
