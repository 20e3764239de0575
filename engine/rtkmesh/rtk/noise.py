"""How much an observation is worth: variances of single differences."""

from math import sin
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.gnss.signals import SYSTEMS

Vector = NDArray[np.float64]

CN0_KNEE_DBHZ: Final = 34.0  # where thermal noise and obstructions double the variance of an open-sky signal
UNALIGNED_CODE_M: Final = 0.6  # two codes of one band: differential code biases of the satellites (IGS DCB products: 0.3 to 1 m) stay in
CLOCK_DRIFT_MPS: Final = 1.5e-3  # satellite clock over the age of a base epoch: 5e-12 s/s (caesium of GPS IIF; rubidium is 5 times better)
IONOSPHERE_PPM: Final = 0.5e-6  # ionospheric gradient that stays in where it is no state
SCALE_PRIOR_DOF: Final = 3.0  # how many residuals the default code sigma is worth against the measured ones
SCALE_MEMORY_DOF: Final = 400.0  # how many are remembered: some tens of seconds at 1 Hz, code multipath lasts as long
SCALE_RANGE: Final = (0.02, 30.0)  # variance factors: survey antennas (0.15 m) to patches between trees (5 m)


@kernel
def elevation_variance(a_m: float, b_m: float, elevation_rad: float) -> float:
    """Return a^2 + (b / sin elevation)^2 (Eueler and Goad 1991 in the form that RTKLIB made common)."""
    s = max(sin(elevation_rad), 0.05)
    return a_m * a_m + b_m * b_m / (s * s)


@kernel
def cn0_factor(cn0_dbhz: float) -> float:
    """Return the factor of the variance for a carrier to noise density ratio (1 where it is not known).

    Thermal noise goes with 10^(-C/N0 / 10) (Langley 1997); below the knee it outgrows what the elevation model holds.
    """
    if not cn0_dbhz > 0.0:
        return 1.0
    return 1.0 + 10.0 ** (-0.1 * (cn0_dbhz - CN0_KNEE_DBHZ))


class CodeScale:
    """The variance factor of pseudoranges per system, learned from residuals: one default cannot suit survey antennas and patches.

    The estimate is the posterior mean of a scaled inverse chi-square with ``SCALE_PRIOR_DOF`` degrees of freedom at 1.
    """

    def __init__(self) -> None:
        self._squares = np.zeros(len(SYSTEMS))
        self._dof = np.zeros(len(SYSTEMS))

    def factors(self) -> Vector:
        """Return the variance factor per system."""
        raw = (SCALE_PRIOR_DOF + self._squares) / (SCALE_PRIOR_DOF + self._dof)
        return _within_range(raw)

    def learn(self, squares: Vector, dof: Vector) -> None:
        """Take in the sums of squared normalised residuals (for a factor of 1) and their degrees of freedom, per system."""
        self._squares += squares
        self._dof += dof
        shrink = np.minimum(1.0, SCALE_MEMORY_DOF / np.maximum(self._dof, 1.0))
        self._squares *= shrink
        self._dof *= shrink

    def trial(self, squares: Vector, dof: Vector) -> Vector:
        """Return what the factors would be after ``learn``."""
        raw = (SCALE_PRIOR_DOF + self._squares + squares) / (SCALE_PRIOR_DOF + self._dof + dof)
        return _within_range(raw)


def _within_range(factors: Vector) -> Vector:
    return np.minimum(np.maximum(factors, SCALE_RANGE[0]), SCALE_RANGE[1])
